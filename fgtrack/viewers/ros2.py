"""Writes what shows a run as a rosbag2 recording of standard messages, for RViz and whatever reads ROS."""

import mmap
import re
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

from rosbags.interfaces import Connection, Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from fgtrack.core.errors import DataError, FgtrackError
from fgtrack.core.files import read_head
from fgtrack.io.adapters.common import RosMessage
from fgtrack.io.output import Kind, check_output, new_file, new_folder, write_error
from fgtrack.io.ros.bag_files import METADATA
from fgtrack.io.ros.bag_writer import RECORDING
from fgtrack.io.ros.mcap_file import MCAP_MAGIC
from fgtrack.io.ros.typestore import one_line
from fgtrack.viewers.ros2_messages import ViewerMessageFactory
from fgtrack.viewers.shapes import EgoMotion, Facts, Objects, Scene, ViewerMessage

_INT64_LIMIT = 1 << 63
_MARK = ("made_by", "fgtrack export")  # stands in the metadata of the recording, which its file repeats
_MARKED = rb"^ *custom_data:\n +%b: %b$" % (_MARK[0].encode(), _MARK[1].encode())
_MARKED_FOLDER = re.compile(_MARKED, re.MULTILINE)
_MARKED_FILE = re.compile(
    rb"\x07\0\0\0rosbag2.{4}\x13\0\0\0serialized_metadata.{4}[^\0]{0,500}?" + _MARKED, re.DOTALL | re.MULTILINE
)
_FOREVER = QosTime(0, 0)


def _reliable(durability: QosDurability) -> Qos:
    return Qos(
        QosHistory.KEEP_LAST,
        10,
        QosReliability.RELIABLE,
        durability,
        _FOREVER,
        _FOREVER,
        QosLiveliness.SYSTEM_DEFAULT,
        _FOREVER,
        False,
    )


def _is_export_folder(path: Path) -> bool:
    return RECORDING.recognises(path) and bool(_MARKED_FOLDER.search((path / METADATA).read_bytes()))


def _is_export_file(path: Path) -> bool:
    if read_head(path, len(MCAP_MAGIC)) != MCAP_MAGIC:
        return False
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        return _MARKED_FILE.search(content) is not None


_FOLDER = Kind("a rosbag2 folder of `fgtrack export`", _is_export_folder)
_FILE = Kind("an MCAP file of `fgtrack export --ros2`", _is_export_file)


def check_viewer_bag(path: Path, overwrite: bool) -> None:
    """Raise `CallError` where `write_viewer_bag` would for what is at `path`."""
    check_output(path, _FILE if path.suffix == ".mcap" else _FOLDER, overwrite)


def write_viewer_bag(path: Path, messages: Iterable[ViewerMessage], *, overwrite: bool = False) -> dict[str, int]:
    """Write `messages`, in the order of their log times, as a rosbag2 recording; gives their number by topic.

    `path` becomes a rosbag2 folder, or its MCAP file alone where the name ends in `.mcap`. It appears when it is
    complete. Facts have no standard message and are left out. Raises as `write_bag`.
    """
    check_viewer_bag(path, overwrite)
    try:
        if path.suffix != ".mcap":
            with new_folder(path, _FOLDER, overwrite) as folder:
                return _write(folder, messages)
        with (
            new_file(path, _FILE, overwrite) as file,
            tempfile.TemporaryDirectory(".part", f"{path.name}.", path.parent) as place,
        ):
            folder = Path(place) / path.stem
            counts = _write(folder, messages)
            with (folder / f"{folder.name}.mcap").open("rb") as written:
                shutil.copyfileobj(written, file)
            return counts
    except FgtrackError:
        raise
    except OSError as error:
        raise write_error(path, error) from error
    except Exception as error:  # rosbags lets struct errors and its own through
        raise DataError(f"{path}: cannot be written ({one_line(error)})") from error


def _write(folder: Path, messages: Iterable[ViewerMessage]) -> dict[str, int]:
    factory = ViewerMessageFactory()
    connections: dict[str, Connection] = {}
    counts: Counter[str] = Counter()
    bag = Writer(folder, version=Writer.VERSION_LATEST, storage_plugin=StoragePlugin.MCAP)
    bag.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    bag.set_custom_data(*_MARK)
    with bag:
        for message in messages:
            if not 0 <= message.log_ns < _INT64_LIMIT:
                raise DataError(f"the time {message.log_ns} ns lies outside what a recording holds")
            for topic, made in _ros_messages(factory, message):
                if topic not in connections:
                    durability = _durability(message)
                    connections[topic] = bag.add_connection(
                        topic,
                        made.__msgtype__,
                        typestore=factory.typestore,
                        offered_qos_profiles=[_reliable(durability)],
                    )
                bag.write(connections[topic], message.log_ns, factory.serialize(made))
                counts[topic] += 1
    return dict(counts)


def _durability(message: ViewerMessage) -> QosDurability:
    lasting = isinstance(message, Scene) and message.lasting
    return QosDurability.TRANSIENT_LOCAL if lasting else QosDurability.VOLATILE


def _ros_messages(factory: ViewerMessageFactory, message: ViewerMessage) -> Iterator[tuple[str, RosMessage]]:
    """Topics, and the messages on them that show `message`."""
    match message:
        case Scene():
            yield f"{message.topic}/markers", factory.marker_array(message)
        case Objects():
            yield message.topic, factory.detection3d_array(message.objects)
        case EgoMotion():
            yield "/tf", factory.transforms(message.ego)
            yield "/ego/odometry", factory.odometry(message.ego)
        case Facts():
            return
