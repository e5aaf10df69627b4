from dataclasses import replace

import numpy as np
import pytest
from support.paper import paper
from support.tracking import START_NS, ms

from fgtrack.config.settings import Config
from fgtrack.core.types import Detection, DetectionList, ObjectReport, TickReport
from fgtrack.models.sensors import SensorModel
from fgtrack.pipeline.build import build_tracker
from fgtrack.pipeline.public import replay
from fgtrack.tracking.objects import Objects
from fgtrack.tracking.tracker import MultiObjectTracker

POINTS = SensorModel(std={"x_m": 0.5, "y_m": 0.5})


def tracker(config: Config | None = None) -> MultiObjectTracker:
    return build_tracker(replace(config or Config(), sensors={"lidar": POINTS}))


def one_list(k: int, *objects: Detection) -> DetectionList:
    stamp_ns = START_NS + k * ms(100)
    return DetectionList("lidar", stamp_ns, stamp_ns, objects, "map")


def seen(one: MultiObjectTracker, k: int, *objects: Detection) -> TickReport:
    message = one_list(k, *objects)
    one.receive(message)
    return one.tick(message.stamp_ns)


@pytest.mark.parametrize(
    "association", ["{kind: euclidean, gate_m: 5.0}", "{kind: mahalanobis}"]
)
def test_a_car_never_joins_the_track_of_a_pedestrian(association: str) -> None:
    one = tracker(paper(f"association={association}", "merge={kind: none}"))
    for k in range(4):
        seen(one, k, Detection(x_m=10.0, y_m=0.0, class_name="pedestrian"))
    report = seen(one, 4, Detection(x_m=10.1, y_m=0.0, class_name="car"))
    assert [(each.disposition.value, each.track_id) for each in report.updates] == [
        ("birth", 1)
    ]
    report = seen(
        one,
        5,
        Detection(x_m=10.0, y_m=0.0),
        Detection(x_m=10.1, y_m=0.0, class_name="car"),
    )
    assert [each.track_id for each in report.updates] == [
        0,
        1,
    ]  # what has no class may belong to any


@pytest.mark.parametrize(
    ("first", "second", "joins"),
    [
        ("car", "Truck", True),
        ("car", "animal", False),
        ("animal", "debris", False),
        ("animal", "Animal", True),
        (None, "pedestrian", True),
        ("car", None, True),
    ],
)
def test_which_classes_may_be_one_object(
    first: str | None, second: str | None, joins: bool
) -> None:
    one = tracker()
    for k in range(3):
        seen(one, k, Detection(x_m=10.0, y_m=0.0, class_name=first))
    report = seen(one, 3, Detection(x_m=10.0, y_m=0.0, class_name=second))
    assert [each.track_id for each in report.updates] == [0 if joins else 1]


def test_the_class_of_a_track_is_that_of_most_of_its_detections_and_its_size_their_mean() -> (
    None
):
    one = tracker()
    for k, (name, length_m) in enumerate(
        [("van", 5.0), ("car", 4.0), ("car", 4.2), (None, None)]
    ):
        width_m = None if length_m is None else 1.8
        report = seen(
            one,
            k,
            Detection(
                x_m=10.0, y_m=0.0, class_name=name, length_m=length_m, width_m=width_m
            ),
        )
    [track] = report.tracks
    assert track.object == ObjectReport(
        "car", 2 / 3, pytest.approx(4.4), pytest.approx(1.8), None
    )


def test_what_some_detections_do_not_give_is_the_mean_of_the_others() -> None:
    one = tracker()
    for k, (width_m, height_m) in enumerate([(1.8, 1.5), (2.0, None), (None, 1.7)]):
        report = seen(
            one,
            k,
            Detection(
                x_m=10.0, y_m=0.0, length_m=4.0, width_m=width_m, height_m=height_m
            ),
        )
    [track] = report.tracks
    assert track.object == ObjectReport(
        None, None, pytest.approx(4.0), pytest.approx(1.9), pytest.approx(1.6)
    )


def test_a_track_without_any_word_on_its_object_says_nothing() -> None:
    [track] = seen(tracker(), 0, Detection(x_m=10.0, y_m=0.0)).tracks
    assert track.object is None


def test_what_is_known_ends_with_the_track() -> None:
    objects = Objects()
    objects.learn(3, [Detection(class_name="car", height_m=1.5)])
    assert objects.reports([3]) == [ObjectReport("car", 1.0, height_m=1.5)]
    apart = objects.apart(
        [Detection(class_name=name) for name in ("person", None, "car")], [3, 4]
    )
    assert apart is not None
    assert apart(np.array([0, 1, 2, 0]), np.array([0, 0, 0, 1])).tolist() == [
        True,
        False,
        False,
        False,
    ]
    objects.forget(3)
    assert objects.reports([3]) == [None]
    assert objects.apart([Detection(class_name="person")], [3]) is None


def test_the_run_folder_has_a_row_for_each_object(tmp_path) -> None:
    sized = Detection(
        x_m=10.0, y_m=0.0, class_name="car", length_m=4.0, width_m=2.0, height_m=1.5
    )
    messages = [one_list(k, sized, Detection(x_m=90.0, y_m=0.0)) for k in range(5)]
    row = {
        "track_id": 0,
        "class_name": "car",
        "class_share": 1.0,
        "length_m": 4.0,
        "width_m": 2.0,
        "height_m": 1.5,
    }
    row["id"] = ""
    for run in (
        replay(messages, Config(), out=tmp_path / "run"),
        replay(messages, Config()),
    ):
        assert {name: run.objects[name].tolist() for name in run.objects} == {
            name: [row[name]] for name in row
        }
