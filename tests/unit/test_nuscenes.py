"""Boxes in the submission form of nuScenes, with ego poses and truth from its tables."""

import json
import math
from pathlib import Path

import pytest
from support.messages import tilted

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.types import Detection, DetectionList, EgoState, Message, TruthState
from fgtrack.inputs.formats.common import object_id
from fgtrack.inputs.formats.nuscenes import _motion
from fgtrack.inputs.settings import InputConfig, NuscenesInput
from fgtrack.inputs.source import input_kind, open_input

T0_US = 1_532_402_927_647_951


def turned(yaw_rad: float) -> list[float]:
    return tilted(yaw_rad).tolist()


def box(
    x_m: float, name: str = "car", score: float = 0.8, **more: object
) -> dict[str, object]:
    kind = {"detection_name": name, "detection_score": score}
    common = {
        "sample_token": "s0",
        "translation": [x_m, 2.0, 1.0],
        "size": [1.9, 4.5, 1.6],
        "rotation": turned(0.5),
    }
    return {**common, "velocity": [-math.cos(0.5), -math.sin(0.5)], **kind, **more}


def annotation(
    sample: str, instance: str, x_m: float, **points: int
) -> dict[str, object]:
    place = {"translation": [x_m, 2.0, 1.0], "rotation": turned(0.5)}
    return {"sample_token": sample, "instance_token": instance, **place, **points}


def data(at: Path, boxes: dict[str, object] | None = None) -> Path:
    """Two samples half a second apart of one scene, one of another; the ego drives to the north and turns left."""
    tables = {
        "scene": [
            {"token": "a", "name": "scene-0001"},
            {"token": "b", "name": "scene-0002"},
        ],
        "sample": [
            {"token": "s1", "timestamp": T0_US + 500_000, "scene_token": "a"},
            {"token": "s0", "timestamp": T0_US, "scene_token": "a"},
            {"token": "other", "timestamp": T0_US + 9_000_000, "scene_token": "b"},
        ],
        "sample_data": [
            {"sample_token": "s0", "ego_pose_token": "p0"},
            {"sample_token": "s1", "ego_pose_token": "p1"},
            {"sample_token": "other", "ego_pose_token": "p2"},
        ],
        "ego_pose": [
            {
                "token": "p1",
                "timestamp": T0_US + 500_000,
                "translation": [100.0, 205.0, 0.0],
                "rotation": turned(1.67),
            },
            {
                "token": "p0",
                "timestamp": T0_US,
                "translation": [100.0, 200.0, 0.0],
                "rotation": turned(1.47),
            },
            {
                "token": "p2",
                "timestamp": T0_US + 9_000_000,
                "translation": [0.0, 0.0, 0.0],
                "rotation": turned(0.0),
            },
        ],
        "category": [
            {"token": "c", "name": "vehicle.car"},
            {"token": "d", "name": "animal"},
        ],
        "instance": [
            {"token": "i", "category_token": "c"},
            {"token": "j", "category_token": "d"},
        ],
        "sample_annotation": [
            annotation("s0", "i", 110.0, num_lidar_pts=5, num_radar_pts=0),
            annotation("s1", "i", 111.0, num_lidar_pts=0),
            annotation("s0", "j", 1.0),
        ],
    }
    (at / "v1.0-mini").mkdir(parents=True)
    for name, rows in tables.items():
        (at / "v1.0-mini" / f"{name}.json").write_text(json.dumps(rows))
    (at / "results.json").write_text(
        json.dumps(
            {"meta": {}, "results": {"s0": [box(110.0)], "s1": []} | (boxes or {})}
        )
    )
    return at / "results.json"


def messages(path: Path, **settings: object) -> list[Message]:
    return list(
        open_input(path, InputConfig(nuscenes=NuscenesInput(**settings))).messages()
    )


def test_a_scene_gives_truth_ego_and_boxes_in_the_map(tmp_path):
    path = data(tmp_path)
    assert input_kind(path) == "nuscenes"
    truth, ego, boxes, unseen, later, nothing = messages(path)
    first_ns, second_ns = T0_US * 1000, T0_US * 1000 + 500_000_000
    yaw_rad = pytest.approx(0.5)
    assert truth == TruthState(first_ns, first_ns, object_id("i"), 110.0, 2.0, yaw_rad)
    assert isinstance(unseen, TruthState)
    assert unseen.ignored
    assert ego == EgoState(
        first_ns,
        first_ns,
        100.0,
        200.0,
        pytest.approx(1.47),
        pytest.approx(10.0),
        pytest.approx(0.4),
    )
    assert isinstance(later, EgoState)
    assert (later.stamp_ns, later.y_m, later.speed_mps) == (
        second_ns,
        205.0,
        pytest.approx(10.0),
    )
    seen = Detection(
        x_m=110.0, y_m=2.0, yaw_rad=yaw_rad, speed_mps=pytest.approx(-1.0), z_m=1.0, length_m=4.5, width_m=1.9,
        height_m=1.6, score=0.8, class_name="car",
    )  # fmt: skip
    assert boxes == DetectionList("detector", first_ns, first_ns, (seen,), "map")
    assert nothing == DetectionList("detector", second_ns, second_ns, (), "map")


def test_classes_scores_and_ids_of_trackers(tmp_path):
    tracked = {
        "tracking_name": "bus",
        "tracking_score": 0.3,
        "tracking_id": "7a",
        "velocity": [math.nan, 0.0],
    }
    bus = {
        key: value
        for key, value in box(1.0).items()
        if not key.startswith("detection_")
    } | tracked
    path = data(tmp_path, {"s0": [box(1.0, "truck"), box(2.0, score=0.1), bus]})
    (found, _) = (
        item
        for item in messages(path, classes=("bus", "car"))
        if isinstance(item, DetectionList)
    )
    _, item = found.objects
    assert found.left_out == ("input.nuscenes.classes",)
    assert (item.class_name, item.score, item.object_id, item.speed_mps) == (
        "bus",
        0.3,
        object_id("7a"),
        None,
    )
    (found, _) = (
        item
        for item in messages(path, classes=(), sensor="x")
        if isinstance(item, DetectionList)
    )
    assert (found.sensor, len(found.objects)) == ("x", 3)


def test_of_several_scenes_one_is_named(tmp_path):
    path = data(tmp_path, {"other": []})
    with pytest.raises(
        CallError,
        match=r"2 scenes .*, name one as input\.nuscenes\.scene: scene-0001, scene-0002",
    ):
        messages(path)
    assert len(messages(path, scene="scene-0001")) == 6
    assert [type(item).__name__ for item in messages(path, scene="b")] == [
        "EgoState",
        "DetectionList",
    ]
    with pytest.raises(CallError, match=r"0 scenes .*, name one .*: scene-0001"):
        messages(path, scene="scene-9")


@pytest.mark.parametrize(
    ("table", "text", "complaint"),
    [
        ("ego_pose", "[{", r"ego_pose\.json: is not JSON"),
        (
            "ego_pose",
            '[{"token": "p0"}]',
            r"sample_data\.json or ego_pose\.json .* \('translation' is missing\)",
        ),
        ("sample", "3", r"sample\.json: is not JSON of the expected form"),
        (
            "sample_annotation",
            '[{"sample_token": "s0", "instance_token": "zz"}]',
            r"not a table of nuScenes \('zz' is missing\)",
        ),
    ],
)
def test_damaged_tables_are_one_line(tmp_path, table, text, complaint):
    path = data(tmp_path)
    (tmp_path / "v1.0-mini" / f"{table}.json").write_text(text)
    with pytest.raises(DataError, match=complaint) as caught:
        messages(path)
    assert "\n" not in str(caught.value)


def test_without_tables_the_setting_is_named(tmp_path):
    path = data(tmp_path)
    with pytest.raises(
        CallError,
        match=r"no folder with ego_pose\.json is next to the file, name the folder as input\.nuscenes\.tables",
    ):
        messages(path, tables="elsewhere")
    (tmp_path / "v1.0-mini").rename(tmp_path / "meta")
    assert len(messages(path, tables="meta")) == 6
    (tmp_path / "meta/sample_annotation.json").unlink()
    assert [type(item) for item in messages(path, tables="meta")] == [
        EgoState,
        DetectionList,
    ] * 2


def test_damaged_boxes_are_named_with_their_sample(tmp_path):
    path = data(tmp_path, boxes={"s0": [box(110.0), None]})
    with pytest.raises(
        DataError,
        match=r"results\.json: sample 's0': .* \(null where the format has another type of value\)",
    ):
        messages(path)


def test_a_path_may_be_relative(tmp_path, monkeypatch):
    path = data(tmp_path / "scenes")
    monkeypatch.chdir(tmp_path)
    assert len(messages(path.relative_to(tmp_path))) == 6


@pytest.mark.parametrize(
    ("yaws_rad", "course_rad"),
    [((0.0, 3.0), 2.9), ((0.0, 3.0), 0.1), ((3.0, -3.0), math.pi)],
    ids=repr,
)
def test_an_ego_that_turns_drives_forward_where_it_goes_along_its_mean_heading(
    yaws_rad, course_rad
):
    """Neither the first heading nor the last says so, nor their mean across the cut at pi."""
    ahead = 5.0 * math.cos(course_rad), 5.0 * math.sin(course_rad)
    speed_mps, _ = _motion((0.0, 0.0, yaws_rad[0]), (*ahead, yaws_rad[1]), 0.5)
    assert speed_mps == pytest.approx(10.0)
