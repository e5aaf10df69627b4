"""Safe outputs: an existing output is kept without `overwrite`, and no output is half-written.

An output is written next to its destination, under a name that ends in `.part`, and
renamed when it is complete. A killed command leaves the `.part`. A folder that must be
readable at any time is locked instead: it is created, and no other command writes into
it until the block ends.
"""

import errno
import fcntl
import filecmp
import os
import secrets
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from fgtrack.core.errors import CallError, DataError, FgtrackError

#: Error numbers of a full or broken disk.
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)
#: Name of the replaced folder inside the `.part` folder of its replacement.
_REPLACED = ".replaced"


def check_output(
    path: Path,
    overwrite: bool,
    replaceable: Callable[[Path], bool] = os.path.isfile,
    what: str = "a file",
) -> None:
    """Raise `CallError` unless the output `path` may be written.

    A new path in a writable folder may be written, and a folder that is empty apart
    from `.part` files. With `overwrite`, an existing output may be replaced if
    `replaceable` is true for it; `what` describes such an output in the message.
    """
    try:
        if not os.path.lexists(path):
            parent = next(
                above for above in Path(os.path.abspath(path)).parents if above.exists()
            )
            if not parent.is_dir() or not os.access(parent, os.W_OK):
                raise PermissionError(
                    errno.EACCES, f"{parent} is not a folder to write into"
                )
            return
        is_link = path.is_symlink()
        if (
            path.is_dir()
            and not is_link
            and all(name.endswith(".part") for name in os.listdir(path))
        ):
            return
        if is_link or not replaceable(path):
            raise CallError(f"{path}: exists and is not {what}, choose another name")
    except OSError as error:
        raise write_error(path, error) from error
    if not overwrite:
        raise CallError(
            f"{path}: already exists, choose another name or replace it with --overwrite"
        )


def check_no_overlap(out: Path, inputs: Iterable[str | Path | None]) -> None:
    """Raise `CallError` if the output `out` overlaps an input: equals it, contains it, or lies inside it."""
    target = out.resolve()
    for source in (each for each in inputs if each is not None):
        source_path = Path(source).resolve()
        overlaps = (
            target == source_path
            or target in source_path.parents
            or source_path in target.parents
        )
        # An input that does not exist is the name of a shipped configuration.
        if overlaps and source_path.exists():
            raise CallError(
                f"{out}: must not overlap the input {source}, choose another name"
            )


def write_error(path: Path, error: OSError) -> FgtrackError:
    """Return the error to raise if `path` cannot be written.

    It is a `DataError` for a full or broken disk, a `CallError` otherwise.
    """
    if error.errno in FULL:
        return DataError(
            f"{path}: cannot be written ({error.strerror}), free some space"
        )
    return CallError(
        f"{path}: cannot be written ({error.strerror or error}), choose another path"
    )


def write_file(path: Path, text: str, overwrite: bool = True) -> None:
    """Write `text` into the file `path`, completely or not at all; raises as `new_path`."""
    with new_path(path, overwrite) as new:
        new.write_bytes(text.encode())


@contextmanager
def new_file(path: Path, overwrite: bool) -> Iterator[BinaryIO]:
    """Open a file for writing bytes that is renamed to `path` when the block ends; raises as `new_path`."""
    with new_path(path, overwrite) as new, new.open("xb") as file:
        yield file


@contextmanager
def new_path(
    path: Path,
    overwrite: bool,
    replaceable: Callable[[Path], bool] = os.path.isfile,
    what: str = "a file",
) -> Iterator[Path]:
    """Temporary path for a file or folder that is renamed to `path` when the block ends.

    Raises the exceptions of `check_output` and `write_error`.
    """
    check_output(path, overwrite, replaceable, what)
    with _part_of(path) as part:
        new = part / Path(os.path.abspath(path)).name
        yield new
        # Another command may have written `path` in the meantime.
        check_output(path, overwrite, replaceable, what)
        if path.is_dir() and new.is_dir():
            os.rename(path, part / _REPLACED)
        os.replace(new, path)


@contextmanager
def new_files(folder: Path, overwrite: bool) -> Iterator[Path]:
    """Temporary folder whose files are moved into `folder` when the block ends.

    Raises the exceptions of `new_path`. Without `overwrite`, an existing file may only be replaced by
    equal content.
    """
    check_output(folder, True, os.path.isdir, "a folder")
    with _part_of(folder) as part:
        yield part
        files = sorted(part.iterdir())
        for file in files:
            other = folder / file.name
            if not other.is_file() or not filecmp.cmp(file, other, shallow=False):
                check_output(other, overwrite)
        folder.mkdir(exist_ok=True)
        for file in files:
            os.replace(file, folder / file.name)


@contextmanager
def _part_of(path: Path) -> Iterator[Path]:
    """Folder `<path>.*.part` that is removed at the end of the block; an interrupt or a kill leaves it.

    Raises the exceptions of `write_error`.
    """
    absolute = Path(os.path.abspath(path))
    part = absolute.with_name(f"{absolute.name}.{secrets.token_hex(6)}.part")
    try:
        part.mkdir(parents=True)
        yield part
        shutil.rmtree(part)
    except Exception as error:
        if not (part / _REPLACED).exists():  # else it holds the only copy
            shutil.rmtree(part, ignore_errors=True)
        if isinstance(error, OSError):
            raise write_error(path, error) from error
        raise


@contextmanager
def locked_folder(folder: Path) -> Iterator[None]:
    """Create and lock `folder` during the block, and remove the folder at the end if it is still empty.

    Raises `CallError` if another command has locked the folder, or if it cannot be
    created.
    """
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = os.open(folder, os.O_RDONLY)
    except OSError as error:
        raise CallError(
            f"{folder}: cannot be made a folder ({error.strerror}), choose another one"
        ) from error
    try:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise CallError(
                f"{folder}: another command is writing there, choose another folder or wait"
            ) from error
        except OSError:  # a file system without locks
            pass
        yield
    finally:
        with suppress(OSError):
            for path in missing:
                path.rmdir()
        os.close(lock)
