"""Opens an input, whatever it is: a recording, a stream or a data set, recognised by its content."""

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.types import Message
from fgtrack.io.adapters import ADAPTERS
from fgtrack.io.config import InputConfig
from fgtrack.io.gate import checked

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class InputSource:
    """An input that can be read any number of times."""

    path: Path
    kind: str
    """Name of its format."""
    messages: Callable[[], Iterator[Message]]
    """Gives the messages in receipt order, as `fgtrack.io.gate` lets them pass.

    Raises `TruncatedInput` behind the last message before a break, `DataError` for all else that is wrong.
    """


@dataclass(frozen=True)
class FileFormat:
    """A format of inputs: a file or a folder with messages in receipt order."""

    description: str
    """What such an input is, for messages: `an fgtrack stream (.jsonl)`."""
    recognises: Callable[[Path], bool]
    """Whether an existing file that is not empty, or a folder, is one, by its content; may raise `OSError`."""
    open: Callable[[Path, InputConfig], Callable[[], Iterator[Message]]]
    """Opens the input at a path: gives what `InputSource.messages` is, and raises as `open_input`."""


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
    name = input_kind(path)
    config = config or InputConfig()
    messages = file_format(name).open(path, config)
    return InputSource(path, name, partial(checked, path, messages, config.most_objects))


def input_kind(path: Path) -> str:
    """Name of the format of `path`, by its content; raises as `open_input`. Plug-ins are asked first."""
    if not path.exists():
        raise CallError(f"{path}: there is no such file or folder")
    formats = _formats()
    try:
        if not path.is_file() and not path.is_dir():
            raise DataError(f"{path}: is neither a file nor a folder, write what comes out of it to a file first")
        if path.is_file() and path.stat().st_size == 0:
            raise DataError(f"{path}: is empty")
        for name, form in formats.items():
            if form.recognises(path):
                return name
        for form in formats.values():
            if not path.is_dir() and form.recognises(path.parent):
                raise DataError(f"{path}: is no input by itself, name its folder {path.parent} ({form.description})")
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error
    known = ", ".join(form.description for form in reversed(formats.values()))
    raise DataError(f"{path}: is none of the inputs that fgtrack reads: {known}")


def file_format(name: str) -> FileFormat:
    """The format `name`. Raises `CallError` where there is none."""
    found = ADAPTERS.load(name)
    if not isinstance(found, FileFormat) and callable(found):
        found = found()
    if not isinstance(found, FileFormat):
        raise CallError(f"adapter {name!r}: is a {type(found).__name__}, not a FileFormat")
    return found


def _formats() -> dict[str, FileFormat]:
    """All formats by name, the last registered first: the built-in ones recognise the loosest last."""
    formats = {}
    for name in reversed([name for name in ADAPTERS if "/" not in name]):
        try:
            formats[name] = file_format(name)
        except CallError as error:
            _logger.warning("%s", error)
    return formats
