"""`fgtrack export`: what is in the files, read back by the readers that viewers use."""

import hashlib
import json
import math
import shutil
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from foxglove import messages as sdk
from mcap.reader import make_reader
from rosbags.interfaces import ConnectionExtRosbag2, QosDurability
from rosbags.rosbag2 import Reader

import fgtrack
from fgtrack.cli.main import run as command
from fgtrack.core.errors import CallError, DataError
from fgtrack.core.types import (
    Detection,
    DetectionList,
    Disposition,
    EgoState,
    ObjectReport,
    TickReport,
    TrackReport,
    TrackState,
    TrackStatus,
    UpdateRecord,
)
from fgtrack.evaluation.placement import placed
from fgtrack.io.ros.bag import Bag, BagMessage
from fgtrack.io.run import Run, RunWriter, Table, load_run
from fgtrack.pipeline.build import build_tracker
from fgtrack.pipeline.replay import replay_in_memory
from fgtrack.pipeline.shipped import read_config, shipped_folder
from fgtrack.tracking.preprocess import Candidate, Preprocess
from fgtrack.viewers.export import export, viewer_messages
from fgtrack.viewers.foxglove import write_foxglove
from fgtrack.viewers.ros2 import write_viewer_bag
from fgtrack.viewers.schemas import SCHEMAS
from fgtrack.viewers.shapes import Scene
from fgtrack.viewers.surroundings import truth_messages

#: SHA-256 of the schemas that @foxglove/schemas 2.1.0 publishes, without `description` and `$comment`, keys sorted.
PUBLISHED_SCHEMAS = "d4fcf71a99197351d009edf4917e20a5146f3959c64d715f31f6317dcaff2da5"

Entry = tuple[int, int, dict[str, Any]]
"""Log time, publish time, message."""


def read(path: Path) -> dict[str, list[Entry]]:
    """The messages of an MCAP file by topic, each checked against the schema that the file holds."""
    found = defaultdict(list)
    validators = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages(log_time_order=False):
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            if schema.name not in validators:
                validators[schema.name] = jsonschema.Draft202012Validator(json.loads(schema.data))
            value = json.loads(message.data)
            validators[schema.name].validate(value)
            found[channel.topic].append((message.log_time, message.publish_time, value))
    return dict(found)


def read_bag(path: Path) -> dict[str, list[BagMessage]]:
    bag = Bag(path)
    found = defaultdict(list)
    for message in bag.messages({topic.name for topic in bag.topics}):
        found[message.topic].append(message)
    return dict(found)


def ns(time: dict[str, int]) -> int:
    return time["sec"] * 1_000_000_000 + time["nsec"]


def pairs(table: Table, log: str, stamp: str) -> Counter[tuple[int, int]]:
    return Counter(zip(table[log].tolist(), table[stamp].tolist(), strict=True))


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs of two estimators over a recording whose detections come late and out of sequence."""
    folder = tmp_path_factory.mktemp("export")
    assert command(["simulate", "default", "-o", str(folder / "in.jsonl"), "--seed", "3", "--duration", "3"]) == 0
    arguments = ["-c", "smoother", "--map", "oval", "-e", "smoother,ekf-replay", "--set", "smoother.lagged_s=[0.1,0.3]"]
    assert command(["replay", str(folder / "in.jsonl"), *arguments, "-o", str(folder / "runs")]) == 0
    return folder / "runs"


@pytest.fixture(scope="module")
def smoothed(runs: Path) -> Run:
    return load_run(runs / "smoother")


@pytest.fixture(scope="module")
def file(runs: Path) -> Path:
    out = runs.parent / "run.mcap"
    assert command(["export", str(runs / "smoother"), "-o", str(out)]) == 0
    return out


@pytest.fixture(scope="module")
def topics(file: Path) -> dict[str, list[Entry]]:
    return read(file)


@pytest.fixture(scope="module")
def bag(runs: Path) -> dict[str, list[BagMessage]]:
    out = runs.parent / "rosbag"
    assert command(["export", str(runs / "smoother"), "-o", str(out), "--ros2"]) == 0
    return read_bag(out)


def test_truth_of_a_negative_id_is_shown_and_the_ego_is_not() -> None:
    columns = {"stamp_ns": 1, "object_id": 1, "x_m": 2.0, "y_m": 3.0, "yaw_rad": 0.1}
    truth = Table(
        {name: np.array([value] * 3) for name, value in columns.items()} | {"object_id": np.array([-1, -5, 0])}
    )
    [_, shown] = truth_messages(truth)
    assert [one.object_id for one in shown.objects.objects] == [-5, 0]


def test_every_topic_has_the_messages_and_both_times_of_the_run(topics: dict[str, list[Entry]], smoothed: Run) -> None:
    run = smoothed

    def times(topic: str) -> Counter[tuple[int, int]]:
        return Counter((log_ns, publish_ns) for log_ns, publish_ns, _ in topics[topic])

    def poses(topic: str) -> int:
        return sum(len(value["poses"]) for *_, value in topics[topic])

    assert times("/outcomes") == pairs(run.updates, "receipt_ns", "stamp_ns")
    assert any(log_ns > publish_ns for log_ns, publish_ns in times("/outcomes"))
    assert times("/tf") == times("/ego/pose") == pairs(run.ego, "receipt_ns", "stamp_ns")
    assert set(times("/tracks/poses")) == set(pairs(run.tracks, "now_ns", "stamp_ns"))
    assert poses("/tracks/poses") == run.tracks.num_rows
    assert poses("/truth/poses") == (run.truth["object_id"] >= 0).sum()
    final = run.smoothed.where(run.smoothed["kind"] == "final")
    assert poses("/smoothed/poses") == final.num_rows > 0
    for log_ns, publish_ns, _ in topics["/smoothed/poses"]:
        assert publish_ns <= log_ns <= publish_ns + 1_000_000_000  # the window of the smoother
    every: Counter[tuple[int, int]] = Counter()
    for sensor in np.unique(run.detections["sensor"]).tolist():
        mine = run.detections.where(run.detections["sensor"] == sensor)
        lists = Counter(set(pairs(mine, "receipt_ns", "stamp_ns")))
        assert times(f"/detections/{sensor}/poses") == lists
        assert poses(f"/detections/{sensor}/poses") == mine.num_rows
        every += lists
    assert times("/detections") == every
    assert len(topics["/tracks"]) == len(topics["/ellipses"]) >= len(topics["/tracks/poses"])
    assert len(topics["/past"]) == len(np.unique(run.lagged["now_ns"]))
    assert len(topics["/map"]) == len(topics["/ego"]) == 1


def test_poses_are_those_of_the_run(topics: dict[str, list[Entry]], smoothed: Run) -> None:
    tracks = smoothed.tracks
    rows = {
        (now_ns, round(x_m, 4), round(y_m, 4)): yaw_rad
        for now_ns, x_m, y_m, yaw_rad in zip(
            *(tracks[name].tolist() for name in ("now_ns", "x_m", "y_m", "yaw_rad")), strict=True
        )
    }
    for log_ns, publish_ns, value in topics["/tracks/poses"]:
        assert ns(value["timestamp"]) == publish_ns
        assert value["frame_id"] == "map"
        for pose in value["poses"]:
            place, turn = pose["position"], pose["orientation"]
            assert (turn["x"], turn["y"]) == (0.0, 0.0)
            assert math.hypot(turn["z"], turn["w"]) == pytest.approx(1.0, abs=2e-6)
            yaw_rad = 2.0 * math.atan2(turn["z"], turn["w"])
            assert abs(math.remainder(yaw_rad - rows[log_ns, place["x"], place["y"]], math.tau)) < 5e-6


def test_the_frame_of_the_ego_follows_its_path(topics: dict[str, list[Entry]], smoothed: Run) -> None:
    for row, (_, publish_ns, value) in enumerate(topics["/tf"]):
        assert (value["parent_frame_id"], value["child_frame_id"]) == ("map", "ego")
        assert ns(value["timestamp"]) == publish_ns == smoothed.ego["stamp_ns"][row]
        assert value["translation"]["x"] == pytest.approx(smoothed.ego["x_m"][row], abs=6e-5)
    [(_, _, scene)] = topics["/ego"]
    assert scene["entities"][0]["frame_id"] == "ego"
    assert scene["entities"][0]["frame_locked"] is True


def test_a_track_that_has_ended_is_removed(topics: dict[str, list[Entry]]) -> None:
    shown: set[str] = set()
    for topic in ("/tracks", "/ellipses"):
        shown.clear()
        for *_, value in topics[topic]:
            shown -= {one["id"] for one in value["deletions"]}
            here = {one["id"] for one in value["entities"]}
            assert shown <= here
            shown = here


# A run made by hand

STAMP_NS, RECEIPT_NS, TICK_NS = 1_000_000_000, 1_400_000_000, 1_410_000_000


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
        for k, status, state in ((4, TrackStatus.CONFIRMED, track), (5, TrackStatus.COASTING, other))
    )
    late = UpdateRecord("lidar", STAMP_NS, RECEIPT_NS, 0, Disposition.OUT_OF_SEQUENCE, 4, 1.5)
    lost = UpdateRecord("lidar", STAMP_NS, RECEIPT_NS, 1, Disposition.GATED)
    refused = UpdateRecord("lidar", STAMP_NS, RECEIPT_NS, 2, Disposition.TOO_OLD, 4)
    merged = UpdateRecord("lidar", STAMP_NS, RECEIPT_NS, 3, Disposition.MERGED, 4)
    config = (
        "ego: {detection_origin_x_m: -2.0, detection_origin_y_m: 0.0}\n"
        "sensors: {lidar: {mount: {x_m: 1.0, y_m: 2.0, yaw_rad: 0.0}}}\n"
    )
    with RunWriter(path, config) as writer:
        for time_ns in (900_000_000, 1_100_000_000):
            writer.write_ego(EgoState(time_ns, time_ns + 5, 100.0, 50.0, math.pi / 2, 0.0))
        objects = [
            Detection(x_m=11.0, y_m=0.0),
            Detection(bearing_rad=0.0),
            Detection(range_m=20.0, bearing_rad=math.pi / 2),
            Detection(x_m=11.0, y_m=1.0),
        ]
        writer.write_detections(DetectionList("lidar", STAMP_NS, RECEIPT_NS, objects, "sensor"))
        writer.write_tick(TickReport(0, TICK_NS, reports, (late, lost, refused, merged)), 1, 4)
        writer.write_tick(TickReport(1, TICK_NS + 20_000_000, reports[1:], ()), 1, 0)
        writer.finish({"estimator": "smoother"})
    return path


def test_an_arrow_leads_from_where_a_detection_was_sensed_to_its_track_now(by_hand: Path, tmp_path: Path) -> None:
    export([by_hand], tmp_path / "x.mcap")
    topics = read(tmp_path / "x.mcap")
    # The sensor is 1 m behind the ego's reference point (-2 + 1) and 2 m to the left: at (98, 49), and looks north.
    [(log_ns, publish_ns, value)] = topics["/arrivals"]
    assert (log_ns, publish_ns) == (RECEIPT_NS, STAMP_NS)
    [arrow] = value["entities"][0]["arrows"]
    assert arrow["pose"]["position"] == pytest.approx({"x": 98.0, "y": 60.0, "z": 0.3})
    assert arrow["shaft_length"] + arrow["head_length"] == pytest.approx(8.0)
    assert arrow["pose"]["orientation"]["z"] == pytest.approx(math.sin(math.pi / 4), abs=1e-6)
    assert arrow["color"]["a"] == 1.0
    # It is shown for half a second from its receipt on, 0.4 s after its stamp.
    assert ns(value["entities"][0]["lifetime"]) == 900_000_000
    [(_, _, scene)] = topics["/detections"]
    [entity] = scene["entities"]
    assert entity["id"] == "lidar"
    places = [one["pose"]["position"] for one in entity["spheres"]]
    assert places[0] == pytest.approx({"x": 98.0, "y": 60.0, "z": 0.5})
    assert places[1] == pytest.approx({"x": 78.0, "y": 49.0, "z": 0.5})  # to the left
    assert places[2] == pytest.approx({"x": 97.0, "y": 60.0, "z": 0.5})
    grey = [len({one["color"][c] for c in "rgb"}) == 1 for one in entity["spheres"]]
    assert grey == [False, True, False]
    [sight] = entity["lines"]
    assert sight["points"][0] == pytest.approx({"x": 98.0, "y": 49.0, "z": 0.0})
    assert sight["points"][1] == pytest.approx({"x": 98.0, "y": 199.0, "z": 0.0})
    assert sight["color"]["r"] == sight["color"]["g"] == sight["color"]["b"]  # grey: it was not used
    became = ["out_of_sequence", "gated", "too_old", "merged"]
    assert [value["disposition"] for *_, value in topics["/outcomes"]] == became
    assert topics["/outcomes"][0][2]["delay_s"] == 0.4
    assert ns(topics["/outcomes"][0][2]["header"]["stamp"]) == STAMP_NS
    assert topics["/outcomes"][0][2]["track_id"] == 4
    assert topics["/outcomes"][0][2]["nis"] == 1.5
    assert not {"track_id", "nis"} & set(topics["/outcomes"][1][2])


@pytest.fixture(scope="module")
def described(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two tracks: a car whose height nobody tells, and one of which nothing is told."""
    path = tmp_path_factory.mktemp("described") / "run"
    state = TrackState(TICK_NS, np.array([98.0, 68.0, 0.0, 20.0, 0.0]), np.eye(5))
    car = ObjectReport("car", 1.0, 4.2, 1.7)
    reports = tuple(TrackReport(k, TrackStatus.CONFIRMED, state, 4, object=told) for k, told in ((1, car), (2, None)))
    with RunWriter(path, "{}") as writer:
        writer.write_tick(TickReport(0, TICK_NS, reports, ()), 1, 0)
        writer.finish({"estimator": "smoother"})
    return path


def test_a_box_has_the_size_that_detections_told_and_its_label_the_class(described: Path, tmp_path: Path) -> None:
    export([described], tmp_path / "x.mcap")
    topics = read(tmp_path / "x.mcap")
    [(_, _, scene)] = topics["/tracks"]
    car, unknown = scene["entities"]
    assert car["cubes"][0]["size"] == {"x": 4.2, "y": 1.7, "z": 1.2}  # the height of a racing car
    assert unknown["cubes"][0]["size"] == {"x": 4.8, "y": 2.0, "z": 1.2}
    assert [one["texts"][0]["text"] for one in (car, unknown)] == ["1 car", "2"]
    assert {"key": "class", "value": "car"} in car["metadata"]
    assert "class" not in {one["key"] for one in unknown["metadata"]}


def test_a_bag_has_the_size_and_class_of_a_track(described: Path, tmp_path: Path) -> None:
    export([described], tmp_path / "bag", ros2=True)
    car, unknown = read_bag(tmp_path / "bag")["/tracks"][0].data.detections
    assert [(one.bbox.size.x, one.bbox.size.y, one.bbox.size.z) for one in (car, unknown)] == [(4.2, 1.7, 0), (0, 0, 0)]
    assert [one.results[0].hypothesis.class_id for one in (car, unknown)] == ["car", ""]


def test_an_ellipse_reaches_two_standard_deviations_along_its_axes(by_hand: Path, tmp_path: Path) -> None:
    export([by_hand], tmp_path / "x.mcap")
    first, second = read(tmp_path / "x.mcap")["/ellipses"]
    straight, turned = (one["cylinders"][0] for one in first[2]["entities"])
    assert (straight["size"]["x"], straight["size"]["y"]) == (8.0, 4.0)  # 2 sigma to both sides: 4 times 2, 4 times 1
    assert straight["pose"]["position"] == {"x": 98.0, "y": 68.0, "z": 1.25}  # on its box
    assert straight["pose"]["orientation"]["z"] == 0.0
    assert (turned["size"]["x"], turned["size"]["y"]) == (12.0, 2.0)  # 4 times 3, 4 times 0.5
    yaw_rad = 2.0 * math.atan2(turned["pose"]["orientation"]["z"], turned["pose"]["orientation"]["w"])
    assert yaw_rad == pytest.approx(0.5 + math.pi / 2, abs=5e-6)
    assert [one["id"] for one in second[2]["deletions"]] == ["track 4"]


def test_a_file_and_a_bag_say_the_same_of_a_run_made_by_hand(by_hand: Path, tmp_path: Path) -> None:
    export([by_hand], tmp_path / "bag", ros2=True)
    found = read_bag(tmp_path / "bag")
    [arrow] = found["/arrivals/markers"][0].data.markers
    assert [(point.x, point.y) for point in arrow.points] == [pytest.approx((98.0, 60.0)), pytest.approx((98.0, 68.0))]
    assert arrow.header.stamp.sec * 10**9 + arrow.header.stamp.nanosec == STAMP_NS
    assert found["/arrivals/markers"][0].log_ns == RECEIPT_NS
    first, second = (one.data.markers for one in found["/ellipses/markers"])
    assert [(one.scale.x, one.scale.y) for one in first] == [pytest.approx((8.0, 4.0)), pytest.approx((12.0, 2.0))]
    assert [(one.ns, one.action) for one in second] == [("track 5", 0), ("track 4", 2)]
    track = found["/tracks"][0].data.detections[0]
    assert track.id == "4"
    assert np.diag(track.results[0].pose.covariance.reshape(6, 6)).tolist() == [4.0, 1.0, 0.0, 0.0, 0.0, 0.01]
    odometry = found["/ego/odometry"][0].data
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("map", "base_link")
    [transform] = found["/tf"][0].data.transforms
    assert transform.transform.rotation.z == pytest.approx(math.sin(math.pi / 4))


def test_a_bag_has_the_messages_and_times_of_the_run(bag: dict[str, list[BagMessage]], smoothed: Run) -> None:
    def stamp_ns(message: BagMessage) -> int:
        header = message.data.header
        return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)

    def times(topic: str) -> Counter[tuple[int, int]]:
        return Counter((one.log_ns, stamp_ns(one)) for one in bag[topic])

    assert times("/ego/odometry") == pairs(smoothed.ego, "receipt_ns", "stamp_ns")
    assert len(bag["/tf"]) == smoothed.ego.num_rows
    assert set(times("/tracks")) == set(pairs(smoothed.tracks, "now_ns", "stamp_ns"))
    assert sum(len(one.data.detections) for one in bag["/tracks"]) == smoothed.tracks.num_rows
    for sensor in np.unique(smoothed.detections["sensor"]).tolist():
        mine = smoothed.detections.where(smoothed.detections["sensor"] == sensor)
        assert set(times(f"/detections/{sensor}")) == set(pairs(mine, "receipt_ns", "stamp_ns"))
        assert sum(len(one.data.detections) for one in bag[f"/detections/{sensor}"]) == mine.num_rows
    kinds = {
        "/tracks": "vision_msgs/msg/Detection3DArray",
        "/ego/odometry": "nav_msgs/msg/Odometry",
        "/tf": "tf2_msgs/msg/TFMessage",
        "/tracks/markers": "visualization_msgs/msg/MarkerArray",
    }
    assert {topic: bag[topic][0].type for topic in kinds} == kinds


def test_what_is_sent_once_reaches_those_who_listen_later(bag: dict[str, list[BagMessage]], runs: Path) -> None:
    lasting = set()
    with Reader(runs.parent / "rosbag") as reader:
        for connection in reader.connections:
            assert isinstance(connection.ext, ConnectionExtRosbag2)
            [profile] = connection.ext.offered_qos_profiles
            if profile.durability is QosDurability.TRANSIENT_LOCAL:
                lasting.add(connection.topic)
    assert lasting == {"/map/markers", "/ego/markers"}
    assert all(len(bag[topic]) == 1 for topic in lasting)


# Schemas


def test_the_schemas_are_those_that_foxglove_publishes() -> None:
    ours = {name: schema for name, schema in SCHEMAS.items() if name.startswith("foxglove.")}
    text = json.dumps(ours, sort_keys=True, separators=(",", ":")).encode()
    assert hashlib.sha256(text).hexdigest() == PUBLISHED_SCHEMAS


def test_the_sdk_of_foxglove_takes_every_message(topics: dict[str, list[Entry]]) -> None:
    kinds = {
        "arrows": "ArrowPrimitive",
        "cubes": "CubePrimitive",
        "spheres": "SpherePrimitive",
        "cylinders": "CylinderPrimitive",
        "lines": "LinePrimitive",
        "texts": "TextPrimitive",
        "deletions": "SceneEntityDeletion",
        "entities": "SceneEntity",
        "metadata": "KeyValuePair",
        "points": "Point3",
        "poses": "Pose",
        "pose": "Pose",
        "position": "Vector3",
        "size": "Vector3",
        "translation": "Vector3",
        "orientation": "Quaternion",
        "rotation": "Quaternion",
        "color": "Color",
    }

    def made(name: str, value: Any) -> Any:
        if name == "timestamp":
            return sdk.Timestamp(value["sec"], value["nsec"])
        if name == "lifetime":
            return sdk.Duration(value["sec"], value["nsec"])
        if isinstance(value, list):
            return [made(name, one) for one in value]
        if isinstance(value, dict):
            return getattr(sdk, kinds[name])(**fields_of(value))
        return value

    def fields_of(value: dict[str, Any]) -> dict[str, Any]:
        found = {key: made(key, one) for key, one in value.items()}
        if "type" in found:
            assert found["type"] == 0
            strip, one = sdk.LinePrimitiveLineType.LineStrip, sdk.SceneEntityDeletionType.MatchingId
            found["type"] = strip if "points" in found else one
        return found

    roots = {"/tf": "FrameTransform", "/ego/pose": "PoseInFrame"}
    tried = 0
    for topic, entries in topics.items():
        root = roots.get(topic, "PosesInFrame" if topic.endswith("/poses") else "SceneUpdate")
        for *_, value in entries[:20] if topic != "/outcomes" else []:
            assert getattr(sdk, root)(**fields_of(value)).encode()
            tried += 1
    assert tried > 100


# Placement


def test_detections_are_where_the_tracker_places_them(runs: Path) -> None:
    """The path of the ego is linear between its stamps; the tracker extrapolates where it does not know it yet."""
    places: dict[tuple[str, int, int], tuple[float, float]] = {}

    class Watched(Preprocess):
        def __init__(self, inner: Preprocess) -> None:
            self.inner = inner

        def __call__(self, batch: Any, sensor: Any, ego: Any) -> Any:
            candidates, records = self.inner(batch, sensor, ego)
            for one in candidates:
                assert isinstance(one, Candidate)
                if one.position_m is not None and not one.merged:
                    places[batch.sensor, batch.stamp_ns, one.index] = tuple(one.position_m.tolist())
            return candidates, records

    config = read_config("smoother", [], track_map="oval", estimator="ekf-replay")
    assert build_tracker(config)
    messages = fgtrack.simulate("default", seed=3, duration_s=3.0)
    run, _ = replay_in_memory(
        messages, config, observed=lambda parts: replace(parts, preprocess=Watched(parts.preprocess))
    )
    table, found = run.detections, placed(run)
    keys = zip(table["sensor"].tolist(), table["stamp_ns"].tolist(), table["index"].tolist(), strict=True)
    off_m = [
        math.dist(places[key], position_m)
        for key, position_m in zip(keys, found.position_m.tolist(), strict=True)
        if key in places
    ]
    assert len(off_m) > 50
    assert max(off_m) < 0.2
    assert np.median(off_m) < 0.02


# Files


def test_the_same_run_gives_the_same_bytes(file: Path, runs: Path, tmp_path: Path) -> None:
    export([runs / "smoother"], tmp_path / "again.mcap")
    assert (tmp_path / "again.mcap").read_bytes() == file.read_bytes()
    export([runs / "smoother"], tmp_path / "a.mcap", ros2=True)
    export([runs / "smoother"], tmp_path / "b" / "a.mcap", ros2=True)
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b" / "a.mcap").read_bytes()


@pytest.mark.parametrize("ros2", [False, True])
def test_what_is_there_is_replaced_only_on_request_and_only_an_export(
    runs: Path, tmp_path: Path, ros2: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run.mcap"
    arguments = ["export", str(runs / "ekf-replay"), "-o", str(out), *(["--ros2"] if ros2 else [])]
    assert command(arguments) == 0
    written = out.read_bytes()
    assert command(arguments) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert command([*arguments, "--overwrite"]) == 0
    assert out.read_bytes() == written
    fgtrack.simulate("single_opponent", duration_s=0.2, out=tmp_path / "drive")
    [recording] = (tmp_path / "drive").glob("*.mcap")
    kept = recording.read_bytes()
    arguments[3] = str(recording)
    assert command([*arguments, "--overwrite"]) == 2
    assert "is not an MCAP file of" in capsys.readouterr().err
    assert recording.read_bytes() == kept
    assert sorted(path.name for path in tmp_path.iterdir()) == ["drive", "run.mcap"]


def test_a_recording_is_not_replaced_by_an_exported_folder(runs: Path, tmp_path: Path) -> None:
    fgtrack.simulate("single_opponent", duration_s=0.2, out=tmp_path / "drive")
    with pytest.raises(CallError, match=r"is not a rosbag2 folder of `fgtrack export`"):
        export([runs / "ekf-replay"], tmp_path / "drive", ros2=True, overwrite=True)
    export([runs / "ekf-replay"], tmp_path / "bag", ros2=True)
    export([runs / "ekf-replay"], tmp_path / "bag", ros2=True, overwrite=True)


@pytest.mark.parametrize("name", ["run.mcap", "bag"])
def test_an_export_that_fails_leaves_nothing(smoothed: Run, tmp_path: Path, name: str) -> None:
    messages, _ = viewer_messages({"run": smoothed})

    def broken() -> Iterator[Any]:
        for count, message in enumerate(messages):
            if count == 500:
                raise DataError("a row is damaged")
            yield message

    for write in (write_foxglove, write_viewer_bag) if name == "run.mcap" else (write_viewer_bag,):
        with pytest.raises(DataError, match="a row is damaged"):
            write_foxglove(tmp_path / name, broken(), {}) if write is write_foxglove else write(
                tmp_path / name, broken()
            )
        assert not list(tmp_path.iterdir())


def test_a_time_before_1970_is_one_line(tmp_path: Path) -> None:
    scene = Scene("/tracks", 5, -5)
    with pytest.raises(DataError, match="-5 ns lies before 1970"):
        write_foxglove(tmp_path / "x.mcap", [scene], {})
    with pytest.raises(DataError, match="-5 ns lies outside"):
        write_viewer_bag(tmp_path / "x.mcap", [Scene("/tracks", -5, 5)])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["missing", "-o", "x.mcap"], "missing: no run folder"),
        (["RUN", "-o", "x"], "x: viewers know such a file by its name, let it end in .mcap"),
        (["RUN", "RUN", "-o", "x.mcap"], "is given twice"),
        (["RUN"], "Missing option '-o'"),
    ],
)
def test_a_call_that_cannot_be_done_is_one_line(
    runs: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    line: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert command(["export", *(str(runs / "smoother") if word == "RUN" else word for word in arguments)]) == 2
    [told] = capsys.readouterr().err.strip().splitlines()
    assert line in told
    assert not list(tmp_path.iterdir())


def test_a_run_that_was_killed_is_exported_up_to_there(runs: Path, tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    for path in (runs / "smoother").iterdir():
        content = path.read_bytes()
        (tmp_path / "run" / path.name).write_bytes(content[: len(content) // 2] if path.suffix == ".csv" else content)
    meta = json.loads((tmp_path / "run/meta.json").read_text())
    (tmp_path / "run/meta.json").write_text(json.dumps({"format": meta["format"], "complete": False}))
    export([tmp_path / "run"], tmp_path / "x.mcap")
    run = load_run(tmp_path / "run")
    topics = read(tmp_path / "x.mcap")
    assert sum(len(value["poses"]) for *_, value in topics["/tracks/poses"]) == run.tracks.num_rows > 0
    assert len(topics["/outcomes"]) == run.updates.num_rows > 0
    updates = tmp_path / "run/updates.csv"
    updates.write_text(updates.read_text().splitlines()[0] + "\n")
    export([tmp_path / "run"], tmp_path / "y.mcap")
    assert {"/outcomes", "/arrivals"} & set(read(tmp_path / "y.mcap")) == set()


# Several runs, and runs of which something is missing


def test_several_runs_stand_side_by_side(runs: Path, tmp_path: Path) -> None:
    export([runs], tmp_path / "both.mcap")
    topics = read(tmp_path / "both.mcap")
    assert {"/map", "/ego", "/tf", "/smoother/tracks", "/ekf_replay/tracks", "/smoother/past"} <= set(topics)
    assert "/tracks" not in topics
    assert "/ekf_replay/past" not in topics  # a filter corrects no past
    colours = {
        name: {
            tuple(box["color"][c] for c in "rgb")
            for *_, value in topics[f"/{name}/tracks"]
            for one in value["entities"]
            for box in one["cubes"]
        }
        for name in ("smoother", "ekf_replay")
    }
    assert all(len(found) == 1 for found in colours.values())
    assert colours["smoother"] != colours["ekf_replay"]


def test_runs_of_different_recordings_are_refused(runs: Path, by_hand: Path, tmp_path: Path) -> None:
    with pytest.raises(CallError, match="are of different recordings"):
        export([runs / "smoother", by_hand], tmp_path / "x.mcap")
    assert not list(tmp_path.iterdir())
    shutil.copytree(by_hand, tmp_path / "other")
    ego = tmp_path / "other/ego.csv"
    ego.write_text(ego.read_text().replace(",100,", ",101,"))
    with pytest.raises(CallError, match="are of different recordings"):
        export([by_hand, tmp_path / "other"], tmp_path / "x.mcap")


def test_a_run_of_an_older_version_and_a_map_that_is_gone_are_told(
    by_hand: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old = tmp_path / "old"
    old.mkdir()
    for path in by_hand.iterdir():
        if path.name != "detections.csv":
            (old / path.name).write_bytes(path.read_bytes())
    (old / "config.yaml").write_text("map: {track: gone.csv}\n")
    assert command(["export", str(old), "-o", str(tmp_path / "x.mcap")]) == 0
    told = capsys.readouterr().err
    assert "has no detections.csv" in told
    assert "map.track: gone.csv is not there any more" in told
    topics = read(tmp_path / "x.mcap")
    assert "/detections" not in topics
    assert len(topics["/outcomes"]) == 4


def test_thirty_objects(tmp_path: Path) -> None:
    ticks = 20
    rng = np.random.default_rng(1)
    with RunWriter(tmp_path / "run") as writer:
        for tick in range(ticks):
            now_ns = 10**18 + tick * 20_000_000
            tracks = tuple(
                TrackReport(k, TrackStatus.CONFIRMED, TrackState(now_ns - k, rng.normal(size=5), np.eye(5)), 3)
                for k in range(30)
            )
            writer.write_tick(TickReport(tick, now_ns, tracks, ()), 1, 0)
        writer.finish({"estimator": "smoother"})
    export([tmp_path / "run"], tmp_path / "x.mcap")
    topics = read(tmp_path / "x.mcap")
    assert len(topics["/tracks/poses"]) == 30 * ticks  # every track has a stamp of its own here
    assert {(log_ns - publish_ns) for log_ns, publish_ns, _ in topics["/tracks/poses"]} == set(range(30))
    assert all(len(value["entities"]) == 30 for *_, value in topics["/tracks"])


# The layout


def test_the_layout_shows_topics_that_are_written(topics: dict[str, list[Entry]]) -> None:
    layout = json.loads((shipped_folder() / "foxglove_layout.json").read_text(encoding="utf-8"))
    panels = layout["configById"]
    named = {name for name, shown in panels["3D!fgtrack"]["topics"].items() if shown["visible"]}
    alone = {name for name in named if name.count("/") == 1}
    assert alone <= set(topics)
    assert {name.partition("/")[0] or "/" + name.split("/")[2] for name in named - alone} <= alone
    paths = [one["value"] for panel in panels.values() for one in panel.get("paths", [])]
    paths += [panel["topicPath"] for panel in panels.values() if "topicPath" in panel]
    for path in paths:
        topic, _, field = path.partition(".")
        assert not field or any(field in value for *_, value in topics[topic])

    def leaves(part: Any) -> Iterator[str]:
        if isinstance(part, str):
            yield part
        else:
            yield from leaves(part["first"])
            yield from leaves(part["second"])

    assert sorted(leaves(layout["layout"])) == sorted(panels)
