"""The stream format `fgtrack-stream/1`: messages as JSON lines, plain or gzipped, in receipt order."""

import gzip
import json
import logging
import zlib
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, BinaryIO, get_args

from fgtrack.core.errors import DataError
from fgtrack.core.types import (
    MEASURABLE,
    STATE_NAMES,
    Detection,
    DetectionList,
    EgoState,
    Frame,
    Message,
    TruthState,
)
from fgtrack.io.config import InputConfig
from fgtrack.io.errors import TruncatedInput, UntilBreak
from fgtrack.io.output import Kind, new_file
from fgtrack.io.source import FileFormat

STREAM_FORMAT = "fgtrack-stream/1"
GZIP_MAGIC = b"\x1f\x8b"

_logger = logging.getLogger(__name__)
_INT64_LIMIT = 1 << 63
_TIMES = ("stamp_ns", "receipt_ns")
_EGO_REQUIRED = ("x_m", "y_m", "yaw_rad", "speed_mps")
_EGO_OPTIONAL = ("yaw_rate_radps", "accel_mps2")
_TRUTH_REQUIRED = ("x_m", "y_m")
_TRUTH_OPTIONAL = tuple(name for name in STATE_NAMES if name not in _TRUTH_REQUIRED)
_DETECTION_KEYS = {*MEASURABLE, "covariance", "stamp_ns", "object_id"}
_KEYS = {
    "ego": {"type", *_TIMES, *_EGO_REQUIRED, *_EGO_OPTIONAL, "in_pit"},
    "detections": {"type", *_TIMES, "sensor", "frame", "objects"},
    "truth": {"type", *_TIMES, "object_id", *STATE_NAMES},
}

# A parsed JSON object: its values are checked one by one below.
Record = dict[str, Any]


def read_stream(path: Path | str) -> Iterator[Message]:
    """Messages of the stream `path` in the order of the file, which is receipt order.

    Gzip is recognised by its magic number. Unknown keys are ignored; one warning is logged with their names
    and counts.

    Raises
    ------
    TruncatedInput
        The file breaks off; raised after every message before the break.
    DataError
        Anything else is wrong; the message names file and line.
    """
    path = Path(path)
    unknown: Counter[str] = Counter()
    newest_ns: int | None = None
    with closing(_records(path)) as records:
        _check_header(path, next(records, None))
        for line, record in records:
            try:
                message = _message(record, unknown)
            except _BadRecordError as error:
                raise DataError(f"{path}:{line}: {error}") from error
            if not isinstance(message, TruthState):
                if newest_ns is not None and message.receipt_ns < newest_ns:
                    raise DataError(
                        f"{path}:{line}: receipt_ns {message.receipt_ns} is before {newest_ns} of an earlier "
                        "record, sort the stream by receipt_ns"
                    )
                newest_ns = message.receipt_ns
            yield message
    if unknown:
        names = ", ".join(f"{name} ({count})" for name, count in sorted(unknown.items()))
        _logger.warning("%s: ignored unknown keys: %s", path, names)


def _recognises(path: Path) -> bool:
    if not path.is_file():
        return False
    with path.open("rb") as file:
        start = file.read(64)
    return start.startswith(GZIP_MAGIC) or start.lstrip().startswith(b"{")


def _open(path: Path, config: InputConfig) -> Callable[[], Iterator[Message]]:
    return lambda: read_stream(path)


FORMAT = FileFormat("an fgtrack stream (.jsonl, .jsonl.gz)", _recognises, _open)


def read_header(path: Path | str) -> Mapping[str, Any]:
    """Header record of the stream `path`; JSON values. Raises `DataError` when there is none."""
    path = Path(path)
    with closing(_records(path)) as records:
        return _check_header(path, next(records, None))


def write_stream(
    path: Path | str,
    messages: Iterable[Message],
    header: Mapping[str, object] | None = None,
    overwrite: bool = False,
) -> int:
    """Write `messages`, which must be in receipt order, to `path`; gives their number.

    A name that ends in `.gz` is gzipped; the same messages give the same bytes. The file gets its name when it is
    whole; what a killed writer leaves beside it (`<path>.*.part`) is readable.

    Parameters
    ----------
    header
        Entries of the header record beside `type` and `format`.
    overwrite
        Replace a stream at `path`.

    Raises
    ------
    TruncatedInput
        `messages` broke off; what came before is written.
    CallError
        Something is at `path`, or it cannot be written.
    DataError
        The disk is full.
    """
    path = Path(path)
    count = 0
    with new_file(path, STREAM, overwrite) as file, _packed(file, path.name.endswith(".gz")) as lines:
        lines.write(_line({"type": "header", "format": STREAM_FORMAT, **(header or {})}))
        readable = UntilBreak(messages)
        for message in readable:
            lines.write(_line(_record(message)))
            count += 1
    readable.raise_error()
    return count


def _is_stream(path: Path) -> bool:
    try:
        return path.is_file() and bool(read_header(path))
    except DataError:
        return False


STREAM = Kind("an fgtrack stream", _is_stream)


@contextmanager
def _packed(file: BinaryIO, gzipped: bool) -> Iterator[BinaryIO | gzip.GzipFile]:
    if not gzipped:
        yield file
        return
    with gzip.GzipFile(filename="", mode="wb", fileobj=file, mtime=0) as packed:
        yield packed


def _line(record: Mapping[str, object]) -> bytes:
    return json.dumps(record, default=_plain).encode() + b"\n"


def _plain(value: Any) -> object:  # a NumPy scalar, which json does not know
    return value.item()


def _given(value: object, names: Iterable[str]) -> Record:
    return {name: field for name in names if (field := getattr(value, name)) is not None}


def _record(message: Message) -> Record:
    times = {"stamp_ns": message.stamp_ns, "receipt_ns": message.receipt_ns}
    match message:
        case EgoState():
            return {"type": "ego", **times, **_given(message, (*STATE_NAMES, "in_pit"))}
        case TruthState():
            return {"type": "truth", **times, **_given(message, ("object_id", *STATE_NAMES))}
        case DetectionList():
            names = (*MEASURABLE, "covariance", "stamp_ns", "object_id")
            objects = [_given(item, names) for item in message.objects]
            return {
                "type": "detections",
                "sensor": message.sensor,
                **times,
                "frame": message.frame,
                "objects": objects,
            }


def _records(path: Path) -> Generator[tuple[int, Record], None, None]:
    """Line number and JSON object of every line that is not blank."""
    line, num_records = 0, 0
    try:
        with path.open("rb") as raw:
            packed = raw.read(2) == GZIP_MAGIC
            raw.seek(0)
            file: BinaryIO | gzip.GzipFile = gzip.GzipFile(fileobj=raw) if packed else raw
            for line, text in enumerate(file, 1):
                if not text.strip():
                    continue
                try:
                    record = json.loads(text.decode())
                except (ValueError, RecursionError) as error:
                    if num_records and not text.endswith(b"\n"):
                        raise TruncatedInput(
                            f"{path}:{line}: breaks off in the middle of record {num_records + 1}"
                        ) from error
                    raise DataError(f"{path}:{line}: is not JSON ({error})") from error
                if not isinstance(record, dict):
                    raise DataError(f"{path}:{line}: is not a JSON object")
                num_records += 1
                yield line, record
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise TruncatedInput(f"{path}:{line + 1}: breaks off after record {num_records} ({error})") from error
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error


def _check_header(path: Path, first: tuple[int, Record] | None) -> Record:
    if first is None:
        raise DataError(f"{path}: is empty, a stream starts with a header record")
    line, record = first
    if record.get("type") != "header":
        raise DataError(f"{path}:{line}: a stream starts with a header record of format {STREAM_FORMAT!r}")
    if record.get("format") != STREAM_FORMAT:
        raise DataError(f"{path}:{line}: format {record.get('format')!r} is not {STREAM_FORMAT!r}")
    return record


class _BadRecordError(Exception):
    """What is wrong with a record; the caller adds where."""


def _message(record: Record, unknown: Counter[str]) -> Message:
    kind = record.get("type")
    keys = _KEYS.get(kind) if isinstance(kind, str) else None
    if keys is None:
        raise _BadRecordError(f"unknown record type {kind!r}, known are {', '.join(_KEYS)}")
    if not record.keys() <= keys:
        unknown.update(f"{kind}.{key}" for key in record.keys() - keys)
    stamp_ns, receipt_ns = (_integer(record, name) for name in _TIMES)
    if kind == "detections":
        return _detection_list(record, stamp_ns, receipt_ns, unknown)
    if kind == "ego":
        required = {name: _number(record, name) for name in _EGO_REQUIRED}
        optional = {name: _number(record, name) for name in _EGO_OPTIONAL if record.get(name) is not None}
        in_pit = record.get("in_pit")
        if not (in_pit is None or isinstance(in_pit, bool)):
            raise _BadRecordError(f"in_pit: true or false expected, not {in_pit!r}")
        return EgoState(stamp_ns, receipt_ns, **required, **optional, in_pit=in_pit)
    return TruthState(
        stamp_ns,
        receipt_ns,
        _integer(record, "object_id"),
        **{name: _number(record, name) for name in _TRUTH_REQUIRED},
        **{name: _number(record, name) for name in _TRUTH_OPTIONAL if record.get(name) is not None},
    )


def _detection_list(record: Record, stamp_ns: int, receipt_ns: int, unknown: Counter[str]) -> DetectionList:
    sensor = _required(record, "sensor")
    if not isinstance(sensor, str) or not sensor:
        raise _BadRecordError(f"sensor: a name expected, not {sensor!r}")
    frame = record.get("frame", "ego")
    if frame not in get_args(Frame):
        raise _BadRecordError(f"frame: one of {', '.join(get_args(Frame))} expected, not {frame!r}")
    objects = _required(record, "objects")
    if not isinstance(objects, list):
        raise _BadRecordError(f"objects: a list expected, not {objects!r}")
    detections = []
    for index, item in enumerate(objects):
        try:
            detections.append(_detection(item, unknown))
        except _BadRecordError as error:
            raise _BadRecordError(f"objects[{index}]: {error}") from error
    return DetectionList(sensor, stamp_ns, receipt_ns, tuple(detections), frame)


def _detection(item: object, unknown: Counter[str]) -> Detection:
    if not isinstance(item, dict):
        raise _BadRecordError(f"a JSON object expected, not {item!r}")
    if not item.keys() <= _DETECTION_KEYS:
        unknown.update(f"objects.{key}" for key in item.keys() - _DETECTION_KEYS)
    measured = {name: _number(item, name) for name in MEASURABLE if item.get(name) is not None}
    return Detection(
        **measured,
        covariance=_covariance(item["covariance"], len(measured)) if item.get("covariance") is not None else None,
        stamp_ns=_integer(item, "stamp_ns") if item.get("stamp_ns") is not None else None,
        object_id=_integer(item, "object_id") if item.get("object_id") is not None else None,
    )


def _covariance(values: object, size: int) -> tuple[float, ...]:
    if not isinstance(values, list) or len(values) != size * size:
        raise _BadRecordError(f"covariance: a list of {size} x {size} numbers expected")
    return tuple(_float("covariance", value) for value in values)


def _required(record: Record, name: str) -> object:
    if name not in record:
        raise _BadRecordError(f"{name}: is missing")
    return record[name]


def _integer(record: Record, name: str) -> int:
    value = _required(record, name)
    if type(value) is not int or not -_INT64_LIMIT <= value < _INT64_LIMIT:
        raise _BadRecordError(f"{name}: a 64 bit integer expected, not {value!r}")
    return value


def _number(record: Record, name: str) -> float:
    return _float(name, _required(record, name))


def _float(name: str, value: object) -> float:
    if type(value) is float:
        return value
    if type(value) is not int:
        raise _BadRecordError(f"{name}: a number expected, not {value!r}")
    try:
        return float(value)
    except OverflowError as error:
        raise _BadRecordError(f"{name}: {str(value)[:20]}... is too large for a number") from error
