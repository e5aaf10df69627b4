"""Exchanges the files of a folder that other files share: all of them, or none."""

import errno
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from fgtrack.io.output import REPLACED, keep_mode, part_folder, write_error

#: Name of what a killed exchange leaves, before its `.part`.
EXCHANGED = "files"


@contextmanager
def exchanged(folder: Path, names: Sequence[str], overwrite: bool) -> Iterator[Path]:
    """A folder whose files take the place of those called `names` in `folder` when the block ends.

    The last of `names` tells what the folder holds: of the old files it goes first, of the new ones it comes last.
    The old files are removed when the new ones are there; after an error they are back, and a kill leaves them in the
    `.part`. Raises `CallError` where one cannot be replaced, and without `overwrite` where one is there.
    """
    try:
        with part_folder(folder / EXCHANGED) as part:
            old, new = part / REPLACED, part / "new"
            new.mkdir()
            yield new
            old.mkdir()
            with ExitStack() as undone:
                for name in reversed(names) if overwrite else ():
                    if os.path.lexists(folder / name):
                        _move(folder / name, old / name, undone)
                for name in names:
                    if (new / name).exists():
                        keep_mode(old / name, new / name)
                        _move(new / name, folder / name, undone)
                undone.pop_all()
            shutil.rmtree(part)
    except OSError as error:
        raise write_error(folder, error) from error


def _move(source: Path, target: Path, undone: ExitStack) -> None:
    """Rename the file `source`, and back where what follows fails; never to where something is."""
    try:
        if source.is_dir() and not source.is_symlink():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        if os.path.lexists(target):
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST))
        os.rename(source, target)
    except OSError as error:
        raise write_error(target if isinstance(error, FileExistsError) else source, error) from error
    undone.callback(os.rename, target, source)
