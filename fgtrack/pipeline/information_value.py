"""The information of a late detection about the present."""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from fgtrack.core.time import seconds
from fgtrack.core.types import FloatArray, TrackState
from fgtrack.estimation.base import Estimator, Measurement, UpdateStatus


@dataclass(frozen=True, slots=True)
class ReceivedMeasurement:
    """A measurement that is known to be of the object, and when it arrives."""

    sensor: str
    receipt_ns: int
    measurement: Measurement


@dataclass(frozen=True, slots=True)
class InformationValue:
    """The information of one measurement about the state at its receipt."""

    sensor: str
    stamp_ns: int
    receipt_ns: int
    status: UpdateStatus
    gain_nats: float
    """0.5 log(det P before / det P after); 0 of a measurement that was dropped, below 0 where the method forgets
    more than it learns."""
    error_change_m: float | None
    """Position error after minus before, below 0 where the position got better; None where truth is unknown."""

    @property
    def delay_s(self) -> float:
        """Receipt minus stamp."""
        return seconds(self.receipt_ns - self.stamp_ns)


def information_values(
    estimator: Estimator,
    arrivals: Iterable[ReceivedMeasurement],
    true_position: Callable[[int], FloatArray | None] | None = None,
) -> Iterator[InformationValue]:
    """Feed `arrivals`, in order of receipt, to `estimator`; the value of each for the present, its receipt.

    The gain is in the whole state. In a linear model with an exact method it is the mutual information of the
    measurement and the present state given all that had arrived before. An error may well change for the worse by
    chance; its mean over many detections counts.

    Parameters
    ----------
    true_position
        True x and y at a stamp, shape (2,), None where unknown.
    """
    for arrival in arrivals:
        now_ns = arrival.receipt_ns
        estimator.advance(now_ns)
        position = None if true_position is None else true_position(now_ns)
        log_det_before, error_before_m = _spread_and_error(estimator.state_at(now_ns), position)
        status = estimator.update(arrival.measurement).status
        log_det, error_m = _spread_and_error(estimator.state_at(now_ns), position)
        yield InformationValue(
            arrival.sensor,
            arrival.measurement.stamp_ns,
            now_ns,
            status,
            0.5 * (log_det_before - log_det),
            None if position is None else error_m - error_before_m,
        )


def _spread_and_error(state: TrackState, position: FloatArray | None) -> tuple[float, float]:
    """Logarithm of the determinant of the covariance, and the distance from `position`, NaN where unknown."""
    error_m = math.nan if position is None else float(np.linalg.norm(state.mean[:2] - position))
    return float(np.linalg.slogdet(state.covariance).logabsdet), error_m
