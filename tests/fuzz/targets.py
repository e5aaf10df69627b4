"""What is fuzzed: healthy inputs of every kind, and the commands that read them."""

import gzip
import json
import math
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.typesys import Stores, get_typestore

import fgtrack
from fgtrack.cli.main import run
from fgtrack.io.ros.bag_writer import write_bag
from fgtrack.io.stream import write_stream
from fgtrack.models.oval import make_oval
from fgtrack.pipeline.shipped import shipped_folder

Files = Mapping[str, bytes]
RUN = "run"
"""Folder of the run that a command writes, which is looked at."""


@dataclass(frozen=True, eq=False)
class Target:
    """A kind of input."""

    name: str
    healthy: Callable[[], Sequence[Files]]
    """Inputs that are right, as contents by name."""
    spoilt: Callable[[str], bool]
    """Which files are spoilt."""
    commands: Sequence[Sequence[str]]
    """Words of the commands, called in the folder of the files."""


@cache
def drive() -> tuple[fgtrack.EgoState | fgtrack.DetectionList, ...]:
    """Two seconds of one car, with delays."""
    return tuple(fgtrack.simulate("single_opponent", seed=1, duration_s=2.0))


def _stream(messages: Sequence[fgtrack.Message] = ()) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "drive.jsonl"
        write_stream(path, messages or drive())
        return path.read_bytes()


def _straight() -> bytes:
    """A car on a straight line, long enough for noise and offsets to be fitted."""
    rng, messages = np.random.default_rng(1), list[fgtrack.Message]()
    for k in range(60):
        now_ns, at_m = 10**9 + k * 10**8, 20.0 + k
        messages.append(fgtrack.EgoState(now_ns, now_ns, 0.0, 0.0, 0.0, 0.0))
        messages.append(fgtrack.TruthState(now_ns, now_ns, 1, at_m, 5.0))
        for name in ("lidar", "radar") if k % 3 == 0 else ("lidar",):
            x_m, y_m = rng.normal((at_m, 5.0), 0.3).tolist()
            seen = fgtrack.Detection(x_m=x_m, y_m=y_m)
            messages.append(fgtrack.DetectionList(name, now_ns, now_ns + 10**7, (seen,), "map"))
    return _stream(sorted(messages, key=lambda message: message.receipt_ns))


def _bag(storage: str) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        write_bag(Path(folder) / "bag", drive(), storage)
        (file,) = (file for file in (Path(folder) / "bag").iterdir() if file.suffix != ".yaml")
        return file.read_bytes()


def _ros1() -> bytes:
    store = get_typestore(Stores.ROS1_NOETIC)
    types = store.types
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "drive.bag"
        with Rosbag1Writer(path) as writer:
            topic = writer.add_connection("/odom", "nav_msgs/msg/Odometry", typestore=store)
            for k in range(40):
                time = types["builtin_interfaces/msg/Time"](1000 + k // 20, (k % 20) * 50_000_000)
                header = types["std_msgs/msg/Header"](k, time, "map")
                pose = types["geometry_msgs/msg/Pose"](
                    types["geometry_msgs/msg/Point"](1.0 * k, 0.0, 0.0),
                    types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
                )
                zero = types["geometry_msgs/msg/Vector3"](20.0, 0.0, 0.0)
                message = types["nav_msgs/msg/Odometry"](
                    header,
                    "base",
                    types["geometry_msgs/msg/PoseWithCovariance"](pose, np.zeros(36)),
                    types["geometry_msgs/msg/TwistWithCovariance"](
                        types["geometry_msgs/msg/Twist"](zero, zero), np.zeros(36)
                    ),
                )
                receipt_ns = 1_000_000_000_000 + k * 50_000_000
                writer.write(topic, receipt_ns, store.serialize_ros1(message, "nav_msgs/msg/Odometry"))
        return path.read_bytes()


def _autoferry() -> Files:
    records, truth = [], []
    for k in range(40):
        sensor, time = k % 4 + 1, round(1000.0 + 0.1 * k, 3)
        points = [[10.0 + 0.1 * k, -20.0], [5.0, 30.0 - 0.1 * k]]
        measurement = points if sensor < 3 else [0.3, -1.2]
        records.append({"sensorID": sensor, "time": time, "ownshipPosition": [1.0, 2.0], "measurement": measurement})
        truth.append([{"targetID": 1, "position": [11.0 + 0.1 * k, -18.0, 0.0], "time": time}])
    return {
        "in/scenario9_detections.json": json.dumps(records).encode(),
        "in/scenario9_groundTruth.json": json.dumps(truth).encode(),
    }


def _log_folder() -> Files:
    columns = "time_ns;detection_input;ego_state;tracking_input;match_dict;filter_log;object_dict;pred_dict"
    rows = [f"{columns};cycle_time_ns"]
    for k in range(30):
        now_ns = 10**12 + k * 20_000_000
        ego = {"is_updated": True, "in_pit": False, "t": now_ns - 10**7, "state": [1.0 * k, 2.0, 3.0, 40.0, 0.1, -1.0]}
        lidar = [[{"state": [20.0, 1.0, 0.1], "t": now_ns - 5 * 10**7, "keys": ["x", "y", "yaw"]}], now_ns - 5 * 10**7]
        radar = [[{"state": [20.0, 1.0, 9.0], "t": now_ns - 3 * 10**7, "keys": ["x", "y", "v"]}], now_ns - 3 * 10**7]
        cells = (now_ns, {"lidar": lidar, "radar": radar}, ego, [], {}, {}, {}, {}, 5)
        rows.append(";".join(map(json.dumps, cells)))
    return {"in/data_logs.csv": "\n".join(rows).encode()}


def _kitti() -> Files:
    eye = "1 0 0 0 0 1 0 0 0 0 1 0"
    camera = "700 0 600 0 0 700 180 0 0 0 1 0"
    calib = "\n".join(
        [*(f"P{k}: {camera}" for k in range(4)), "R_rect 1 0 0 0 1 0 0 0 1", "Tr_velo_cam 0 -1 0 0 0 0 -1 0 1 0 0 0"]
    )
    oxts, labels, poses = [], [], []
    for k in range(20):
        values = np.zeros(30)
        values[:6] = 49.0 + 1e-5 * k, 8.0, 110.0, 0.0, 0.0, 0.1
        values[8] = 10.0
        oxts.append(" ".join(map(repr, values.tolist())))
        labels.append(f"{k} 1 Car 0 0 0.0 1 2 3 4 1.5 1.6 4.0 2.0 1.5 {20.0 + 0.1 * k} {-0.5 * math.pi}")
        poses.append(f"{k},2,1,2,3,4,9.0,1.5,1.6,4.0,2.0,1.5,{20.0 + 0.1 * k},{-0.5 * math.pi},0.0")
    texts = {"oxts": oxts, "label_02": labels, "pointrcnn_car": poses, "calib": [f"{calib}\nTr_imu_velo {eye}", ""]}
    return {f"in/{name}/0001.txt": "\n".join(lines).encode() for name, lines in texts.items()}


def _kitti_forms() -> list[Files]:
    """The forms in which detectors and trackers publish, beside that of `_kitti`."""
    files = _kitti()
    other = {name: content for name, content in files.items() if "pointrcnn" not in name}
    place = "1 2 3 4 1.5 1.6 4.0 2.0 1.5 20.0"
    tracking = "\n".join(f"{k} 5 Car -1 -1 0.1 {place} -1.57 9.{k}" for k in range(20)).encode()
    image = "\n".join(f"{k},100.5,150,180.25,200,0.9" for k in range(20)).encode()
    frames = {f"in/pointrcnn_car/0001/{k:06d}.txt": f"Car 0 0 0.1 {place} -1.57 9.{k}\n".encode() for k in range(20)}
    return [
        {**other, "in/pointrcnn_car/0001.txt": tracking},
        {**other, "in/rrc_car/0001.txt": image},
        {**other, **frames},
    ]


def _tables() -> Files:
    """CSV in three files, with a mapping of their columns."""
    ego, seen, cars = ["t;east;north;heading;kmh"], ["ms\tgot\trange\tazimuth\tkind\tsnr\tid"], ["t,id,x,y"]
    for k in range(40):
        t = f"{1000.0 + 0.05 * k:.2f}"
        ego.append(f"{t};{k}.5;2;90.0;72")
        seen.append(f"{1_000_000 + 50 * k}\t{1_000_090 + 50 * k}\t{20 + 0.1 * k}\t-1.5\tcar\t9\tcar_a")
        cars.append(f'{t},"car_a",{k + 20},3')
    texts = {"ego.csv": ego, "radar.tsv": seen, "cars.csv": cars}
    return {"x.yaml": _MAPPING} | {f"in/{name}": "\n".join(lines).encode() for name, lines in texts.items()}


def _nuscenes() -> Files:
    north = [math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]
    boxes: dict[str, object] = {}
    tables: dict[str, list[dict[str, object]]] = {
        "scene": [{"token": "a", "name": "scene-0001"}],
        "category": [{"token": "c", "name": "vehicle.car"}],
        "instance": [{"token": "i", "category_token": "c"}],
    }
    for k in range(10):
        stamp_us, token, at = 10**15 + 500_000 * k, f"s{k}", [110.0, 2.0 + k, 1.0]
        boxes[token] = [
            {
                "sample_token": token,
                "translation": at,
                "size": [1.9, 4.5, 1.6],
                "rotation": north,
                "velocity": [0.0, 2.0],
                "tracking_name": "car",
                "tracking_id": "7",
                "tracking_score": 0.8,
            }
        ]
        seen = {"num_lidar_pts": 5, "num_radar_pts": 0}
        place = {"translation": [100.0, 1.0 * k, 0.0], "rotation": north}
        for name, entry in {
            "sample": {"token": token, "timestamp": stamp_us, "scene_token": "a"},
            "sample_data": {"sample_token": token, "ego_pose_token": f"p{k}"},
            "ego_pose": {"token": f"p{k}", "timestamp": stamp_us, **place},
            "sample_annotation": {
                "sample_token": token,
                "instance_token": "i",
                "translation": at,
                "rotation": north,
                **seen,
            },
        }.items():
            tables.setdefault(name, []).append(entry)
    files = {f"in/v1.0-mini/{name}.json": json.dumps(entries).encode() for name, entries in tables.items()}
    return {"in/results.json": json.dumps({"meta": {}, "results": boxes}).encode(), **files}


def _map() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        make_oval().write(Path(folder) / "x.csv")
        return (Path(folder) / "x.csv").read_bytes()


def _run() -> Files:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run"
        fgtrack.replay(iter(drive()), "smoother", out=path)
        return {f"in/{file.name}": file.read_bytes() for file in path.iterdir()}


def _shipped(kind: str) -> list[bytes]:
    return [file.read_bytes() for file in sorted((shipped_folder() / kind).glob("*.yaml"))]


_SWEEP = b"""format: fgtrack-sweep/1
scenario: single_opponent
config: smoother
duration_s: 0.5
seeds: [1, 2]
estimators: [ekf-replay]
set: {map.track: null}
vary: {association.gate_m: [3.0, 5.0], scenario.sensors.radar.rate_hz: [10.0]}
metrics: ["position_*"]
"""
_MAPPING = b"""estimator: ekf-replay
input:
  csv:
    ego:
      file: ego.csv
      columns:
        {stamp: t, x_m: east, y_m: north, yaw_rad: {path: heading, scale: -1, offset: 90, degrees: true},
         speed_mps: kmh}
    detections:
      radar:
        file: radar.tsv
        columns:
          {stamp: ms, receipt: got, range_m: range, bearing_rad: {path: azimuth, degrees: true}, class_name: kind,
           object_id: id}
        time_unit: ms
        frame: sensor
        filters: {snr: {min: 6}}
    truth: {file: cars.csv, columns: {stamp: t, object_id: id, x_m: x, y_m: y}}
sensors:
  radar: {std: {range_m: 0.5, bearing_rad: 0.02}, max_delay_s: 1.0}
"""
_EXCLUDED = b"""{"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {}, "geometry":
{"type": "MultiPolygon", "coordinates":
[[[[0.0, 0.0], [90.0, 0.0], [90.0, 90.5], [0.0, 0.0]]], [[[5, 5], [9, 5], [9, 9], [5, 5]]]]}}]}"""
_CORNERS = b"area,x_m,y_m\nshore,0.0,0.0\nshore,90.0,0.5\nshore,90.0,90.0\npier,5,5\npier,9,5\npier,9,9\n"
_DELAYS = b"radar: {delay: {kind: gamma, mean_s: 0.1, std_s: 0.05, least_s: 0.01}}\n"
_NUSCENES = "sensors={detector: {std: {x_m: 0.5, y_m: 0.5}}}"
_REPLAY = ("--overwrite", "-o", RUN, "-e")
_EKF = (*_REPLAY, "ekf-replay")
_CV = ("--set", "motion={kind: cv, std_per_s: {velocity: 3.0}}", "--set", "clock.node_hz=10")
_MERGE = "merge={kind: connected, distance_m: 5.1}"


def _all(name: str) -> bool:
    return True


def _only(name: str) -> Callable[[str], bool]:
    return lambda file: file == name


TARGETS = (
    Target(
        "stream",
        lambda: [{"x.jsonl": _stream()}],
        _all,
        [("info", "x.jsonl"), ("replay", "x.jsonl", "-c", "open_space", *_EKF)],
    ),
    Target(
        "stream-smoother",
        lambda: [{"x.jsonl": _stream()}],
        _all,
        [("replay", "x.jsonl", "-c", "open_space", "--set", _MERGE, *_REPLAY, "smoother")],
    ),
    Target(
        "gzip",
        lambda: [{"x.jsonl.gz": gzip.compress(_stream(), mtime=0)}],
        _all,
        [("info", "x.jsonl.gz"), ("replay", "x.jsonl.gz", "-c", "open_space", *_EKF)],
    ),
    Target(
        "mcap",
        lambda: [{"x.mcap": _bag("mcap")}],
        _all,
        [("info", "x.mcap"), ("replay", "x.mcap", "-c", "open_space", *_EKF)],
    ),
    Target(
        "sqlite3",
        lambda: [{"x.db3": _bag("sqlite3")}],
        _all,
        [("info", "x.db3"), ("replay", "x.db3", "-c", "open_space", *_EKF)],
    ),
    Target(
        "ros1",
        lambda: [{"x.bag": _ros1()}],
        _all,
        [("info", "x.bag"), ("replay", "x.bag", "-c", "open_space", "--set", "input.ego.topic=/odom", *_EKF)],
    ),
    Target(
        "autoferry",
        lambda: [_autoferry()],
        _all,
        [("info", "in"), ("replay", "in", "-c", "autoferry", *_EKF), ("compare", RUN)],
    ),
    Target(
        "log-folder",
        lambda: [_log_folder()],
        _all,
        [
            ("info", "in"),
            ("replay", "in", "-c", "karle2023", "--set", "map.track=null", *_REPLAY, "ekf-backward-forward"),
        ],
    ),
    Target("kitti", lambda: [_kitti()], _all, [("info", "in"), ("replay", "in", "-c", "kitti", *_EKF)]),
    Target(
        "kitti-forms",
        _kitti_forms,
        lambda name: "_car" in name,
        [("info", "in"), ("replay", "in", "-c", "kitti", *_EKF)],
    ),
    Target(
        "tables",
        lambda: [_tables()],
        _all,
        [("info", "in", "-c", "x.yaml"), ("replay", "in", "-c", "x.yaml", "--overwrite", "-o", RUN)],
    ),
    Target(
        "nuscenes",
        lambda: [_nuscenes()],
        _all,
        [("info", "in/results.json"), ("replay", "in/results.json", "-c", "open_space", "--set", _NUSCENES, *_EKF)],
    ),
    Target(
        "excluded",
        lambda: [{"x.json": _EXCLUDED, "x.jsonl": _stream()}, {"x.json": _CORNERS, "x.jsonl": _stream()}],
        _only("x.json"),
        [("replay", "x.jsonl", "-c", "open_space", "--set", 'map.excluded=["x.json"]', *_EKF)],
    ),
    Target(
        "configuration",
        lambda: [{"x.yaml": content, "x.jsonl": _stream()} for content in _shipped(".")],
        _only("x.yaml"),
        [("config", "-c", "x.yaml"), ("replay", "x.jsonl", "-c", "x.yaml", *_EKF)],
    ),
    Target(
        "scenario",
        lambda: [{"x.yaml": content} for content in _shipped("scenarios")],
        _only("x.yaml"),
        [("simulate", "x.yaml", "-o", "out.jsonl", "--overwrite", "--duration", "0.5")],
    ),
    Target("sweep", lambda: [{"x.yaml": _SWEEP}], _only("x.yaml"), [("sweep", "x.yaml", "-o", "swept", "--jobs", "1")]),
    Target(
        "map",
        lambda: [{"x.csv": _map(), "x.jsonl": _stream()}],
        _only("x.csv"),
        [
            ("replay", "x.jsonl", "-c", "smoother", "--map", "x.csv", *_EKF),
            ("replay", "x.jsonl", "-c", "karle2023_reference", "--map", "x.csv", "-o", RUN, "--overwrite"),
        ],
    ),
    Target(
        "delays",
        lambda: [{"x.yaml": _DELAYS, "x.jsonl": _stream()}],
        _only("x.yaml"),
        [("convert", "x.jsonl", "out.jsonl", "--delays", "x.yaml", "--overwrite")],
    ),
    Target(
        "tune", lambda: [{"x.jsonl": _straight()}], _all, [("tune", "x.jsonl", *_CV, "-o", "x.yaml", "--overwrite")]
    ),
    Target(
        "advise",
        lambda: [{"x.jsonl": _straight()}],
        _all,
        [("advise", "x.jsonl", *_CV, "--tune"), ("offsets", "x.jsonl", *_CV)],
    ),
    Target("run", lambda: [_run()], _all, [("compare", "in"), ("export", "in", "-o", "x.mcap", "--overwrite")]),
)
__all__ = ["RUN", "TARGETS", "Target", "run"]
