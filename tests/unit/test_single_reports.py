"""Sensors that report objects one by one: a rotating RADAR, ADS-B, AIS."""

import math

import numpy as np
import pytest

from fgtrack.config.settings import Config
from fgtrack.core.types import Detection, DetectionList, FloatArray, Message
from fgtrack.meaning.assumed import assumed, source_of
from fgtrack.meaning.assumption import Assumed
from fgtrack.meaning.coverage import Coverage, coverages

START_S = 36_000.0


def rotating(
    period_s: float,
    *,
    identified: bool,
    num_aircraft: int = 16,
    turns: int = 60,
    std_m: float = 40.0,
    std_rad: float = 1.2e-3,
) -> list[Message]:
    """Reports of a RADAR at the origin, one aircraft each, in the order of their bearings."""
    rng = np.random.default_rng(4)
    starts_m = rng.uniform(-60e3, 60e3, (num_aircraft, 2))
    courses_rad = rng.uniform(-math.pi, math.pi, num_aircraft)
    velocities_mps = rng.uniform(100.0, 230.0, (num_aircraft, 1)) * np.column_stack(
        [np.cos(courses_rad), np.sin(courses_rad)]
    )
    reports = []
    for turn in range(turns):
        at_m = starts_m + velocities_mps * period_s * turn
        bearings_rad = np.arctan2(at_m[:, 1], at_m[:, 0]) % math.tau
        for k, bearing_rad in enumerate(bearings_rad.tolist()):
            time_s = period_s * (turn + bearing_rad / math.tau)
            if rng.random() > 0.95:
                continue
            x_m, y_m = starts_m[k] + velocities_mps[k] * time_s
            range_m = math.hypot(x_m, y_m) + rng.normal(0.0, std_m)
            angle_rad = math.atan2(y_m, x_m) + rng.normal(0.0, std_rad)
            item = Detection(
                x_m=range_m * math.cos(angle_rad),
                y_m=range_m * math.sin(angle_rad),
                id=f"{k:06X}" if identified else None,
            )
            reports.append((round((START_S + time_s) * 1e9), item))
    return [
        DetectionList("radar", stamp_ns, stamp_ns, (item,), "map")
        for stamp_ns, item in sorted(reports, key=lambda each: each[0])
    ]


def coverage(messages: list[Message]) -> Coverage:
    return coverages(messages)["radar"]


def draft(messages: list[Message]) -> Assumed:
    return assumed(Config(), source_of(lambda: messages))


@pytest.mark.parametrize("period_s", [1.0, 4.0, 10.0])
@pytest.mark.parametrize("identified", [True, False], ids=["ids", "no ids"])
def test_the_period_of_a_rotating_radar_is_the_time_between_reports_of_an_object(
    period_s: float, identified: bool
) -> None:
    found = coverage(rotating(period_s, identified=identified))
    assert not found.scans
    assert found.rate_hz is not None
    assert found.rate_hz > 10.0 / period_s
    assert found.reports is not None
    assert found.reports.by_id is identified
    assert found.reports.period_s == pytest.approx(period_s, rel=0.05)


@pytest.mark.parametrize("identified", [True, False], ids=["ids", "no ids"])
def test_the_noise_of_a_rotating_radar_grows_across_the_line_of_sight(
    identified: bool,
) -> None:
    reports = coverage(rotating(4.0, identified=identified)).reports
    assert reports is not None
    assert reports.along.growth == 0.0
    assert reports.along.std == pytest.approx(40.0, rel=0.15)
    at_50_km_m = math.hypot(reports.across.std, 50e3 * reports.across.growth)
    assert at_50_km_m == pytest.approx(60.0, rel=0.2)


def test_ticks_windows_and_lives_follow_the_period_of_an_object() -> None:
    config = draft(rotating(10.0, identified=True)).config
    assert config.clock.node_hz == 1.0
    assert config.filter.storage_s == pytest.approx(20.0, abs=2.0)
    assert config.lifecycle.lifetime_s > 30.0  # type: ignore[union-attr]
    assert config.motion.kind == "cv"
    quick = draft(rotating(1.0, identified=True)).config
    assert quick.clock.node_hz == 4.0
    assert quick.motion.kind == "cv"  # aircraft do not turn with 10 g


def test_identities_that_jump_are_no_identities() -> None:
    rng = np.random.default_rng(1)
    messages = rotating(4.0, identified=True)
    shuffled = [each.objects[0].id for each in messages]  # type: ignore[union-attr]
    rng.shuffle(shuffled)
    mixed: list[Message] = [
        DetectionList(
            "radar",
            each.stamp_ns,
            each.receipt_ns,
            (Detection(x_m=each.objects[0].x_m, y_m=each.objects[0].y_m, id=name),),  # type: ignore[union-attr]
            "map",
        )
        for each, name in zip(messages, shuffled, strict=True)
    ]
    reports = coverage(mixed).reports
    assert reports is not None
    assert not reports.by_id
    assert reports.period_s == pytest.approx(4.0, rel=0.05)


def ships(course_of: str) -> list[Message]:
    """Reports of two ships every 10 s, with the yaw of their motion or with a compass course instead."""
    result: list[Message] = []
    for k in range(100):
        for ship, course_rad in enumerate((0.3, 2.0)):
            time_s = 10.0 * k + 5.0 * ship
            travelled: FloatArray = (
                5.0 * time_s * np.array([math.cos(course_rad), math.sin(course_rad)])
            )
            yaw_rad = course_rad if course_of == "yaw" else math.pi / 2 - course_rad
            item = Detection(
                travelled[0],
                travelled[1] + 3e3 * ship,
                yaw_rad,
                5.2,
                id=str(211_000_000 + ship),
            )
            stamp_ns = round((START_S + time_s) * 1e9)
            result.append(DetectionList("radar", stamp_ns, stamp_ns, (item,), "map"))
    return result


def test_a_course_that_contradicts_the_motion_of_its_object_is_not_used() -> None:
    assert set(draft(ships("yaw")).config.sensors["radar"].std) == {
        "x_m",
        "y_m",
        "yaw_rad",
        "speed_mps",
    }
    wrong = draft(ships("compass"))
    assert set(wrong.config.sensors["radar"].std) == {"x_m", "y_m", "speed_mps"}
    assert any("yaw_rad is not used: it differs by" in line for line in wrong.lines())
