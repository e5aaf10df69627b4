"""The kinematic states that a bank gives: those of the present, and smoothed ones."""

from collections.abc import Iterable, Sequence

import numpy as np

from fgtrack.core.types import FloatArray, SmoothedReport, TrackState
from fgtrack.estimation.filters.propagation import wrapped_yaw
from fgtrack.models.motion import MotionModel

__all__ = ["PresentStates", "final_reports", "smoothed_reports"]


class PresentStates(list[TrackState]):
    """Kinematic states of several tracks at one stamp, and the arrays that they are views of.

    Parameters
    ----------
    motion
        The motion model.
    stamp_ns
        Their stamp.
    means, covariances
        In the model's own form, shapes (m, n) and (m, n, n).
    """

    def __init__(self, motion: MotionModel, stamp_ns: int, means: FloatArray, covariances: FloatArray) -> None:
        self.means, self.covariances = _kinematic(motion, means, covariances)
        rows = zip(self.means, self.covariances, strict=True)
        super().__init__([TrackState(stamp_ns, mean, covariance) for mean, covariance in rows])


def smoothed_reports(
    motion: MotionModel,
    track_ids: Iterable[int],
    stamps_ns: Iterable[int],
    means: FloatArray,
    covariances: FloatArray,
    lag_s: float | None = None,
) -> list[SmoothedReport]:
    """Reports of m states of `motion`, shapes (m, n) and (m, n, n): final ones, or those `lag_s` before the present."""
    rows = zip(track_ids, stamps_ns, *_kinematic(motion, means, covariances), strict=True)
    return [SmoothedReport(track_id, TrackState(stamp_ns, x, P), lag_s) for track_id, stamp_ns, x, P in rows]


def final_reports(motion: MotionModel, states: Sequence[tuple[int, TrackState]]) -> list[SmoothedReport]:
    """Reports of final states in the form of `motion`, each with its track."""
    if not states:
        return []
    track_ids, final = zip(*states, strict=True)
    means, covariances = np.array([each.mean for each in final]), np.array([each.covariance for each in final])
    return smoothed_reports(motion, track_ids, [each.stamp_ns for each in final], means, covariances)


def _kinematic(motion: MotionModel, means: FloatArray, covariances: FloatArray) -> tuple[FloatArray, FloatArray]:
    means, covariances = motion.kinematic(means, covariances)
    return wrapped_yaw(means), covariances
