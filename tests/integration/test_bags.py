import math
import sqlite3
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer as McapWriter
from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore
from support.messages import START_NS, drive, exact, message_lists, shared

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.types import Detection, DetectionList, EgoState, TruthState
from fgtrack.inputs.errors import TruncatedInput, UntilBreak
from fgtrack.inputs.formats.native import DETECTIONS, NATIVE_ADAPTERS, TRUTH
from fgtrack.inputs.ros.bag import Bag
from fgtrack.inputs.ros.bag_writer import write_bag
from fgtrack.inputs.ros.definitions import DEFINITIONS
from fgtrack.inputs.ros.messages import MessageFactory
from fgtrack.inputs.ros.own_messages import own_message
from fgtrack.inputs.ros.typestore import MessageTypes
from fgtrack.inputs.settings import Filter, InputConfig, TopicInput
from fgtrack.inputs.source import open_input
from fgtrack.inputs.validation import validated_message

STORAGES = ("mcap", "sqlite3")


def storage_file(bag: Path) -> Path:
    return next(file for file in bag.iterdir() if file.suffix in (".mcap", ".db3"))


def read(path: Path, config: InputConfig | None = None) -> list:
    return list(open_input(path, config).messages())


# --- what fgtrack writes


@given(messages=message_lists(), storage=st.sampled_from(STORAGES))
def test_every_field_survives_the_bag_to_the_bit_and_in_order(
    tmp_path_factory, messages, storage
):
    path = tmp_path_factory.mktemp("bag") / "bag"
    assert write_bag(path, messages, storage) == len(messages)
    if messages:
        assert exact(read(path)) == exact(messages)
        bag = Bag(path)
        found = [
            NATIVE_ADAPTERS[topic.type](data, log_ns)
            for topic, log_ns, data in bag.messages(own(bag))
        ]
        assert exact(map(validated_message, found)) == exact(messages)


def own(bag: Bag) -> set[str]:
    return {topic.name for topic in bag.topics if topic.type in NATIVE_ADAPTERS}


def test_wrong_bytes_of_a_type_of_fgtrack_are_refused_and_another_layout_is_read():
    factory, text = MessageFactory(), DEFINITIONS[TRUTH]
    state = TruthState(7, 7, 1, 2.0, 3.0, speed_mps=4.0)
    message = factory.truth(state)
    whole = bytes(factory.serialize(message))
    assert (
        own_message(TRUTH, whole, 7) == own_message(TRUTH, whole + bytes(3), 7) == state
    )
    for data in (
        *(whole[:size] for size in range(4, len(whole))),
        whole + bytes(4),
        whole.replace(b"map\0", b"maps"),
    ):
        with pytest.raises((ValueError, struct.error)):
            own_message(TRUTH, data, 7)
    empty = DetectionList("x", 7, 7, [Detection(covariance=())])
    assert (
        own_message(DETECTIONS, bytes(factory.serialize(factory.detections(empty))), 7)
        == empty
    )
    older = typestore_with(
        text.replace("bool ignored\n", "").replace("float64[] outline_m\n", "")
    )
    del message.ignored, message.outline_m
    data = bytes(older.serialize_cdr(older.types[TRUTH](**vars(message)), TRUTH))
    key = (
        TRUTH,
        MessageDefinition(
            MessageDefinitionFormat.MSG, older.generate_msgdef(TRUTH, ros_version=2)[0]
        ),
    )
    assert (
        NATIVE_ADAPTERS[TRUTH](MessageTypes([key], False).decode(key, data, "", 7), 7)
        == state
    )


def typestore_with(text: str) -> Typestore:
    """Types of ROS 2 and truth of another definition."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(text, TRUTH))
    return store


def test_two_copies_of_one_file_in_a_folder_are_refused(tmp_path):
    write_bag(tmp_path / "bag", drive())
    content = storage_file(tmp_path / "bag").read_bytes()
    (tmp_path / "bag" / "metadata.yaml").unlink()
    (tmp_path / "bag" / "copy.mcap").write_bytes(content)
    with pytest.raises(
        DataError, match="have the same content: remove one, or give one of the files"
    ):
        read(tmp_path / "bag")


@pytest.mark.parametrize(
    "covariance",
    [(), (1.0,), (1.0, 0.0, 0.0), (0.1,) * 9, (float("nan"), 0.0, 0.0, 1.0)],
)
def test_a_covariance_that_is_none_is_written_as_it_is(tmp_path, covariance):
    """The tracker counts such a detection as invalid, from a bag as from a stream."""
    items = (
        Detection(x_m=20.0, y_m=1.0, covariance=covariance),
        Detection(x_m=40.0, y_m=1.0),
    )
    messages = [DetectionList("radar", 1_000, 2_000, items, "map")]
    write_bag(tmp_path / "bag", messages)
    [found] = read(tmp_path / "bag")
    assert exact([found]) == exact(messages)


def test_a_stamp_that_ros_cannot_hold_is_one_line(tmp_path):
    with pytest.raises(DataError, match="1901 to 2038"):
        write_bag(tmp_path / "bag", [EgoState(1 << 62, 0, 0.0, 0.0, 0.0, 0.0)])


def test_the_twin_of_the_ego_says_how_sure_it_is(tmp_path):
    root = np.tril(np.arange(1.0, 26.0).reshape(5, 5) / 10.0)
    covariance = root @ root.T
    covariance[:3, 3:] = covariance[3:, :3] = 0.0  # odometry holds pose and twist apart
    state = EgoState(
        START_NS,
        START_NS,
        1.0,
        2.0,
        0.5,
        20.0,
        0.1,
        covariance=tuple(covariance.ravel().tolist()),
    )
    write_bag(tmp_path / "bag", [state])
    [found] = read(tmp_path / "bag", InputConfig(ego=TopicInput("/ego/odometry")))
    np.testing.assert_allclose(np.reshape(found.covariance, (5, 5)), covariance)
    assert read(tmp_path / "bag") == [state]


def test_the_twins_say_what_other_tools_can_show(tmp_path):
    write_bag(tmp_path / "bag", drive())
    types = {topic.name: topic.type for topic in Bag(tmp_path / "bag").topics}
    assert types["/ego/odometry"] == "nav_msgs/msg/Odometry"
    assert types["/detections/lidar"] == "vision_msgs/msg/Detection3DArray"
    config = InputConfig(
        ego=TopicInput("/ego/odometry"),
        detections={
            "lidar": TopicInput("/detections/lidar"),
            "radar": TopicInput("/detections/radar"),
        },
    )
    found = read(tmp_path / "bag", config)
    lists = [message for message in drive() if isinstance(message, DetectionList)]
    read_lists = [message for message in found if isinstance(message, DetectionList)]
    assert [
        (m.sensor, m.stamp_ns, m.receipt_ns, len(m.objects)) for m in read_lists
    ] == [(m.sensor, m.stamp_ns, m.receipt_ns, len(m.objects)) for m in lists]
    for mine, theirs in zip(lists, read_lists, strict=True):
        for a, b in zip(mine.objects, theirs.objects, strict=True):
            assert (a.x_m, a.y_m, a.object_id) == (b.x_m, b.y_m, b.object_id)
            assert b.speed_mps is None
            assert b.yaw_rad == (
                None if a.yaw_rad is None else pytest.approx(a.yaw_rad, abs=1e-15)
            )
    ego = next(message for message in found if isinstance(message, EgoState))
    assert ego == EgoState(START_NS, START_NS, 0.0, 0.0, pytest.approx(0.25), 50.0, 0.1)


# --- what breaks off


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("kept", [0.5, 0.9, 0.999])
def test_a_truncated_recording_gives_all_before_the_break_and_then_says_so(
    tmp_path, storage, kept
):
    messages = drive(1500)
    write_bag(tmp_path / "bag", messages, storage)
    file = storage_file(tmp_path / "bag")
    data = file.read_bytes()
    file.write_bytes(data[: int(len(data) * kept)])
    for path in (tmp_path / "bag", file):
        readable = UntilBreak(open_input(path).messages())
        found = list(readable)
        with pytest.raises(
            TruncatedInput, match=f"after {len(found)} messages"
        ) as caught:
            readable.raise_error()
        assert "\n" not in str(caught.value)
        assert found == messages[: len(found)]
        assert len(found) > (kept - 0.3) * len(messages)


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("kept", [0, 3, 20, 100, 700])
def test_hardly_any_recording_is_one_line(tmp_path, storage, kept):
    write_bag(tmp_path / "bag", drive(), storage)
    file = storage_file(tmp_path / "bag")
    file.write_bytes(file.read_bytes()[:kept])
    for path in (tmp_path / "bag", file):
        with pytest.raises(DataError) as caught:
            read(path)
        assert "\n" not in str(caught.value)


def test_a_sqlite_recording_with_a_write_ahead_log_is_read_whole_and_left_alone(
    tmp_path,
):
    write_bag(tmp_path / "bag", drive(), "sqlite3")
    file = storage_file(tmp_path / "bag")
    (tmp_path / "bag/metadata.yaml").unlink()
    connection = sqlite3.connect(file)
    connection.execute("PRAGMA journal_mode=WAL")
    connection.execute("PRAGMA wal_autocheckpoint=0")
    connection.execute("UPDATE messages SET timestamp = timestamp + 1")
    connection.commit()
    before = file.read_bytes()
    readable = UntilBreak(open_input(file).messages())
    found = list(readable)
    assert [m.receipt_ns for m in found] == [m.receipt_ns + 1 for m in drive()]
    assert readable.error is not None
    assert "not closed" in str(readable.error)
    assert file.read_bytes() == before
    connection.close()


# --- foreign recordings


@pytest.fixture(scope="module")
def humble():
    return get_typestore(Stores.ROS2_HUMBLE)


def make_odometry(store, stamp_ns, ros1=False):
    message = MessageFactory().odometry(
        EgoState(stamp_ns, 9, 1.0, 2.0, 0.5 * math.pi, -3.0, 0.5)
    )
    if ros1:
        header = message.header
        message.header = store.types["std_msgs/msg/Header"](
            seq=4, stamp=header.stamp, frame_id=header.frame_id
        )
    return message


ODOMETRY_STATE = EgoState(5, 9, 1.0, 2.0, pytest.approx(1.5707963267948966), -3.0, 0.5)


@pytest.mark.parametrize(
    ("plugin", "mode"),
    [(StoragePlugin.MCAP, mode) for mode in CompressionMode]
    + [
        (StoragePlugin.SQLITE3, mode)
        for mode in CompressionMode
        if mode != CompressionMode.STORAGE
    ],
)
def test_compressed_recordings_are_read(tmp_path, humble, plugin, mode):
    writer = Writer(tmp_path / "bag", version=9, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection(
            "/odom", "nav_msgs/msg/Odometry", typestore=humble
        )
        data = humble.serialize_cdr(make_odometry(humble, 5), "nav_msgs/msg/Odometry")
        writer.write(connection, 9, bytes(data))
    assert read(tmp_path / "bag", InputConfig(ego=TopicInput("/odom"))) == [
        ODOMETRY_STATE
    ]


def test_a_ros1_bag_is_read(tmp_path):
    store = get_typestore(Stores.ROS1_NOETIC)
    with Rosbag1Writer(tmp_path / "a.bag") as writer:
        connection = writer.add_connection(
            "/odom", "nav_msgs/msg/Odometry", typestore=store
        )
        data = store.serialize_ros1(
            make_odometry(store, 5, ros1=True), "nav_msgs/msg/Odometry"
        )
        writer.write(connection, 9, bytes(data))
    assert read(tmp_path / "a.bag", InputConfig(ego=TopicInput("/odom"))) == [
        ODOMETRY_STATE
    ]


def test_what_follows_the_end_of_a_recording_is_a_break(tmp_path):
    write_bag(tmp_path / "bag", drive(), "mcap")
    whole, path = storage_file(tmp_path / "bag").read_bytes(), tmp_path / "x.mcap"
    path.write_bytes(whole)
    expected = [log_ns for _, log_ns, _ in Bag(path).messages(["/fgtrack/ego"])]
    path.write_bytes(whole + b"x" * 1000)
    found = []
    with pytest.raises(
        TruncatedInput,
        match=f"has other data behind its end: split the file at byte {len(whole)}",
    ):
        found.extend(log_ns for _, log_ns, _ in Bag(path).messages(["/fgtrack/ego"]))
    assert found == expected


@pytest.mark.parametrize("compression", [None, *Rosbag1Writer.CompressionFormat])
def test_a_truncated_ros1_bag_gives_its_whole_chunks(tmp_path, compression):
    store = get_typestore(Stores.ROS1_NOETIC)
    path = tmp_path / "a.bag"
    writer = Rosbag1Writer(path)
    if compression:
        writer.set_compression(compression)
    writer.chunk_threshold = 2000
    with writer:
        connection = writer.add_connection(
            "/odom", "nav_msgs/msg/Odometry", typestore=store
        )
        for time_ns in range(20):
            data = store.serialize_ros1(
                make_odometry(store, 5, ros1=True), "nav_msgs/msg/Odometry"
            )
            writer.write(connection, time_ns, bytes(data))
    config = InputConfig(ego=TopicInput("/odom"))
    assert len(read(path, config)) == 20
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * 0.6)])
    readable = UntilBreak(open_input(path, config).messages())
    found = list(readable)
    assert readable.error is not None
    assert 5 < len(found) < 20
    assert [message.receipt_ns for message in found] == list(range(len(found)))


def test_an_empty_last_part_is_a_break_and_the_others_are_read(tmp_path):
    write_bag(tmp_path / "bag_0", drive())
    (tmp_path / "bag_0/metadata.yaml").unlink()
    (tmp_path / "bag_0/bag_1.mcap").touch()
    readable = UntilBreak(open_input(tmp_path / "bag_0").messages())
    assert list(readable) == drive()
    assert "is empty" in str(readable.error)


def test_messages_of_split_files_come_in_log_time_order(tmp_path, humble):
    for part, times in (("b_10", (2, 5)), ("b_2", (1, 5, 7))):
        with Writer(
            tmp_path / part, version=9, storage_plugin=StoragePlugin.MCAP
        ) as writer:
            connection = writer.add_connection(
                "/odom", "nav_msgs/msg/Odometry", typestore=humble
            )
            for time_ns in times:
                state = make_odometry(humble, 10 * len(part) + time_ns)
                writer.write(
                    connection,
                    time_ns,
                    bytes(humble.serialize_cdr(state, connection.msgtype)),
                )
    folder = tmp_path / "split"
    folder.mkdir()
    for part in ("b_10", "b_2"):
        (tmp_path / part / f"{part}.mcap").rename(folder / f"{part}.mcap")
    found = read(folder, InputConfig(ego=TopicInput("/odom")))
    assert [message.receipt_ns for message in found] == [1, 2, 5, 5, 7]
    assert [message.stamp_ns for message in found] == [31, 42, 45, 35, 37]


def test_a_file_without_chunks_is_read(tmp_path):
    write_bag(tmp_path / "bag", drive())
    with (
        storage_file(tmp_path / "bag").open("rb") as file,
        (tmp_path / "x.mcap").open("wb") as out,
    ):
        writer, channels = McapWriter(out, use_chunking=False), {}
        writer.start(profile="ros2")
        for schema, channel, message in make_reader(file).iter_messages():
            if channel.id not in channels:
                number = writer.register_schema(
                    schema.name, schema.encoding, schema.data
                )
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, number
                )
            writer.add_message(
                channels[channel.id],
                message.log_time,
                message.data,
                message.publish_time,
            )
        writer.finish()
    assert read(tmp_path / "x.mcap") == drive()


def test_an_unordered_mcap_file_is_read_in_log_time_order_with_and_without_its_end(
    tmp_path, humble
):
    with Writer(
        tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP
    ) as writer:
        connection = writer.add_connection(
            "/odom", "nav_msgs/msg/Odometry", typestore=humble
        )
        for number, time_ns in enumerate((7, 3, 9, 7, 8, 1)):
            if number == 3:
                writer.storage.close_chunk()
            data = humble.serialize_cdr(
                make_odometry(humble, number), connection.msgtype
            )
            writer.write(connection, time_ns, bytes(data))
    config, written = (
        InputConfig(ego=TopicInput("/odom")),
        [(1, 5), (3, 1), (7, 0), (7, 3), (8, 4), (9, 2)],
    )
    assert [
        (message.receipt_ns, message.stamp_ns)
        for message in read(tmp_path / "bag", config)
    ] == written
    file = storage_file(tmp_path / "bag")
    file.write_bytes(file.read_bytes()[:-10])
    found = list(UntilBreak(open_input(file, config).messages()))
    assert [(message.receipt_ns, message.stamp_ns) for message in found] == written


# --- the recordings of other people


def test_a_wrong_serialization_is_refused_in_one_line():
    with pytest.raises(DataError, match="wrong_format"):
        open_input(shared("data/bags/rosbag2_tests_resources/mcap/wrong_rmw_test"))


def test_a_needed_type_without_definition_is_one_line_and_a_given_one_is_read(tmp_path):
    path = shared("data/bags/rosbag2_py_resources/sqlite3/convert_a")
    defined = shared("data/bags/rosbag2_py_resources/mcap/convert_a")
    fields = {
        "x_m": "float64_value",
        "y_m": "float32_value",
        "object_id": "int32_value",
    }
    item = TopicInput("b_basictypes", fields=fields)
    with pytest.raises(
        DataError, match=r"test_msgs/msg/BasicTypes .* message_definitions"
    ):
        read(path, InputConfig(detections={"x": item}))
    definition = tmp_path / "test_msgs/msg/BasicTypes.msg"
    definition.parent.mkdir(parents=True)
    names = ["bool", "byte", "char", "float32", "float64"]
    names += [f"{sign}int{bits}" for bits in (8, 16, 32, 64) for sign in ("", "u")]
    definition.write_text("".join(f"{name} {name}_value\n" for name in names))
    for path_given in (definition, definition.parent):
        config = InputConfig(
            detections={"x": item}, message_definitions=(str(path_given),)
        )
        found = read(path, config)
        assert len(found) == 50
        assert found == read(defined, InputConfig(detections={"x": item}))
        assert found[3].stamp_ns == found[3].receipt_ns


# --- configurations


def test_a_topic_that_the_recording_lacks_is_named_with_what_there_is(tmp_path):
    write_bag(tmp_path / "bag", drive())
    config = InputConfig(
        ego=TopicInput("/ego/odometry"), detections={"lidar": TopicInput("/lidar")}
    )
    with pytest.raises(
        DataError, match=r"no topic /lidar; .* /detections/lidar \(vision_msgs"
    ):
        open_input(tmp_path / "bag", config)


def test_a_foreign_recording_without_a_configuration_is_one_line():
    with pytest.raises(DataError, match=r"name its topics .* /odom \(nav_msgs"):
        open_input(shared("data/bags/nav2_turtlebot.mcap"))


def test_a_topic_that_fgtrack_wrote_follows_the_keys_that_name_it(tmp_path):
    near, far = (
        Detection(x_m=5.0, y_m=0.0, score=0.9),
        Detection(x_m=9.0, y_m=0.0, score=0.2),
    )
    truth = TruthState(1, 2, 7, 1.0, 2.0)
    write_bag(tmp_path / "bag", [truth, DetectionList("lidar", 1, 2, (near, far))])
    item = TopicInput(
        "/fgtrack/detections/lidar", frame="map", filters={"score": Filter(min=0.5)}
    )
    config = InputConfig(detections={"front": item}, truth=TopicInput("/fgtrack/truth"))
    assert read(tmp_path / "bag", config) == [
        truth,
        DetectionList("front", 1, 2, (near,), "map"),
    ]
    with pytest.raises(
        CallError, match="objects of type fgtrack_msgs/msg/Truth need `fields`"
    ):
        read(
            tmp_path / "bag",
            InputConfig(detections={"front": TopicInput("/fgtrack/truth")}),
        )


@pytest.mark.parametrize(
    ("config", "complaint"),
    [
        (InputConfig(ego=TopicInput("/detections/lidar")), "needs `fields`"),
        (
            InputConfig(ego=TopicInput("/ego/odometry", fields={"x": "a"})),
            "unknown field 'x'",
        ),
        (
            InputConfig(ego=TopicInput("/ego/odometry", fields={"x_m": "a"})),
            "must contain y_m",
        ),
        (
            InputConfig(ego=TopicInput("/ego/odometry", scan_s=0.1)),
            "scan_s applies to detections only",
        ),
        (
            InputConfig(ego=TopicInput("/ego/odometry", frame="ego")),
            "frame applies to detections only",
        ),
        (
            InputConfig(
                detections={"lidar": TopicInput("/detections/lidar", object_id=1)}
            ),
            "object_id applies to truth",
        ),
    ],
)
def test_a_topic_that_does_not_fit_and_a_key_that_it_does_not_read_are_refused(
    tmp_path, config, complaint
):
    write_bag(tmp_path / "bag", drive())
    with pytest.raises(CallError, match=complaint):
        open_input(tmp_path / "bag", config)
