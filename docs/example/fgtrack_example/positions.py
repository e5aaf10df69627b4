"""A file format."""

from decimal import Decimal
from functools import partial
from itertools import groupby

from fgtrack import Detection, DetectionList, FileFormat

HEADER = "seconds sensor x_m y_m"


def is_positions(path):
    """True for a file that begins with the header."""
    return path.is_file() and path.read_bytes().startswith(f"{HEADER}\n".encode())


def read_positions(path):
    """Yield a list of detections for each scan: the lines of one time and sensor, in the map frame."""
    lines = path.read_text().splitlines()[1:]
    for (seconds, sensor), scan in groupby(map(str.split, lines), key=lambda words: words[:2]):
        stamp_ns = int(Decimal(seconds) * 10**9)
        objects = [Detection(x_m=float(x_m), y_m=float(y_m)) for _, _, x_m, y_m in scan]
        yield DetectionList(sensor, stamp_ns, stamp_ns, objects, frame="map")


FORMAT = FileFormat(
    description=f"a table of positions ({HEADER})",
    recognises=is_positions,
    open=lambda path, config: partial(read_positions, path),
)
