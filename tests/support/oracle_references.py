"""What the oracle makes of a stream, by the equations that an estimator solves."""

from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any

from support.oracle.filters import filtered
from support.oracle.linearised import AVERAGES, TANGENTS
from support.oracle.mixture import mixed
from support.oracle.problem import Estimate
from support.oracle_streams import Stream

from fgtrack.estimation.base import Estimator
from fgtrack.estimation.registry import ESTIMATORS, start_estimator
from fgtrack.models.motion import CTRA, CTRV

Reference = Callable[[int], Estimate]
"""The state at a stamp."""

_STAY_S = 3.0, 2.0
_ACCEL_DENSITY_M2PS5 = 0.5
#: A window that keeps everything, and thresholds at which a smoother relinearises at every move.
_CONVERGED = {
    "ring_s": 10.0,
    "relinearise": {"yaw_rad": 1e-7, "speed_mps": 1e-7, "yaw_rate_radps": 1e-7, "accel_mps2": 1e-7},
}
_OPTIONS: Mapping[str, Mapping[str, Any]] = {
    "smoother": {**_CONVERGED, "max_iterations": 20},
    "smoother-batch": _CONVERGED,
    "smoother-banded": {**_CONVERGED, "max_iterations": 20},
    "iekf-replay": {"max_iterations": 100, "tolerance": 1e-10},
    "iplf-replay": {"max_iterations": 100, "tolerance": 1e-10},
    "imm-replay": {"stay_s": _STAY_S[0], "other_stay_s": _STAY_S[1], "accel_density_m2ps5": _ACCEL_DENSITY_M2PS5},
}


def start(name: str, stream: Stream) -> Estimator:
    """The estimator `name` for the object of `stream`, with settings by which it solves its equations to rounding."""
    factory = ESTIMATORS.load(name)
    return start_estimator(name, factory, stream.motion, stream.prior, stream.lag_s, _OPTIONS.get(name, {}))


def reference(name: str, stream: Stream) -> Reference:
    """The oracle's solution of the equations of the estimator `name`."""
    if name.startswith("smoother"):
        return stream.solution.state_at
    if name == "imm-replay":
        return _imm(stream)
    linearisation = AVERAGES if name in ("ukf-replay", "iplf-replay") else TANGENTS
    return filtered(stream.problem, linearisation, iterated=name in ("iekf-replay", "iplf-replay")).state_at


def _imm(stream: Stream) -> Reference:
    """CTRV beside CTRA, or the other way round, with the noise that they share."""
    own = stream.motion
    assert isinstance(own, CTRV)
    noise = {name: getattr(own, name) for name in asdict(CTRV())}
    beside = CTRV(**noise) if isinstance(own, CTRA) else CTRA(**noise, accel_density_m2ps5=_ACCEL_DENSITY_M2PS5)
    unknown = CTRA().start_variance("accel_mps2")
    return mixed((stream.problem, stream.problem_of(beside)), _STAY_S, unknown).state_at
