import math
from dataclasses import replace

import numpy as np
import pytest
from support.paper import paper
from support.tracking import START_NS, message

from fgtrack.config.reading import read_config, read_scenario
from fgtrack.config.recorded import recorded_of
from fgtrack.config.settings import Config, Effective
from fgtrack.config.yaml_file import plain
from fgtrack.core.errors import DataError
from fgtrack.core.types import Detection, DetectionList, EgoState
from fgtrack.inputs.recording import write_recording
from fgtrack.inputs.settings import InputConfig, TopicInput
from fgtrack.inputs.source import open_input
from fgtrack.meaning.assumed import ASSUMED_STD, assumed, source_of
from fgtrack.models.sensors import Mount, SensorModel
from fgtrack.pipeline.build import build_road
from fgtrack.pipeline.public import replay, simulate
from fgtrack.tracking.lives.existence import ExistenceRules
from fgtrack.tracking.parts import check_sensor

POINT = Detection(x_m=20.0, y_m=1.0)


@pytest.mark.parametrize(
    ("objects", "measured"),
    [
        ([POINT], {"x_m", "y_m"}),
        (
            [POINT, Detection(x_m=1.0, y_m=2.0, speed_mps=3.0)],
            {"x_m", "y_m", "speed_mps"},
        ),
        ([Detection(range_m=5.0, bearing_rad=0.1)], {"range_m", "bearing_rad"}),
        (
            [Detection(x_m=5.0, y_m=0.1, range_m=5.0, bearing_rad=0.1, yaw_rad=0.2)],
            {"x_m", "y_m", "yaw_rad"},
        ),
        ([Detection(bearing_rad=0.1, x_m=1.0)], {"bearing_rad"}),
        ([], {"x_m", "y_m"}),
    ],
)
def test_a_sensor_without_a_name_in_the_configuration_measures_what_its_detections_hold(
    objects, measured
) -> None:
    [(name, sensor)] = assumed(
        Config(), source_of(lambda: [message(*objects, sensor="odd")])
    ).config.sensors.items()
    assert name == "odd"
    assert sensor.std == {one: ASSUMED_STD[one] for one in measured}


def test_what_the_input_names_and_the_recording_has_no_detection_of_is_taken_to_measure_positions() -> (
    None
):
    named = InputConfig(
        detections={
            "lidar": TopicInput("/lidar"),
            "radar": TopicInput("/radar"),
            "sonar": TopicInput("/sonar"),
        }
    )
    config = replace(Config(), input=named, ignore_sensors=("sonar",))
    found = assumed(
        config, source_of(lambda: [message(POINT, sensor="lidar")])
    ).config.sensors
    assert [(name, set(sensor.std)) for name, sensor in found.items()] == [
        ("lidar", {"x_m", "y_m"}),
        ("radar", {"x_m", "y_m"}),
    ]


def test_named_sensors_stay_the_only_ones() -> None:
    named = paper()
    found = assumed(named, source_of(lambda: [message(POINT, sensor="odd")])).config
    assert found.sensors.keys() == named.sensors.keys()
    with pytest.raises(DataError, match="'odd' has no model"):
        check_sensor("odd", named.sensors)


def test_what_is_ignored_gets_no_model_and_a_break_is_left_to_the_replay() -> None:
    def broken():
        yield message(POINT, sensor="a")
        yield message(POINT, sensor="b")
        raise DataError("cut off")

    found = assumed(
        replace(Config(), ignore_sensors=("b",)), source_of(broken)
    ).config.sensors
    assert list(found) == ["a"]


def test_messages_without_any_configuration_are_tracked() -> None:
    def messages():
        for k in range(20):
            one = message(
                Detection(x_m=20.0 + k, y_m=1.0), sensor="odd", stamp_ms=100.0 * k
            )
            yield EgoState(one.stamp_ns, one.receipt_ns, 0.0, 0.0, 0.0, 0.0)
            yield one

    run = replay(messages())
    assert run.meta["effective"] == plain(
        Effective((0.0, 0.0), None, "filter.storage_s", 3.0, 3.0)
    )
    assert set(run.config["sensors"]) == {"odd"}
    assert set(run.tracks["track_id"].tolist()) == {0}
    newest = run.tracks["now_ns"] == run.tracks["now_ns"].max()
    assert run.tracks["x_m"][newest].to_numpy() == pytest.approx([39.0], abs=0.5)
    assert run.tracks["speed_mps"][newest].to_numpy() == pytest.approx([10.0], abs=1.0)
    assert run.tracks["status"][newest].tolist() == ["confirmed"]


def test_what_was_assumed_is_a_configuration_that_assumes_nothing_and_says_why(
    tmp_path,
) -> None:
    lists = [message(POINT, sensor="radar.front")]
    config = paper(
        "birth.speed_std_mps=3.0",
        "motion.std_per_s={position: 0.1, yaw: 0.1, speed: 1.0, yaw_rate: 1.0}",
    )
    found = assumed(replace(config, sensors={}), source_of(lambda: lists))
    path = tmp_path / "mine.yaml"
    path.write_text(found.to_yaml())
    assert "# assumed: usual for" in path.read_text()
    loaded = read_config(path)
    assert loaded == found.config
    assert assumed(loaded, source_of(lambda: lists)).assumptions == ()


CARRIED = {
    "ego": {"detection_origin_x_m": -1.74, "of a later version": 1},
    "map": {"track": "oval"},
    "sensors": {
        "lidar": {
            "field_of_view_rad": 2.0,
            "view_range_m": 80.0,
            "mount": {"x_m": 2.0},
        },
        "unheard": {},
    },
}


def carrying(settings, *objects, sensor="lidar"):
    return replace(
        source_of(lambda: [message(*objects, sensor=sensor)]), settings=lambda: settings
    )


def test_what_a_recording_carries_is_taken_where_the_configuration_is_open() -> None:
    found = assumed(Config(), carrying(CARRIED, POINT))
    lidar = found.config.sensors["lidar"]
    assert (found.config.ego.detection_origin_x_m, found.config.map.track) == (
        -1.74,
        "oval",
    )
    assert (lidar.field_of_view_rad, lidar.view_range_m, lidar.mount) == (
        2.0,
        80.0,
        Mount(2.0),
    )
    assert list(found.config.sensors) == ["lidar"]
    assert {one.key for one in found.assumptions if one.reason == "recorded"} == {
        "ego.detection_origin_x_m",
        "map.track",
        "sensors.lidar.mount",
        "sensors.lidar.field_of_view_rad",
        "sensors.lidar.view_range_m",
    }
    assert found.lines() == [
        "assumed, recording: ego.detection_origin_x_m -1.74, map.track oval (recorded)",
        "assumed, lidar: standard deviations x_m 1, y_m 1 (usual for a LiDAR or RADAR detector of cars); "
        "mounted at 2 m, 0 m, field of view 115 degrees, range 80 m (recorded)",
    ]


@pytest.mark.parametrize("as_file", [True, False])
def test_a_key_that_the_user_has_set_wins_also_where_it_is_set_to_its_default(
    tmp_path, as_file
) -> None:
    settings = [
        "ego.detection_origin_x_m=0.0",
        "map.track=none",
        "sensors.lidar={std: {x_m: 1.0, y_m: 1.0}, mount: {}, field_of_view_rad: 6.28}",
    ]
    if as_file:
        path = tmp_path / "c.yaml"
        path.write_text(
            "\n".join(
                one.replace(".", ": {", 1).replace("=", ": ") + "}" for one in settings
            )
        )
        config = read_config(path)
    else:
        config = read_config(None, settings)
    found = assumed(config, carrying(CARRIED, POINT))
    assert [one.key for one in found.assumptions] == ["sensors.lidar.view_range_m"]
    lidar = found.config.sensors["lidar"]
    assert (lidar.mount, lidar.field_of_view_rad, lidar.view_range_m) == (
        Mount(),
        6.28,
        80.0,
    )
    assert (found.config.ego.detection_origin_x_m, found.config.map.track_file) == (
        0.0,
        None,
    )
    assert not build_road(found.config.map).has_track


@pytest.mark.parametrize(
    ("settings", "warning"),
    [
        (
            {"ego": {"detection_origin_x_m": "far"}},
            "the recorded settings are ignored, ego.detection_origin_x_m",
        ),
        (
            {"sensors": {"lidar": {"mount": 3}}},
            "the recorded settings are ignored, sensors.lidar.mount",
        ),
        (
            {"map": {"track": "gone.csv"}},
            "the recorded map gone.csv does not exist, give the map with --map",
        ),
        ({"by another program": [1]}, None),
    ],
)
def test_what_is_not_valid_of_what_a_recording_carries_is_left_out_with_a_warning(
    settings, warning, caplog
) -> None:
    found = assumed(Config(), carrying(settings, POINT))
    assert [one.key for one in found.assumptions] == ["sensors.lidar.std"]
    assert (found.config.ego.detection_origin_x_m, found.config.map.track) == (
        0.0,
        None,
    )
    assert [warning in one for one in caplog.messages] == (
        [] if warning is None else [True]
    )


def forward(num_scans=400):
    """A car that swings within 57 degrees ahead, 30 m off, in front of a standing ego."""
    for k in range(num_scans):
        bearing_rad = 0.5 * math.sin(0.05 * k)
        point = Detection(
            x_m=30.0 * math.cos(bearing_rad), y_m=30.0 * math.sin(bearing_rad)
        )
        yield EgoState(
            START_NS + 50_000_000 * k, START_NS + 50_000_000 * k, 0.0, 0.0, 0.0, 0.0
        )
        yield message(*([point] if k % 10 else []), sensor="radar", stamp_ms=50.0 * k)


def test_a_sensor_is_taken_to_see_where_it_detects_unless_any_of_it_is_given() -> None:
    radar = assumed(Config(), source_of(forward)).config.sensors["radar"]
    assert (radar.field_of_view_rad, radar.view_range_m) == (
        pytest.approx(1.0, abs=0.03),
        33.0,
    )
    named = replace(
        Config(), sensors={"radar": SensorModel(std={"x_m": 2.0, "y_m": 2.0})}
    )
    found = assumed(named, source_of(forward)).config.sensors["radar"]
    assert (found.field_of_view_rad, found.view_range_m) == (
        radar.field_of_view_rad,
        radar.view_range_m,
    )
    for given in (
        {"field_of_view_rad": 3.0},
        {"view_range_m": 90.0},
        {"max_range_m": 90.0},
    ):
        config = replace(
            Config(),
            sensors={"radar": SensorModel(std={"x_m": 2.0, "y_m": 2.0}, **given)},
        )
        assert assumed(config, source_of(forward)).assumptions == ()


def test_what_leaves_the_view_of_the_only_sensor_that_gives_positions_ends_at_once() -> (
    None
):
    alone = assumed(Config(), source_of(forward)).config
    assert alone.lifecycle.out_of_view_s == pytest.approx(0.025, rel=0.01)

    def with_slow_sensor():
        for k, one in enumerate(forward()):
            yield one
            if k % 50 == 0:
                yield message(POINT, sensor="lidar", stamp_ms=25.0 * k)

    assert assumed(
        Config(), source_of(with_slow_sensor)
    ).config.lifecycle.out_of_view_s == pytest.approx(3.1, rel=0.1)

    def silent():  # the second of two sensors says nothing for a second
        for one in forward():
            yield one
            if (
                getattr(one, "objects", ())
                and not 3.0 <= (one.stamp_ns - START_NS) * 1e-9 < 4.0
            ):
                yield replace(one, sensor="lidar")

    assert assumed(
        Config(), source_of(silent)
    ).config.lifecycle.out_of_view_s == pytest.approx(1.6, abs=0.1)
    own = replace(Config(), lifecycle=ExistenceRules(out_of_view_s=2.0))
    assert assumed(own, source_of(forward)).config.lifecycle == own.lifecycle


def test_bearings_alone_are_left_out_beside_positions_unless_their_mount_is_recorded() -> (
    None
):
    bearing = message(Detection(bearing_rad=0.1), sensor="camera")
    source = source_of(lambda: [message(POINT, sensor="lidar"), bearing])
    found = assumed(Config(), source)
    assert set(found.config.used_sensors) == {"lidar"}
    assert "camera ignored" in found.lines()[-1]
    assert found.to_yaml().count("# assumed: no positions") == 1
    assert set(assumed(Config(), source_of(lambda: [bearing])).config.used_sensors) == {
        "camera"
    }
    mounted = replace(
        source, settings=lambda: {"sensors": {"camera": {"mount": {"x_m": 1.0}}}}
    )
    assert set(assumed(Config(), mounted).config.used_sensors) == {"lidar", "camera"}


def test_where_sensors_disagree_about_a_hull_a_track_claims_what_is_near() -> None:
    def hull():
        for one in forward():
            yield one
            if getattr(one, "objects", ()):
                x_m, y_m = one.objects[0].x_m + 8.0, one.objects[0].y_m
                yield replace(
                    one, sensor="lidar", objects=[Detection(x_m=x_m, y_m=y_m)]
                )

    found = assumed(Config(), source_of(hull))
    apart_m = 8.0 / 1.18
    assert found.config.association.claim_m == pytest.approx(
        2.0 * math.sqrt(12.0) * apart_m, abs=3.0
    )
    assert found.config.lifecycle.min_travel_m == pytest.approx(
        3.0 * apart_m / math.sqrt(2.0), abs=1.0
    )
    assert "no track begins within" in found.lines()[-1]
    for sensor in (
        found.config.sensors.values()
    ):  # half of the variance each, nearly all of it an offset that lasts
        assert (
            sensor.std["x_m"]
            == sensor.std["y_m"]
            == pytest.approx(8.0 / 1.18 / math.sqrt(2.0), rel=0.1)
        )
        assert sensor.correlation.share == pytest.approx(
            1.0 - 1.0 / sensor.std["x_m"] ** 2, abs=0.01
        )
    along = assumed(Config(), source_of(forward)).config
    assert (along.association.claim_m, along.lifecycle.min_travel_m) == (0.0, 0.0)

    def boxes():  # a detector of vehicles: those that stand are vehicles, too
        for one in hull():
            items = [
                replace(each, length_m=30.0, width_m=8.0)
                for each in getattr(one, "objects", ())
            ]
            yield replace(one, objects=items) if items else one

    assert assumed(Config(), source_of(boxes)).config.lifecycle.min_travel_m == 0.0


def test_errors_that_differ_from_list_to_list_are_no_offset() -> None:
    rng = np.random.default_rng(0)

    def noisy():
        for one in forward():
            yield one
            if getattr(one, "objects", ()):
                x_m, y_m = (
                    one.objects[0].x_m + 2.0 * rng.normal(),
                    one.objects[0].y_m + 2.0 * rng.normal(),
                )
                yield replace(
                    one, sensor="lidar", objects=[Detection(x_m=x_m, y_m=y_m)]
                )

    assert (
        assumed(Config(), source_of(noisy)).config.sensors["lidar"].correlation is None
    )


@pytest.mark.parametrize(("every", "lag_s"), [(30, 3.0), (250, 25.0), (600, 58.0)])
def test_windows_hold_two_lists_of_the_slowest_sensor_up_to_a_minute(
    every: int, lag_s: float
) -> None:
    def seldom():
        scans = 0
        for one in forward(1300):
            yield one
            if isinstance(one, DetectionList):
                scans += 1
                if scans % every == 0:
                    yield replace(one, sensor="slow")

    found = assumed(Config(), source_of(seldom))
    assert (found.config.smoother.lag_s, found.config.filter.storage_s) == (
        lag_s,
        lag_s + 2.0,
    )
    assert ("longer than the longest window" in found.lines()[-1]) == (lag_s == 58.0)


def test_boxes_are_taken_to_be_more_exact_than_points() -> None:
    box = replace(POINT, length_m=4.0, width_m=1.8)
    found = assumed(Config(), source_of(lambda: [message(box, sensor="lidar")]))
    assert found.config.sensors["lidar"].std == {"x_m": 0.3, "y_m": 0.3}
    assert "usual for boxes" in found.lines()[0]


def test_a_rear_sensor_gets_a_mount_that_looks_back() -> None:
    def rear():
        for one in forward():
            objects = [
                Detection(x_m=-each.x_m, y_m=each.y_m)
                for each in getattr(one, "objects", ())
            ]
            yield replace(one, objects=objects) if objects else one

    found = assumed(Config(), source_of(rear))
    assert found.config.sensors["radar"].mount.yaw_rad == pytest.approx(
        math.pi, abs=0.01
    )
    assert (
        "axis 180 degrees, field of view 57 degrees, range 33 m (coverage of 360 detections"
        in found.lines()[0]
    )


@pytest.mark.parametrize("name", ["stream.jsonl", "stream.jsonl.gz", "mcap", "sqlite3"])
def test_what_a_recording_carries_survives_writing_and_converting(
    tmp_path, name
) -> None:
    settings = recorded_of(read_scenario("default", duration_s=1.0))
    assert settings["sensors"]["radar"]["mount"] == {
        "x_m": 3.0,
        "y_m": 0.0,
        "yaw_rad": 0.0,
    }
    storage = "sqlite3" if name == "sqlite3" else "mcap"
    written = simulate("default", duration_s=1.0, out=tmp_path / name, storage=storage)
    assert open_input(written).settings() == settings
    bag = tmp_path / "converted"
    assert write_recording(
        bag, open_input(written).messages(), settings=open_input(written).settings()
    )
    assert open_input(bag).settings() == settings
    bare = tmp_path / "bare"
    write_recording(bare, open_input(written).messages())
    assert open_input(bare).settings() == {}


def test_without_a_configuration_a_recording_is_tracked_as_with_what_it_carries(
    tmp_path,
) -> None:
    recording = simulate(
        "default", duration_s=5.0, seed=1, out=tmp_path / "drive.jsonl"
    )
    bare = replay(recording)
    path = tmp_path / "assumed.yaml"
    path.write_text(assumed(Config(), open_input(recording)).to_yaml())
    messages = list(open_input(recording).messages())
    assert (
        replay(messages, path).meta["digest"]
        == bare.meta["digest"]
        != replay(messages).meta["digest"]
    )
    assert bare.config["ego"]["detection_origin_x_m"] == -1.74


@pytest.mark.parametrize(
    ("delay_s", "window_s"), [(0.1, 3.0), (2.5, 3.0), (6.0, 8.0), (45.0, 3.0)]
)
def test_windows_hold_the_delays_of_nearly_all_lists(
    delay_s: float, window_s: float
) -> None:
    delay_ns = round(1e9 * delay_s)

    def late():
        for one in forward():
            yield replace(one, receipt_ns=one.stamp_ns + delay_ns)

    config = assumed(Config(), source_of(late)).config
    assert config.filter.storage_s == pytest.approx(window_s, abs=1.0)
    assert config.smoother.lag_s + config.smoother.ring_s == pytest.approx(
        window_s, abs=1.0
    )
