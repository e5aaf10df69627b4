"""What a replay assumes of objects that are measured every few seconds."""

import csv
import gzip
import math
from collections import defaultdict
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import fgtrack
from fgtrack.config.reading import read_config
from fgtrack.config.settings import Config
from fgtrack.core.types import Detection, DetectionList
from fgtrack.meaning.assumed import assumed, source_of

SECOND_NS = 10**9
OPENSKY = (
    Path(__file__).resolve().parents[2]
    / "../shared/data/opensky/OpenSky_Plane_States.csv.gz"
)


def turning(
    period_s: float, count: int = 6, duration_s: float = 240.0, lone: bool = True
) -> list[DetectionList]:
    """Aircraft at 200 m/s that report every `period_s`, in lists of their own or together; each turns by 3 deg/s for
    30 s in the middle."""
    radius_m = 200.0 / math.radians(3.0)
    found = []
    for k in range(int(duration_s / period_s)):
        objects = []
        for number in range(count):
            at_s = k * period_s + (number * period_s / count if lone else 0.0)
            turn_s = min(max(at_s - 100.0, 0.0), 30.0)
            angle = math.radians(3.0) * turn_s
            straight_m = 200.0 * (at_s - turn_s)
            before_m = min(straight_m, 200.0 * 100.0)
            after_m = straight_m - before_m
            x_m = before_m + radius_m * math.sin(angle) + after_m * math.cos(angle)
            y_m = (
                radius_m * (1.0 - math.cos(angle))
                + after_m * math.sin(angle)
                + 20e3 * number
            )
            objects.append((at_s, Detection(x_m=x_m, y_m=y_m)))
        groups = [[one] for one in objects] if lone else [objects]
        for group in groups:
            stamp_ns = round((1000.0 + group[0][0]) * SECOND_NS)
            found.append(
                DetectionList(
                    "adsb", stamp_ns, stamp_ns, [one for _, one in group], frame="map"
                )
            )
    return found


@pytest.mark.parametrize("lone", [True, False])
def test_objects_that_are_measured_every_ten_seconds_keep_their_tracks_through_a_turn(
    lone: bool,
) -> None:
    messages = turning(10.0, lone=lone)
    assert all(a.receipt_ns <= b.receipt_ns for a, b in pairwise(messages))
    run = fgtrack.replay(messages)
    assert np.count_nonzero(run.updates["disposition"] == "birth") == 6


def test_a_replay_says_what_it_assumes_of_slow_reporters_and_what_is_set_stays() -> (
    None
):
    messages = turning(10.0)
    found = assumed(Config(), source_of(lambda: messages))
    values = {
        one.key: one.value
        for one in found.assumptions
        if not one.key.startswith(("sensors.", "lifecycle."))
    }
    assert values == {
        "motion.kind": "cv",
        "motion.std_per_s": {"velocity": 150.0},
        "clock.node_hz": 1.0,
        "filter.storage_s": 20.0,
        "smoother.lag_s": 20.0,
    }
    assert any("every 10 s" in line for line in found.lines())
    mine = read_config(None, ["motion.std_per_s.yaw=0.2", "clock.node_hz=5"])
    kept = assumed(mine, source_of(lambda: messages)).config
    assert (kept.motion, kept.clock) == (mine.motion, mine.clock)
    again = read_config(None, [])
    assert assumed(again, source_of(lambda: turning(1.0))).config.motion == again.motion


def reporting() -> list[DetectionList]:
    """Six aircraft that report position and velocity every 10 s, each in a list of its own, for two minutes."""
    found = []
    for k in range(72):
        number, at_s = k % 6, k * 10.0 / 6.0
        south_mps = 100.0 * (number % 2)
        x_m, y_m = (
            1e3 + 30e3 * number + 200.0 * at_s,
            20e3 * (number % 3) - south_mps * at_s,
        )
        velocity = {
            "yaw_rad": -math.atan2(south_mps, 200.0),
            "speed_mps": math.hypot(south_mps, 200.0),
        }
        stamp_ns = SECOND_NS * 1000 + round(at_s * SECOND_NS)
        found.append(
            DetectionList(
                "adsb",
                stamp_ns,
                stamp_ns,
                [Detection(x_m=x_m, y_m=y_m, **velocity)],
                frame="map",
            )
        )
    return found


def test_objects_that_report_one_by_one_are_tracked_each_under_one_id() -> None:
    run = fgtrack.replay(reporting(), set={"clock.node_hz": 1.0})
    assert run.config["sensors"]["adsb"]["scan"] is False
    assert sum(run.updates["disposition"] == "birth") == 6
    last = run.tracks["tick"] == run.tracks["tick"].max()
    assert list(run.tracks["status"][last]) == ["confirmed"] * 6


def test_a_scan_misses_what_it_lacks_whatever_the_recording_looks_like() -> None:
    empty = replace(
        reporting()[-1],
        stamp_ns=SECOND_NS * 1130,
        receipt_ns=SECOND_NS * 1130,
        objects=[],
    )
    run = fgtrack.replay([*reporting(), empty], set={"clock.node_hz": 1.0})
    assert run.config["sensors"]["adsb"]["scan"] is True
    assert sum(run.updates["disposition"] == "birth") > 6


def _reports(duration_s: float) -> tuple[list[DetectionList], list[str]]:
    """Each new position of OpenSky in a list of its own, in order of receipt, and the aircraft that it is of."""
    with gzip.open(OPENSKY, "rt") as file:
        rows = list(csv.DictReader(file))
    end_s = min(float(row["time"]) for row in rows) + duration_s
    new = {
        (float(row["time"]), float(row["lastposupdate"]), row["icao24"]): row
        for row in reversed(rows)
    }
    seen, messages, names = set[tuple[str, str]](), [], []
    for (poll_s, stamp_s, name), row in sorted(new.items()):
        if poll_s > end_s or (name, row["lastposupdate"]) in seen:
            continue
        seen.add((name, row["lastposupdate"]))
        north_m = math.radians(float(row["lat"]) - 52.5) * 6.371e6
        east_m = (
            math.radians(float(row["lon"]) + 2.0)
            * 6.371e6
            * math.cos(math.radians(52.5))
        )
        stamp_ns = round(stamp_s * SECOND_NS)
        receipt_ns = max(round(poll_s * SECOND_NS), stamp_ns)
        messages.append(
            DetectionList(
                "adsb",
                stamp_ns,
                receipt_ns,
                [Detection(x_m=east_m, y_m=north_m)],
                frame="map",
            )
        )
        names.append(name)
    order = sorted(range(len(messages)), key=lambda k: messages[k].receipt_ns)
    return [messages[k] for k in order], [names[k] for k in order]


@pytest.mark.slow
@pytest.mark.skipif(not OPENSKY.is_file(), reason="needs ../shared/data/opensky")
def test_aircraft_of_opensky_keep_one_track_each_without_a_configuration() -> None:
    messages, names = _reports(300.0)
    owner = {
        (one.stamp_ns, one.objects[0].x_m): name
        for one, name in zip(messages, names, strict=True)
    }
    run = fgtrack.replay(messages)
    table = run.detections
    of_detection = [
        owner[key]
        for key in zip(table["stamp_ns"].tolist(), table["x_m"].tolist(), strict=True)
    ]
    confirmed = set(
        run.tracks["track_id"][run.tracks["status"] == "confirmed"].tolist()
    )
    by_key = defaultdict(list)
    for stamp_ns, track_id in zip(
        run.updates["stamp_ns"].tolist(), run.updates["track_id"].tolist(), strict=True
    ):
        by_key[stamp_ns].append(track_id)
    tracks = defaultdict(list)
    for stamp_ns, name in zip(table["stamp_ns"].tolist(), of_detection, strict=True):
        if len(by_key[stamp_ns]) == 1:  # else two aircraft report at once
            tracks[name].append(by_key[stamp_ns][0])
    long = [ids for ids in tracks.values() if len(ids) > 20]
    tracked = [
        ids for ids in long if sum(each in confirmed for each in ids) >= 0.8 * len(ids)
    ]
    assert len(long) > 20
    assert len(tracked) >= 0.95 * len(long)
    assert sum(len(set(ids) & confirmed) for ids in long) <= 1.2 * len(long)
