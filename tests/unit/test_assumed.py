from dataclasses import replace

import pytest
from support.paper import paper
from support.tracking import message

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.types import Detection, EgoState
from fgtrack.io.config import InputConfig, TopicInput
from fgtrack.models.sensors import SensorModel
from fgtrack.pipeline.assumed import ASSUMED_STD, assumed, source_of
from fgtrack.pipeline.config import Config
from fgtrack.pipeline.effective import Effective
from fgtrack.pipeline.public import replay
from fgtrack.pipeline.shipped import read_config
from fgtrack.tracking.tracker import check_sensor

POINT = Detection(x_m=20.0, y_m=1.0)


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
    [(name, sensor)] = assumed(Config(), source_of(lambda: [message(*objects, sensor="odd")])).config.sensors.items()
    assert name == "odd"
    assert sensor.std == {one: ASSUMED_STD[one] for one in measured}


def test_what_the_input_names_and_the_recording_has_no_detection_of_is_taken_to_measure_positions() -> None:
    named = InputConfig(
        detections={"lidar": TopicInput("/lidar"), "radar": TopicInput("/radar"), "sonar": TopicInput("/sonar")}
    )
    config = replace(Config(), input=named, ignore_sensors=("sonar",))
    found = assumed(config, source_of(lambda: [message(POINT, sensor="lidar")])).config.sensors
    assert [(name, set(sensor.std)) for name, sensor in found.items()] == [
        ("lidar", {"x_m", "y_m"}),
        ("radar", {"x_m", "y_m"}),
    ]


def test_named_sensors_stay_the_only_ones() -> None:
    named = paper()
    assert assumed(named, source_of(lambda: [message(POINT, sensor="odd")])).config.sensors == named.sensors
    with pytest.raises(DataError, match="'odd' has no model"):
        check_sensor("odd", named.sensors)


def test_what_is_ignored_gets_no_model_and_a_break_is_left_to_the_replay() -> None:
    def broken():
        yield message(POINT, sensor="a")
        yield message(POINT, sensor="b")
        raise DataError("cut off")

    found = assumed(replace(Config(), ignore_sensors=("b",)), source_of(broken)).config.sensors
    assert list(found) == ["a"]


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
        assumed(Config(), source_of(lambda: lists))
    assert len(assumed(Config(), source_of(lambda: lists[1:])).config.sensors) == 100


def test_what_was_assumed_is_a_configuration_that_assumes_nothing_and_says_why(tmp_path) -> None:
    lists = [message(POINT, sensor="radar.front")]
    config = paper("birth.speed_std_mps=3.0", "motion.std_per_s={position: 0.1, yaw: 0.1, speed: 1.0, yaw_rate: 1.0}")
    found = assumed(replace(config, sensors={}), source_of(lambda: lists))
    path = tmp_path / "mine.yaml"
    path.write_text(found.to_yaml())
    assert "# assumed: usual of" in path.read_text()
    loaded = read_config(path)
    assert loaded == found.config
    assert assumed(loaded, source_of(lambda: lists)).assumptions == ()
