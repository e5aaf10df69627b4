"""What came first does not matter: measurements of one stamp have an order, and yaws one turn."""

import math
from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest

from fgtrack.core.geometry import wrap_angle
from fgtrack.core.types import YAW, FloatArray, TrackState
from fgtrack.estimation.base import Measurement, Start
from fgtrack.estimation.filters.initiation import Fix, Search
from fgtrack.estimation.registry import ESTIMATORS, estimator
from fgtrack.models.measurement import SensorPose
from fgtrack.models.motion import CTRV, CV
from fgtrack.models.sensors import RobustLoss
from fgtrack.testing.references import difference

MS = 1_000_000
START = Start(
    position_m=(20.0, 5.0),
    yaw_rad=0.4,
    yaw_std_rad=0.3,
    speed_mps=20.0,
    speed_std_mps=5.0,
)
BEARING = Measurement.of(
    50 * MS, bearing_rad=0.5, std={"bearing_rad": 0.05}, pose=SensorPose(-10.0, -12.0)
)
POSITION = Measurement.of(50 * MS, x_m=21.2, y_m=5.1, std={"x_m": 0.4, "y_m": 0.4})

#: Two measurements that have stamp, components and values in common.
ALIKE = {
    "pose": (BEARING, replace(BEARING, pose=SensorPose(-40.0, -28.0))),
    "heading of the sensor": (
        BEARING,
        replace(BEARING, pose=SensorPose(-10.0, -12.0, 0.1)),
    ),
    "covariance": (BEARING, replace(BEARING, R=np.array([[0.2**2]]))),
    "loss": (replace(BEARING, loss=RobustLoss("huber", 0.5)), BEARING),
    "kind of loss": tuple(
        replace(BEARING, loss=RobustLoss(kind, 0.5)) for kind in ("huber", "cauchy")
    ),
    "width of the loss": tuple(
        replace(BEARING, loss=RobustLoss("huber", width)) for width in (0.5, 1.0)
    ),
}


@pytest.mark.parametrize("what", ALIKE)
def test_two_measurements_that_differ_in_anything_have_an_order(what: str) -> None:
    first, second = ALIKE[what]
    assert (first.order < second.order) != (second.order < first.order)
    assert first.order == replace(first, z=first.z.copy()).order


@pytest.mark.parametrize("what", ALIKE)
@pytest.mark.parametrize("name", ["ekf-replay", "ukf-replay"])
def test_equal_values_of_one_stamp_count_the_same_whichever_came_first(
    name: str, what: str
) -> None:
    states = [fed(name, order) for order in permutations((*ALIKE[what], POSITION))]
    assert len({bits(state) for state in states}) == 1


def test_of_two_fixes_in_one_place_at_one_time_the_line_takes_the_same_first() -> None:
    start = Start(position_m=(0.0, 0.0), position_std_m=0.1)
    search = Search.of(CTRV(), start, "regression")
    assert search is not None
    first = Fix(0.0, np.zeros(2), 0.01 * np.eye(2))
    good, bad = (
        Fix(0.1, np.array([1.0, 0.5]), variance * np.eye(2)) for variance in (0.01, 4.0)
    )
    found = [
        search.next_line(lambda order=order: [first, *order], 100 * MS)
        for order in ([good, bad], [bad, good])
    ]
    assert found[0] is not None
    assert found[1] is not None
    for one, other in zip(found[0][0], found[1][0], strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("name", list(ESTIMATORS))
def test_a_yaw_that_is_handed_out_has_one_turn(name: str) -> None:
    start = replace(
        START, position_m=(0.0, 0.0), yaw_rad=3.0, speed_mps=10.0, yaw_rate_radps=1.0
    )
    one = estimator(name, CTRV(), start)
    for k in range(1, 30):
        yaw_rad = 3.0 + 0.1 * k
        x_m, y_m = (
            10.0 * (math.sin(yaw_rad) - math.sin(3.0)),
            -10.0 * (math.cos(yaw_rad) - math.cos(3.0)),
        )
        one.update(
            Measurement.of(100 * k * MS, x_m=x_m, y_m=y_m, std={"x_m": 0.1, "y_m": 0.1})
        )
    newest_ns = one.window_ns[1]
    yaws_rad = [
        one.state_at(newest_ns + ahead * 100 * MS).mean[YAW] for ahead in range(50)
    ]
    assert max(np.abs(yaws_rad)) <= math.pi
    assert min(yaws_rad) < -3.0
    assert wrap_angle(yaws_rad[0] - 3.0 - newest_ns / 1e9) == pytest.approx(
        0.0, abs=0.05
    )


def test_a_comparison_takes_yaws_the_short_way_round() -> None:
    P = 0.01 * np.eye(5)
    one, other = (
        TrackState(0, np.array([0.0, 0.0, yaw_rad, 10.0, 0.0]), P)
        for yaw_rad in (3.14, -3.14)
    )
    assert difference(one, other, CTRV())[0] == pytest.approx(
        (2.0 * math.pi - 6.28) / 0.1
    )
    slow, fast = (
        TrackState(0, np.array([0.0, 0.0, vx_mps, 0.0]), P[:4, :4])
        for vx_mps in (0.0, 2.0 * math.pi)
    )
    assert difference(fast, slow, CV())[0] == pytest.approx(20.0 * math.pi)


def fed(name: str, measurements: tuple[Measurement, ...]) -> TrackState:
    """What an estimator says after `measurements`, a little later."""
    one = estimator(name, CTRV(), START)
    for measurement in measurements:
        one.update(measurement)
    if name.startswith("smoother"):
        one.bank.converge()  # type: ignore[attr-defined]  # that of a smoother
    return one.state_at(60 * MS)


def bits(state: TrackState) -> bytes:
    values: FloatArray = np.concatenate([state.mean, state.covariance.ravel()])
    return values.tobytes()
