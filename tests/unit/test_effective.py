from dataclasses import replace

import pytest
from support.paper import paper
from support.tracking import message

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.types import Detection, EgoState
from fgtrack.io.config import InputConfig, TopicInput
from fgtrack.models.sensors import SensorModel
from fgtrack.pipeline.config import Config
from fgtrack.pipeline.effective import ASSUMED_STD, Effective, effective, with_sensors
from fgtrack.pipeline.public import replay
from fgtrack.tracking.tracker import check_sensor

POINT = Detection(x_m=20.0, y_m=1.0)


def test_the_paper_shifts_its_detections_and_merges_and_the_run_says_so() -> None:
    assert str(effective(paper())) == (
        "detection origin -1.74 m ahead, 0 m left of the ego; merge up to 5.1 m; lag 3.5 s"
    )
    smoother = effective(paper("estimator=smoother", "motion.kind=ctrv", "smoother.late=fuse"))
    assert (smoother.lag_s, smoother.reach_s) == (1.0, 3.0)
    assert str(smoother).endswith("lag 1 s, late detections up to 3 s")
    drops = effective(paper("estimator=smoother-banded", "motion.kind=ctrv", "smoother.late=drop"))
    assert (drops.lag_s, drops.reach_s) == (1.0, 1.0)


@pytest.mark.parametrize(
    ("objects", "measured"),
    [
        ([POINT], {"x_m", "y_m"}),
        ([POINT, Detection(x_m=1.0, y_m=2.0, speed_mps=3.0)], {"x_m", "y_m", "speed_mps"}),
        ([Detection(range_m=5.0, bearing_rad=0.1)], {"range_m", "bearing_rad"}),
        ([Detection(x_m=5.0, y_m=0.1, range_m=5.0, bearing_rad=0.1, yaw_rad=0.2)], {"x_m", "y_m", "yaw_rad"}),
        ([Detection(bearing_rad=0.1, x_m=1.0)], {"bearing_rad"}),
        ([], {"x_m", "y_m"}),
    ],
)
def test_a_sensor_without_a_name_in_the_configuration_measures_what_its_detections_hold(objects, measured) -> None:
    [(name, sensor)] = with_sensors(Config(), lambda: [message(*objects, sensor="odd")]).sensors.items()
    assert name == "odd"
    assert sensor.std == {one: ASSUMED_STD[one] for one in measured}


def test_what_the_input_names_and_the_recording_has_no_detection_of_is_taken_to_measure_positions() -> None:
    named = InputConfig(
        detections={"lidar": TopicInput("/lidar"), "radar": TopicInput("/radar"), "sonar": TopicInput("/sonar")}
    )
    config = replace(Config(), input=named, ignore_sensors=("sonar",))
    found = with_sensors(config, lambda: [message(POINT, sensor="lidar")]).sensors
    assert [(name, set(sensor.std)) for name, sensor in found.items()] == [
        ("lidar", {"x_m", "y_m"}),
        ("radar", {"x_m", "y_m"}),
    ]


def test_named_sensors_stay_the_only_ones() -> None:
    named = paper()
    assert with_sensors(named, lambda: [message(POINT, sensor="odd")]) is named
    with pytest.raises(DataError, match="'odd' has no model"):
        check_sensor("odd", named.sensors)


def test_what_is_ignored_gets_no_model_and_a_break_is_left_to_the_replay() -> None:
    def broken():
        yield message(POINT, sensor="a")
        yield message(POINT, sensor="b")
        raise DataError("cut off")

    found = with_sensors(replace(Config(), ignore_sensors=("b",)), broken)
    assert list(found.sensors) == ["a"]


def test_messages_without_any_configuration_are_tracked() -> None:
    def messages():
        for k in range(20):
            one = message(Detection(x_m=20.0 + k, y_m=1.0), sensor="odd", stamp_ms=100.0 * k)
            yield EgoState(one.stamp_ns, one.receipt_ns, 0.0, 0.0, 0.0, 0.0)
            yield one

    run = replay(messages())
    assert run.meta["effective"] == Effective((0.0, 0.0), None, "filter.storage_s", 3.0, 3.0).values()
    assert set(run.config["sensors"]) == {"odd"}
    assert set(run.tracks["track_id"].tolist()) == {0}
    newest = run.tracks["now_ns"] == run.tracks["now_ns"].max()
    assert run.tracks["x_m"][newest] == pytest.approx([39.0], abs=0.5)
    assert run.tracks["speed_mps"][newest] == pytest.approx([10.0], abs=1.0)
    assert run.tracks["status"][newest].tolist() == ["confirmed"]


def test_more_sensors_than_anyone_has_are_refused() -> None:
    sensors = {f"radar{k}": SensorModel(std={"x_m": 1.0, "y_m": 1.0}) for k in range(101)}
    with pytest.raises(ValueError, match=r"^sensors: 101 of them, at most 100"):
        Config(sensors=sensors)
    lists = [message(POINT, sensor=name) for name in sensors]
    with pytest.raises(CallError, match=r"^input: 101 sensors with those of the recording, at most 100"):
        with_sensors(Config(), lambda: iter(lists))
    assert len(with_sensors(Config(), lambda: iter(lists[1:])).sensors) == 100
