"""Opens an input, whatever it is: a recording, a stream or a data set, recognised by its content."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.types import Frame, Message
from fgtrack.io.adapters.autoferry import detections_file, read_scenario
from fgtrack.io.adapters.fusiontracking import LOG_NAME, read_log
from fgtrack.io.config import InputConfig
from fgtrack.io.ros.bag import Bag, is_bag_file, is_bag_folder
from fgtrack.io.ros.topics import TopicUse, bag_messages, topic_uses
from fgtrack.io.stream import GZIP_MAGIC, read_stream

Kind = Literal["recording", "stream", "autoferry", "fusiontracking"]

_KNOWN = (
    "a rosbag2 folder, an .mcap, .db3 or ROS 1 .bag file, an fgtrack stream (.jsonl, .jsonl.gz), "
    f"an Autoferry scenario folder (*_detections.json), a FusionTracking log folder ({LOG_NAME})"
)


@dataclass(frozen=True)
class InputSource:
    """An input that can be read any number of times."""

    path: Path
    kind: Kind
    messages: Callable[[], Iterator[Message]]
    """Gives the messages in receipt order.

    Raises `TruncatedInput` behind the last message before a break, `DataError` for all else that is wrong.
    """
    topics: tuple[TopicUse, ...] = ()
    """Of a recording: the topics that are read, and as what."""


def open_input(path: Path | str, config: InputConfig | None = None) -> InputSource:
    """Open the input at `path`.

    Raises
    ------
    CallError
        Nothing is there, or the configuration does not fit.
    DataError
        It is nothing that fgtrack reads, or damaged.
    """
    path = Path(path)
    config = config or InputConfig()
    match kind := input_kind(path):
        case "recording":
            bag = Bag(path, config.message_definitions)
            uses = topic_uses(bag, config)
            return InputSource(path, kind, lambda: bag_messages(bag, uses), uses)
        case "stream":
            return InputSource(path, kind, lambda: read_stream(path))
        case "autoferry":
            return InputSource(path, kind, lambda: read_scenario(path))
        case "fusiontracking":
            frames: dict[str, Frame] = {sensor: item.frame for sensor, item in config.detections.items() if item.frame}
            return InputSource(path, kind, lambda: read_log(path, frames))


def input_kind(path: Path) -> Kind:
    """What `path` is, by its content; raises as `open_input`."""
    if not path.exists():
        raise CallError(f"{path}: there is no such file or folder")
    try:
        if path.is_dir():
            return _folder_kind(path)
        if path.name == LOG_NAME or detections_file(path.parent) == path:
            raise CallError(f"{path}: is part of a data set, name its folder {path.parent}")
        with path.open("rb") as file:
            start = file.read(64)
        if is_bag_file(path):
            return "recording"
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error
    if not start:
        raise DataError(f"{path}: is empty")
    if start.startswith(GZIP_MAGIC) or start.lstrip().startswith(b"{"):
        return "stream"
    raise DataError(f"{path}: is none of the inputs that fgtrack reads: {_KNOWN}")


def _folder_kind(path: Path) -> Kind:
    if is_bag_folder(path):
        return "recording"
    if detections_file(path):
        return "autoferry"
    if (path / LOG_NAME).is_file():
        return "fusiontracking"
    raise DataError(f"{path}: is none of the inputs that fgtrack reads: {_KNOWN}")
