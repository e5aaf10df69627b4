"""What the oracle makes of a stream, by the equations that an estimator says it solves."""

from collections.abc import Callable, Mapping
from dataclasses import asdict
from types import MappingProxyType
from typing import Any

from fgtrack.models.motion import CTRA, CTRV
from fgtrack.pipeline.oracle.filters import filtered
from fgtrack.pipeline.oracle.linearised import AVERAGES, TANGENTS
from fgtrack.pipeline.oracle.mixture import mixed
from fgtrack.pipeline.oracle.problem import Estimate
from fgtrack.pipeline.verify_streams import Stream

#: The state at a stamp; None where the equations do not say it.
Reference = Callable[[int], Estimate | None]

_STAY_S = 3.0, 2.0
_ACCEL_DENSITY_M2PS5 = 0.5
_RING_S = 10.0
#: Thresholds at which a smoother follows every move, so that it converges to rounding.
_TINY = MappingProxyType({"yaw_rad": 1e-7, "speed_mps": 1e-7, "yaw_rate_radps": 1e-7, "accel_mps2": 1e-7})

#: Without a promise at other settings: a ring as long as the stream, small thresholds, iterations that end at rounding.
DEFAULTS_IN_A_RING: Mapping[str, Any] = {"ring_s": _RING_S}
OPTIONS: Mapping[str, Mapping[str, Any]] = {
    "smoother": {"ring_s": _RING_S, "relinearise": _TINY, "max_iterations": 20},
    "smoother-batch": {"ring_s": _RING_S, "relinearise": _TINY},
    "smoother-banded": {"ring_s": _RING_S, "relinearise": _TINY, "max_iterations": 20},
    "iekf-replay": {"max_iterations": 100, "tolerance": 1e-10},
    "iplf-replay": {"max_iterations": 100, "tolerance": 1e-10},
    "imm-replay": {
        "stay_s": _STAY_S[0],
        "other_stay_s": _STAY_S[1],
        "accel_density_m2ps5": _ACCEL_DENSITY_M2PS5,
    },
}


def reference(stream: Stream, solves: str) -> Reference | None:
    """The oracle's solution of the equations `solves` (see `Claims.solves`); None of a name that says nothing."""
    if solves not in _EQUATIONS:
        return None
    if solves not in stream.references:
        stream.references[solves] = _EQUATIONS[solves](stream)
    found: Reference = stream.references[solves]
    return found


def _imm(stream: Stream) -> Reference:
    """Of CTRV beside CTRA, or the other way round, with the noise that they share."""
    own = stream.motion
    assert isinstance(own, CTRV)
    noise = {name: getattr(own, name) for name in asdict(CTRV())}
    beside = CTRV(**noise) if isinstance(own, CTRA) else CTRA(**noise, accel_density_m2ps5=_ACCEL_DENSITY_M2PS5)
    unknown = CTRA().start_variance("accel_mps2")
    return mixed((stream.problem, stream.problem_of(beside)), _STAY_S, unknown).state_at


_EQUATIONS: Mapping[str, Callable[[Stream], Reference]] = {
    "ekf": lambda stream: filtered(stream.problem, TANGENTS).state_at,
    "iekf": lambda stream: filtered(stream.problem, TANGENTS, iterated=True).state_at,
    "ukf": lambda stream: filtered(stream.problem, AVERAGES).state_at,
    "iplf": lambda stream: filtered(stream.problem, AVERAGES, iterated=True).state_at,
    "imm": _imm,
    "least squares": lambda stream: stream.solution.state_at,
}
