import pytest
from mcap.writer import Writer as McapWriter
from support.messages import START_NS, drive, shared

from fgtrack.core.errors import DataError
from fgtrack.io.config import InputConfig, TopicInput
from fgtrack.io.info import describe
from fgtrack.io.ros.bag_writer import write_bag
from fgtrack.io.stream import write_stream


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
    assert topics["/detections/lidar"].delay.p50_s == pytest.approx(0.06)
    assert topics["/detections/lidar"].used_as is None
    assert "detections" in topics["/detections/lidar"].note


def test_a_configuration_says_which_topic_is_which_sensor(tmp_path):
    write_bag(tmp_path / "bag", drive())
    config = InputConfig(TopicInput("/ego/odometry"), {"front": TopicInput("/detections/lidar")})
    info = describe(tmp_path / "bag", config)
    used = {name: topic.used_as for name, topic in by_name(info).items() if topic.used_as}
    assert used == {"/ego/odometry": "ego", "/detections/lidar": "detections front"}
    info = describe(tmp_path / "bag", InputConfig(TopicInput("/ego/odometry"), {"x": TopicInput("/nothing")}))
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
    assert topics["ego"].delay.max_s == 0.0


def test_every_shared_recording_is_described_or_refused_in_one_line():
    root = shared("data/bags")
    paths = [*root.rglob("*.mcap"), *root.rglob("*.db3"), *(file.parent for file in root.rglob("metadata.yaml"))]
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


def test_a_type_without_definition_is_listed_with_the_reason():
    topics = by_name(describe(shared("data/bags/rosbag2_py_resources/sqlite3/convert_a")))
    assert topics["b_basictypes"].count == 50
    assert "test_msgs/msg/BasicTypes" in topics["b_basictypes"].note


def test_stamps_of_another_clock_are_pointed_out():
    topic = by_name(describe(shared("data/bags/nav2_turtlebot.mcap")))["/odom"]
    assert topic.count == 2639
    assert "another clock" in topic.note


def test_a_channel_without_a_type_is_listed_with_its_problem(tmp_path):
    """As MCAP allows it, for JSON or bytes."""
    with (tmp_path / "x.mcap").open("wb") as file:
        writer = McapWriter(file)
        writer.start(profile="ros2", library="")
        channel = writer.register_channel("/plain", "cdr", 0)
        writer.add_message(channel, 5, b"\0\1\0\0", 5)
        writer.finish()
    (topic,) = describe(tmp_path / "x.mcap", InputConfig()).topics
    assert topic.name == "/plain"
    assert "a type without a name is neither in the recording nor known" in topic.note
