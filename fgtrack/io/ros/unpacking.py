"""Unpacks what a recording has compressed, and never more than it may be: a few bytes can stand for gigabytes."""

import bz2
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]  # has no stubs

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

from fgtrack.core.errors import DataError
from fgtrack.io.errors import LARGEST_BYTES, refuse_larger

__all__ = ["unpacked", "unpacked_file"]

_PORTION = 1 << 20
_LARGEST_RATIO = 100

#: Of each compression, what makes a decompressor: `decompress(data, max_length)`, `eof`.
_DECOMPRESSORS: dict[str, Callable[[], Any]] = {
    "zstd": zstd.ZstdDecompressor,
    "lz4": LZ4FrameDecompressor,
    "bz2": bz2.BZ2Decompressor,
}


def unpacked(compression: str, data: bytes, what: str, largest_bytes: int, cut: bool = False) -> bytes:
    """`data` without its compression, named as in MCAP files and ROS 1 bags; of `cut` data what can be had.

    Raises
    ------
    DataError
        It is larger than `largest_bytes`, or the compression is not known; `what` says where it is.
    Exception
        Whatever the library raises where the data are damaged; `EOFError` where they break off.
    """
    if compression in ("", "none"):
        refuse_larger(len(data), what, largest_bytes)
        return data
    if compression not in _DECOMPRESSORS:
        raise DataError(f"{what}: compression {compression!r} is not known, only {', '.join(_DECOMPRESSORS)}")
    decompressor = _DECOMPRESSORS[compression]()
    found: bytes = decompressor.decompress(data, largest_bytes + 1)
    refuse_larger(len(found), what, largest_bytes)
    if not decompressor.eof and not cut:
        raise EOFError("compressed data break off")
    return found


def unpacked_file(path: Path, target: BinaryIO) -> None:
    """Unpack the zstd file `path`.

    Raises `DataError` where it becomes larger than any recording does, and whatever the library raises where it is
    damaged.
    """
    allowed = max(LARGEST_BYTES, _LARGEST_RATIO * path.stat().st_size)
    with zstd.open(path, "rb") as packed:
        while portion := packed.read(_PORTION):
            allowed -= len(portion)
            if allowed < 0:
                raise DataError(f"{path}: unpacks to more than {_LARGEST_RATIO} times its size, no recording does")
            target.write(portion)
