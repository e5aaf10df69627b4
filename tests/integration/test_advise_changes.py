"""`advise` on an hour in which a clock drifts and a mount turns."""

import math
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

import fgtrack
from fgtrack.core.types import DetectionList, Message
from fgtrack.inputs.stream import write_stream

CONFIG = {
    "map": {"track": "oval"},
    "sensors": {
        "lidar": {"std": {"x_m": 0.2, "y_m": 0.2}},
        "radar": {"std": {"x_m": 0.5, "y_m": 0.5}},
    },
}
TURNED_AFTER_S = 2100.0
TURN_RAD = math.radians(2.0)


def speeds(first_mps: float, duration_s: float) -> str:
    knots = (
        f"[{10.0 * k}, {40.0 + (first_mps if k % 2 else -first_mps)}]"
        for k in range(round(duration_s / 10.0) + 1)
    )
    return f"[{', '.join(knots)}]"


def scenario(folder: Path, duration_s: float, drift_ppm: float) -> Path:
    """Two cars ahead of the ego, whose speeds change all the time; the clock of the RADAR runs too fast."""
    sensor = "rate_hz: 5.0, max_range_m: 100.0"
    path = folder / "hour.yaml"
    path.write_text(f"""
map: oval
duration_s: {duration_s}
ego: {{kind: track, arc_m: 100.0, speed: [[0.0, 40.0]]}}
opponents:
  - {{kind: track, arc_m: 130.0, lateral_m: -3.0, speed: {speeds(8.0, duration_s)}}}
  - {{kind: track, arc_m: 125.0, lateral_m: 3.0, speed: {speeds(-8.0, duration_s)}}}
sensors:
  - {{name: lidar, std: {{x_m: 0.2, y_m: 0.2}}, {sensor}, delay: {{kind: constant, delay_s: 0.05}}}}
  - name: radar
    std: {{x_m: 0.5, y_m: 0.5}}
    rate_hz: 5.0
    phase_s: 0.07
    max_range_m: 100.0
    delay: {{kind: constant, delay_s: 0.06}}
    clock: [{{kind: drift, drift_ppm: {drift_ppm}}}]
ego_messages: {{rate_hz: 20.0}}
truth_rate_hz: 5.0
""")
    return path


def turned(messages: Iterator[Message]) -> Iterator[Message]:
    """The messages, in which the LiDAR is turned after 35 minutes."""
    cos, sin = math.cos(TURN_RAD), math.sin(TURN_RAD)
    first_ns = None
    for message in messages:
        first_ns = message.receipt_ns if first_ns is None else first_ns
        late = message.receipt_ns - first_ns > TURNED_AFTER_S * 1e9
        if late and isinstance(message, DetectionList) and message.sensor == "lidar":
            objects = tuple(
                replace(
                    one,
                    x_m=cos * one.x_m - sin * one.y_m,
                    y_m=sin * one.x_m + cos * one.y_m,
                )
                for one in message.objects
            )
            message = replace(message, objects=objects)
        yield message


def changes(advice: fgtrack.Advice) -> dict[str, str]:
    """Text of each change by the sensor and the word for the quantity."""
    return {
        f"{one.about} {one.text.split()[1]}": one.text
        for one in advice.findings
        if one.kind == "change"
    }


@pytest.mark.slow
def test_a_clock_that_drifts_and_a_mount_that_turns_are_found_with_the_time(
    tmp_path: Path,
) -> None:
    hour = scenario(tmp_path, 3600.0, drift_ppm=40e-3 / 3600.0 * 1e6)
    write_stream(tmp_path / "hour.jsonl", turned(fgtrack.simulate(hour, seed=1)))
    found = changes(fgtrack.advise(tmp_path / "hour.jsonl", CONFIG))
    assert set(found) == {"radar clock", "radar mount"}
    size_ms, half_ms = map(
        float,
        re.search(r"drifts by ([+-]\d+) ± (\d+) ms", found["radar clock"]).groups(),
    )
    # The parts are centred 30 s after the start and before the end.
    assert abs(size_ms - 40.0 * 3300.0 / 3600.0) < max(half_ms, 5.0)
    turn_deg = float(re.search(r"turns by ([+-][\d.]+)", found["radar mount"])[1])
    assert turn_deg == pytest.approx(2.0, abs=0.4)
    between = re.search(r"between minute (\d+) and minute (\d+)", found["radar mount"])
    first, last = map(int, between.groups())
    assert first - 1 <= TURNED_AFTER_S / 60.0 <= last + 1
    assert last - first <= 2


@pytest.mark.slow
def test_a_recording_without_a_change_has_no_change(tmp_path: Path) -> None:
    hour = scenario(tmp_path, 1500.0, drift_ppm=0.0)
    assert (
        changes(
            fgtrack.advise(
                fgtrack.simulate(hour, seed=2, out=tmp_path / "hour.jsonl"), CONFIG
            )
        )
        == {}
    )
