"""Clock offsets of recordings: from messages, through the tracker, to a report."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fgtrack.cli.main import run
from fgtrack.clocks.offsets import OffsetReport, SensorOffset, estimate_offsets
from fgtrack.config.reading import read_scenario
from fgtrack.config.settings import Config
from fgtrack.config.yaml_file import load
from fgtrack.core.errors import CallError, DataError
from fgtrack.core.time import nanoseconds
from fgtrack.core.types import (
    Detection,
    DetectionList,
    EgoState,
    Frame,
    Message,
    TruthState,
)
from fgtrack.inputs.stream import write_stream
from fgtrack.models.sensors import SensorModel
from fgtrack.sim.clocks import OffsetClock
from fgtrack.sim.simulate import simulate
from fgtrack.sim.vehicles import TrackVehicle

Capture = pytest.CaptureFixture[str]

CONFIG = Path(__file__).resolve().parents[2] / "configs/smoother.yaml"
START_NS = 1_600_000_000_000_000_000
#: What the sensors of the default scenario are really like; the configuration has the paper's numbers.
NOISE = (
    "sensors.lidar_cluster.std.x_m=0.3",
    "sensors.lidar_cluster.std.y_m=0.1",
    "sensors.radar.std.x_m=0.8",
    "sensors.radar.std.y_m=0.4",
)
OVAL = ("map.track=oval", "map.pit=oval")


def traffic(wrong: str, offset_s: float, seconds_of: float) -> list[Message]:
    """The default scenario's sensors with one wrong clock, in an ego that overtakes slow cars."""
    scenario = read_scenario("default")
    sensors = tuple(
        replace(s, clock=(OffsetClock(offset_s),) if s.name == wrong else ())
        for s in scenario.sensors
    )
    slow = tuple(
        TrackVehicle(
            arc_m=150.0 + 90.0 * i,
            lateral_m=2.5 if i % 2 else 4.5,
            speed=((0.0, 30.0),),
        )
        for i in range(4)
    )
    ego = TrackVehicle(arc_m=100.0, lateral_m=-2.0, speed=((0.0, 60.0),))
    changed = replace(
        scenario, ego=ego, opponents=slow, sensors=sensors, duration_s=seconds_of
    )
    return simulate(changed, np.random.default_rng(5))


def parked(frame: Frame, num: int = 30) -> list[Message]:
    """An object at rest, seen by two sensors of an ego that stands."""
    rng = np.random.default_rng(0)
    found: list[Message] = []
    for k in range(num):
        for sensor, after_s in (("lidar", 0.0), ("radar", 0.04)):
            stamp_ns = START_NS + nanoseconds(0.1 * k + after_s)
            found.append(EgoState(stamp_ns, stamp_ns, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
            x_m, y_m = np.array([20.0, 5.0]) + 0.1 * rng.standard_normal(2)
            found.append(
                DetectionList(
                    sensor, stamp_ns, stamp_ns, (Detection(x_m=x_m, y_m=y_m),), frame
                )
            )
    return found


def two_sensors() -> Config:
    sensor = SensorModel(std={"x_m": 0.1, "y_m": 0.1})
    return replace(load(Config, CONFIG), sensors={"lidar": sensor, "radar": sensor})


def row(report: OffsetReport, sensor: str) -> SensorOffset:
    return next(item for item in report.sensors if item.sensor == sensor)


def test_a_wrong_clock_is_found_by_the_command_without_truth(
    tmp_path: Path, capsys: Capture
) -> None:
    stream = tmp_path / "traffic.jsonl"
    write_stream(stream, traffic("lidar_cluster", 0.04, 8.0))
    settings = [word for setting in (*OVAL, *NOISE) for word in ("--set", setting)]
    assert (
        run(
            [
                "offsets",
                str(stream),
                "-c",
                str(CONFIG),
                "--reference",
                "radar",
                "--json",
                *settings,
            ]
        )
        == 0
    )
    report = json.loads(capsys.readouterr().out)
    assert report["reference"] == "radar"
    lidar = next(
        item for item in report["sensors"] if item["sensor"] == "lidar_cluster"
    )
    assert abs(lidar["offset_s"] - 0.04) < 4.0 * lidar["std_s"] < 0.02
    assert lidar["num_detections"] > 60
    assert "its stamps are" in report["verdicts"]["lidar_cluster"]


def test_a_large_offset_is_found_against_the_sensor_that_sees_most() -> None:
    messages = [
        one for one in traffic("radar", -0.2, 8.0) if not isinstance(one, TruthState)
    ]
    report = estimate_offsets(messages, load(Config, CONFIG, [*OVAL, *NOISE]))
    assert report.reference == "lidar_cluster"
    radar = row(report, "radar")
    assert radar.offset_s == pytest.approx(-0.2, abs=0.02)
    assert radar.is_off
    assert row(report, "lidar_cluster").offset_s == 0.0


@pytest.mark.parametrize("frame", ["ego", "map"])
def test_parked_cars_tell_nothing_and_the_report_says_why(frame: Frame) -> None:
    radar = row(
        estimate_offsets(parked(frame, num=60), two_sensors(), "lidar"), "radar"
    )
    assert radar.num_detections >= 50
    assert not radar.is_known
    assert "m/s (rms) in its frame" in radar.why


def test_one_modality_and_objects_seen_by_one_sensor_only_have_nothing_to_compare() -> (
    None
):
    alone = [
        one
        for one in parked("ego")
        if not (isinstance(one, DetectionList) and one.sensor == "radar")
    ]
    (lidar,) = estimate_offsets(alone, two_sensors()).sensors
    assert (lidar.sensor, lidar.offset_s, lidar.is_known) == ("lidar", None, False)
    assert lidar.why == "the only sensor: no other clock to compare with"
    radar = row(
        estimate_offsets(parked("ego", num=20), two_sensors(), "lidar"), "radar"
    )
    assert (radar.offset_s, radar.is_known) == (None, False)
    assert (
        radar.why
        == "fewer than 30 detections of objects whose path is known from lidar"
    )


def test_an_unknown_reference_and_an_empty_input_are_refused() -> None:
    with pytest.raises(
        CallError,
        match="reference 'sonar': not a sensor of the input, use lidar, radar",
    ):
        estimate_offsets(parked("ego"), two_sensors(), "sonar")
    with pytest.raises(DataError, match="no detections"):
        estimate_offsets(
            [one for one in parked("ego") if isinstance(one, EgoState)], two_sensors()
        )
    with pytest.raises(DataError, match="at least 5 are needed"):
        estimate_offsets(parked("ego", num=2), two_sensors())


def test_the_command_shows_a_table_and_exits_1_where_the_input_breaks_off(
    tmp_path: Path, capsys: Capture
) -> None:
    stream = tmp_path / "parked.jsonl"
    write_stream(stream, parked("ego"))
    lines = stream.read_text().splitlines(keepends=True)
    stream.write_text("".join(lines[:-1]) + lines[-1][:20])
    assert run(["offsets", str(stream), "-c", str(CONFIG), "--reference", "lidar"]) == 1
    shown = capsys.readouterr()
    assert "reference" in shown.out
    assert "reported stamp - true time" in shown.out
    assert "the messages before are used" in shown.err
    assert len(shown.err.splitlines()) == 1
