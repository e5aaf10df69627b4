"""Safe outputs: nothing is removed or replaced that a command did not write, and no output is half-written.

A file, or a folder that is written once, is made beside its destination under a random name that ends in `.part`, and
renamed when it is complete; a killed command leaves the `.part`. A folder that must be readable at any time is claimed
instead: created, and locked until the command ends.
"""

import errno
import filecmp
import importlib
import os
import re
import secrets
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from fgtrack.core.errors import CallError, DataError, FgtrackError

_PART = re.compile(r"\.[0-9a-f]{12}\.part$")
#: Name of what is replaced, inside the `.part` of what replaces it.
REPLACED = ".replaced"
#: Of a disk that takes no more.
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)


@dataclass(frozen=True)
class Kind:
    """A kind of output; it replaces nothing but its own kind."""

    name: str
    recognises: Callable[[Path], bool]
    """Whether an existing path is of this kind and holds nothing else."""


def check_output(path: Path, kind: Kind, overwrite: bool) -> None:
    """Raise `CallError` unless `path` can be made, is an empty folder or, with `overwrite`, of this kind."""
    try:
        if not os.path.lexists(path):
            parent = next(above for above in Path(os.path.abspath(path)).parents if above.exists())
            if not parent.is_dir():
                raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR))
            if not os.access(parent, os.W_OK):
                raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
            return
        if path.is_dir() and not path.is_symlink() and not any(path.iterdir()):
            return
        own = not path.is_symlink() and kind.recognises(path)
    except OSError as error:
        raise write_error(path, error) from error
    if not own:
        raise CallError(f"{path}: exists and is not {kind.name}, choose another name")
    if not overwrite:
        raise CallError(f"{path}: already exists, choose another name or replace it with --overwrite")


def check_apart(out: Path, inputs: Iterable[Path]) -> None:
    """Raise `CallError` where the output `out` is one of `inputs` (those that exist), holds one, or lies in one."""
    place = out.resolve()
    for source in inputs:
        where = source.resolve()
        if place == where or place in where.parents:
            raise CallError(f"{out}: is the input or holds it ({source}), choose another name")
        if where in place.parents:
            raise CallError(f"{out}: lies in the input {source}, choose another place")


def write_error(path: Path, error: OSError) -> FgtrackError:
    """The error to raise where `path` cannot be written: `DataError` for a full or broken disk, else `CallError`."""
    if error.errno in FULL:
        return DataError(f"{path}: cannot be written ({error.strerror}), free some space")
    return CallError(f"{path}: cannot be written ({error.strerror or error}), choose another place")


def write_file(path: Path, text: str) -> None:
    """Write the text file `path` completely or not at all, replacing a former version; a link there is an error."""
    part = _part_of(path)
    try:
        if path.is_symlink():
            raise FileExistsError(errno.EEXIST, "is a link")
        with _removed_on_error(part):
            with part.open("xb") as file:
                keep_mode(path, part)
                file.write(text.encode())
            os.replace(part, path)
    except OSError as error:
        raise write_error(path, error) from error


@contextmanager
def new_file(path: Path, kind: Kind, overwrite: bool) -> Iterator[BinaryIO]:
    """A file that is renamed to `path` when the block ends; raises as `check_output` and `write_error`."""
    check_output(path, kind, overwrite)
    part = _part_of(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with _removed_on_error(part):
            with part.open("xb") as file:
                keep_mode(path, part)
                yield file
            _rename(part, path, kind, overwrite)
    except OSError as error:
        raise write_error(path, error) from error


@contextmanager
def new_folder(path: Path, kind: Kind, overwrite: bool) -> Iterator[Path]:
    """Path at which to make a folder that is renamed to `path` when the block ends; raises as `new_file`."""
    check_output(path, kind, overwrite)
    try:
        with part_folder(path) as part:
            keep_mode(path, part)
            new, old = part / Path(os.path.abspath(path)).name, part / REPLACED
            yield new
            if path.exists():
                keep_mode(path, new)
                for file in new.iterdir():
                    keep_mode(path / file.name, file)
            if overwrite and path.exists():
                check_output(path, kind, overwrite)
                os.rename(path, old)
            try:
                os.rename(new, path)
            except OSError:
                if old.exists():
                    os.rename(old, path)
                raise
            shutil.rmtree(part)
    except OSError as error:
        raise write_error(path, error) from error


@contextmanager
def part_folder(path: Path) -> Iterator[Path]:
    """A new folder `<path>.*.part`, removed after an error unless something replaced is still in it."""
    part = _part_of(path)
    part.mkdir(parents=True)
    with _removed_on_error(part):
        yield part


def keep_mode(old: Path, new: Path) -> None:
    """Give `new` the permissions of what it replaces, where that is there: what was private stays private."""
    with suppress(FileNotFoundError):
        if not old.is_symlink():
            shutil.copymode(old, new)


@contextmanager
def new_files(folder: Path, kind: Kind, overwrite: bool) -> Iterator[Path]:
    """A folder whose files are moved to `folder` when the block ends: all, or none where one must not be replaced.

    An existing file may be replaced with `overwrite` where it is of this kind, or if it is equal.
    """
    with claimed(folder):
        part = folder / f"{secrets.token_hex(6)}.part"
        try:
            part.mkdir()
            with _removed_on_error(part):
                yield part
                files = sorted(part.iterdir())
                for file in files:
                    place = folder / file.name
                    if not (place.is_file() and not place.is_symlink() and filecmp.cmp(file, place, shallow=False)):
                        check_output(place, kind, overwrite)
                for file in files:
                    keep_mode(folder / file.name, file)
                    os.replace(file, folder / file.name)
            part.rmdir()
        except OSError as error:
            raise write_error(folder, error) from error


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
        _lock(lock, folder)
        yield
    finally:
        with suppress(OSError):
            for path in missing:
                path.rmdir()
        os.close(lock)


def _lock(descriptor: int, folder: Path) -> None:
    fcntl = importlib.import_module("fcntl")  # of POSIX
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise CallError(f"{folder}: another command is writing there, choose another folder or wait") from error
    except OSError:  # a file system without locks
        return


def _rename(part: Path, path: Path, kind: Kind, overwrite: bool) -> None:
    if not overwrite:
        try:
            os.link(part, path)  # unlike a renaming this never replaces what was made meanwhile
        except FileExistsError:
            raise
        except OSError:  # a file system without links, each says it in its own way
            pass
        else:
            part.unlink()
            return
    check_output(path, kind, overwrite)
    os.replace(part, path)


def part_of(name: str) -> str:
    """Name of the file that a `.part` was to become; that of any other file itself."""
    return _PART.sub("", name)


def _part_of(path: Path) -> Path:
    path = Path(os.path.abspath(path))
    return path.with_name(f"{path.name}.{secrets.token_hex(6)}.part")


@contextmanager
def _removed_on_error(part: Path) -> Iterator[None]:
    """Remove the file or folder `part` after an error; an interrupt keeps it, as a kill does."""
    try:
        yield
    except Exception:
        replaced = part / REPLACED
        if replaced.is_dir() and any(replaced.iterdir()):  # it could not be put back
            raise
        if part.is_dir():
            shutil.rmtree(part, ignore_errors=True)
        else:
            part.unlink(missing_ok=True)
        raise
