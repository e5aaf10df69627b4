"""Recordings as recorders and people leave them: split, compressed, renamed."""

import shutil

import pytest
import zstandard
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore
from support.tracking import ms

from fgtrack.core.errors import DataError
from fgtrack.core.types import EgoState
from fgtrack.inputs.info import describe
from fgtrack.inputs.recording import write_recording
from fgtrack.inputs.settings import InputConfig, TopicInput
from fgtrack.inputs.source import input_kind, open_input

START_NS = 1_700_000_000 * 10**9


def egos(first=0, count=20):
    return [
        EgoState(t, t + ms(2.0), x_m=float(k), y_m=0.0, yaw_rad=0.0, speed_mps=10.0)
        for k in range(first, first + count)
        for t in [START_NS + ms(100.0 * k)]
    ]


def bag(folder, storage="mcap"):
    """Folder of a recording, with its only file of messages."""
    write_recording(folder, egos(), storage)
    (file,) = [each for each in folder.iterdir() if each.suffix != ".yaml"]
    return file


def ros1_bag(file, first, count=10):
    store = get_typestore(Stores.ROS1_NOETIC)
    kind = "geometry_msgs/msg/PointStamped"
    with Writer(file) as writer:
        connection = writer.add_connection("/point", kind, typestore=store)
        for k in range(first, first + count):
            t = START_NS + ms(100.0 * k)
            message = store.types[kind](
                header=store.types["std_msgs/msg/Header"](
                    seq=k,
                    stamp=store.types["builtin_interfaces/msg/Time"](
                        sec=t // 10**9, nanosec=t % 10**9
                    ),
                    frame_id="map",
                ),
                point=store.types["geometry_msgs/msg/Point"](x=float(k), y=0.0, z=0.0),
            )
            writer.write(connection, t, store.serialize_ros1(message, kind))


POINTS = InputConfig(
    detections={
        "points": TopicInput("/point", fields={"x_m": "point.x", "y_m": "point.y"})
    }
)


def test_the_parts_of_a_split_ros1_bag_are_one_recording(tmp_path):
    for k in (2, 0, 1):
        ros1_bag(tmp_path / f"drive_{k}.bag", 10 * k)
    lists = list(open_input(tmp_path, POINTS).messages())
    assert [each.objects[0].x_m for each in lists] == list(range(30))
    assert [topic.count for topic in describe(tmp_path).topics] == [30]


def test_a_bag_that_its_recorder_did_not_close_is_a_part_too(tmp_path):
    ros1_bag(tmp_path / "drive_0.bag", 0)
    ros1_bag(tmp_path / "drive_1.bag", 10)
    (tmp_path / "drive_1.bag").rename(tmp_path / "drive_1.bag.active")
    assert len(list(open_input(tmp_path, POINTS).messages())) == 20


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("ending", [".zstd", ".zst"])
@pytest.mark.parametrize("as_folder", [True, False])
def test_a_zstd_file_needs_no_metadata(tmp_path, storage, ending, as_folder):
    file = bag(tmp_path / "drive", storage)
    packed = tmp_path / "packed" / (file.name + ending)
    packed.parent.mkdir()
    packed.write_bytes(zstandard.ZstdCompressor().compress(file.read_bytes()))
    path = packed.parent if as_folder else packed
    assert input_kind(path) == "recording"
    assert list(open_input(path).messages()) == egos()


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_renamed_file_beside_its_metadata_is_read(tmp_path, storage):
    file = bag(tmp_path / "drive", storage)
    file.rename(file.with_stem("monday"))
    assert list(open_input(tmp_path / "drive").messages()) == egos()


def test_a_file_without_metadata_in_a_renamed_folder_is_read(tmp_path):
    file = bag(tmp_path / "drive")
    (file.parent / "metadata.yaml").unlink()
    shutil.move(file.parent, tmp_path / "other")
    assert list(open_input(tmp_path / "other").messages()) == egos()


def test_a_missing_file_beside_metadata_is_one_line(tmp_path):
    file = bag(tmp_path / "drive")
    name = file.name
    file.unlink()
    with pytest.raises(DataError, match=name):
        list(open_input(tmp_path / "drive").messages())


def test_bags_of_ros1_and_ros2_are_not_one_recording(tmp_path):
    file = bag(tmp_path / "drive")
    (file.parent / "metadata.yaml").unlink()
    ros1_bag(file.with_suffix(".bag"), 0)
    with pytest.raises(DataError, match="bags of ROS 1 and of ROS 2, give one"):
        open_input(tmp_path / "drive", POINTS)
