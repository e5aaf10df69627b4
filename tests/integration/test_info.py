import pytest
from support.messages import START_NS, drive, shared

from fgtrack.core.errors import DataError
from fgtrack.core.types import DetectionList, EgoState
from fgtrack.inputs.info import describe
from fgtrack.inputs.ros.bag_writer import write_bag
from fgtrack.inputs.settings import InputConfig, TopicInput
from fgtrack.inputs.stream import write_stream


def by_name(info):
    return {topic.name: topic for topic in info.topics}


def test_a_recording_is_described_by_its_topics_with_rates_and_delays(tmp_path):
    write_bag(tmp_path / "bag", drive())
    info = describe(tmp_path / "bag")
    assert (info.kind, info.start_ns, info.problem) == ("recording", START_NS, None)
    assert info.duration_s == pytest.approx(0.49)
    topics = by_name(info)
    assert topics["/fgtrack/ego"].rate_hz == pytest.approx(100.0)
    assert topics["/fgtrack/ego"].used_as == "messages"
    assert topics["/detections/lidar"].delay["p50_s"] == pytest.approx(0.06)
    assert topics["/detections/lidar"].used_as is None
    assert topics["/detections/lidar"].note is None


def test_a_configuration_says_which_topic_is_which_sensor(tmp_path):
    write_bag(tmp_path / "bag", drive())
    config = InputConfig(
        TopicInput("/ego/odometry"), {"front": TopicInput("/detections/lidar")}
    )
    info = describe(tmp_path / "bag", config)
    used = {
        name: topic.used_as for name, topic in by_name(info).items() if topic.used_as
    }
    assert used == {"/ego/odometry": "ego", "/detections/lidar": "detections front"}
    info = describe(
        tmp_path / "bag",
        InputConfig(TopicInput("/ego/odometry"), {"x": TopicInput("/nothing")}),
    )
    assert "no topic /nothing" in info.problem


def test_a_stream_is_described_by_its_sensors_up_to_the_break(tmp_path):
    write_stream(tmp_path / "a.jsonl", drive())
    (tmp_path / "a.jsonl").write_bytes((tmp_path / "a.jsonl").read_bytes()[:-5])
    info = describe(tmp_path / "a.jsonl")
    assert info.kind == "stream"
    assert "breaks off" in info.problem
    topics = by_name(info)
    assert topics["radar"].count == 10
    assert topics["radar"].used_as == "detections radar"
    assert topics["ego"].delay["max_s"] == 0.0


def test_times_in_another_unit_are_a_problem(tmp_path):
    seconds = [
        EgoState(1_700_000_000 + k // 100, 1_700_000_000 + k // 100, k, 0.0, 0.0, 1.0)
        for k in range(900)
    ]
    write_stream(tmp_path / "s.jsonl", seconds)
    problem = describe(tmp_path / "s.jsonl").problem
    assert problem.startswith(
        "900 times within 8e-09 s, which no sensor sends: they are not in ns, but probably in s"
    )
    clocks = [
        EgoState(0, 0, 0.0, 0.0, 0.0, 0.0),
        DetectionList("radar", START_NS, START_NS, ()),
    ]
    write_stream(tmp_path / "clocks.jsonl", clocks)
    assert (
        "years long: its times have several units or clocks"
        in describe(tmp_path / "clocks.jsonl").problem
    )


def test_every_shared_recording_is_described_or_refused_in_one_line():
    root = shared("data/bags")
    paths = [
        *root.rglob("*.mcap"),
        *root.rglob("*.db3"),
        *(file.parent for file in root.rglob("metadata.yaml")),
    ]
    assert len(paths) > 30
    refused = []
    for path in paths:
        try:
            info = describe(path)
        except DataError as error:
            refused.append(str(error))
            continue
        assert info.problem is None
        assert info.topics
        for topic in info.topics:
            assert topic.count >= 0
            assert topic.note is None or "\n" not in topic.note
    assert refused
    assert all("wrong_format" in line and "\n" not in line for line in refused)


def test_stamps_of_another_clock_are_pointed_out():
    topic = by_name(describe(shared("data/bags/nav2_turtlebot.mcap")))["/odom"]
    assert topic.count == 2639
    assert "different clocks" in topic.note
