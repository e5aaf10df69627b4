"""An extrapolated pose is as uncertain as the ego's own states show."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from support.tracking import START_NS, ms

from fgtrack.core.types import EgoState, FloatArray
from fgtrack.tracking.ego.growth import EgoGrowth
from fgtrack.tracking.ego.trajectory import EgoStd, EgoTrajectory


def drive(
    accel_mps2: float,
    yaw_accel_radps2: float,
    seconds: float = 30.0,
    speed_mps: float = 10.0,
) -> list[EgoState]:
    """States of an ego at 50 Hz with sinusoidal accelerations of these standard deviations, of period 8 s."""
    w, states = 2.0 * math.pi / 8.0, list[EgoState]()
    x_m = y_m = yaw_rad = 0.0
    for k in range(round(50.0 * seconds)):
        time_s = 0.02 * k
        speed = speed_mps - math.sqrt(2.0) * accel_mps2 / w * math.cos(w * time_s)
        rate = -math.sqrt(2.0) * yaw_accel_radps2 / w * math.cos(w * time_s)
        stamp_ns = START_NS + ms(20.0 * k)
        states.append(EgoState(stamp_ns, stamp_ns, x_m, y_m, yaw_rad, speed, rate))
        yaw_rad += 0.02 * rate
        x_m, y_m = (
            x_m + 0.02 * speed * math.cos(yaw_rad),
            y_m + 0.02 * speed * math.sin(yaw_rad),
        )
    return states


def trajectory(states: list[EgoState], std: EgoStd | None = None) -> EgoTrajectory:
    source = EgoTrajectory(1.0, 1.0, std or EgoStd(), growth=EgoGrowth(1.0, 0.1, 2.25))
    for each in states:
        assert source.receive(each) is None
    return source


def covariance(source: EgoTrajectory, after_s: float) -> FloatArray:
    pose = source.pose_at(source.newest_ns + ms(1e3 * after_s), 0)
    assert pose is not None
    assert pose.covariance is not None
    assert pose.extrapolated_s == pytest.approx(after_s)
    return pose.covariance


@pytest.mark.parametrize(
    ("accel_mps2", "yaw_accel_radps2"), [(8.0, 0.4), (1.5, 0.2), (0.05, 0.004)]
)
@pytest.mark.parametrize("after_s", [0.15, 0.5, 0.9])
def test_the_growth_is_learned_from_a_race_car_a_car_and_a_ship(
    accel_mps2: float, yaw_accel_radps2: float, after_s: float
) -> None:
    P = covariance(
        trajectory(drive(accel_mps2, yaw_accel_radps2, speed_mps=15.0)), after_s
    )
    turned = math.sqrt(P[2, 2]) / (0.5 * yaw_accel_radps2 * after_s**2)
    assert 0.8 < turned < 1.8
    along = math.sqrt(P[0, 0] + P[1, 1]) / (0.5 * accel_mps2 * after_s**2)
    assert 0.8 < along < 2.6  # with what the turn adds


def test_a_bend_after_a_long_straight_counts_at_once() -> None:
    straight, bend = drive(0.01, 0.001, 100.0), drive(0.01, 0.2, 4.0)
    shift_ns, way_m = straight[-1].stamp_ns - START_NS + ms(20.0), straight[-1].x_m
    turning = [
        replace(each, stamp_ns=at, receipt_ns=at, x_m=each.x_m + way_m + 0.2)
        for each, at in ((each, each.stamp_ns + shift_ns) for each in bend)
    ]
    before, after = (
        covariance(trajectory(states), 0.5)[2, 2]
        for states in (straight, straight + turning)
    )
    assert before < (0.5 * 0.005 * 0.5**2) ** 2
    assert after > (0.5 * 0.1 * 0.5**2) ** 2


def test_until_the_ego_has_driven_the_configured_accelerations_count() -> None:
    P = covariance(trajectory(drive(0.0, 0.0)[:1]), 0.4)
    assert math.sqrt(P[0, 0]) == pytest.approx(0.5 * 1.0 * 0.4**2)
    assert math.sqrt(P[2, 2]) == pytest.approx(0.5 * 0.1 * 0.4**2)


def test_an_ego_that_stands_shows_nothing_of_how_it_drives() -> None:
    still = [
        replace(each, x_m=0.0, y_m=0.0, yaw_rad=0.0, speed_mps=0.0)
        for each in drive(0.0, 0.0)
    ]
    np.testing.assert_array_equal(
        covariance(trajectory(still), 0.5), covariance(trajectory(still[:1]), 0.5)
    )


def test_a_jump_of_the_position_is_no_acceleration() -> None:
    states = drive(0.5, 0.05)
    moved = [
        replace(each, x_m=each.x_m + 300.0 * (k > 700)) for k, each in enumerate(states)
    ]
    one, other = trajectory(moved), trajectory(states)
    assert one.jumps == 1
    assert covariance(one, 0.5)[0, 0] < 1.2 * covariance(other, 0.5)[0, 0]


def test_the_growth_is_added_to_the_covariance_that_the_state_has() -> None:
    states = drive(1.0, 0.1)
    plain, own = (
        covariance(trajectory(states), 0.3),
        covariance(trajectory(states, EgoStd(0.5, 0.01)), 0.3),
    )
    assert own[0, 0] - plain[0, 0] > 0.5**2
    assert own[2, 2] - plain[2, 2] == pytest.approx(0.01**2)


def test_between_two_states_and_with_an_unknown_uncertainty_nothing_grows() -> None:
    states = drive(1.0, 0.1)
    assert (
        trajectory(states).pose_at(states[-9].stamp_ns + ms(7.0), 0).covariance is None
    )
    plain = EgoTrajectory(1.0, 1.0)
    plain.receive(states[0])
    assert plain.pose_at(START_NS + ms(300.0), 0).covariance is None


@pytest.mark.parametrize("apart", [10, 25, 50])
def test_between_states_that_are_far_apart_the_pose_follows_the_bend_and_has_an_uncertainty(
    apart: int,
) -> None:
    states = drive(1.0, 0.2, speed_mps=15.0)
    source, line = trajectory(states[::apart]), EgoTrajectory(1.0, 1.0)
    for each in states[::apart]:
        line.receive(each)
    squares = []
    for truth in states[1300 : 1300 + 4 * apart]:
        if (truth.stamp_ns - START_NS) % ms(20.0 * apart):
            pose, straight = (
                source.pose_at(truth.stamp_ns, 0),
                line.pose_at(truth.stamp_ns, 0),
            )
            error = np.subtract(
                pose[:5],
                [
                    truth.x_m,
                    truth.y_m,
                    truth.yaw_rad,
                    truth.speed_mps,
                    truth.yaw_rate_radps,
                ],
            )
            squares.append(
                (
                    error[2] ** 2 / pose.covariance[2, 2],
                    error[:2] @ error[:2],
                    error[2] ** 2,
                )
            )
            squares[-1] += ((straight.yaw_rad - truth.yaw_rad) ** 2,)
    yaw_nees, _, own, linear = np.mean(squares, axis=0)
    assert yaw_nees < 1.5
    assert own < linear


def test_states_whose_speeds_are_wrong_do_not_throw_the_pose_out_of_the_gap() -> None:
    states = [
        replace(each, speed_mps=0.0, yaw_rate_radps=0.0)
        for each in drive(1.0, 0.1)[::25]
    ]
    source = trajectory(states)
    for before, after in pairwise(states[-5:]):
        pose = source.pose_at((before.stamp_ns + after.stamp_ns) // 2, 0)
        assert min(before.x_m, after.x_m) <= pose.x_m <= max(before.x_m, after.x_m)


def test_before_the_first_state_a_pose_is_as_uncertain_as_after_the_last() -> None:
    source = trajectory([EgoState(START_NS, START_NS, 0.0, 0.0, 0.0, 10.0, 0.0)])
    before, after = (source.pose_at(START_NS + ms(at), 0) for at in (-400.0, 400.0))
    np.testing.assert_allclose(np.diag(before.covariance), np.diag(after.covariance))
    assert before.covariance[1, 2] == pytest.approx(-after.covariance[1, 2])
    assert before.x_m == pytest.approx(-after.x_m)


def test_lists_that_share_an_error_tell_no_more_together_than_it_allows() -> None:
    source = EgoGrowth(1.0, 0.1, 2.25)
    ego = EgoState(START_NS, START_NS, 0.0, 0.0, 0.0, 10.0)
    plain = source.covariance(ego, 0.5)[2, 2]
    counted = [
        source.shared(ego, 0.5, START_NS + ms(50.0 * k), 50.0)[2, 2] for k in range(40)
    ]
    assert counted[0] == pytest.approx(plain)
    assert np.all(np.diff(counted) > 0.0)
    assert counted[-1] > 3.0 * plain
    later = source.shared(ego, 0.5, START_NS + ms(9_000.0), 50.0)[2, 2]
    assert later == pytest.approx(plain, rel=1e-3)


def test_lists_at_one_stamp_share_the_error_in_any_order() -> None:
    ego = EgoState(START_NS, START_NS, 0.0, 0.0, 0.0, 10.0)
    source = EgoGrowth(1.0, 0.1, 2.25)
    first, second = (source.shared(ego, 0.5, START_NS, 50.0)[2, 2] for _ in range(2))
    assert second == pytest.approx(3.0 * first)


def test_white_noise_of_the_ego_is_no_error_that_lasts() -> None:
    rng = np.random.default_rng(5)
    noisy = [
        replace(each, yaw_rad=each.yaw_rad + 0.01 * rng.normal())
        for each in drive(0.01, 0.001)
    ]
    smooth = drive(0.01, 0.1)
    ratios = []
    for states in (noisy, smooth):
        growth = trajectory(states)._growth
        counted = [
            growth.shared(states[-1], 0.3, START_NS + ms(100.0 * k), 50.0)[2, 2]
            for k in range(20)
        ]
        ratios.append(counted[-1] / counted[0])
    assert ratios[0] < 1.5 < ratios[1]
