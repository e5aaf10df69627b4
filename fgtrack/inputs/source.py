"""Opens an input (recording, stream or data set) and recognises its format by the content."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from fgtrack.core.checks import check_paths
from fgtrack.core.errors import CallError, DataError
from fgtrack.core.types import Message
from fgtrack.inputs.errors import one_line
from fgtrack.inputs.foreign import check_content, known_form
from fgtrack.inputs.formats import ADAPTERS
from fgtrack.inputs.receipts import with_right_receipts
from fgtrack.inputs.settings import InputConfig
from fgtrack.inputs.validation import validated


@dataclass(frozen=True)
class InputSource:
    """An input that can be read any number of times."""

    path: Path
    kind: str
    """Name of its format."""
    messages: Callable[[], Iterator[Message]]
    """Returns an iterator over the validated messages in receipt order (`fgtrack.inputs.validation`).

    The iterator raises `TruncatedInput` after the last message before a break, and
    `DataError` for other faults.
    """
    settings: Callable[[], Mapping[str, object]] = dict
    """Returns the configuration keys and values that the recording carries; see `fgtrack.config.recorded`.

    Raises `DataError` if the input cannot be read.
    """


@dataclass(frozen=True)
class FileFormat:
    """A format of inputs: files or folders from which messages are read in receipt order."""

    description: str
    """Description for messages: `an fgtrack stream (.jsonl)`."""
    recognises: Callable[[Path], bool]
    """True if the content of a non-empty file or of a folder has this format; may raise `OSError`."""
    open: Callable[[Path, InputConfig], Callable[[], Iterator[Message]]]
    """Opens the input at a path: returns `InputSource.messages`, raises the exceptions of `open_input`."""
    settings: Callable[[Path], Mapping[str, object]] = lambda path: {}
    """Returns the settings that the input at a path carries, as `InputSource.settings`."""
    recordings: Callable[[Path, InputConfig], Sequence[Path]] = lambda path, config: (
        path,
    )
    """Returns the paths of the recordings in a folder of this format."""
    files: Callable[[Path], Iterable[Path]] = lambda path: (
        path.rglob("*") if path.is_dir() else (path,)
    )
    """Returns the paths of all files of the recording at a path; there may be folders among them."""
    validates: bool = False
    """True if the reader itself validates every message with `validated_message`."""


def open_input(path: Path | str, config: InputConfig | None = None) -> InputSource:
    """Open the input at `path`.

    Raises `CallError` if nothing exists there or `config` does not fit, and `DataError`
    if the format is unknown or the input cannot be read.
    """
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
        lambda: with_right_receipts(path, validated(path, messages, form.validates)),
        partial(form.settings, path),
    )


def input_kind(path: Path) -> str:
    """Return the name of the format of `path`, recognised by the content; plug-ins are asked first.

    Raises the exceptions of `open_input`.
    """
    try:
        exists = path.exists()
    except (OSError, RuntimeError) as error:  # a loop of symbolic links
        raise DataError(f"{path}: cannot be opened ({one_line(error)})") from error
    if not exists:
        loop = ", the link leads nowhere or to itself" if path.is_symlink() else ""
        raise CallError(f"{path}: there is no such file or folder{loop}")
    # Plug-ins are registered last and asked first. The built-in formats follow, the least specific ones at the end.
    names = [name for name in reversed(list(ADAPTERS)) if "/" not in name]
    try:
        if not path.is_file() and not path.is_dir():
            raise DataError(
                f"{path}: exists, but is neither a file nor a folder; write its content to a file first"
            )
        if path.is_file() and path.stat().st_size == 0:
            raise DataError(f"{path}: is empty")
        check_content(path)
        # Formats are loaded as they are asked, because the reader of bags loads slowly.
        for name in names:
            form = file_format(name)
            with ADAPTERS.plugin_errors(name, f"cannot recognise {path}"):
                if form.recognises(path):
                    return name
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error
    if (known := known_form(path)) is not None:
        raise DataError(f"{path}: {known}")
    formats_read = ", ".join(file_format(name).description for name in reversed(names))
    raise DataError(
        f"{path}: has a format that fgtrack does not read; it reads {formats_read}"
    )


def file_format(name: str) -> FileFormat:
    """Return the format `name`; raises `CallError` if a plug-in fails or is no `FileFormat`."""
    with ADAPTERS.plugin_errors(name, "cannot be created"):
        form = ADAPTERS.load(name)
        form = form if isinstance(form, FileFormat) else form()
    if not isinstance(form, FileFormat):
        raise CallError(
            f"adapter {name!r}: is a {type(form).__name__}, not a FileFormat"
        )
    return form
