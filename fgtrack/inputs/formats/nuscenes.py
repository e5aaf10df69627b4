"""nuScenes: boxes in the data set's submission format, ego poses and truth from its tables.

Caesar et al., "nuScenes: a multimodal dataset for autonomous driving", CVPR 2020. The
input is the JSON file of results (`meta`, and `results` by sample). The tables are in a
folder `v1.0-...` next to the file. Boxes and truth are in the map frame and received at
the stamp of their sample. The ego's speed and yaw rate are computed from successive
poses. True objects without LiDAR or RADAR points are ignored, as in the data set's own
evaluation.
"""

import math
import re
from collections.abc import Iterator, Mapping
from functools import partial
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from typing import Any

from fgtrack.core.errors import CallError
from fgtrack.core.geometry import wrap_angle
from fgtrack.core.time import seconds
from fgtrack.core.types import Detection, DetectionList, EgoState, Message, TruthState
from fgtrack.inputs.formats.common import (
    json_values,
    object_id,
    reported_as,
    signed_speed_mps,
    split,
)
from fgtrack.inputs.settings import NuscenesInput
from fgtrack.inputs.source import FileFormat

_RESULTS = re.compile(rb'\s*\{\s*"(meta|results)"\s*:')
_OF_RESULTS = re.compile(r'.*?"results"\s*:\s*\{\s*', re.DOTALL)
_NS_PER_US = 1000
_CATEGORIES = {
    "movable_object.barrier": "barrier",
    "movable_object.trafficcone": "traffic_cone",
    "vehicle.bicycle": "bicycle",
    "vehicle.bus": "bus",
    "vehicle.car": "car",
    "vehicle.construction": "construction_vehicle",
    "vehicle.motorcycle": "motorcycle",
    "vehicle.trailer": "trailer",
    "vehicle.truck": "truck",
    "human.pedestrian": "pedestrian",
}
Json = Any
"""Parsed JSON, checked while it is read."""


def read_scene(file: Path, settings: NuscenesInput) -> Iterator[Message]:
    """Yield the messages of a scene in receipt order; at equal stamps the truth, then the ego, then the boxes."""
    tables = _tables(file, settings)
    with reported_as(f"{tables}: scene.json or sample.json is not a table of nuScenes"):
        samples = _samples(tables, file, settings)
    with reported_as(f"{file}: is not a list of boxes by sample"):
        boxes = {token: listed for token, listed in _results(file) if token in samples}
    with reported_as(
        f"{tables}: sample_data.json or ego_pose.json is not a table of nuScenes"
    ):
        egos = _egos(tables, samples)
    with reported_as(
        f"{tables}: category.json, instance.json or sample_annotation.json is not a table of nuScenes"
    ):
        truth = _truth(tables, samples, settings)
    lists = []
    for token, stamp_ns in samples.items():
        if token in boxes:
            with reported_as(f"{file}: sample {token!r:.60}: is not a list of boxes"):
                objects, left_out = split(_boxes(boxes[token], settings))
            lists.append(
                DetectionList(
                    settings.sensor, stamp_ns, stamp_ns, objects, "map", left_out
                )
            )
    messages: list[Message] = [*truth, *egos, *lists]
    yield from sorted(messages, key=attrgetter("receipt_ns"))


def _results(file: Path) -> Iterator[tuple[str, Json]]:
    """Yield each sample with its boxes."""
    entries = json_values(file, _OF_RESULTS)
    return zip(entries, entries, strict=True)


def _tables(file: Path, settings: NuscenesInput) -> Path:
    """Return the folder of the tables; the results file, or the link to it, may be anywhere. Raises `CallError`."""
    beside = [file.parent, file.resolve().parent]
    given = settings.tables
    if given is not None:
        folders = [each / given for each in (*beside, Path())]
    else:
        found = {each.parent for each in beside[1].glob("v1.0-*/ego_pose.json")}
        folders = [*(found if len(found) == 1 else ()), *beside]
    for folder in folders:
        if (folder / "ego_pose.json").is_file():
            return folder
    raise CallError(
        f"{file}: no folder with ego_pose.json is next to the file, name the folder as input.nuscenes.tables"
    )


def _samples(tables: Path, file: Path, settings: NuscenesInput) -> dict[str, int]:
    """Return the stamps of the scene's samples, by token, in the order of time.

    Raises `CallError` unless exactly one scene is meant.
    """
    names = {each["token"]: each["name"] for each in json_values(tables / "scene.json")}
    with_results = {token for token, _ in _results(file)}
    samples = [
        (each["timestamp"], each["token"], each["scene_token"])
        for each in json_values(tables / "sample.json")
    ]
    scenes = {scene for _, token, scene in samples if token in with_results}
    if settings.scene is not None:
        scenes = {
            token for token, name in names.items() if settings.scene in (token, name)
        }
    if len(scenes) != 1:
        choice = ", ".join(sorted(names[token] for token in scenes or names)[:5])
        raise CallError(
            f"{file}: has {len(scenes)} scenes with this name or these samples, "
            f"name one as input.nuscenes.scene: {choice} ..."
        )
    return {
        token: int(time_us) * _NS_PER_US
        for time_us, token, scene in sorted(samples)
        if scene in scenes
    }


def _egos(tables: Path, samples: Mapping[str, int]) -> list[EgoState]:
    """Return the states of the ego at the samples' sensor data, with speed and yaw rate from successive poses."""
    wanted = {
        each["ego_pose_token"]
        for each in json_values(tables / "sample_data.json")
        if each["sample_token"] in samples
    }
    poses = {}
    for each in json_values(tables / "ego_pose.json"):
        if each["token"] in wanted:
            x_m, y_m, _ = map(float, each["translation"])
            poses[int(each["timestamp"]) * _NS_PER_US] = (
                x_m,
                y_m,
                _yaw_rad(each["rotation"]),
            )
    stamps = sorted(poses)
    motions = [_motion(poses[a], poses[b], seconds(b - a)) for a, b in pairwise(stamps)]
    motions = motions[:1] + motions if motions else [(0.0, 0.0)] * len(stamps)
    return [
        EgoState(stamp, stamp, *poses[stamp], speed, rate)
        for stamp, (speed, rate) in zip(stamps, motions, strict=True)
    ]


def _motion(
    first: tuple[float, ...], second: tuple[float, ...], after_s: float
) -> tuple[float, float]:
    """Return speed along the yaw, and yaw rate, between two poses (x, y, yaw)."""
    turn_rad = wrap_angle(second[2] - first[2])
    middle_rad = first[2] + 0.5 * turn_rad
    vx_mps = (second[0] - first[0]) / after_s
    vy_mps = (second[1] - first[1]) / after_s
    return signed_speed_mps(vx_mps, vy_mps, middle_rad), turn_rad / after_s


def _boxes(boxes: list[Json], settings: NuscenesInput) -> Iterator[Detection | str]:
    for box in boxes:
        name = box.get("detection_name", box.get("tracking_name"))
        score = float(box.get("detection_score", box.get("tracking_score", math.nan)))
        if settings.classes and name not in settings.classes:
            yield "input.nuscenes.classes"
            continue
        x_m, y_m, z_m = map(float, box["translation"])
        width_m, length_m, height_m = map(float, box["size"])
        yaw_rad = _yaw_rad(box["rotation"])
        vx_mps, vy_mps = map(float, box.get("velocity") or (math.nan, math.nan))
        yield Detection(
            x_m=x_m,
            y_m=y_m,
            yaw_rad=yaw_rad,
            speed_mps=signed_speed_mps(vx_mps, vy_mps, yaw_rad)
            if math.isfinite(vx_mps + vy_mps)
            else None,
            object_id=object_id(box.get("tracking_id", "")),
            z_m=z_m,
            length_m=length_m,
            width_m=width_m,
            height_m=height_m,
            score=score if math.isfinite(score) else None,
            class_name=name,
        )


def _truth(
    tables: Path, samples: Mapping[str, int], settings: NuscenesInput
) -> list[TruthState]:
    if not (tables / "sample_annotation.json").is_file():
        return []
    categories = {
        each["token"]: next(
            (
                name
                for begin, name in _CATEGORIES.items()
                if each["name"].startswith(begin)
            ),
            None,
        )
        for each in json_values(tables / "category.json")
    }
    kinds = {
        each["token"]: categories[each["category_token"]]
        for each in json_values(tables / "instance.json")
    }
    states = []
    for each in json_values(tables / "sample_annotation.json"):
        stamp_ns = samples.get(each["sample_token"])
        kind = kinds[each["instance_token"]]
        if (
            stamp_ns is None
            or kind is None
            or (settings.classes and kind not in settings.classes)
        ):
            continue
        x_m, y_m, _ = map(float, each["translation"])
        number = object_id(each["instance_token"]) or 0
        unseen = not each.get("num_lidar_pts", 1) + each.get("num_radar_pts", 0)
        states.append(
            TruthState(
                stamp_ns,
                stamp_ns,
                number,
                x_m,
                y_m,
                _yaw_rad(each["rotation"]),
                ignored=unseen,
            )
        )
    return states


def _yaw_rad(rotation: list[float]) -> float:
    w, x, y, z = map(float, rotation)
    return math.atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)


def _recognises(path: Path) -> bool:
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return _RESULTS.match(file.read(64)) is not None


FORMAT = FileFormat(
    "nuScenes results (.json) with the data set's tables next to the file",
    _recognises,
    lambda path, config: partial(read_scene, path, config.nuscenes),
)
