import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.tracking import START_NS, ms

from fgtrack.core.types import EgoState
from fgtrack.tracking.ego import EgoSource, EgoTrajectory
from fgtrack.tracking.published import PublishedEgo


def ego(stamp_ms: float, x_m: float = 0.0, yaw_rad: float = 0.0, speed_mps: float = 10.0, **more) -> EgoState:
    return EgoState(START_NS + ms(stamp_ms), START_NS + ms(stamp_ms), x_m, 0.0, yaw_rad, speed_mps, **more)


def trajectory(yaw_weight: float = 1.0, yaw_rate_weight: float = 1.0, memory_s: float = 5.0) -> EgoTrajectory:
    return EgoTrajectory(yaw_weight, yaw_rate_weight, memory_s, max_extrapolation_s=1.0)


def pose(source: EgoSource, stamp_ms: float):
    return source.pose_at(START_NS + ms(stamp_ms), START_NS)


# --- the clean trajectory


def test_between_two_states_the_pose_is_interpolated_the_short_way_round() -> None:
    source = trajectory()
    source.receive(EgoState(START_NS, START_NS, 10.0, 2.0, 3.1, 20.0, 0.1))
    source.receive(EgoState(START_NS + ms(100), START_NS, 14.0, 4.0, -3.1, 40.0, 0.5))
    found = pose(source, 25.0)
    turned = 2 * math.pi - 6.2
    assert (found.x_m, found.y_m, found.speed_mps) == pytest.approx((11.0, 2.5, 25.0))
    assert found.yaw_rad == pytest.approx(3.1 + 0.25 * turned)
    assert found.yaw_rate_radps == pytest.approx(0.2)
    assert pose(source, 100.0).x_m == 14.0
    assert pose(source, 0.0).x_m == 10.0


@pytest.mark.parametrize(("stamp_ms", "x_m"), [(1100, 20.0), (1100.000001, None), (-1000, -10.0), (-1000.000001, None)])
def test_beyond_its_ends_the_trajectory_goes_straight_on_for_a_limited_time(stamp_ms: float, x_m: float | None) -> None:
    source = trajectory()
    source.receive(ego(0.0))
    source.receive(ego(100.0, x_m=10.0, yaw_rate_radps=0.5))
    found = pose(source, stamp_ms)
    if x_m is None:
        assert found is None
    else:
        assert found.x_m == pytest.approx(x_m)
        assert found.yaw_rad == pytest.approx(0.5 if stamp_ms > 0 else 0.0)
        assert found.yaw_rate_radps == (0.5 if stamp_ms > 0 else 0.0)


def test_without_any_state_there_is_no_pose() -> None:
    assert pose(trajectory(), 0.0) is None
    assert trajectory().current is None


@given(order=st.permutations(range(6)))
def test_states_that_come_out_of_order_stand_in_order(order: list[int]) -> None:
    source = trajectory()
    for k in order:
        assert source.receive(ego(20.0 * k, x_m=float(k * k))) is None
    for k in range(5):
        assert pose(source, 20.0 * k + 10.0).x_m == pytest.approx((k * k + (k + 1) ** 2) / 2)
    assert source.current.x_m == 25.0


def test_a_repeated_stamp_and_what_is_no_number_are_refused_with_the_reason() -> None:
    source = trajectory()
    source.receive(ego(0.0, x_m=1.0))
    assert source.receive(ego(0.0, x_m=2.0)) == "repeated stamp"
    for name in ("x_m", "y_m", "yaw_rad", "speed_mps", "yaw_rate_radps", "accel_mps2"):
        for value in (math.nan, math.inf, 1e300):
            assert source.receive(replace(ego(10.0), **{name: value})) == "not finite"
    assert source.current.x_m == 1.0


def test_a_low_pass_does_not_lag_in_a_steady_turn() -> None:
    source = trajectory(yaw_weight=0.3, yaw_rate_weight=0.4)
    for k in range(200):
        source.receive(ego(10.0 * k, yaw_rad=math.remainder(0.005 * k, 2 * math.pi), yaw_rate_radps=0.5))
        assert source.current.yaw_rad == pytest.approx(math.remainder(0.005 * k, 2 * math.pi), abs=1e-9)


def test_a_low_pass_takes_its_share_of_the_new_value_once() -> None:
    source = trajectory(yaw_weight=0.9, yaw_rate_weight=0.4)
    source.receive(ego(0.0, yaw_rad=0.0, yaw_rate_radps=0.0))
    source.receive(ego(10.0, yaw_rad=1.0, yaw_rate_radps=1.0))
    for _ in range(3):
        source.start_tick()
    assert (source.current.yaw_rad, source.current.yaw_rate_radps) == pytest.approx((0.9, 0.4))
    source.receive(ego(20.0, yaw_rad=1.0, yaw_rate_radps=1.0))
    assert source.current.yaw_rad == pytest.approx(0.904 + 0.9 * (1.0 - 0.904))
    assert source.current.yaw_rate_radps == pytest.approx(0.4 + 0.4 * 0.6)


def test_the_low_pass_wraps() -> None:
    source = trajectory(yaw_weight=0.75)
    source.receive(ego(0.0, yaw_rad=math.pi - 0.1))
    source.receive(ego(10.0, yaw_rad=-math.pi + 0.1))
    assert source.current.yaw_rad == pytest.approx(-math.pi + 0.05)
    assert (source.current.x_m, source.current.speed_mps) == (0.0, 10.0)


def test_the_memory_keeps_what_it_promises_and_not_much_more() -> None:
    source = trajectory(memory_s=0.5)
    for k in range(1000):
        source.receive(ego(10.0 * k, x_m=float(k)))
    assert pose(source, 9990.0 - 500.0).x_m == pytest.approx(949.0)
    assert pose(source, 7500.0) is None
    assert len(source._states) < 200


@pytest.mark.parametrize("source", [trajectory(), PublishedEgo(0.9, 0.4, ms(10), 350)])
def test_the_pit_lane_is_remembered_until_the_source_says_otherwise(source: EgoSource) -> None:
    said = []
    for k, in_pit in enumerate([None, True, None, False, None]):
        source.receive(ego(10.0 * k, in_pit=in_pit))
        said.append(source.in_pit)
    assert said == [False, True, True, False, False]


# --- the published storage


def test_the_published_low_pass_filters_its_own_output_again_at_every_tick() -> None:
    source = PublishedEgo(0.9, 0.4, ms(10), 350)
    source.receive(ego(0.0, yaw_rad=0.0))
    source.start_tick()
    source.receive(ego(10.0, yaw_rad=1.0, yaw_rate_radps=1.0))
    for k in range(1, 4):
        source.start_tick()
        assert source.current.yaw_rad == pytest.approx(0.9**k)
        assert source.current.yaw_rate_radps == pytest.approx(0.4**k)


def test_the_published_pose_is_from_the_nearest_entry_and_of_two_the_newer() -> None:
    source = PublishedEgo(1.0, 1.0, ms(10), 350)
    for k in range(3):
        source.receive(ego(20.0 * k, x_m=100.0 * k, speed_mps=10.0))
        source.start_tick()
    present_ns = START_NS + ms(40)

    def x_at(stamp_ms: float) -> float:
        return source.pose_at(START_NS + ms(stamp_ms), present_ns).x_m

    assert x_at(30.0) == pytest.approx(200.0 - 0.1)
    assert x_at(29.9) == pytest.approx(100.0 + 0.099)
    assert x_at(-5000.0) == pytest.approx(-50.0)  # however far away


def test_the_published_pose_without_delay_is_from_the_newest_message_even_before_it_is_stored() -> None:
    source = PublishedEgo(1.0, 1.0, ms(10), 350)
    source.receive(ego(0.0, x_m=1.0))
    source.start_tick()
    source.receive(ego(20.0, x_m=9.0, speed_mps=0.0))
    half_step_ns = START_NS + ms(15)
    assert source.pose_at(half_step_ns, START_NS + ms(20)).x_m == 9.0
    assert source.pose_at(half_step_ns - 1, START_NS + ms(20)).x_m == pytest.approx(1.15)


def test_the_published_ego_refuses_repeated_stamps_only_of_the_newest() -> None:
    source = PublishedEgo(1.0, 1.0, ms(10), 3)
    assert source.pose_at(START_NS, START_NS) is None
    assert source.receive(ego(10.0)) is None
    assert source.receive(ego(10.0)) == "repeated stamp"
    assert source.receive(ego(20.0, x_m=math.nan)) == "not finite"
    assert source.receive(ego(0.0)) is None
    assert source.current.stamp_ns == START_NS


def test_the_published_storage_has_a_length_in_ticks() -> None:
    source = PublishedEgo(1.0, 1.0, ms(10), 3)
    for k in range(6):
        source.receive(ego(20.0 * k, x_m=float(k), speed_mps=0.0))
        source.start_tick()
    assert source.pose_at(START_NS, START_NS + ms(100)).x_m == 3.0
