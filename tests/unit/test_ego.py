import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.tracking import START_NS, ms

from fgtrack.core.types import EgoState
from fgtrack.karle2023.tracker_parts import PublishedEgo
from fgtrack.tracking.ego.trajectory import EgoStd, EgoTrajectory, extrapolated


def ego(
    stamp_ms: float,
    x_m: float = 0.0,
    yaw_rad: float = 0.0,
    speed_mps: float = 10.0,
    **more,
) -> EgoState:
    return EgoState(
        START_NS + ms(stamp_ms),
        START_NS + ms(stamp_ms),
        x_m,
        0.0,
        yaw_rad,
        speed_mps,
        **more,
    )


def trajectory(
    yaw_weight: float = 1.0, yaw_rate_weight: float = 1.0, memory_s: float = 5.0
) -> EgoTrajectory:
    return EgoTrajectory(yaw_weight, yaw_rate_weight, memory_s=memory_s)


def pose(source: EgoTrajectory, stamp_ms: float):
    return source.pose_at(START_NS + ms(stamp_ms), START_NS)


@pytest.mark.parametrize("source", [trajectory(), PublishedEgo(0.9, 0.4, ms(10), 350)])
def test_a_stray_stamp_is_refused_and_the_next_ones_are_taken(
    source: EgoTrajectory,
) -> None:
    assert source.receive(ego(0.0)) is None
    assert (
        source.receive(replace(ego(60_000.0), receipt_ns=START_NS + ms(10)))
        == "stamp ahead of its receipt"
    )
    assert source.receive(ego(20.0)) is None
    assert (
        source.receive(replace(ego(-60_000.0), receipt_ns=START_NS + ms(30)))
        == "stamp jumps back"
    )
    assert source.receive(ego(40.0, x_m=0.4)) is None
    assert source.current.x_m == 0.4


def test_a_state_that_is_a_little_late_or_early_is_taken() -> None:
    source = trajectory()
    assert source.receive(replace(ego(900.0), receipt_ns=START_NS)) is None
    assert source.receive(replace(ego(-90.0), receipt_ns=START_NS)) is None


def test_a_state_off_the_way_of_an_ego_that_drives_diagonally_is_held_back() -> None:
    source = trajectory()
    for k in range(3):
        state = replace(
            ego(1000.0 * k, 50.0 * k * math.cos(1.0), 1.0, 50.0),
            y_m=50.0 * k * math.sin(1.0),
        )
        assert source.receive(state) is None
        assert source.current.y_m == state.y_m
    assert (
        source.receive(
            replace(state, stamp_ns=state.stamp_ns + ms(100), y_m=state.y_m + 40.0)
        )
        is None
    )
    assert source.current.y_m == state.y_m


def test_a_gap_is_filled_from_its_ends_as_far_as_they_are_extrapolated() -> None:
    source = trajectory(memory_s=60.0)
    source.receive(ego(0.0, x_m=0.0))
    source.receive(ego(5000.0, x_m=1000.0))
    assert pose(source, 900.0).x_m == pytest.approx(9.0)
    assert pose(source, 4100.0).x_m == pytest.approx(991.0)
    assert pose(source, 1100.0) is None
    assert pose(source, 3900.0) is None


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


@pytest.mark.parametrize(
    ("stamp_ms", "x_m"),
    [
        (1100, 10.0 + 20.0 * math.sin(0.5)),
        (1100.000001, None),
        (-1000, -10.0),
        (-1000.000001, None),
    ],
)
def test_beyond_its_ends_the_trajectory_goes_on_for_a_limited_time(
    stamp_ms: float, x_m: float | None
) -> None:
    source = trajectory()
    source.receive(ego(0.0))
    source.receive(ego(100.0, x_m=10.0, yaw_rate_radps=0.5))
    found = pose(source, stamp_ms)
    if x_m is None:
        assert found is None
    else:
        assert found.x_m == pytest.approx(x_m)
        assert found.y_m == pytest.approx(
            20.0 * (1.0 - math.cos(0.5)) if stamp_ms > 0 else 0.0
        )
        assert found.yaw_rad == pytest.approx(0.5 if stamp_ms > 0 else 0.0)
        assert found.yaw_rate_radps == (0.5 if stamp_ms > 0 else 0.0)


def test_without_any_state_there_is_no_pose() -> None:
    assert pose(trajectory(), 0.0) is None
    assert trajectory().current is None


@given(order=st.permutations(range(6)))
def test_states_that_come_out_of_order_stand_in_order(order: list[int]) -> None:
    source = trajectory()
    for k in order:
        assert source.receive(ego(20.0 * k, x_m=0.05 * k * k)) is None
    for k in range(5):
        assert pose(source, 20.0 * k + 10.0).x_m == pytest.approx(
            0.05 * (k * k + (k + 1) ** 2) / 2
        )
    assert source.current.x_m == 1.25


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
        source.receive(
            ego(
                10.0 * k,
                yaw_rad=math.remainder(0.005 * k, 2 * math.pi),
                yaw_rate_radps=0.5,
            )
        )
        assert source.current.yaw_rad == pytest.approx(
            math.remainder(0.005 * k, 2 * math.pi), abs=1e-9
        )


def test_a_low_pass_takes_its_share_of_the_new_value_once() -> None:
    source = trajectory(yaw_weight=0.9, yaw_rate_weight=0.4)
    source.receive(ego(0.0, yaw_rad=0.0, yaw_rate_radps=0.0))
    source.receive(ego(10.0, yaw_rad=1.0, yaw_rate_radps=1.0))
    for _ in range(3):
        source.start_tick()
    assert (source.current.yaw_rad, source.current.yaw_rate_radps) == pytest.approx(
        (0.9, 0.4)
    )
    source.receive(ego(20.0, yaw_rad=1.0, yaw_rate_radps=1.0))
    assert source.current.yaw_rad == pytest.approx(0.904 + 0.9 * (1.0 - 0.904))
    assert source.current.yaw_rate_radps == pytest.approx(0.4 + 0.4 * 0.6)


@given(order=st.permutations(range(6)))
def test_the_low_pass_follows_the_stamps_in_any_order(order: list[int]) -> None:
    states = [ego(20.0 * k, x_m=0.2 * k, yaw_rad=0.01 * k * k) for k in range(6)]
    in_order, source = trajectory(0.6, 0.4), trajectory(0.6, 0.4)
    for each in states:
        in_order.receive(each)
    for k in order:
        source.receive(states[k])
    assert source.current == in_order.current
    for k in range(10):
        assert pose(source, 10.0 * k) == pose(in_order, 10.0 * k)


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
def test_the_pit_lane_is_remembered_until_the_source_says_otherwise(
    source: EgoTrajectory,
) -> None:
    said = []
    for k, in_pit in enumerate([None, True, None, False, None]):
        source.receive(ego(10.0 * k, in_pit=in_pit))
        said.append(source.in_pit)
    assert said == [False, True, True, False, False]


# --- its covariance

COVARIANCE = np.diag([0.04, 0.01, 1e-4, 0.25, 1e-4])
COVARIANCE[0, 2] = COVARIANCE[2, 0] = 1e-3


def flat(matrix: np.ndarray) -> tuple[float, ...]:
    return tuple(matrix.ravel().tolist())


def uncertain(**std: float) -> EgoTrajectory:
    return EgoTrajectory(1.0, 1.0, EgoStd(**std))


def test_the_pose_is_as_uncertain_as_its_states_and_in_between_as_their_mean() -> None:
    source = uncertain()
    source.receive(ego(0.0, covariance=flat(COVARIANCE)))
    source.receive(ego(100.0, x_m=1.0, covariance=flat(3.0 * COVARIANCE)))
    for stamp_ms, factor in ((0.0, 1.0), (25.0, 1.5), (100.0, 3.0)):
        np.testing.assert_allclose(
            pose(source, stamp_ms).covariance, factor * COVARIANCE, rtol=1e-12
        )


@pytest.mark.parametrize(
    "source", [uncertain(), PublishedEgo(1.0, 1.0, ms(10), 350, EgoStd())]
)
def test_ahead_of_the_states_it_grows_by_the_numeric_derivative(
    source: EgoTrajectory,
) -> None:
    entries = ("x_m", "y_m", "yaw_rad", "speed_mps", "yaw_rate_radps")
    state = EgoState(
        START_NS, START_NS, 3.0, -2.0, 0.7, 20.0, 0.3, covariance=flat(COVARIANCE)
    )
    straight = isinstance(source, PublishedEgo)
    source.receive(state)
    source.start_tick()
    stamp_ns, columns = START_NS + ms(400), []
    for name in entries:
        near = [
            replace(state, **{name: getattr(state, name) + step})
            for step in (1e-6, -1e-6)
        ]
        ends = [extrapolated(each, stamp_ns, straight=straight) for each in near]
        columns.append((np.array(ends[0][:5]) - np.array(ends[1][:5])) / 2e-6)
    F = np.stack(columns, axis=1)
    found = source.pose_at(stamp_ns, stamp_ns)
    assert found is not None
    np.testing.assert_allclose(
        found.covariance, F @ COVARIANCE @ F.T, rtol=1e-6, atol=1e-9
    )


def test_what_a_state_does_not_say_the_configuration_says() -> None:
    source = uncertain(position_m=0.5, yaw_rad=0.02, speed_mps=0.3)
    source.receive(ego(0.0))
    np.testing.assert_allclose(
        pose(source, 0.0).covariance, np.diag([0.25, 0.25, 4e-4, 0.09, 0.0])
    )
    known = np.zeros((5, 5))
    known[:3, :3] = COVARIANCE[:3, :3]
    source.receive(ego(100.0, covariance=flat(known)))
    found = pose(source, 100.0).covariance
    np.testing.assert_allclose(found[:3, :3], COVARIANCE[:3, :3])
    np.testing.assert_allclose(found[3:, 3:], np.diag([0.09, 0.0]))


@pytest.mark.parametrize("source", [trajectory(), uncertain()])
def test_where_nobody_says_anything_or_nobody_asks_there_is_no_covariance(
    source: EgoTrajectory,
) -> None:
    asked = source._std is not None
    source.receive(ego(0.0, covariance=None if asked else flat(COVARIANCE)))
    assert pose(source, 0.0).covariance is None
    source.receive(ego(50.0, covariance=flat(COVARIANCE)))
    halfway = pose(source, 25.0).covariance
    if asked:
        np.testing.assert_allclose(halfway, 0.5 * COVARIANCE)
    else:
        assert halfway is None


@pytest.mark.parametrize(
    "given",
    [
        (1.0,) * 4,
        flat(COVARIANCE * math.nan),
        flat(-COVARIANCE),
        flat(COVARIANCE + np.eye(5, k=1)),
        flat(np.ones((5, 5)) - 0.5 * np.eye(5)),
        flat(COVARIANCE * 1e30),
    ],
)
def test_a_covariance_that_is_none_is_refused_where_it_is_asked_for(
    given: tuple[float, ...],
) -> None:
    assert uncertain().receive(ego(0.0, covariance=given)) == "not a covariance"
    assert trajectory().receive(ego(0.0, covariance=given)) is None
    assert (
        uncertain().receive(ego(0.0, covariance=flat(np.ones((5, 5))))) is None
    )  # singular


def test_the_published_storage_has_a_length_in_ticks() -> None:
    source = PublishedEgo(1.0, 1.0, ms(10), 3)
    for k in range(6):
        source.receive(ego(20.0 * k, x_m=float(k), speed_mps=0.0))
        source.start_tick()
    assert source.pose_at(START_NS, START_NS + ms(100)).x_m == 3.0


def test_the_published_pose_without_delay_is_from_the_newest_message_even_before_it_is_stored() -> (
    None
):
    source = PublishedEgo(1.0, 1.0, ms(10), 350)
    source.receive(ego(0.0, x_m=1.0))
    source.start_tick()
    source.receive(ego(20.0, x_m=9.0, speed_mps=0.0))
    half_step_ns = START_NS + ms(15)
    assert source.pose_at(half_step_ns, START_NS + ms(20)).x_m == 9.0
    assert source.pose_at(half_step_ns - 1, START_NS + ms(20)).x_m == pytest.approx(
        1.15
    )
