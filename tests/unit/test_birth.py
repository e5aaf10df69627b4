from dataclasses import replace

import numpy as np
import pytest
from support.tracking import START_NS, StraightRoad, bearing, ms

from fgtrack.core.geometry import rotation
from fgtrack.core.types import EgoState
from fgtrack.estimation.base import Measurement, Start, StatesAt
from fgtrack.estimation.birth import initial_state
from fgtrack.models.measurement import SensorPose, measurement_model
from fgtrack.models.motion import CTRV
from fgtrack.models.road import Road
from fgtrack.tracking.birth import Birth, in_any_direction
from fgtrack.tracking.preprocess import Candidate

EGO = EgoState(START_NS, START_NS, 0.0, 0.0, 0.0, speed_mps=50.0, accel_mps2=-2.0)
ROAD = StraightRoad(yaw_rad=0.4, curvature_radpm=0.01)
POSITION_COVARIANCE = np.array([[0.5, 0.1], [0.1, 0.3]])


def seen(**values: float) -> Candidate:
    """A candidate at (3, 4) with these further components, of standard deviation 0.7."""
    components = {"x_m": 3.0, "y_m": 4.0, **values}
    R = np.diag([0.49] * len(components))
    R[:2, :2] = POSITION_COVARIANCE
    z = np.array(list(components.values()))
    measurement = Measurement(
        START_NS, measurement_model(tuple(components), CTRV()), z, R
    )
    return Candidate(0, (), measurement, z[:2], R[:2, :2])


@pytest.mark.parametrize("kind", ["fixed", "measured"])
def test_what_is_not_measured_comes_from_the_map_and_the_ego(kind) -> None:
    prior = Birth(kind=kind, ego_speed_factor=0.8, speed_std_mps=2.0).prior(
        seen(), ROAD, EGO, ego_in_pit=False
    )
    assert prior.stamp_ns == START_NS
    assert tuple(prior.position_m) == (3.0, 4.0)
    assert prior.yaw_rad == 0.4
    assert prior.speed_mps == pytest.approx(0.8 * 50.0)
    assert prior.yaw_rate_radps == pytest.approx(40.0 * 0.01)
    assert prior.accel_mps2 == 0.0
    assert (prior.yaw_std_rad, prior.speed_std_mps) == (0.5, 2.0)
    assert Birth(kind=kind).prior(seen(), ROAD, EGO, ego_in_pit=False).speed_mps == 0.0


def test_a_position_of_unknown_heading_is_as_uncertain_across_as_along() -> None:
    start = Birth(speed_std_mps=50.0).prior(seen(), Road(), None, ego_in_pit=False)
    motion, dt_s = CTRV(), 0.5
    x, P = initial_state(motion, start)
    F = motion.jacobian(x, dt_s)
    ahead = StatesAt(
        (3, 4), np.stack([motion.predict(x, dt_s)] * 2), np.stack([F @ P @ F.T] * 2)
    )
    found = in_any_direction(ahead, START_NS + ms(1e3 * dt_s), {4: start})
    assert (found.covariances[0] == ahead.covariances[0]).all()
    assert found.covariances[1, :2, :2] == pytest.approx(
        POSITION_COVARIANCE + 25.0**2 * np.eye(2)
    )


def test_a_measured_component_starts_with_its_own_deviation_or_a_fixed_one() -> None:
    candidate = seen(yaw_rad=1.0, speed_mps=20.0)
    measured = Birth().prior(candidate, ROAD, EGO, ego_in_pit=False)
    assert (measured.yaw_std_rad, measured.speed_std_mps) == pytest.approx((0.7, 0.7))
    assert measured.position_covariance == pytest.approx(POSITION_COVARIANCE)
    assert measured.yaw_rate_radps == pytest.approx(20.0 * 0.01)
    fixed = Birth(kind="fixed", along_std_m=2.0, across_std_m=0.5).prior(
        candidate, ROAD, EGO, ego_in_pit=False
    )
    assert (fixed.yaw_std_rad, fixed.speed_std_mps) == (0.5, 100.0)
    assert (
        (fixed.yaw_rad, fixed.speed_mps)
        == (measured.yaw_rad, measured.speed_mps)
        == (1.0, 20.0)
    )
    turn = rotation(1.0)
    assert fixed.position_covariance == pytest.approx(
        turn @ np.diag([4.0, 0.25]) @ turn.T
    )


@pytest.mark.parametrize(("ego", "in_pit"), [(None, False), (EGO, True)])
def test_without_an_ego_on_the_track_an_object_is_assumed_to_stand(
    ego: EgoState | None, in_pit: bool
) -> None:
    prior = Birth(kind="fixed", ego_speed_factor=0.8).prior(
        seen(), ROAD, ego, ego_in_pit=in_pit
    )
    assert (prior.speed_mps, prior.yaw_rate_radps, prior.accel_mps2) == (0.0, 0.0, 0.0)


def test_a_slow_ego_lends_its_acceleration() -> None:
    for speed_mps, accel_mps2 in [(9.9, -2.0), (10.0, 0.0)]:
        prior = Birth(kind="fixed", slow_ego_mps=10.0).prior(
            seen(), ROAD, replace(EGO, speed_mps=speed_mps), ego_in_pit=False
        )
        assert prior.accel_mps2 == accel_mps2


def test_without_a_map_the_heading_is_unknown_and_the_road_straight() -> None:
    prior = Birth(kind="fixed").prior(seen(), Road(), EGO, ego_in_pit=False)
    assert prior.yaw_rad is None
    assert prior.yaw_rate_radps == 0.0
    assert (
        Birth(kind="fixed")
        .prior(seen(yaw_rad=0.3), Road(), EGO, ego_in_pit=False)
        .yaw_rad
        == 0.3
    )


def test_a_bearing_alone_starts_nothing() -> None:
    assert (
        Birth(kind="fixed").prior(
            bearing(0.1, SensorPose()), ROAD, EGO, ego_in_pit=False
        )
        is None
    )


@pytest.mark.parametrize(
    "name",
    [
        "yaw_std_rad",
        "speed_std_mps",
        "yaw_rate_std_radps",
        "accel_std_mps2",
        "across_std_m",
    ],
)
def test_a_deviation_that_makes_no_sense_is_named(name: str) -> None:
    with pytest.raises(ValueError, match=name):
        Birth(kind="fixed", **{name: 0.0})


@pytest.mark.parametrize(
    ("is_smoothed", "dt_s", "spreads"),
    [(False, 0.4, True), (True, 0.4, False), (False, 0.6, False)],
)
def test_before_its_second_position_a_filtered_state_spreads_in_any_direction(
    is_smoothed: bool, dt_s: float, spreads: bool
) -> None:
    """The second position is 0.5 s after the first one; a smoother has used both."""
    start = Start(stamp_ns=START_NS, speed_std_mps=30.0)
    P = np.diag(
        [0.2 if is_smoothed else 0.1 + (30.0 * dt_s) ** 2, 0.1, 1.0, 900.0, 0.1]
    )
    one = StatesAt((4,), np.zeros((1, 5)), P[None])
    found = in_any_direction(
        one, START_NS + ms(1e3 * dt_s), {}, {4: (start, START_NS + ms(500))}
    )
    assert found.covariances[0, 1, 1] == pytest.approx(
        0.1 + (30.0 * dt_s) ** 2 * spreads
    )
    np.testing.assert_array_equal(found.covariances[0, 0], P[0])
