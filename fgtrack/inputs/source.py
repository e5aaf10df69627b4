"""Opens an input, whatever it is: a recording, a stream or a data set, recognised by its content."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from fgtrack.core.checks import check_paths
from fgtrack.core.errors import CallError, DataError
from fgtrack.core.types import Message
from fgtrack.inputs.formats import ADAPTERS
from fgtrack.inputs.settings import InputConfig
from fgtrack.inputs.validation import validated


@dataclass(frozen=True)
class InputSource:
    """An input that can be read any number of times."""

    path: Path
    kind: str
    """Name of its format."""
    messages: Callable[[], Iterator[Message]]
    """Gives the messages in receipt order, as `fgtrack.inputs.validation` lets them pass.

    Raises `TruncatedInput` behind the last message before a break, `DataError` for all else that is wrong.
    """
    settings: Callable[[], Mapping[str, object]] = dict
    """Gives what the recording carries of a configuration, by the names of its keys; see `fgtrack.config.recorded`.

    Raises `DataError` where the input cannot be read.
    """


@dataclass(frozen=True)
class FileFormat:
    """A format of inputs: a file or a folder with messages in receipt order."""

    description: str
    """Name of the format, for messages: `an fgtrack stream (.jsonl)`."""
    recognises: Callable[[Path], bool]
    """True if an existing file that is not empty, or a folder, is one, by its content; may raise `OSError`."""
    open: Callable[[Path, InputConfig], Callable[[], Iterator[Message]]]
    """Opens the input at a path: gives what `InputSource.messages` is, and raises as `open_input`."""
    settings: Callable[[Path], Mapping[str, object]] = lambda path: {}
    """Settings that the input at a path carries, as `InputSource.settings`."""
    validates: bool = False
    """True if the reader validates every message by itself, with `validated_message`."""


def open_input(path: Path | str, config: InputConfig | None = None) -> InputSource:
    """Open the input at `path`; raises `CallError` where nothing is there or `config` does not fit, and `DataError`."""
    check_paths(recording=path)
    path = Path(path)
    name = input_kind(path)
    config = config or InputConfig()
    with ADAPTERS.plugin_errors(name, f"cannot open {path}"):
        form = file_format(name)
        messages = form.open(path, config)
    return InputSource(
        path,
        name,
        partial(validated, path, messages, form.validates),
        partial(form.settings, path),
    )


def input_kind(path: Path) -> str:
    """Name of the format of `path`, by its content; raises as `open_input`. Plug-ins are asked first."""
    if not path.exists():
        raise CallError(f"{path}: there is no such file or folder")
    # The last registered first: plug-ins, then the built-in ones, which recognise the loosest last.
    names = [name for name in reversed(list(ADAPTERS)) if "/" not in name]
    try:
        if not path.is_file() and not path.is_dir():
            raise DataError(
                f"{path}: is neither a file nor a folder, write what comes out of it to a file first"
            )
        if path.is_file() and path.stat().st_size == 0:
            raise DataError(f"{path}: is empty")
        for name in names:  # loaded one after the other: that of bags is large
            form = file_format(name)
            with ADAPTERS.plugin_errors(name, f"cannot look at {path}"):
                if form.recognises(path):
                    return name
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error
    formats_read = ", ".join(file_format(name).description for name in reversed(names))
    raise DataError(f"{path}: is not an input that fgtrack reads: {formats_read}")


def file_format(name: str) -> FileFormat:
    """The format `name`. Raises `CallError` where a plug-in fails or is not one."""
    with ADAPTERS.plugin_errors(name, "cannot be made"):
        form = ADAPTERS.load(name)
        form = form if isinstance(form, FileFormat) else form()
    if not isinstance(form, FileFormat):
        raise CallError(
            f"adapter {name!r}: is a {type(form).__name__}, not a FileFormat"
        )
    return form
