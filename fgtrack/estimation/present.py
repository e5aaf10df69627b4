"""The states that a bank gives for the present."""

from fgtrack.core.types import FloatArray, TrackState
from fgtrack.estimation.propagation import wrapped_yaw
from fgtrack.models.motion import MotionModel

__all__ = ["PresentStates"]


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
        means, self.covariances = motion.kinematic(means, covariances)
        self.means = wrapped_yaw(means)
        rows = zip(self.means, self.covariances, strict=True)
        super().__init__([TrackState(stamp_ns, mean, covariance) for mean, covariance in rows])
