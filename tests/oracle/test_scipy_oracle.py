"""Every exact estimator against a calculation with SciPy that shares no code with it, in random orders of arrival."""

from collections.abc import Callable, Mapping
from functools import cache
from itertools import product
from typing import Any

import numpy as np
import pytest
from support import oracle_streams as streams
from support.oracle import filtered
from support.oracle_streams import Stream

from fgtrack.core.types import TrackState
from fgtrack.estimation.base import Estimator
from fgtrack.estimation.registry import ESTIMATORS, start_estimator
from fgtrack.testing.references import dense_joint, difference

Draw = Callable[[np.random.Generator], Stream]
SMOOTHERS = ("smoother", "smoother-banded", "smoother-batch")
AHEAD_NS = 100_000_000
#: Once converged, and where what has left the window keeps its linearisation: more the shorter the window.
SMOOTHED: dict[Draw, float] = {
    streams.whole: 1e-5,
    streams.observed: 1e-5,
    streams.robust: 1e-5,
    streams.accelerated: 1e-5,
    streams.leaving: 5e-3,
}
#: A window that keeps everything, and thresholds at which a smoother relinearises at every move.
CONVERGED = {
    "ring_s": 10.0,
    "relinearise": {
        "yaw_rad": 1e-7,
        "speed_mps": 1e-7,
        "yaw_rate_radps": 1e-7,
        "accel_mps2": 1e-7,
    },
}
OPTIONS: Mapping[str, Mapping[str, Any]] = {
    "smoother": {**CONVERGED, "max_iterations": 20},
    "smoother-batch": CONVERGED,
    "smoother-banded": {**CONVERGED, "max_iterations": 20},
}


@cache
def drawn(draw: Draw) -> Stream:
    return draw(np.random.default_rng(1))


def start(name: str, stream: Stream) -> Estimator:
    """The estimator `name`, with settings by which it solves its equations to rounding."""
    factory = ESTIMATORS.load(name)
    return start_estimator(
        name, factory, stream.motion, stream.prior, stream.lag_s, OPTIONS.get(name, {})
    )


def fed(estimator: Estimator, stream: Stream) -> Estimator:
    """`estimator` after all of `stream`, every measurement fused, converged where it has to be asked for that."""
    for place in stream.order:
        assert estimator.update(stream.measurements[place]).innovation is not None
    converge = getattr(getattr(estimator, "bank", None), "converge", None)
    if converge is not None:
        converge(100)
    return estimator


def largest(differences: list[tuple[float, float]]) -> float:
    """A NaN wins."""
    return float(np.max(differences))


def apart(name: str, draw: Draw) -> float:
    stream = drawn(draw)
    found, expected = (
        fed(start(name, stream), stream),
        filtered(stream.problem).state_at,
    )
    stamps = [stream.newest_ns, stream.newest_ns + AHEAD_NS]
    if name in SMOOTHERS:
        expected, stamps = stream.solution.state_at, [*stream.probes_ns(), *stamps]
    return largest(
        [
            difference(found.state_at(at), TrackState(at, *expected(at)), stream.motion)
            for at in stamps
        ]
    )


def test_the_dense_joint_of_a_linear_model_is_that_of_scipy() -> None:
    stream = drawn(streams.linear)
    stamps = [*stream.probes_ns(), stream.newest_ns, stream.newest_ns + AHEAD_NS]
    joint = dense_joint(stream.motion, stream.prior, stream.measurements, stamps)
    expected = stream.solution.state_at
    assert (
        largest([difference(joint[at], TrackState(at, *expected(at))) for at in stamps])
        < 1e-7
    )


@pytest.mark.parametrize(
    ("name", "draw"),
    [
        *product(SMOOTHERS[:2], SMOOTHED),
        *product(SMOOTHERS[2:], (streams.observed, streams.robust)),
    ],
)
def test_a_converged_smoother_solves_least_squares(name: str, draw: Draw) -> None:
    assert apart(name, draw) < SMOOTHED[draw]


@pytest.mark.parametrize("draw", SMOOTHED)
def test_the_replaying_filter_is_the_extended_kalman_filter(draw: Draw) -> None:
    assert apart("ekf-replay", draw) < 1e-7
