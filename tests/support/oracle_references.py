"""What the oracle makes of a stream, by the equations that an estimator solves."""

from collections.abc import Callable, Mapping
from typing import Any

from support.oracle.filters import filtered
from support.oracle.problem import Estimate
from support.oracle_streams import Stream

from fgtrack.estimation.base import Estimator
from fgtrack.estimation.registry import ESTIMATORS, start_estimator

Reference = Callable[[int], Estimate]
"""The state at a stamp."""

#: A window that keeps everything, and thresholds at which a smoother relinearises at every move.
_CONVERGED = {
    "ring_s": 10.0,
    "relinearise": {"yaw_rad": 1e-7, "speed_mps": 1e-7, "yaw_rate_radps": 1e-7, "accel_mps2": 1e-7},
}
_OPTIONS: Mapping[str, Mapping[str, Any]] = {
    "smoother": {**_CONVERGED, "max_iterations": 20},
    "smoother-batch": _CONVERGED,
    "smoother-banded": {**_CONVERGED, "max_iterations": 20},
}


def start(name: str, stream: Stream) -> Estimator:
    """The estimator `name` for the object of `stream`, with settings by which it solves its equations to rounding."""
    factory = ESTIMATORS.load(name)
    return start_estimator(name, factory, stream.motion, stream.prior, stream.lag_s, _OPTIONS.get(name, {}))


def reference(name: str, stream: Stream) -> Reference:
    """The oracle's solution of the equations of the estimator `name`."""
    if name.startswith("smoother"):
        return stream.solution.state_at
    return filtered(stream.problem).state_at
