"""Detectors that take the rear of a car for its front: one car stays one track, and faces as it is."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from support.cases import each_once

import fgtrack
from fgtrack.core.geometry import rotation
from fgtrack.core.time import NS_PER_S, nanoseconds
from fgtrack.core.types import (
    Detection,
    DetectionList,
    EgoState,
    FloatArray,
    SmoothedReport,
    TrackReport,
    TrackStatus,
)

FIRST_NS = 1_000 * NS_PER_S
STEP_S = 0.01
SETTLED_S = 1.3
"""Tracks are judged from one second and three lists of 10 Hz on."""
#: Yaw rate and speed by time.
Drive = Callable[[float], tuple[float, float]]
EGO = np.array([2.0, -5.0, 0.4])

DRIVES: Mapping[str, Drive] = {
    "straight": lambda t: (0.0, 12.0),
    "U-turn": lambda t: (0.6 if 4.0 <= t < 4.0 + math.pi / 0.6 else 0.0, 4.0),
    "hairpins": lambda t: (
        1.0 if 3.0 <= t < 3.0 + math.pi else -1.0 if 9.0 <= t < 9.0 + math.pi else 0.0,
        6.0,
    ),
    "turns in place": lambda t: (0.25, 0.0),
    "reverses": lambda t: (0.04, -3.0),
    "drives on, then back": lambda t: (
        0.03,
        min(4.0, max(4.0 - 2.0 * (t - 4.0), -3.0)),
    ),
    "stands": lambda t: (0.0, 0.0),
}


def poses_of(drive: Drive, duration_s: float) -> FloatArray:
    """x, y, yaw and speed in steps of `STEP_S`."""
    poses = np.zeros((round(duration_s / STEP_S) + 2, 4))
    poses[0] = 10.0, 20.0, 0.7, drive(0.0)[1]
    for k in range(1, len(poses)):
        x_m, y_m, yaw_rad, _ = poses[k - 1]
        rate_radps, speed_mps = drive((k - 1) * STEP_S)
        middle_rad = yaw_rad + 0.5 * rate_radps * STEP_S
        moved_m = (
            speed_mps * STEP_S * np.array([math.cos(middle_rad), math.sin(middle_rad)])
        )
        poses[k] = (
            x_m + moved_m[0],
            y_m + moved_m[1],
            yaw_rad + rate_radps * STEP_S,
            drive(k * STEP_S)[1],
        )
    return poses


@dataclass(frozen=True)
class Sensor:
    hz: float = 10.0
    std_m: float = 0.3
    yaw_std_rad: float | None = 0.1
    speed_std_mps: float | None = None
    flips: float = 0.0
    row: int = 1
    """Flips in succession."""
    astray: float = 0.0
    """Share of yaws that are a quarter of a turn off."""
    is_first_flipped: bool = False
    delay_s: tuple[float, float] = (0.05, 0.05)
    frame: str = "map"
    has_covariance: bool = False


@dataclass
class Outcome:
    """Of the ticks after `SETTLED_S`, and the shortest delay, as far as a car is near."""

    one: list[bool] = field(default_factory=list)
    backwards: list[bool] = field(default_factory=list)
    wrong_speed: list[bool] = field(default_factory=list)
    squares: list[float] = field(default_factory=list)
    """Normalised squared errors of the positions."""
    ids: set[int] = field(default_factory=set)
    smoothed: list[SmoothedReport] = field(default_factory=list)
    last: tuple[TrackReport, ...] = ()
    tracker: fgtrack.Tracker | None = None


def lists_of(
    name: str, sensor: Sensor, cars: list[FloatArray], duration_s: float, seed: int
) -> list[DetectionList]:
    rng, left, result = np.random.default_rng([seed, len(name)]), 0, []
    for k in range(int(duration_s * sensor.hz)):
        time_s, objects = k / sensor.hz, []
        for poses in cars:
            x_m, y_m, yaw_rad, speed_mps = poses[round(time_s / STEP_S)].tolist()
            if left == 0 and rng.random() < sensor.flips / sensor.row:
                left = sensor.row
            flipped = left > 0 or (sensor.is_first_flipped and k == 0)
            left = max(left - 1, 0)
            position_m = np.array([x_m, y_m]) + sensor.std_m * rng.standard_normal(2)
            yaw_rad += math.pi * flipped + (
                math.pi / 2.0 if rng.random() < sensor.astray else 0.0
            )
            if sensor.frame == "ego":
                position_m, yaw_rad = (
                    rotation(EGO[2]).T @ (position_m - EGO[:2]),
                    yaw_rad - EGO[2],
                )
            values: dict[str, Any] = {
                "x_m": float(position_m[0]),
                "y_m": float(position_m[1]),
            }
            variances = [sensor.std_m**2] * 2
            if sensor.yaw_std_rad is not None:
                values["yaw_rad"] = math.remainder(
                    yaw_rad + sensor.yaw_std_rad * rng.standard_normal(), math.tau
                )
                variances.append(sensor.yaw_std_rad**2)
            if sensor.speed_std_mps is not None:
                values["speed_mps"] = (
                    speed_mps + sensor.speed_std_mps * rng.standard_normal()
                )
                variances.append(sensor.speed_std_mps**2)
            if sensor.has_covariance:
                values["covariance"] = tuple(np.diag(variances).ravel().tolist())
            objects.append(Detection(**values))
        stamp_ns = FIRST_NS + nanoseconds(time_s)
        receipt_ns = stamp_ns + nanoseconds(rng.uniform(*sensor.delay_s))
        result.append(DetectionList(name, stamp_ns, receipt_ns, objects, sensor.frame))  # type: ignore[arg-type]
    return result


def run(
    drive: str | Drive,
    sensors: Mapping[str, Sensor],
    *,
    seed: int,
    duration_s: float = 12.0,
    other: FloatArray | None = None,
    begun_s: float = 0.0,
    **settings: Any,
) -> Outcome:
    """Track one car, or the first one of two, at 10 Hz; its ticks are judged from `begun_s` on."""
    poses = poses_of(DRIVES[drive] if isinstance(drive, str) else drive, duration_s)
    cars = [poses] if other is None else [poses, other]
    stds = {}
    for name, each in sensors.items():
        std = {
            "x_m": each.std_m,
            "y_m": each.std_m,
            "yaw_rad": each.yaw_std_rad,
            "speed_mps": each.speed_std_mps,
        }
        stds[name] = {
            "std": {key: value for key, value in std.items() if value is not None}
        }
    tracker = fgtrack.Tracker(fgtrack.Config().replace({"sensors": stds, **settings}))
    messages: list[EgoState | DetectionList] = [
        EgoState(stamp_ns, stamp_ns, *EGO.tolist(), 0.0)
        for stamp_ns in range(
            FIRST_NS, FIRST_NS + nanoseconds(duration_s), NS_PER_S // 20
        )
    ]
    for name, each in sensors.items():
        messages += lists_of(name, each, cars, duration_s, seed)
    messages.sort(key=lambda message: message.receipt_ns)
    outcome = Outcome()
    settled_s = max(
        begun_s,
        SETTLED_S + min(each.delay_s[1] + 3.0 / each.hz for each in sensors.values()),
    )
    for tick in range(int(10 * duration_s)):
        now_ns = FIRST_NS + tick * NS_PER_S // 10
        while messages and messages[0].receipt_ns <= now_ns:
            tracker.receive(messages.pop(0))
        report = tracker.tick(now_ns)
        outcome.smoothed += report.smoothed
        x_m, y_m, yaw_rad, speed_mps = poses[round(tick * 0.1 / STEP_S)].tolist()
        shown = [
            each for each in report.tracks if each.status is not TrackStatus.TENTATIVE
        ]
        if other is not None:
            away_m = other[round(tick * 0.1 / STEP_S), :2]
            shown = [
                each
                for each in shown
                if math.hypot(each.x_m - x_m, each.y_m - y_m)
                <= math.hypot(each.x_m - away_m[0], each.y_m - away_m[1])
            ]
        outcome.ids |= {each.track_id for each in shown}
        if tick * 0.1 < settled_s:
            continue
        outcome.one.append(len(shown) == 1)
        outcome.backwards.append(
            any(math.cos(each.yaw_rad - yaw_rad) < 0.0 for each in shown)
        )
        for each in shown:
            outcome.wrong_speed.append(
                abs(speed_mps) > 2.0 and each.speed_mps * speed_mps < 0.0
            )
            error_m = np.array([each.x_m - x_m, each.y_m - y_m])
            outcome.squares.append(
                float(error_m @ np.linalg.solve(each.covariance[:2, :2], error_m))
            )
    outcome.smoothed += tracker.finish()
    outcome.last, outcome.tracker = report.tracks, tracker
    return outcome


def assert_one_that_faces_as_the_car(*outcomes: Outcome) -> None:
    """The bar: one track in 98 % of the ticks, facing backwards in less than 1 %."""
    assert np.mean(np.concatenate([each.one for each in outcomes])) >= 0.98
    assert np.mean(np.concatenate([each.backwards for each in outcomes])) < 0.01
    assert np.mean(np.concatenate([each.wrong_speed for each in outcomes])) < 0.01


@pytest.mark.parametrize(
    "seeds",
    [range(2), pytest.param(range(2, 6), marks=pytest.mark.slow)],
    ids=["two seeds", "four more"],
)
@pytest.mark.parametrize("flips", [0.05, 0.3])
@pytest.mark.parametrize("drive", DRIVES)
def test_one_car_stays_one_track(drive: str, flips: float, seeds: range) -> None:
    """Where 30 % are flipped, a car that reverses from the start may be one that drives forwards for some seconds."""
    begun_s = 6.0 if flips == 0.3 and drive == "reverses" else 0.0
    outcomes = [
        run(drive, {"lidar": Sensor(flips=flips)}, seed=seed, begun_s=begun_s)
        for seed in seeds
    ]
    assert_one_that_faces_as_the_car(*outcomes)
    assert all(len(each.ids) == 1 for each in outcomes)


@pytest.mark.parametrize(
    ("drive", "sensor"),
    each_once(
        ["straight", "U-turn"],
        [
            Sensor(hz=2.0, flips=0.2),
            Sensor(hz=25.0, flips=0.3),
            Sensor(std_m=0.1, yaw_std_rad=0.05, flips=0.3),
            Sensor(std_m=2.0, yaw_std_rad=0.4, flips=0.3),
            Sensor(flips=0.15, row=5),
            Sensor(flips=0.1, astray=0.2),
            Sensor(flips=0.3, frame="ego", has_covariance=True),
            Sensor(is_first_flipped=True, flips=0.1),
            Sensor(flips=0.2, speed_std_mps=0.3),
            Sensor(flips=0.2, delay_s=(0.1, 1.0)),
        ],
    ),
    ids=lambda value: (
        value
        if isinstance(value, str)
        else ", ".join(
            f"{key} {own}"
            for key, own in vars(value).items()
            if own != vars(Sensor())[key]
        )
    ),
)
def test_one_car_stays_one_track_with_other_errors_and_rates(
    drive: str, sensor: Sensor
) -> None:
    outcomes = [
        run(drive, {"lidar": sensor}, seed=seed, duration_s=20.0) for seed in range(2)
    ]
    assert_one_that_faces_as_the_car(*outcomes)


@pytest.mark.long
@pytest.mark.parametrize(
    ("estimator", "delay_s"),
    [
        *each_once(
            ["imm-replay", "smoother-banded", "smoother"], [(0.05, 0.05), (0.1, 1.0)]
        ),
        pytest.param("ukf-replay", (0.05, 0.05), marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_every_estimator_keeps_one_track(
    estimator: str, delay_s: tuple[float, float]
) -> None:
    sensor = Sensor(flips=0.25, delay_s=delay_s)
    outcomes = [
        run(drive, {"lidar": sensor}, seed=seed, estimator=estimator)
        for seed, drive in enumerate(("straight", "U-turn", "reverses"))
    ]
    assert_one_that_faces_as_the_car(*outcomes)


@pytest.mark.parametrize("drive", ["U-turn", "reverses", "stands"])
def test_a_sensor_that_flips_is_told_from_one_that_does_not(drive: str) -> None:
    sensors = {
        "good": Sensor(hz=5.0),
        "bad": Sensor(std_m=0.5, yaw_std_rad=0.2, flips=0.4, delay_s=(0.2, 0.2)),
    }
    outcome = run(drive, sensors, seed=1, duration_s=20.0)
    assert_one_that_faces_as_the_car(outcome)
    assert outcome.tracker is not None
    yaws = outcome.tracker.yaws
    assert yaws["good"].get("flipped", 0) <= 1
    assert abs(yaws["bad"]["flipped"] - 0.4 * yaws["bad"]["yaws"]) < 3.0 * math.sqrt(
        0.24 * yaws["bad"]["yaws"]
    )


def test_a_car_that_reverses_has_a_negative_speed_within_its_covariance() -> None:
    outcome = run("reverses", {"lidar": Sensor(flips=0.1)}, seed=2)
    [track] = outcome.last
    assert abs(track.speed_mps + 3.0) < 4.0 * math.sqrt(track.covariance[3, 3])


def test_a_radar_gives_the_sign_of_the_speed_of_a_car_that_began_backwards() -> None:
    lidar, radar = (
        Sensor(is_first_flipped=True),
        Sensor(std_m=1.0, yaw_std_rad=None, speed_std_mps=0.2),
    )
    for drive in ("straight", "reverses", "drives on, then back"):
        outcome = run(drive, {"lidar": lidar, "radar": radar}, seed=3)
        assert_one_that_faces_as_the_car(outcome)


def test_positions_lie_within_their_covariance_in_spite_of_flips() -> None:
    """Errors are correlated over about half a second: so many are independent."""
    outcomes = [
        run("U-turn", {"lidar": Sensor(flips=0.3)}, seed=seed, duration_s=20.0)
        for seed in range(4)
    ]
    squares = np.concatenate([each.squares for each in outcomes])
    independent = len(squares) * 0.1 / 0.5
    assert squares.mean() < 2.0 + 3.3 * math.sqrt(4.0 / independent)
    assert squares.mean() > 2.0 - 3.3 * math.sqrt(4.0 / independent)


def test_smoothed_states_face_as_the_car() -> None:
    sensor = Sensor(flips=0.3, is_first_flipped=True)
    settings = {"estimator": "smoother-banded", "smoother.lagged_s": [0.3]}
    outcome = run("U-turn", {"lidar": sensor}, seed=4, **settings)
    poses = poses_of(DRIVES["U-turn"], 13.0)
    late = [
        each
        for each in outcome.smoothed
        if each.state.stamp_ns > FIRST_NS + 2 * NS_PER_S
    ]
    assert {each.lag_s is None for each in late} == {True, False}
    for each in late:
        yaw_rad = poses[round((each.state.stamp_ns - FIRST_NS) / NS_PER_S / STEP_S), 2]
        assert math.cos(each.state.mean[2] - yaw_rad) > 0.5
        assert each.state.mean[3] > 0.0


def test_the_past_faces_as_the_present() -> None:
    std = {"x_m": 0.3, "y_m": 0.3, "yaw_rad": 0.1}
    tracker = fgtrack.Tracker(
        fgtrack.Config().replace({"sensors": {"lidar": {"std": std}}})
    )
    poses = poses_of(DRIVES["straight"], 4.0)
    for message in lists_of("lidar", Sensor(is_first_flipped=True), [poses], 3.0, 5):
        tracker.receive(message)
        tracker.tick(message.receipt_ns)
    now_ns = FIRST_NS + 3 * NS_PER_S
    tracker.tick(now_ns)
    for stamp_ns in (now_ns - NS_PER_S, now_ns, now_ns + NS_PER_S):
        for track in (tracker.state_at(0, stamp_ns), *tracker.tracks_at(stamp_ns)):
            assert math.cos(track.yaw_rad - 0.7) > 0.9
            assert track.speed_mps == pytest.approx(12.0, abs=2.0)


@pytest.mark.parametrize("estimator", ["ekf-replay", "smoother-banded"])
def test_the_order_of_arrival_does_not_matter(estimator: str) -> None:
    """Readings are the same; states are, as without flips, up to where a smoother is linearised."""
    poses, results, words = poses_of(DRIVES["U-turn"], 4.0), [], []
    lists = lists_of("lidar", Sensor(flips=0.3), [poses], 3.0, 6)
    std = {"x_m": 0.3, "y_m": 0.3, "yaw_rad": 0.1}
    for order in (
        list(range(30)),
        [
            *range(12),
            14,
            17,
            13,
            12,
            18,
            16,
            15,
            *range(19, 23),
            25,
            28,
            24,
            23,
            29,
            27,
            26,
        ],
    ):
        settings = {"sensors": {"lidar": {"std": std}}, "estimator": estimator}
        tracker, newest_ns, updates = (
            fgtrack.Tracker(fgtrack.Config().replace(settings)),
            0,
            [],
        )
        for k in order:
            tracker.receive(lists[k])
            newest_ns = max(newest_ns, lists[k].receipt_ns)
            updates += tracker.tick(newest_ns).updates
        [track] = tracker.tick(FIRST_NS + 3 * NS_PER_S).tracks
        results.append(track)
        words.append({each.stamp_ns: each.yaw for each in updates})
    tolerance = 1e-9 if estimator == "ekf-replay" else 0.02
    assert words[0] == words[1]
    assert "flipped" in words[0].values()
    np.testing.assert_allclose(
        results[0].state.mean, results[1].state.mean, rtol=0.0, atol=tolerance
    )
    np.testing.assert_allclose(
        results[0].covariance, results[1].covariance, rtol=tolerance, atol=tolerance
    )


@pytest.mark.parametrize("flips", [0.0, 0.3])
def test_cars_side_by_side_in_opposite_directions_do_not_swap(flips: float) -> None:
    poses = poses_of(lambda t: (0.0, 8.0), 12.0)
    left_m = 2.0 * np.array([-math.sin(0.7), math.cos(0.7)])
    oncoming = poses[::-1].copy()
    oncoming[:, :2] += left_m
    oncoming[:, 2] += math.pi
    for seed in range(3):
        outcome = run(
            lambda t: (0.0, 8.0),
            {"lidar": Sensor(flips=flips)},
            seed=seed,
            other=oncoming,
        )
        assert_one_that_faces_as_the_car(outcome)
        assert len(outcome.ids) == 1


@pytest.mark.parametrize("drive", ["straight", "U-turn", "reverses"])
def test_a_cartesian_state_faces_as_the_car(drive: str) -> None:
    motion = {"kind": "cv", "std_per_s": {"velocity": 15.0}}
    outcomes = [
        run(drive, {"lidar": Sensor(flips=0.1)}, seed=seed, motion=motion)
        for seed in range(3)
    ]
    assert_one_that_faces_as_the_car(*outcomes)


def test_a_yaw_that_was_turned_or_left_is_reported_so() -> None:
    std = {"x_m": 0.3, "y_m": 0.3, "yaw_rad": 0.1}
    tracker = fgtrack.Tracker(
        fgtrack.Config().replace({"sensors": {"lidar": {"std": std}}})
    )
    updates = []
    for k, yaw_rad in enumerate([*[0.0] * 10, math.pi - 0.05, 1.6, 0.02]):
        stamp_ns = FIRST_NS + k * NS_PER_S // 10
        tracker.receive(
            DetectionList(
                "lidar",
                stamp_ns,
                stamp_ns,
                [Detection(x_m=1.0 + k, y_m=0.0, yaw_rad=yaw_rad)],
                "map",
            )
        )
        updates += tracker.tick(stamp_ns).updates
    assert [each.yaw for each in updates] == [*[None] * 10, "flipped", "unused", None]
    assert abs(updates[10].innovation["yaw_rad"]) < 0.3
    assert set(updates[11].innovation) == {"x_m", "y_m"}
    assert all(each.nis is None or each.nis < 16.0 for each in updates)
    assert tracker.yaws == {"lidar": {"yaws": 12, "flipped": 1, "unused": 1}}
