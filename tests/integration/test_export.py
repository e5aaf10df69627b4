"""`fgtrack export`: what is in the files, read back by the readers that viewers use."""

import json
import math
import shutil
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.interfaces import ConnectionExtRosbag2, QosDurability
from rosbags.rosbag2 import Reader

from fgtrack.cli.main import run as command
from fgtrack.config.shipped import shipped_folder
from fgtrack.core.types import (
    Detection,
    DetectionList,
    Disposition,
    EgoState,
    TickReport,
    TrackReport,
    TrackState,
    TrackStatus,
    UpdateRecord,
)
from fgtrack.inputs.ros.bag import Bag
from fgtrack.runs import Columns, Run, RunWriter, load_run
from fgtrack.show.export import viewer_messages
from fgtrack.show.shapes import Scene, Shape, ViewerMessage

pytest.importorskip(
    "foxglove", reason="foxglove-sdk is not installed (extra `foxglove`)"
)
from fgtrack.show.foxglove import values

Times = Counter[tuple[int, int]]
"""Number of messages by log time and publish time, or stamp."""


def read(path: Path) -> dict[str, Times]:
    """The times of the messages of an MCAP file by topic."""
    found: defaultdict[str, Times] = defaultdict(Counter)
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages(
            log_time_order=False
        ):
            assert schema is not None
            is_own = schema.name == "fgtrack.Outcome"
            assert (schema.encoding, channel.message_encoding) == (
                ("jsonschema", "json") if is_own else ("protobuf", "protobuf")
            )
            assert schema.name.startswith("foxglove.") or is_own
            found[channel.topic][message.log_time, message.publish_time] += 1
    return dict(found)


def messages_of(run: Path) -> dict[str, list[ViewerMessage]]:
    """The messages that show `run`, by topic; those with poses below it."""
    found = defaultdict(list)
    for message in viewer_messages({"run": load_run(run)})[0]:
        found[
            f"{message.topic}/poses"
            if isinstance(message.content, tuple)
            else message.topic
        ].append(message)
    return dict(found)


def read_bag(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """Log times and messages by topic."""
    bag = Bag(path)
    found = defaultdict(list)
    for topic, log_ns, message in bag.messages({topic.name for topic in bag.topics}):
        found[topic.name].append((log_ns, message))
    return dict(found)


def pairs(table: Columns, log: str, stamp: str) -> Times:
    return Counter(zip(table[log].tolist(), table[stamp].tolist(), strict=True))


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs of two estimators over a recording whose detections come late and out of sequence."""
    folder = tmp_path_factory.mktemp("export")
    assert (
        command(
            [
                "simulate",
                "default",
                "-o",
                str(folder / "in.jsonl"),
                "--seed",
                "3",
                "--duration",
                "3",
            ]
        )
        == 0
    )
    arguments = [
        "-c",
        "smoother",
        "--map",
        "oval",
        "-e",
        "smoother,ekf-replay",
        "--set",
        "smoother.lagged_s=[0.1,0.3]",
    ]
    assert (
        command(
            ["replay", str(folder / "in.jsonl"), *arguments, "-o", str(folder / "runs")]
        )
        == 0
    )
    return folder / "runs"


@pytest.fixture(scope="module")
def smoothed(runs: Path) -> Run:
    return load_run(runs / "smoother")


@pytest.fixture(scope="module")
def shown(runs: Path) -> dict[str, list[ViewerMessage]]:
    return messages_of(runs / "smoother")


@pytest.fixture(scope="module")
def file(runs: Path) -> Path:
    out = runs.parent / "run.mcap"
    assert command(["export", str(runs / "smoother"), "-o", str(out)]) == 0
    return out


@pytest.fixture(scope="module")
def bag(runs: Path) -> dict[str, list[tuple[int, Any]]]:
    out = runs.parent / "rosbag"
    assert command(["export", str(runs / "smoother"), "-o", str(out), "--ros2"]) == 0
    return read_bag(out)


def test_every_topic_has_the_messages_and_both_times_of_the_run(
    file: Path, shown: dict[str, list[ViewerMessage]], smoothed: Run
) -> None:
    run, times = smoothed, read(file)

    def poses(topic: str) -> int:
        return sum(len(one.content) for one in shown[topic])

    assert times["/outcomes"] == pairs(run.tables["updates"], "receipt_ns", "stamp_ns")
    assert any(log_ns > publish_ns for log_ns, publish_ns in times["/outcomes"])
    assert (
        times["/tf"]
        == times["/ego/pose"]
        == pairs(run.tables["ego"], "receipt_ns", "stamp_ns")
    )
    assert set(times["/tracks/poses"]) == set(
        pairs(run.tables["tracks"], "now_ns", "stamp_ns")
    )
    assert poses("/tracks/poses") == run.tables["tracks"].num_rows
    assert poses("/truth/poses") == (run.tables["truth"]["object_id"] >= 0).sum()
    final = run.tables["smoothed"].where(run.tables["smoothed"]["kind"] == "final")
    assert poses("/smoothed/poses") == final.num_rows > 0
    end_ns = run.tables["timing"]["now_ns"].max()
    for log_ns, publish_ns in times["/smoothed/poses"]:
        assert log_ns == max(
            publish_ns, min(publish_ns + 1_000_000_000, end_ns)
        )  # the window of the smoother
    every: Times = Counter()
    for sensor in np.unique(run.tables["detections"]["sensor"]).tolist():
        mine = run.tables["detections"].where(
            run.tables["detections"]["sensor"] == sensor
        )
        lists = Counter(set(pairs(mine, "receipt_ns", "stamp_ns")))
        assert times[f"/detections/{sensor}/poses"] == lists
        assert poses(f"/detections/{sensor}/poses") == mine.num_rows
        every += lists
    assert times["/detections"] == every
    assert times["/past"].total() == len(np.unique(run.tables["lagged"]["now_ns"]))
    assert times["/map"].total() == times["/ego"].total() == 1
    places = {
        (log_ns, x_m, y_m)
        for log_ns, x_m, y_m in zip(
            *(run.tables["tracks"][n].tolist() for n in ROW), strict=True
        )
    }
    assert places == {
        (one.log_ns, each.x_m, each.y_m)
        for one in shown["/tracks/poses"]
        for each in one.content
    }


ROW = ("now_ns", "x_m", "y_m")


# A run made by hand

STAMP_NS, RECEIPT_NS, TICK_NS = 1_000_000_000, 1_400_000_000, 1_410_000_000


def test_blocks_of_times_do_not_change_a_message(
    runs: Path,
    shown: dict[str, list[ViewerMessage]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Also a track that ends where a block ends is removed from the scene."""
    monkeypatch.setattr("fgtrack.show.run_messages._BLOCK_TIMES", 3)
    assert messages_of(runs / "smoother") == shown


@pytest.fixture(scope="module")
def by_hand(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An ego at (100, 50) that looks north; an object is sensed 10 m ahead and received when it is 8 m farther."""
    path = tmp_path_factory.mktemp("hand") / "run"
    P = np.diag([4.0, 1.0, 0.01, 1.0, 0.01])
    track = TrackState(TICK_NS, np.array([98.0, 68.0, math.pi / 2, 20.0, 0.0]), P)
    turn = np.array([[math.cos(0.5), -math.sin(0.5)], [math.sin(0.5), math.cos(0.5)]])
    turned = P.copy()
    turned[:2, :2] = turn @ np.diag([0.25, 9.0]) @ turn.T
    other = TrackState(TICK_NS, np.array([0.0, 0.0, -3.0, 5.0, 0.0]), turned)
    reports = tuple(
        TrackReport(k, status, state, 4)
        for k, status, state in (
            (4, TrackStatus.CONFIRMED, track),
            (5, TrackStatus.COASTING, other),
        )
    )
    late = UpdateRecord(
        "lidar", STAMP_NS, RECEIPT_NS, 0, Disposition.OUT_OF_SEQUENCE, 4, 1.5
    )
    lost = UpdateRecord("lidar", STAMP_NS, RECEIPT_NS, 1, Disposition.GATED)
    refused = UpdateRecord("lidar", STAMP_NS, RECEIPT_NS, 2, Disposition.TOO_OLD, 4)
    merged = UpdateRecord("lidar", STAMP_NS, RECEIPT_NS, 3, Disposition.MERGED, 4)
    config = (
        "ego: {detection_origin_x_m: -2.0, detection_origin_y_m: 0.0}\n"
        "sensors: {lidar: {mount: {x_m: 1.0, y_m: 2.0, yaw_rad: 0.0}}}\n"
    )
    with RunWriter(path, config) as writer:
        for time_ns in (900_000_000, 1_100_000_000):
            writer.write_ego(
                EgoState(time_ns, time_ns + 5, 100.0, 50.0, math.pi / 2, 0.0)
            )
        objects = [
            Detection(x_m=11.0, y_m=0.0),
            Detection(bearing_rad=0.0),
            Detection(range_m=20.0, bearing_rad=math.pi / 2),
            Detection(x_m=11.0, y_m=1.0),
        ]
        writer.write_detections(
            DetectionList("lidar", STAMP_NS, RECEIPT_NS, objects, "sensor")
        )
        writer.write_tick(
            TickReport(0, TICK_NS, reports, (late, lost, refused, merged)), 1, 4
        )
        writer.write_tick(TickReport(1, TICK_NS + 20_000_000, reports[1:], ()), 1, 0)
        writer.finish({"estimator": "smoother"})
    return path


def shapes(message: ViewerMessage) -> list[Shape]:
    assert isinstance(message.content, Scene)
    return [shape for entity in message.content.entities for shape in entity.shapes]


def test_an_arrow_leads_from_where_a_detection_was_sensed_to_its_track_now(
    by_hand: Path,
) -> None:
    topics = messages_of(by_hand)
    # The sensor is 1 m behind the ego's reference point (-2 + 1) and 2 m to the left: at (98, 49), and looks north.
    [message] = topics["/arrivals"]
    assert (message.log_ns, message.stamp_ns) == (RECEIPT_NS, STAMP_NS)
    [arrow] = shapes(message)
    assert arrow.at_m == pytest.approx((98.0, 60.0))
    assert (arrow.size_m[0], arrow.yaw_rad, arrow.colour[3]) == pytest.approx(
        (8.0, math.pi / 2, 1.0)
    )
    [detections] = topics["/detections"]
    first, sight, to_the_left, merged = shapes(detections)
    assert [one.at_m for one in (first, to_the_left, merged)] == [
        pytest.approx(place) for place in ((98.0, 60.0), (78.0, 49.0), (97.0, 60.0))
    ]
    assert sight.points_m == [pytest.approx((98.0, 49.0)), pytest.approx((98.0, 199.0))]
    grey = [
        len(set(one.colour[:3])) == 1 for one in (first, sight, to_the_left, merged)
    ]
    assert grey == [False, True, True, False]  # of those that were not used
    outcomes = [one.content for one in topics["/outcomes"]]
    assert [one["disposition"] for one in outcomes] == [
        "out_of_sequence",
        "gated",
        "too_old",
        "merged",
    ]
    assert [outcomes[0][name] for name in ("delay_s", "track_id", "nis")] == [
        0.4,
        4,
        1.5,
    ]
    assert outcomes[1]["track_id"] is outcomes[1]["nis"] is None


def test_foxglove_gets_what_the_shapes_say(by_hand: Path) -> None:
    """The messages of its SDK cannot be read field by field, so their text is."""
    topics = messages_of(by_hand)

    def text(topic: str) -> str:
        return " ".join(
            str(value) for message in topics[topic] for _, value in values(message)
        )

    arrow = text("/arrivals")
    assert "position: Some(Vector3 { x: 98.0, y: 60.0" in arrow
    assert "shaft_length: 6.5" in arrow
    assert "head_length: 1.5" in arrow
    # It is shown for half a second from its receipt on, 0.4 s after its stamp.
    assert "timestamp: Some(Timestamp { sec: 1, nsec: 0 })" in arrow
    assert "lifetime: Some(Duration { sec: 0, nsec: 900000000 })" in arrow
    assert 'id: "track 4"' in text("/tracks")
    assert 'text: "5"' in text("/tracks")
    assert "deletions=[SceneEntityDeletion" in text("/tracks")
    assert "lines: [LinePrimitive { r#type: LineStrip" in text("/detections")
    assert 'child_frame_id="ego"' in text("/ego")
    assert 'frame_id: "ego", id: "ego"' in text("/ego")
    assert "frame_locked: true" in text("/ego")
    assert {"track_id", "nis"} & set(next(values(topics["/outcomes"][1]))[1]) == set()


def test_a_bag_has_the_messages_and_times_of_the_run(
    bag: dict[str, list[tuple[int, Any]]], smoothed: Run
) -> None:
    def stamp_ns(message: Any) -> int:
        return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)

    def times(topic: str) -> Counter[tuple[int, int]]:
        return Counter((log_ns, stamp_ns(one)) for log_ns, one in bag[topic])

    assert times("/ego/odometry") == pairs(
        smoothed.tables["ego"], "receipt_ns", "stamp_ns"
    )
    assert len(bag["/tf"]) == smoothed.tables["ego"].num_rows
    assert set(times("/tracks")) == set(
        pairs(smoothed.tables["tracks"], "now_ns", "stamp_ns")
    )
    assert (
        sum(len(one.detections) for _, one in bag["/tracks"])
        == smoothed.tables["tracks"].num_rows
    )
    for sensor in np.unique(smoothed.tables["detections"]["sensor"]).tolist():
        mine = smoothed.tables["detections"].where(
            smoothed.tables["detections"]["sensor"] == sensor
        )
        assert set(times(f"/detections/{sensor}")) == set(
            pairs(mine, "receipt_ns", "stamp_ns")
        )
        assert (
            sum(len(one.detections) for _, one in bag[f"/detections/{sensor}"])
            == mine.num_rows
        )
    kinds = {
        "/tracks": "vision_msgs/msg/Detection3DArray",
        "/ego/odometry": "nav_msgs/msg/Odometry",
        "/tf": "tf2_msgs/msg/TFMessage",
        "/tracks/markers": "visualization_msgs/msg/MarkerArray",
    }
    assert {topic: bag[topic][0][1].__msgtype__ for topic in kinds} == kinds


def test_what_is_sent_once_reaches_those_who_listen_later(
    bag: dict[str, list[tuple[int, Any]]], runs: Path
) -> None:
    lasting = set()
    with Reader(runs.parent / "rosbag") as reader:
        for connection in reader.connections:
            assert isinstance(connection.ext, ConnectionExtRosbag2)
            [profile] = connection.ext.offered_qos_profiles
            if profile.durability is QosDurability.TRANSIENT_LOCAL:
                lasting.add(connection.topic)
    assert lasting == {"/map/markers", "/ego/markers"}
    assert all(len(bag[topic]) == 1 for topic in lasting)


# Several runs, and runs of which something is missing


def test_several_runs_stand_side_by_side(runs: Path, tmp_path: Path) -> None:
    both = {
        path.name: load_run(path) for path in (runs / "smoother", runs / "ekf-replay")
    }
    messages = list(viewer_messages(both)[0])
    topics = {one.topic for one in messages}
    assert {
        "/map",
        "/ego",
        "/smoother/tracks",
        "/ekf_replay/tracks",
        "/smoother/past",
    } <= topics
    assert "/tracks" not in topics
    assert "/ekf_replay/past" not in topics  # a filter corrects no past
    boxes = {
        (one.topic, shape.colour[:3])
        for one in messages
        if one.topic.endswith("/tracks") and isinstance(one.content, Scene)
        for shape in shapes(one)
        if shape.kind == "cube"
    }
    assert len(boxes) == len({colour for _, colour in boxes}) == 2


def test_a_map_that_is_gone_is_reported(
    by_hand: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old = tmp_path / "old"
    shutil.copytree(by_hand, old)
    (old / "config.yaml").write_text("map: {track: gone.csv}\n")
    assert command(["export", str(old), "-o", str(tmp_path / "x.mcap")]) == 0
    assert "map.track: the file gone.csv is missing" in capsys.readouterr().err


def test_the_layout_shows_topics_that_are_written(file: Path) -> None:
    topics = read(file)
    layout = json.loads(
        (shipped_folder() / "foxglove_layout.json").read_text(encoding="utf-8")
    )
    panels = layout["configById"]
    named = {
        name
        for name, shown in panels["3D!fgtrack"]["topics"].items()
        if shown["visible"]
    }
    alone = {name for name in named if name.count("/") == 1}
    assert alone <= set(topics)
    assert {"/" + name.split("/")[2] for name in named - alone} <= alone
    paths = [
        one["value"] for panel in panels.values() for one in panel.get("paths", [])
    ]
    paths += [panel["topicPath"] for panel in panels.values() if "topicPath" in panel]
    assert {path.partition(".")[0] for path in paths} <= set(topics)
