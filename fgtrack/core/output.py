"""Safe outputs: what exists stays without `overwrite`, and no output is half-written.

Made beside its destination under a name that ends in `.part`, which a killed command leaves, and renamed when complete.
A folder that must be readable at any time is claimed instead: created, and locked until the command ends.
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
    path: Path,
    overwrite: bool,
    replaceable: Callable[[Path], bool] = os.path.isfile,
    what: str = "a file",
) -> None:
    """Raise `CallError` unless `path` can be made, is empty (but for `.part`) or, with `overwrite`, may be replaced."""
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


def check_apart(out: Path, inputs: Iterable[str | Path | None]) -> None:
    """Raise `CallError` where the output `out` is one of `inputs`, holds one, or lies in one."""
    target = out.resolve()
    for source in (each for each in inputs if each is not None):
        source_path = Path(source).resolve()
        overlaps = (
            target == source_path
            or target in source_path.parents
            or source_path in target.parents
        )
        if (
            overlaps and source_path.exists()
        ):  # else the name of a shipped configuration
            raise CallError(
                f"{out}: must not overlap the input {source}, choose another name"
            )


def write_error(path: Path, error: OSError) -> FgtrackError:
    """The error to raise where `path` cannot be written: `DataError` for a full or broken disk, else `CallError`."""
    if error.errno in FULL:
        return DataError(
            f"{path}: cannot be written ({error.strerror}), free some space"
        )
    return CallError(
        f"{path}: cannot be written ({error.strerror or error}), choose another path"
    )


def write_file(path: Path, text: str, overwrite: bool = True) -> None:
    """Write the text file `path` completely or not at all."""
    with new_path(path, overwrite) as new:
        new.write_bytes(text.encode())


@contextmanager
def new_file(path: Path, overwrite: bool) -> Iterator[BinaryIO]:
    """A file that is renamed to `path` when the block ends; raises as `new_path`."""
    with new_path(path, overwrite) as new, new.open("xb") as file:
        yield file


@contextmanager
def new_path(
    path: Path,
    overwrite: bool,
    replaceable: Callable[[Path], bool] = os.path.isfile,
    what: str = "a file",
) -> Iterator[Path]:
    """Path of a file or folder that becomes `path` when the block ends; raises as `check_output` and `write_error`."""
    check_output(path, overwrite, replaceable, what)
    with _part_of(path) as part:
        new = part / Path(os.path.abspath(path)).name
        yield new
        check_output(
            path, overwrite, replaceable, what
        )  # another command may have made it
        if path.is_dir() and new.is_dir():
            os.rename(path, part / _REPLACED)
        os.replace(new, path)


@contextmanager
def new_files(folder: Path, overwrite: bool) -> Iterator[Path]:
    """A folder whose files are moved into `folder` when the block ends; raises as `new_path` where one would change."""
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
    """The folder `<path>.*.part`, which is removed at the end of the block; an interrupt keeps it, as a kill does."""
    absolute = Path(os.path.abspath(path))
    part = absolute.with_name(f"{absolute.name}.{secrets.token_hex(6)}.part")
    try:
        part.mkdir(parents=True)
        yield part
        shutil.rmtree(part)
    except Exception as error:
        if not (part / _REPLACED).exists():  # it could not be put back
            shutil.rmtree(part, ignore_errors=True)
        if isinstance(error, OSError):
            raise write_error(path, error) from error
        raise


@contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Create and lock `folder` during the block, remove it if still empty; `CallError` if locked or not possible."""
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
