"""Safe outputs: what exists stays without `overwrite`, and no output is half-written.

A file, or a folder that is written once, is made beside its destination under a random name that ends in `.part`, and
renamed when it is complete; a killed command leaves the `.part`. A folder that must be readable at any time is claimed
instead: created, and locked until the command ends.
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

#: Of a disk that takes no more.
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)
#: Name of a folder that is replaced, inside the `.part` of what replaces it.
_REPLACED = ".replaced"


def check_output(
    path: Path, overwrite: bool, replaceable: Callable[[Path], bool] = os.path.isfile, what: str = "a file"
) -> None:
    """Raise `CallError` unless `path` can be made, is an empty folder or, with `overwrite`, may be replaced.

    What killed commands leave in a folder, whose names end in `.part`, counts as nothing.
    """
    try:
        if not os.path.lexists(path):
            parent = next(above for above in Path(os.path.abspath(path)).parents if above.exists())
            if not parent.is_dir() or not os.access(parent, os.W_OK):
                raise PermissionError(errno.EACCES, f"{parent} is not a folder to write into")
            return
        is_folder = path.is_dir() and not path.is_symlink()
        if is_folder and all(name.endswith(".part") for name in os.listdir(path)):
            return
        if path.is_symlink() or not replaceable(path):
            raise CallError(f"{path}: exists and is not {what}, choose another name")
    except OSError as error:
        raise write_error(path, error) from error
    if not overwrite:
        raise CallError(f"{path}: already exists, choose another name or replace it with --overwrite")


def check_apart(out: Path, inputs: Iterable[str | Path | None]) -> None:
    """Raise `CallError` where the output `out` is one of `inputs`, holds one, or lies in one."""
    target = out.resolve()
    for source in inputs:
        place = None if source is None else Path(source).resolve()
        if place is None or not place.exists():  # the name of a shipped configuration
            continue
        if target == place or target in place.parents:
            raise CallError(f"{out}: is the input or holds it ({source}), choose another name")
        if place in target.parents:
            raise CallError(f"{out}: lies in the input {source}, choose another place")


def write_error(path: Path, error: OSError) -> FgtrackError:
    """The error to raise where `path` cannot be written: `DataError` for a full or broken disk, else `CallError`."""
    if error.errno in FULL:
        return DataError(f"{path}: cannot be written ({error.strerror}), free some space")
    return CallError(f"{path}: cannot be written ({error.strerror or error}), choose another place")


def write_file(path: Path, text: str) -> None:
    """Write the text file `path` completely or not at all, replacing a former version."""
    with new_file(path, overwrite=True) as file:
        file.write(text.encode())


@contextmanager
def new_file(path: Path, overwrite: bool) -> Iterator[BinaryIO]:
    """A file that is renamed to `path` when the block ends; raises as `check_output` and `write_error`."""
    check_output(path, overwrite)
    with _part_of(path) as part:
        part.parent.mkdir(parents=True, exist_ok=True)
        with part.open("xb") as file:
            yield file
        check_output(path, overwrite)  # another command may have made it
        os.replace(part, path)


@contextmanager
def new_files(folder: Path, overwrite: bool) -> Iterator[Path]:
    """A folder whose files are moved into `folder` when the block ends; raises as `new_file` where one would change."""
    check_output(folder, True, os.path.isdir, "a folder")
    with _part_of(folder) as part:
        part.mkdir(parents=True)
        yield part
        files = sorted(part.iterdir())
        for file in files:
            other = folder / file.name
            if not other.is_file() or not filecmp.cmp(file, other, shallow=False):
                check_output(other, overwrite)
        folder.mkdir(exist_ok=True)
        for file in files:
            os.replace(file, folder / file.name)
        part.rmdir()


@contextmanager
def new_folder(path: Path, overwrite: bool, replaceable: Callable[[Path], bool], what: str) -> Iterator[Path]:
    """Path at which to make a folder that is renamed to `path` when the block ends; raises as `new_file`."""
    check_output(path, overwrite, replaceable, what)
    with _part_of(path) as part:
        part.mkdir(parents=True)
        new = part / Path(os.path.abspath(path)).name
        yield new
        check_output(path, overwrite, replaceable, what)
        if path.exists():
            os.rename(path, part / _REPLACED)
        os.rename(new, path)
        shutil.rmtree(part)


@contextmanager
def _part_of(path: Path) -> Iterator[Path]:
    """The path `<path>.*.part`, removed after an error; an interrupt keeps it, as a kill does."""
    absolute = Path(os.path.abspath(path))
    part = absolute.with_name(f"{absolute.name}.{secrets.token_hex(6)}.part")
    try:
        yield part
    except Exception as error:
        if not (part / _REPLACED).exists():  # it could not be put back
            shutil.rmtree(part, ignore_errors=True)
            part.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise write_error(path, error) from error
        raise


@contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Create `folder` and lock it during the block; folders created that are still empty at its end are removed.

    Raises `CallError` where it cannot be created, or another command has locked it.
    """
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = os.open(folder, os.O_RDONLY)
    except OSError as error:
        raise CallError(f"{folder}: cannot be made a folder ({error.strerror}), choose another one") from error
    try:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise CallError(f"{folder}: another command is writing there, choose another folder or wait") from error
        except OSError:  # a file system without locks
            pass
        yield
    finally:
        with suppress(OSError):
            for path in missing:
                path.rmdir()
        os.close(lock)
