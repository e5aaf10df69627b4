"""Clock offsets of recordings: from messages, through the tracker, to a report."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fgtrack.cli.main import run
from fgtrack.core.errors import CallError, DataError
from fgtrack.core.time import nanoseconds
from fgtrack.core.types import Detection, DetectionList, EgoState, Frame, Message
from fgtrack.io.stream import write_stream
from fgtrack.models.sensors import SensorModel
from fgtrack.pipeline.clock_offsets import OffsetReport, OffsetRules, SensorOffset, estimate_offsets
from fgtrack.pipeline.config import Config
from fgtrack.pipeline.load import load
from fgtrack.pipeline.shipped import read_scenario
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
    sensors = tuple(replace(s, clock=(OffsetClock(offset_s),) if s.name == wrong else ()) for s in scenario.sensors)
    slow = tuple(
        TrackVehicle(arc_m=150.0 + 90.0 * i, lateral_m=2.5 if i % 2 else 4.5, speed=((0.0, 30.0),)) for i in range(4)
    )
    ego = TrackVehicle(arc_m=100.0, lateral_m=-2.0, speed=((0.0, 60.0),))
    changed = replace(scenario, ego=ego, opponents=slow, sensors=sensors, duration_s=seconds_of)
    return simulate(changed, np.random.default_rng(5))


def parked(frame: Frame, speed_mps: float = 0.0, num: int = 30) -> list[Message]:
    """An object at rest, or driving off, seen by two sensors of an ego that stands."""
    rng = np.random.default_rng(0)
    found: list[Message] = []
    for k in range(num):
        for sensor, after_s in (("lidar", 0.0), ("radar", 0.04)):
            stamp_ns = START_NS + nanoseconds(0.1 * k + after_s)
            found.append(EgoState(stamp_ns, stamp_ns, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
            x_m, y_m = np.array([20.0 + speed_mps * (0.1 * k + after_s), 5.0]) + 0.1 * rng.standard_normal(2)
            found.append(DetectionList(sensor, stamp_ns, stamp_ns, (Detection(x_m=x_m, y_m=y_m),), frame))
    return found


def two_sensors() -> Config:
    sensor = SensorModel(std={"x_m": 0.1, "y_m": 0.1})
    return replace(load(Config, CONFIG), sensors={"lidar": sensor, "radar": sensor})


def row(report: OffsetReport, sensor: str) -> SensorOffset:
    return next(item for item in report.sensors if item.sensor == sensor)


@pytest.mark.slow
def test_a_wrong_lidar_clock_is_found_by_the_command(tmp_path: Path, capsys: Capture) -> None:
    stream = tmp_path / "traffic.jsonl"
    write_stream(stream, traffic("lidar_cluster", 0.04, 5.0))
    settings = [word for setting in (*OVAL, *NOISE) for word in ("--set", setting)]
    assert run(["offsets", str(stream), "-c", str(CONFIG), "--reference", "radar", "--json", *settings]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["reference"] == "radar"
    assert report["num_tracks"] == 2
    lidar = next(item for item in report["sensors"] if item["sensor"] == "lidar_cluster")
    assert lidar["identifiable"]
    assert abs(lidar["offset_s"] - 0.04) < 3.0 * lidar["std_s"] < 0.02
    assert lidar["num_detections"] > 100
    assert 0.9 < lidar["residual"] < 1.5  # outliers, and cars seen double, are in it
    assert lidar["why"].startswith("information ")


@pytest.mark.slow
def test_a_wrong_radar_clock_is_found_against_the_sensor_that_sees_most() -> None:
    config = load(Config, CONFIG, [*OVAL, *NOISE])
    report = estimate_offsets(traffic("radar", -0.04, 5.0), config)
    assert report.reference == "lidar_cluster"
    radar = row(report, "radar")
    assert radar.identifiable
    assert radar.offset_s is not None
    assert radar.std_s is not None
    assert abs(radar.offset_s + 0.04) < 3.0 * radar.std_s < 0.012
    assert row(report, "lidar_cluster").offset_s == 0.0


@pytest.mark.parametrize("frame", ["ego", "map"])
def test_parked_cars_tell_nothing_and_the_report_says_why(frame: Frame) -> None:
    report = estimate_offsets(parked(frame), two_sensors(), "lidar")
    radar = row(report, "radar")
    assert radar.num_detections >= 20
    assert not radar.identifiable
    assert "m/s (rms) in its frame" in radar.why


def test_an_offset_that_is_known_too_badly_is_given_and_not_taken_for_known() -> None:
    report = estimate_offsets(parked("ego", 6.0), two_sensors(), "lidar", OffsetRules(max_std_s=0.001))
    radar = row(report, "radar")
    assert radar.std_s is not None
    assert 0.001 < radar.std_s < 0.01
    assert not radar.identifiable
    assert "1e+06 /s2 needed: objects move 6 m/s" in radar.why


def test_one_modality_has_nothing_to_compare_it_with() -> None:
    alone = [one for one in parked("ego") if not (isinstance(one, DetectionList) and one.sensor == "radar")]
    report = estimate_offsets(alone, two_sensors())
    (lidar,) = report.sensors
    assert (lidar.sensor, lidar.offset_s, lidar.identifiable) == ("lidar", None, False)
    assert lidar.why == "the only modality: nothing to compare it with"


def test_without_configured_sensors_those_of_the_recording_are_taken() -> None:
    report = estimate_offsets(iter(parked("ego")), replace(load(Config, CONFIG), sensors={}), "lidar")
    assert [one.sensor for one in report.sensors] == ["lidar", "radar"]


def test_sensors_that_share_no_track_have_nothing_to_compare() -> None:
    report = estimate_offsets(parked("ego"), two_sensors(), "lidar", OffsetRules(min_detections=100))
    radar = row(report, "radar")
    assert (report.num_tracks, radar.offset_s, radar.identifiable) == (0, None, False)
    assert radar.why == "no track of 2 s has 100 detections of it and of lidar: nothing to compare"


def test_an_unknown_reference_and_an_empty_input_are_refused() -> None:
    with pytest.raises(CallError, match="reference 'sonar' is no sensor of the input, which has lidar, radar"):
        estimate_offsets(parked("ego"), two_sensors(), "sonar")
    with pytest.raises(DataError, match="no detections"):
        estimate_offsets([one for one in parked("ego") if isinstance(one, EgoState)], two_sensors())


def test_the_command_shows_a_table_and_exits_1_where_the_input_breaks_off(tmp_path: Path, capsys: Capture) -> None:
    stream = tmp_path / "parked.jsonl"
    write_stream(stream, parked("ego"))
    lines = stream.read_text().splitlines(keepends=True)
    stream.write_text("".join(lines[:-1]) + lines[-1][:20])
    assert run(["offsets", str(stream), "-c", str(CONFIG), "--reference", "lidar"]) == 1
    shown = capsys.readouterr()
    assert "reference" in shown.out
    assert "reported stamp - true time" in shown.out
    assert "used up to there" in shown.err
    assert len(shown.err.splitlines()) == 1
