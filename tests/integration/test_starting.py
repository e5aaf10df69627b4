"""`fgtrack info --write`: a starting configuration for a recording that nobody has configured."""

import csv
import math

import pytest
from rosbags.rosbag2 import Writer
from rosbags.rosbag2.enums import StoragePlugin
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from support.messages import START_NS, drive, shared

import fgtrack
from fgtrack.cli.main import run
from fgtrack.config.reading import read_config
from fgtrack.core.types import DetectionList, EgoState, TruthState
from fgtrack.inputs.ros.bag_writer import write_bag
from fgtrack.inputs.settings import Field
from fgtrack.inputs.source import open_input
from fgtrack.inputs.stream import write_stream
from fgtrack.meaning.draft import drafted

RADAR = """std_msgs/Header header
Target[] targets
================================================================================
MSG: acme_msgs/Target
float32 range
float32 azimuth_deg
float32 doppler
float32 rcs
uint32 id
"""


def loaded(text, folder):
    (folder / "my.yaml").write_text(text)
    return read_config(folder / "my.yaml")


def draft_text(recording):
    return drafted(recording).to_yaml()


def table(path, *rows):
    with path.open("w", newline="") as file:
        csv.writer(file).writerows(rows)


@pytest.fixture
def foreign(tmp_path):
    """CSV of another program: epoch seconds, a compass in degrees, km/h, polar detections in degrees."""
    rows = {
        "ego.csv": [["t", "east", "north", "heading", "v", "temp"]],
        "radar.csv": [["t", "seen", "range", "azimuth"]],
    }
    for message in fgtrack.simulate("single_opponent", seed=1, duration_s=3.0):
        stamp, receipt = (
            f"{1_700_000_000 + ns / 1e9:.6f}"
            for ns in (message.stamp_ns, message.receipt_ns)
        )
        if isinstance(message, EgoState):
            heading = (90.0 - math.degrees(message.yaw_rad)) % 360.0
            rows["ego.csv"].append(
                [stamp, message.x_m, message.y_m, heading, 3.6 * message.speed_mps, 21]
            )
        elif isinstance(message, DetectionList) and message.sensor == "radar":
            for one in message.objects:
                bearing = math.degrees(math.atan2(one.y_m, one.x_m))
                rows["radar.csv"].append(
                    [stamp, receipt, math.hypot(one.x_m, one.y_m), bearing]
                )
    (tmp_path / "drive").mkdir()
    for name, lines in rows.items():
        table(tmp_path / "drive" / name, *lines)
    return tmp_path / "drive"


def test_tables_of_another_program_are_written_read_and_replayed(
    foreign, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    assert run(["info", "drive", "--write", "my.yaml"]) == 0
    shown = capsys.readouterr()
    assert "my.yaml: written" in shown.out
    assert "detections radar" in shown.out
    config = read_config("my.yaml")
    assert config.input.csv.ego.columns["yaw_rad"] == Field("heading", -1.0, 90.0, True)
    assert config.input.csv.ego.columns["speed_mps"] == Field("v", 1.0 / 3.6)
    assert config.input.csv.detections["radar"].columns["bearing_rad"] == Field(
        "azimuth", degrees=True
    )
    text = (tmp_path / "my.yaml").read_text()
    assert (
        "degrees; a compass, clockwise from north, as it agrees with the direction of travel"
        in text
    )
    assert "# ego.csv: not used: temp (21 to 21)" in text
    assert run(["replay", "drive", "-c", "my.yaml", "-o", "run"]) == 0
    assert "warning" not in capsys.readouterr().err.replace("map: no map", "")


def test_a_type_that_nobody_knows_is_mapped_by_its_fields(tmp_path):
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(RADAR, "acme_msgs/msg/Scan"))
    with Writer(
        tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP
    ) as writer:
        scans = writer.add_connection(
            "/sensing/front_radar/scan", "acme_msgs/msg/Scan", typestore=store
        )
        words = writer.add_connection(
            "/chatter", "std_msgs/msg/String", typestore=store
        )
        for k in range(20):
            stamp = store.types["builtin_interfaces/msg/Time"](
                1_700_000_000, 50_000_000 * k
            )
            header = store.types["std_msgs/msg/Header"](stamp, "radar")
            targets = [
                store.types["acme_msgs/msg/Target"](
                    40.0 + j, 10.0 * j - 20.0, -3.0, 5.0, j
                )
                for j in range(5)
            ]
            scan = store.types["acme_msgs/msg/Scan"](header, targets)
            receipt_ns = 1_700_000_000_000_000_000 + 50_000_000 * k + 10_000_000
            writer.write(
                scans, receipt_ns, store.serialize_cdr(scan, "acme_msgs/msg/Scan")
            )
            word = store.types["std_msgs/msg/String"]("a")
            writer.write(
                words, receipt_ns, store.serialize_cdr(word, "std_msgs/msg/String")
            )
    text = draft_text(tmp_path / "bag")
    config = loaded(text, tmp_path)
    assert dict(config.input.detections["front_radar_scan"].fields) == {
        "objects": "targets",
        "range_m": "range",
        "bearing_rad": Field("azimuth_deg", degrees=True),
        "range_rate_mps": "doppler",
        "object_id": "id",
    }
    first = next(iter(open_input(tmp_path / "bag", config.input).messages()))
    assert first.objects[1].bearing_rad == pytest.approx(math.radians(-10.0))
    assert "# Not used: /chatter (std_msgs/msg/String)" in text
    assert "not used: rcs (5 to 5)" in text


def test_topics_of_known_types_are_the_ego_and_sensors(tmp_path):
    write_bag(tmp_path / "all", drive())
    own = loaded(draft_text(tmp_path / "all"), tmp_path)
    assert own.input.ego is None
    assert sorted(own.sensors) == ["lidar", "radar"]
    nav = draft_text(shared("data/bags/nav2_turtlebot.mcap"))
    config = loaded(nav, tmp_path)
    assert (config.input.ego.topic, config.input.ego.stamp_from) == ("/odom", "receipt")
    assert "/amcl_pose as ego: another part has this role" in nav


def test_a_recording_of_which_nothing_can_be_guessed_still_gives_a_configuration(
    tmp_path,
):
    table(tmp_path / "a.csv", ["alpha\u2028", "beta: 1"], [1, "#x"], [2, "{y"])
    text = draft_text(tmp_path / "a.csv")
    assert dict(loaded(text, tmp_path).sensors) == {}
    assert "# Not used: a.csv: no column of times among " in text
    stream = [TruthState(START_NS, START_NS, 1, 0.0, 0.0)]
    write_stream(tmp_path / "s.jsonl", stream)
    assert dict(loaded(draft_text(tmp_path / "s.jsonl"), tmp_path).sensors) == {}
