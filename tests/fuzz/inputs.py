"""What is spoilt: inputs of every kind that are right, as the contents of files by name."""

import json
import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.typesys import Stores, get_typestore
from ruamel.yaml import YAML
from support import kitti

import fgtrack
from fgtrack.config.shipped import shipped_folder
from fgtrack.inputs.ros.bag_writer import write_bag
from fgtrack.inputs.stream import STREAM_FORMAT, write_stream
from fuzz import scene

Files = Mapping[str, bytes]


def _drive(duration_s: float) -> tuple[fgtrack.EgoState | fgtrack.DetectionList, ...]:
    return tuple(fgtrack.simulate("single_opponent", seed=1, duration_s=duration_s))


@cache
def drive() -> tuple[fgtrack.EgoState | fgtrack.DetectionList, ...]:
    """Two seconds of one car, with delays."""
    return _drive(2.0)


@cache
def short_drive() -> tuple[fgtrack.EgoState | fgtrack.DetectionList, ...]:
    """Half a second of one car, with delays."""
    return _drive(0.5)


def stream(messages: Sequence[fgtrack.Message] = ()) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "drive.jsonl"
        write_stream(path, messages or drive())
        return path.read_bytes()


def all_fields() -> Files:
    """A stream of the drive of `scene`, which has every field, and its sensors as a configuration."""
    lines = [{"type": "header", "format": STREAM_FORMAT}]
    for record in scene.drive():
        at_ns = record.pop("at_ns")
        lines.append(record)
        if record["type"] == "ego":
            x_m, y_m = scene.place_m("ahead", record["stamp_ns"])
            lines.append(
                {
                    "type": "truth",
                    "stamp_ns": record["stamp_ns"],
                    "receipt_ns": at_ns,
                    "object_id": 1,
                    "x_m": x_m,
                    "y_m": y_m,
                    "yaw_rad": 0.0,
                    "speed_mps": 11.0,
                }
            )
    text = "".join(f"{json.dumps(line)}\n" for line in lines)
    return {
        "x.jsonl": text.encode(),
        "x.yaml": json.dumps({"sensors": scene.SENSORS}).encode(),
    }


def latitudes() -> bytes:
    """A stream of positions as latitude and longitude, with identities."""
    lines: list[dict[str, object]] = [{"type": "header", "format": STREAM_FORMAT}]
    for k in range(20):
        now_ns = scene.START_NS + k * 10**8
        item = {
            "latitude_deg": 48.0 + 1e-6 * k,
            "longitude_deg": 11.0 + 1e-5 * k,
            "altitude_m": 500.0,
            "identity": "4CA911",
            "id": "4CA911",
        }
        times = {"stamp_ns": now_ns, "receipt_ns": now_ns + 10**7}
        lines.append(
            {"type": "detections", "sensor": "gnss", **times, "objects": [item]}
        )
    return "".join(f"{json.dumps(line)}\n" for line in lines).encode()


def aircraft() -> list[dict[str, float]]:
    """Reports of two aircraft, with their times of measurement and of receipt."""
    return [
        {
            "address": 0x4CACAA + k % 2,
            "sic": 1,
            "measured_s": 100.0 + 0.5 * k,
            "received_s": 100.25 + 0.5 * k,
            "latitude_deg": 41.3 + 0.01 * (k % 2),
            "longitude_deg": 2.08 + 0.001 * k,
            "flight_level": 100.0,
            "speed_nmps": 0.1,
            "course_deg": 90.0,
            "nacp": 9,
        }
        for k in range(16)
    ]


def asterix(records: Sequence[Mapping[str, Any]]) -> bytes:
    """Reports of category 021. Raises what libasterix raises for numbers that the format cannot hold."""
    import asterix.generated as gen

    blocks = []
    for each in records:
        position = (
            ("LAT", (each["latitude_deg"], "°")),
            ("LON", (each["longitude_deg"], "°")),
        )
        motion = (
            ("RE", 0),
            ("GS", (each["speed_nmps"], "NM/s")),
            ("TA", (each["course_deg"], "°")),
        )
        items = {
            "010": (("SAC", 0), ("SIC", each["sic"])),
            "080": each["address"],
            "073": (each["measured_s"], "s"),
            "077": (each["received_s"], "s"),
            "131": position,
            "145": (each["flight_level"], "FL"),
            "160": motion,
            "090": ((0, 7, None), (0, 0, each["nacp"], None)),
        }
        kind = gen.Cat_021_2_6
        blocks.append(kind.create([kind.cv_record.create(items)]).unparse().to_bytes())
    return b"".join(blocks)


def ships() -> list[dict[str, Any]]:
    """Reports of two ships, with the time of receipt of each."""
    return [
        {
            "received_s": 1_397_678_300 + 3 * k,
            "mmsi": 244730036 + k % 2,
            "msg_type": 1,
            "lat": 53.36 + 0.01 * (k % 2),
            "lon": 5.21 + 0.0003 * k,
            "speed": 10.0,
            "course": 90.0,
            "second": (20 + 3 * k - 1) % 60,
        }
        for k in range(16)
    ]


def nmea(records: Sequence[Mapping[str, Any]]) -> bytes:
    """Sentences with tag blocks. Raises what pyais raises for values that a sentence cannot hold."""
    import pyais

    lines = []
    for each in records:
        given = {key: value for key, value in each.items() if key != "received_s"}
        time = f"c:{each['received_s']}"
        check = 0
        for byte in time.encode():
            check ^= byte
        lines += [
            f"\\{time}*{check:02X}\\{line}"
            for line in pyais.encode_dict(given, sentence_type="VDM")
        ]
    return ("\n".join(lines) + "\n").encode()


def straight() -> bytes:
    """A car on a straight line, long enough for noise and offsets to be fitted."""
    rng, messages = np.random.default_rng(1), list[fgtrack.Message]()
    for k in range(60):
        now_ns, at_m = 10**9 + k * 10**8, 20.0 + k
        messages.append(fgtrack.EgoState(now_ns, now_ns, 0.0, 0.0, 0.0, 0.0))
        messages.append(fgtrack.TruthState(now_ns, now_ns, 1, at_m, 5.0))
        for name in ("lidar", "radar") if k % 3 == 0 else ("lidar",):
            x_m, y_m = rng.normal((at_m, 5.0), 0.3).tolist()
            seen = fgtrack.Detection(x_m=x_m, y_m=y_m)
            messages.append(
                fgtrack.DetectionList(name, now_ns, now_ns + 10**7, (seen,), "map")
            )
    return stream(sorted(messages, key=lambda message: message.receipt_ns))


def autoferry() -> Files:
    records, truth = [], []
    for k in range(40):
        sensor, time = k % 4 + 1, round(1000.0 + 0.1 * k, 3)
        points = [[10.0 + 0.1 * k, -20.0], [5.0, 30.0 - 0.1 * k]]
        measurement = points if sensor < 3 else [0.3, -1.2]
        records.append(
            {
                "sensorID": sensor,
                "time": time,
                "ownshipPosition": [1.0, 2.0],
                "measurement": measurement,
            }
        )
        truth.append(
            [{"targetID": 1, "position": [11.0 + 0.1 * k, -18.0, 0.0], "time": time}]
        )
    return {
        "in/scenario9_detections.json": json.dumps(records).encode(),
        "in/scenario9_groundTruth.json": json.dumps(truth).encode(),
    }


def log_folder() -> Files:
    columns = "time_ns;detection_input;ego_state;tracking_input;match_dict;filter_log;object_dict;pred_dict"
    rows = [f"{columns};cycle_time_ns"]
    for k in range(30):
        now_ns = 10**12 + k * 20_000_000
        ego = {
            "is_updated": True,
            "in_pit": False,
            "t": now_ns - 10**7,
            "state": [1.0 * k, 2.0, 3.0, 40.0, 0.1, -1.0],
        }
        lidar = [
            [
                {
                    "state": [20.0, 1.0, 0.1],
                    "t": now_ns - 5 * 10**7,
                    "keys": ["x", "y", "yaw"],
                }
            ],
            now_ns - 5 * 10**7,
        ]
        radar = [
            [
                {
                    "state": [20.0, 1.0, 9.0],
                    "t": now_ns - 3 * 10**7,
                    "keys": ["x", "y", "v"],
                }
            ],
            now_ns - 3 * 10**7,
        ]
        cells = (now_ns, {"lidar": lidar, "radar": radar}, ego, [], {}, {}, {}, {}, 5)
        rows.append(";".join(map(json.dumps, cells)))
    return {"in/data_logs.csv": "\n".join(rows).encode()}


def kitti_sequence() -> Files:
    with tempfile.TemporaryDirectory() as at:
        kitti.folder(
            Path(at) / "in",
            oxts=[kitti.oxts(1e-5 * k, yaw_rad=0.1, speed_mps=10.0) for k in range(20)],
            label_02=[
                kitti.label(k, 1, "Car", 20.0 + 0.1 * k, 2.0, 0.0) for k in range(20)
            ],
            pointrcnn_car=[kitti.pose(k, 20.0 + 0.1 * k, 2.0, 0.0) for k in range(20)],
        )
        return {
            str(file.relative_to(at)): file.read_bytes()
            for file in Path(at).rglob("*.txt")
        }


def tables() -> Files:
    """CSV in three files, with a mapping of their columns."""
    ego, seen, cars = (
        ["t;east;north;heading;kmh"],
        ["ms\tgot\trange\tazimuth\tkind\tsnr\tid"],
        ["t,id,x,y"],
    )
    for k in range(40):
        t = f"{1000.0 + 0.05 * k:.2f}"
        ego.append(f"{t};{k}.5;2;90.0;72")
        seen.append(
            f"{1_000_000 + 50 * k}\t{1_000_090 + 50 * k}\t{20 + 0.1 * k}\t-1.5\tcar\t9\tcar_a"
        )
        cars.append(f'{t},"car_a",{k + 20},3')
    texts = {"ego.csv": ego, "radar.tsv": seen, "cars.csv": cars}
    return {"x.yaml": MAPPING} | {
        f"in/{name}": "\n".join(lines).encode() for name, lines in texts.items()
    }


def nuscenes() -> Files:
    boxes: dict[str, object] = {}
    tables: dict[str, list[dict[str, object]]] = {
        "scene": [{"token": "a", "name": "scene-0001"}]
    }
    for k in range(10):
        stamp_us, token, turned = (
            10**15 + 500_000 * k,
            f"s{k}",
            [math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)],
        )
        box = {
            "sample_token": token,
            "translation": [110.0, 2.0 + k, 1.0],
            "size": [1.9, 4.5, 1.6],
            "rotation": turned,
        }
        boxes[token] = [
            {
                **box,
                "velocity": [0.0, 2.0],
                "tracking_name": "car",
                "tracking_id": "7",
                "tracking_score": 1,
            }
        ]
        for name, entry in {
            "sample": {"token": token, "timestamp": stamp_us, "scene_token": "a"},
            "sample_data": {"sample_token": token, "ego_pose_token": f"p{k}"},
            "ego_pose": {
                "token": f"p{k}",
                "timestamp": stamp_us,
                "translation": [100.0, k, 0.0],
                "rotation": turned,
            },
        }.items():
            tables.setdefault(name, []).append(entry)
    files = {
        f"in/v1.0-mini/{name}.json": json.dumps(entries).encode()
        for name, entries in tables.items()
    }
    return {
        "in/results.json": json.dumps({"meta": {}, "results": boxes}).encode(),
        **files,
    }


def bag(storage: str, messages: Sequence[fgtrack.Message] = ()) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        write_bag(Path(folder) / "bag", messages or drive(), storage)
        (file,) = (
            file for file in (Path(folder) / "bag").iterdir() if file.suffix != ".yaml"
        )
        return file.read_bytes()


def ros1() -> bytes:
    store = get_typestore(Stores.ROS1_NOETIC)
    types = store.types
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "drive.bag"
        with Rosbag1Writer(path) as writer:
            topic = writer.add_connection(
                "/odom", "nav_msgs/msg/Odometry", typestore=store
            )
            for k in range(40):
                time = types["builtin_interfaces/msg/Time"](
                    1000 + k // 20, (k % 20) * 50_000_000
                )
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
                writer.write(
                    topic,
                    receipt_ns,
                    store.serialize_ros1(message, "nav_msgs/msg/Odometry"),
                )
        return path.read_bytes()


def track_map() -> bytes:
    return (Path(__file__).parents[2] / "configs/maps/oval_track.csv").read_bytes()


def run_folder(messages: Sequence[fgtrack.Message] = ()) -> Files:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run"
        fgtrack.replay(iter(messages or drive()), "smoother", out=path)
        return {f"in/{file.name}": file.read_bytes() for file in path.iterdir()}


def configurations() -> list[Files]:
    """Each shipped one, beside a stream of lists of its sensors that measure places."""
    found = []
    for content in shipped("."):
        ours = [
            message.sensor
            for message in drive()
            if isinstance(message, fgtrack.DetectionList)
        ]
        sensors = YAML(typ="safe").load(content)["sensors"]
        theirs = [name for name, sensor in sensors.items() if "x_m" in sensor["std"]]
        if not theirs:
            continue
        names = {
            name: name if name in theirs else theirs[k % len(theirs)]
            for k, name in enumerate(sorted({*ours}))
        }
        messages = [
            replace(message, sensor=names[message.sensor])
            if isinstance(message, fgtrack.DetectionList)
            else message
            for message in drive()
        ]
        found.append({"x.yaml": content, "x.jsonl": stream(messages)})
    return found


def shipped(kind: str) -> list[bytes]:
    return [
        file.read_bytes() for file in sorted((shipped_folder() / kind).glob("*.yaml"))
    ]


SWEEP = b"""format: fgtrack-sweep/1
scenario: single_opponent
config: smoother
duration_s: 0.5
seeds: [1, 2]
estimators: [ekf-replay]
set: {map.track: null}
vary: {association.gate_m: [3.0, 5.0], scenario.sensors.radar.rate_hz: [10.0]}
metrics: ["truth.overall.errors.*"]
"""
MAPPING = b"""estimator: ekf-replay
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
DELAYS = b"""radar:
  delay: {kind: gamma, min_s: 0.01, mean_s: 0.1, q90_s: 0.15}
  clock: [{kind: offset, offset_s: -0.06}, {kind: drift, drift_ppm: 40.0}, {kind: quantised, step_s: 0.001}]
  loss_probability: 0.1
lidar_cluster:
  delay:
    kind: markov_time
    good: {kind: uniform, min_s: 0.0, max_s: 0.2}
    bad: {kind: loss, probability: 0.7, base: {kind: uniform, min_s: 0.08, max_s: 0.18}}
    to_bad_per_s: 0.5
    to_good_per_s: 2.0
  clock: [{kind: arrival}, {kind: jitter, std_s: 0.002}]
"*":
  delay: {kind: markov, good: {kind: constant, delay_s: 0.1}, bad: {kind: none}, to_bad: 0.1, to_good: 0.5}
"""
NUSCENES = "sensors={detector: {std: {x_m: 0.5, y_m: 0.5}}}"
