"""Inputs are recognised by their content, those of plug-ins too."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.types import Detection, DetectionList, EgoState
from fgtrack.inputs.formats import ADAPTERS
from fgtrack.inputs.settings import InputConfig, TopicInput
from fgtrack.inputs.source import open_input
from fgtrack.inputs.stream import write_stream

POINT = "geometry_msgs/msg/PointStamped"
PLUGIN = """
from fgtrack.core.types import Detection, EgoState
from fgtrack.inputs.formats.common import object_list
from fgtrack.inputs.source import FileFormat

def read_point(message):
    return object_list(message.header, [Detection(x_m=message.point.x, y_m=message.point.y)])

def numbers():
    def messages(path, config):
        return lambda: (EgoState(int(n), int(n), 0.0, 0.0, 0.0, 0.0) for n in path.read_text().split()[1:])
    return FileFormat("numbers", lambda path: path.is_file() and path.read_bytes().startswith(b"{numbers}"), messages)

def raises(*_):
    raise KeyError("oh")

stuck = FileFormat("stuck", lambda path: path.is_file() and path.read_bytes().startswith(b"{stuck}"), raises)
"""


@pytest.fixture
def plugin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An installed package with a message type, a format, and an entry that is neither."""
    assert "numbers" not in ADAPTERS
    monkeypatch.delitem(ADAPTERS.__dict__, "_entries")
    folder = tmp_path / "site"
    info = folder / "numbers-1.0.dist-info"
    info.mkdir(parents=True)
    (folder / "numbers_plugin.py").write_text(PLUGIN)
    (info / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: numbers\nVersion: 1.0\n"
    )
    entries = f"{POINT} = numbers_plugin:read_point\nnumbers = numbers_plugin:numbers\nstuck = numbers_plugin:stuck\n"
    (info / "entry_points.txt").write_text(f"[fgtrack.adapters]\n{entries}")
    monkeypatch.syspath_prepend(folder)


@pytest.mark.usefixtures("plugin")
def test_a_format_of_a_plug_in_is_recognised_before_the_built_in_ones(
    tmp_path: Path,
) -> None:
    (tmp_path / "x").write_text("{numbers} 1 5")
    source = open_input(tmp_path / "x")
    assert source.kind == "numbers"
    assert [list(source.messages()) for _ in range(2)] == [
        [EgoState(n, n, 0.0, 0.0, 0.0, 0.0) for n in (1, 5)]
    ] * 2
    write_stream(tmp_path / "y", [])
    assert open_input(tmp_path / "y").kind == "stream"
    (tmp_path / "z").write_text("text")
    with pytest.raises(
        DataError, match=r"FusionTracking log folder \(data_logs\.csv\), .*, numbers"
    ):
        open_input(tmp_path / "z")


@pytest.mark.usefixtures("plugin")
def test_a_format_that_fails_is_named(tmp_path: Path) -> None:
    (tmp_path / "x").write_text("{stuck}")
    with pytest.raises(
        CallError,
        match=r"plug-in numbers_plugin:stuck of numbers 1\.0 cannot open .*x \(KeyError",
    ):
        open_input(tmp_path / "x")


@pytest.mark.usefixtures("plugin")
def test_a_message_type_of_a_plug_in_is_read_like_a_built_in_one(
    tmp_path: Path,
) -> None:
    assert POINT in ADAPTERS
    store = get_typestore(Stores.ROS2_HUMBLE)
    header = store.types["std_msgs/msg/Header"](
        store.types["builtin_interfaces/msg/Time"](1, 2), "map"
    )
    point = store.types[POINT](
        header, store.types["geometry_msgs/msg/Point"](3.0, 4.0, 0.0)
    )
    with Writer(tmp_path / "bag", version=9) as bag:
        connection = bag.add_connection("/cone", POINT, typestore=store)
        bag.write(connection, 2_000_000_000, store.serialize_cdr(point, POINT))
    config = InputConfig(detections={"cones": TopicInput("/cone")})
    cone = DetectionList(
        "cones", 1_000_000_002, 2_000_000_000, (Detection(x_m=3.0, y_m=4.0),), "map"
    )
    assert list(open_input(tmp_path / "bag", config).messages()) == [cone]


@pytest.mark.parametrize(
    "make",
    [os.mkfifo, lambda path: path.symlink_to("/dev/null")],
    ids=["pipe", "device"],
)
def test_a_pipe_or_device_is_refused_at_once(
    tmp_path: Path, make: Callable[[Path], None]
) -> None:
    make(tmp_path / "x.jsonl")
    with pytest.raises(
        DataError, match=r"x\.jsonl: exists, but is neither a file nor a folder"
    ):
        open_input(tmp_path / "x.jsonl")
