"""Files that cannot be read as they are: pointers of Git LFS, archives, formats of other programs."""

import re
from itertools import chain, islice
from pathlib import Path

from fgtrack.core.errors import DataError
from fgtrack.core.files import open_file

_LFS = b"version https://git-lfs.github.com/spec/"
_LFS_BYTES = 1024
_OPENLABEL = re.compile(rb'\s*\{\s*"openlabel"\s*:')
#: Largest number of files of a folder that are examined.
_MOST_FILES = 1000
_HEAD_BYTES = 4096
#: Beginnings of files, and what they are.
_FORMS = {
    b"PK\x03\x04": "is a ZIP archive: unpack it and give the file or folder in it",
    b"Rar!": "is a RAR archive: unpack it and give the file or folder in it",
    b"7z\xbc\xaf\x27\x1c": "is a 7z archive: unpack it and give the file or folder in it",
    b"BZh": "is compressed with bzip2: decompress it first",
    b"\xfd7zXZ": "is compressed with xz: decompress it first",
    b"\x28\xb5\x2f\xfd": "is compressed with zstd, but contains no bag: decompress it first",
    b"\xd4\xc3\xb2\xa1": "is a capture of network packets: extract their payload first",
    b"\x0a\x0d\x0d\x0a": "is a capture of network packets: extract their payload first",
    b"\x89HDF": "is an HDF5 file: write its tables as CSV first",
    b"MATLAB": "is a MATLAB file: write its tables as CSV first (writetable)",
    b"PAR1": "is a Parquet file: write it as CSV first",
    b"\xd0\xcf\x11\xe0": "is an Excel file: write its sheets as CSV first",
}
_TAR = (257, b"ustar")


def check_content(path: Path) -> None:
    """Raise `DataError` for files that look like an input of fgtrack, but contain something else.

    These are pointers of Git LFS, at `path` or in a folder `path`, and annotations in OpenLABEL.
    """
    for file in _files(path):
        if file.stat().st_size > _LFS_BYTES:
            continue
        if _begins_with_lfs(file, file == path):
            raise DataError(
                f"{file}: is a pointer of Git LFS instead of the file: fetch the file with `git lfs pull`"
            )
    if path.is_file():
        with open_file(path) as content:
            if _OPENLABEL.match(content.read(_HEAD_BYTES)):
                raise DataError(
                    f"{path}: is an annotation in OpenLABEL, which fgtrack does not read: "
                    "write its objects as CSV or as a stream"
                )


def _begins_with_lfs(file: Path, is_needed: bool) -> bool:
    """Return True if `file` is a pointer of Git LFS.

    A file that cannot be read counts as False, because a folder may contain unused files. If it `is_needed`, the
    `OSError` is raised.
    """
    try:
        with open_file(file) as content:
            return content.read(len(_LFS)) == _LFS
    except OSError:
        if is_needed:
            raise
        return False


def known_form(path: Path) -> str | None:
    """Return a clause for a message about the file `path`: its format, and how to convert it to an input of fgtrack.

    None if the format is unknown.
    """
    if not path.is_file():
        return None
    with open_file(path) as file:
        head = file.read(_HEAD_BYTES)
    at, tar = _TAR
    if head[at:].startswith(tar):
        return "is a tar archive: unpack it and give the file or folder in it"
    return next(
        (text for begin, text in _FORMS.items() if head.startswith(begin)), None
    )


def _files(path: Path) -> list[Path]:
    if path.is_file():
        return [path]
    folders = [path, *(each for each in path.iterdir() if each.is_dir())]
    files = chain.from_iterable(map(Path.iterdir, folders))
    return [each for each in islice(files, _MOST_FILES) if each.is_file()]
