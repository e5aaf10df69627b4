"""A recording without settings: names suggest, tests decide, and what stays open is asked."""

import csv
import json
import warnings
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import fgtrack
from fgtrack.cli.main import run as command
from fgtrack.config.settings import Config
from fgtrack.core.errors import CallError
from fgtrack.core.types import DetectionList
from fgtrack.meaning import evidence
from fgtrack.meaning.decision import Decision
from fgtrack.meaning.draft import drafted
from fgtrack.models.sensors import Mount
from fgtrack.pipeline.sweep import run_job
from fgtrack.pipeline.sweep import write_tables as write_tables_of_sweep

CARS_M = ((20.0, 3.5, 1.0), (35.0, -3.0, -2.0), (50.0, 0.5, 0.5))
"""Place ahead and to the left at the start, and speed relative to the ego."""
SENSORS = {"radar_front": Mount(), "lidar_rear": Mount(-1.0, 0.5, 0.0)}


def scans(seed, duration_s=12.0):
    """Yield sensor, stamp, receipt and positions in its frame of each list: three cars around an ego at 10 m/s."""
    rng = np.random.default_rng(seed)
    for k in range(int(duration_s * 10)):
        for number, (name, mount) in enumerate(SENSORS.items()):
            stamp_s = 1_700_000_000.0 + 0.1 * k + 0.03 * number
            points = [
                (
                    ahead + speed * 0.1 * k - mount.x_m + 0.1 * rng.normal(),
                    left - mount.y_m + 0.1 * rng.normal(),
                )
                for ahead, left, speed in CARS_M
                if rng.random() < 0.9
            ]
            yield name, stamp_s, stamp_s + 0.05, points


def write_tables(folder, seed=1, names=tuple(SENSORS)):
    folder.mkdir()
    rows = {name: [["time", "received", "x", "y"]] for name in SENSORS if name in names}
    for name, stamp_s, receipt_s, points in scans(seed):
        if name in names:
            rows[name] += [
                [f"{stamp_s:.3f}", f"{receipt_s:.3f}", f"{x:.3f}", f"{y:.3f}"]
                for x, y in points or [("", "")]
            ]
    rows["ego"] = [["time", "received", "x", "y", "heading", "v"]]
    for k in range(500):
        stamp_s = 1_700_000_000.0 + 0.025 * k
        rows["ego"].append(
            [f"{stamp_s:.3f}", f"{stamp_s + 0.002:.3f}", 0.25 * k, 0.0, 0.0, 10.0]
        )
    for name, lines in rows.items():
        with (folder / f"{name}.csv").open("w", newline="") as file:
            csv.writer(file).writerows(lines)
    return folder


DEFINITIONS = {
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score",
    "vision_msgs/msg/ObjectHypothesisWithPose": (
        "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose"
    ),
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size",
    "vision_msgs/msg/Detection3D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox3D bbox\nstring id"
    ),
    "vision_msgs/msg/Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections",
}


def write_bag(folder, seed=1):
    """A bag of another program: odometry, and boxes of no size in the ego's frame."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    types = {}
    for name, text in DEFINITIONS.items():
        types.update(get_types_from_msg(text, name))
    store.register(types)
    t = store.types

    def header(stamp_s, frame):
        time = t["builtin_interfaces/msg/Time"](
            int(stamp_s), round((stamp_s % 1.0) * 1e9)
        )
        return t["std_msgs/msg/Header"](time, frame)

    def pose(x_m, y_m):
        return t["geometry_msgs/msg/Pose"](
            t["geometry_msgs/msg/Point"](x_m, y_m, 0.0),
            t["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
        )

    def uncertain(x_m, y_m):
        return t["geometry_msgs/msg/PoseWithCovariance"](pose(x_m, y_m), np.zeros(36))

    vector = t["geometry_msgs/msg/Vector3"]
    rows = []
    for k in range(500):
        stamp_s = 1_700_000_000.0 + 0.025 * k
        twist = t["geometry_msgs/msg/Twist"](
            vector(10.0, 0.0, 0.0), vector(0.0, 0.0, 0.0)
        )
        message = t["nav_msgs/msg/Odometry"](
            header(stamp_s, "odom"),
            "base_link",
            uncertain(0.25 * k, 0.0),
            t["geometry_msgs/msg/TwistWithCovariance"](twist, np.zeros(36)),
        )
        rows.append((stamp_s + 0.002, "/odom", message))
    for name, stamp_s, receipt_s, points in scans(seed):
        mount = SENSORS[name]
        boxes = []
        for x_m, y_m in points:
            box = t["vision_msgs/msg/BoundingBox3D"](
                pose(x_m + mount.x_m, y_m + mount.y_m), vector(0.0, 0.0, 0.0)
            )
            head = header(stamp_s, "base_link")
            boxes.append(t["vision_msgs/msg/Detection3D"](head, [], box, ""))
        message = t["vision_msgs/msg/Detection3DArray"](
            header(stamp_s, "base_link"), boxes
        )
        rows.append((receipt_s, f"/{name}/detections", message))
    rows.sort(key=lambda row: row[0])
    with Writer(folder, version=9) as writer:
        topics = {}
        for receipt_s, topic, message in rows:
            if topic not in topics:
                topics[topic] = writer.add_connection(
                    topic, message.__msgtype__, typestore=store
                )
            data = store.serialize_cdr(message, message.__msgtype__)
            writer.write(topics[topic], round(receipt_s * 1e9), data)
    return folder


@pytest.fixture(scope="module")
def tables(tmp_path_factory):
    return write_tables(tmp_path_factory.mktemp("tables") / "drive")


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    return write_bag(tmp_path_factory.mktemp("bag") / "drive")


def asks_for_the_mount(sample):
    """Leave the mount of the rear sensor open, unless the user has given it."""
    path = ("sensors", "lidar_rear", "mount")
    names = {each.sensor for each in sample.messages if isinstance(each, DetectionList)}
    if "lidar_rear" in names and sample.is_open(path):
        yield Decision(
            "lidar_rear",
            "mount",
            {},
            "open",
            "no object is common with another sensor",
            "where is it mounted? Set sensors.lidar_rear.mount",
        )


def finds_the_mount(sample):
    path = ("sensors", "lidar_rear", "mount")
    value = {"x_m": -1.0, "y_m": 0.5, "yaw_rad": 0.0}
    yield Decision(
        "lidar_rear", "mount", {path: value}, "tested", "agrees within 0.05 m"
    )


def reads_the_map(sample):
    key = sample.input_path("radar_front")
    yield Decision("radar_front", "frame", {(*key, "frame"): "map"}, "assumed", "odd")


@pytest.fixture
def tests(monkeypatch):
    """Replaces the tests of hypotheses."""

    def set_tests(*new):
        monkeypatch.setattr(evidence, "TESTS", new)

    set_tests()
    return set_tests


def test_a_foreign_folder_and_a_foreign_bag_need_no_configuration(tables, bag, tests):
    for recording in (tables, bag):
        draft = drafted(recording)
        sensors = {name.split("_detections")[0] for name in draft.config.sensors}
        assert sensors == set(SENSORS)
        assert {item.about for item in draft.decisions} >= {"ego"}
        run = fgtrack.replay(recording)
        newest = run.tracks[run.tracks["now_ns"] == run.tracks["now_ns"].max()]
        assert (newest["status"] != "tentative").sum() == 3


def test_a_single_foreign_table_needs_no_configuration(tmp_path, tests):
    write_tables(tmp_path / "drive", names=("radar_front",))
    (tmp_path / "drive/ego.csv").unlink()
    [table] = (tmp_path / "drive").iterdir()
    draft = drafted(table)
    assert list(draft.config.sensors) == ["radar_front"]
    assert draft.config.input.csv.detections["radar_front"].file is None


def test_each_kind_of_decision_is_shown_with_its_certainty(tables, tests):
    tests(reads_the_map, finds_the_mount, asks_for_the_mount)
    draft = drafted(tables)
    lines = draft.lines()
    assert lines[0].startswith("lidar_rear, mount (open): no object is common")
    assert "Set sensors.lidar_rear.mount" in lines[0]
    assert any(
        line == "lidar_rear, mount (tested): agrees within 0.05 m" for line in lines
    )
    assert any(line.startswith("radar_front, frame (assumed): odd") for line in lines)
    assert any(line.startswith("assumed, radar_front: ") for line in lines)


def test_a_tested_setting_is_applied_before_the_next_test_reads(tables, tests):
    seen = []

    def looks(sample):
        seen.extend(
            each.frame
            for each in sample.messages
            if isinstance(each, DetectionList) and each.sensor == "radar_front"
        )
        return ()

    tests(reads_the_map, looks)
    drafted(tables)
    assert set(seen) == {"map"}


def test_a_table_in_the_frame_of_the_sensor_has_the_messages_of_another_reading(
    tables, tests
):
    """The messages get the frame, and the table is read once."""
    seen = []

    def reads_the_sensor(sample):
        key = sample.input_path("radar_front")
        yield Decision(
            "radar_front", "frame", {(*key, "frame"): "sensor"}, "tested", "a mount"
        )

    def looks(sample):
        seen.extend(sample.messages)
        again = evidence.first_messages(sample.path, sample.config)
        assert list(sample.messages) == again
        return ()

    tests(reads_the_sensor, looks)
    drafted(tables)
    frames = {
        (each.sensor, each.frame) for each in seen if isinstance(each, DetectionList)
    }
    assert ("radar_front", "sensor") in frames


def test_a_sensor_with_an_open_question_is_left_out_and_asked_again(
    tables, tests, tmp_path
):
    tests(asks_for_the_mount)
    draft = drafted(tables)
    assert draft.config.ignore_sensors == ("lidar_rear",)
    assert draft.questions == (
        "lidar_rear: where is it mounted? Set sensors.lidar_rear.mount",
    )
    assert "lidar_rear left out of the runs" in draft.problem
    (tmp_path / "s.yaml").write_text(draft.to_yaml())
    again = drafted(tables, Config.from_yaml(tmp_path / "s.yaml"))
    assert again.problem == draft.problem
    answered = Config.from_yaml(tmp_path / "s.yaml").replace(
        {"sensors.lidar_rear.mount": {"x_m": -1.0, "y_m": 0.5}}
    )
    final = drafted(tables, answered)
    assert final.problem is None
    assert final.config.ignore_sensors == ()
    assert final.config.sensors["lidar_rear"].mount == Mount(-1.0, 0.5)
    assert final.config.sensors["lidar_rear"].std


def test_a_sensor_with_an_assumed_lever_arm_is_used_and_asked_again(
    tables, tests, tmp_path, capsys
):
    def assumes_the_arm(sample):
        mount = {("sensors", "lidar_rear", "mount"): {"yaw_rad": 0.0, "x_m": 0.0}}
        question = "where is it mounted? Set sensors.lidar_rear.mount"
        if sample.is_open(("sensors", "lidar_rear", "mount")):
            yield Decision(
                "lidar_rear", "mount", mount, "open", "yaw 0", question, True
            )

    tests(assumes_the_arm)
    draft = drafted(tables)
    assert draft.open_sensors == ()
    assert draft.config.sensors["lidar_rear"].mount == Mount()
    assert "lidar_rear used with an assumed mount" in draft.problem
    (tmp_path / "s.yaml").write_text(draft.to_yaml())
    again = Config.from_yaml(tmp_path / "s.yaml")
    assert list(again.sensors) == ["radar_front"]
    assert drafted(tables, again).problem == draft.problem
    assert "lidar_rear" not in fgtrack.advise(tables).config.sensors
    words = ["replay", str(tables), "-o", str(tmp_path / "run"), "-e", "ekf-replay"]
    assert command(words) == 1
    assert "lidar_rear used with an assumed mount" in capsys.readouterr().err
    mount = {"sensors.lidar_rear.mount": {"x_m": -1.0, "y_m": 0.5}}
    assert drafted(tables, again.replace(mount)).problem is None


@pytest.mark.parametrize("test", [reads_the_map, finds_the_mount])
def test_what_the_user_sets_stays_and_everything_else_is_computed(tables, tests, test):
    tests(test)
    settings = {
        "sensors.lidar_rear.mount": {"x_m": 3.0},
        "sensors.lidar_rear.detection_probability": 0.5,
    }
    given = Config().replace(settings)
    draft = drafted(tables, given)
    rear = draft.config.sensors["lidar_rear"]
    assert (rear.mount, rear.detection_probability) == (Mount(3.0), 0.5)
    assert rear.std
    alone = drafted(tables).config.sensors["radar_front"]
    assert draft.config.sensors["radar_front"] == replace(alone, mount=alone.mount)


def test_a_complete_configuration_is_not_tested(tables, tests, tmp_path):
    tests(finds_the_mount)
    (tmp_path / "s.yaml").write_text(drafted(tables).to_yaml())
    config = Config.from_yaml(tmp_path / "s.yaml")
    called = []
    tests(lambda sample: called.append(sample) or ())
    again = drafted(tables, config)
    assert called == []
    assert again.config == config
    assert again.lines() == []


def test_the_settings_of_one_recording_hold_for_another_of_the_vehicle(
    tables, tests, tmp_path
):
    tests(finds_the_mount)
    (tmp_path / "s.yaml").write_text(drafted(tables).to_yaml())
    other = write_tables(tmp_path / "other", seed=2)
    run = fgtrack.replay(other, tmp_path / "s.yaml")
    assert run.config["sensors"]["lidar_rear"]["mount"]["x_m"] == -1.0
    newest = run.tracks[run.tracks["now_ns"] == run.tracks["now_ns"].max()]
    assert (newest["status"] != "tentative").sum() == 3


def test_replay_and_info_exit_with_1_while_a_question_is_open(
    tables, tests, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    tests(asks_for_the_mount)
    assert command(["replay", str(tables), "-o", "run"]) == 1
    shown = capsys.readouterr()
    assert "lidar_rear left out of the runs" in shown.err
    assert "Set sensors.lidar_rear.mount" in shown.err
    assert fgtrack.load_run("run").meta["complete"]
    assert command(["info", str(tables), "--write", "my.yaml"]) == 1
    assert "# Open: lidar_rear: where is it mounted?" in Path("my.yaml").read_text()
    answer = "sensors.lidar_rear.mount={x_m: -1.0, y_m: 0.5}"
    words = ["replay", str(tables), "-c", "my.yaml", "--set", answer, "-o", "again"]
    assert command(words) == 0
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        fgtrack.replay(tables)
    assert any("left out of the runs" in str(each.message) for each in caught)


@pytest.mark.parametrize(
    "words",
    [
        ("convert", "out.jsonl"),
        pytest.param(("ledger",), marks=pytest.mark.slow),
        pytest.param(("tune", "-o", "tuned.yaml"), marks=pytest.mark.slow),
    ],
)
def test_other_commands_exit_with_1_while_a_question_is_open(
    words, tables, tests, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    tests(asks_for_the_mount)
    assert command([words[0], str(tables), *words[1:]]) == 1
    shown = capsys.readouterr()
    assert "lidar_rear left out of the runs" in shown.err
    assert "Set sensors.lidar_rear.mount" in shown.err


def test_a_sweep_names_the_open_questions(tables, tests, tmp_path):
    tests(asks_for_the_mount)
    recipe = {
        "config": {},
        "recording": str(tables),
        "scenario": None,
        "delays": {},
        "seed": 0,
        "estimators": ["ekf-replay"],
    }
    key, cells = run_job("job", recipe, lambda run: ({"lists": 1}, {}))
    assert [cell.error for cell in cells] == [None]
    assert "Set sensors.lidar_rear.mount" in str(cells[0].problem)
    plan = SimpleNamespace(
        jobs=[SimpleNamespace(key=key, recipe=recipe, cells=(), seed=0)],
        metrics=(),
        columns=(),
        estimators=["ekf-replay"],
    )
    result = write_tables_of_sweep(tmp_path, plan, {key: cells})
    assert result.problems == (cells[0].problem,)


def test_advised_settings_do_not_ignore_a_sensor_with_an_open_question(tables, tests):
    tests(asks_for_the_mount)
    advice = fgtrack.advise(tables)
    assert "lidar_rear" not in advice.config.ignore_sensors
    assert any("Set sensors.lidar_rear.mount" in each.text for each in advice.findings)


def test_a_draft_in_python_has_the_settings_of_the_replay(tables, tests):
    draft = fgtrack.draft(tables, set={"sensors.lidar_rear.mount": {"x_m": 1.0}})
    run = fgtrack.replay(tables, set={"sensors.lidar_rear.mount": {"x_m": 1.0}})
    assert Config.from_dict(run.config) == draft.config
    assert all(isinstance(item, fgtrack.Decision) for item in draft.decisions)
    with pytest.raises(CallError, match="no such file"):
        fgtrack.draft("missing")


def test_an_open_decision_has_a_question_and_no_settings():
    with pytest.raises(ValueError, match="has a question and no settings"):
        Decision("radar", "frame", {}, "open", "unknown")


@pytest.mark.slow
def test_a_study_of_a_foreign_bag_begins_with_the_assumptions_and_asks(
    bag, tests, tmp_path, monkeypatch, capsys
):
    def asks(sample):
        yield Decision(
            "lidar_rear", "frame", {}, "open", "no test", "which frame? Set input..."
        )

    tests(asks)
    assert command(["study", str(bag), "-o", str(tmp_path / "s")]) == 1
    shown = capsys.readouterr()
    assert "lidar_rear left out of the runs" in shown.err
    page = (tmp_path / "s/report.html").read_text()
    assert page.index("lidar_rear, frame (open)") < page.index('id="part-verdict"')
    assert (tmp_path / "s/settings.yaml").exists()
    tests()
    words = ["study", str(bag), "-c", str(tmp_path / "s/settings.yaml")]
    assert command([*words, "-o", str(tmp_path / "t")]) == 0


@pytest.mark.slow
def test_each_of_several_recordings_gets_a_study_and_an_error_does_not_stop_the_others(
    tables, tests, tmp_path, capsys
):
    (tmp_path / "a.csv").write_text("alpha,beta\n1,2\n")
    other = write_tables(tmp_path / "other", seed=2)
    words = ["study", str(tmp_path / "a.csv"), str(tables), str(other)]
    assert command([*words, "-o", str(tmp_path / "out")]) == 1
    shown = capsys.readouterr()
    assert "1 of 3 recordings have an error or an open question" in shown.err
    assert "a: no result error: " in shown.out
    assert (tmp_path / "out/drive/report.html").exists()
    assert (tmp_path / "out/other/report.html").exists()


def test_one_key_of_a_table_or_topic_may_be_set_without_the_others(tables, bag, tests):
    for recording, section, name in (
        (tables, "input.csv.detections", "radar_front"),
        (bag, "input.detections", "radar_front"),
    ):
        given = Config().replace({f"{section}.{name}.frame": "sensor"})
        draft = drafted(recording, given)
        frames = {
            (each.sensor, each.frame)
            for each in draft.source.messages()
            if isinstance(each, DetectionList)
        }
        assert frames == {("radar_front", "sensor"), ("lidar_rear", "ego")}
    given = Config().replace({"input.csv.detections.sonar.frame": "sensor"})
    with pytest.raises(CallError, match=r"sonar.frame: the draft .* has no such"):
        drafted(tables, given)


def test_a_recorded_mount_needs_no_test(tests, tmp_path):
    asked = []

    def asks(sample):
        asked.append(sample.is_open(("sensors", "lidar", "mount")))
        return ()

    tests(asks)
    fgtrack.simulate("default", duration_s=1.0, out=tmp_path / "a.jsonl")
    lines = (tmp_path / "a.jsonl").read_text().splitlines(keepends=True)
    header = json.loads(lines[0])
    for settings in ({}, {"sensors": {"lidar": {"mount": {"x_m": 2.0}}}}):
        first = json.dumps(header | {"settings": settings}) + "\n"
        (tmp_path / "b.jsonl").write_text("".join([first, *lines[1:]]))
        drafted(tmp_path / "b.jsonl")
    assert asked == [True, False]
