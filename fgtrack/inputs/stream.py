"""The stream format `fgtrack-stream/1`: messages as JSON lines in receipt order, plain or gzipped."""

import gzip
import json
import logging
import zlib
from collections import Counter
from collections.abc import Generator, Iterable, Iterator, Mapping
from contextlib import ExitStack, closing
from dataclasses import MISSING, fields
from functools import partial
from operator import methodcaller
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

from fgtrack.core.errors import DataError
from fgtrack.core.files import GZIP_MAGIC, open_file
from fgtrack.core.output import new_file
from fgtrack.core.types import Detection, DetectionList, EgoState, Message, TruthState
from fgtrack.inputs.errors import TruncatedInput, UntilBreak
from fgtrack.inputs.geodetic import GEODETIC, LocalPlane
from fgtrack.inputs.source import FileFormat
from fgtrack.inputs.validation import InvalidMessageError, validated_message

STREAM_FORMAT = "fgtrack-stream/1"
SETTINGS = "settings"
"""Entry of the header record with the configuration keys and values that the recording carries."""
PACKED_TABLES = (".csv.gz", ".tsv.gz", ".txt.gz")
_logger = logging.getLogger(__name__)
_KINDS: dict[str, type[Message]] = {
    "ego": EgoState,
    "detections": DetectionList,
    "truth": TruthState,
}
_Made = TypeVar("_Made")
Record = dict[str, Any]
"""A parsed JSON object; its values are checked one by one below."""


def read_stream(path: Path | str, plane: LocalPlane | None = None) -> Iterator[Message]:
    """Yield the messages of the stream `path`, plain or gzipped, in the order of the file, which is receipt order.

    Latitudes and longitudes are converted into positions in `plane`. By default the first
    position is the origin of the plane. Unknown keys are ignored with one warning.

    Raises `TruncatedInput` after the messages before a break, and `DataError` for other faults.
    """
    path = Path(path)
    plane = plane or LocalPlane()
    unknown: Counter[str] = Counter()
    with closing(_records(path)) as records:
        next(records)
        for line, record in records:
            try:
                yield _message(_in_plane(record, plane), unknown)
            except InvalidMessageError as error:
                raise DataError(f"{path}:{line}: {error}") from error
    if unknown:
        names = ", ".join(
            f"{name} ({count})" for name, count in sorted(unknown.items())
        )
        _logger.warning("%s: ignored unknown keys: %s", path, names)


def _recognises(path: Path) -> bool:
    if not path.is_file():
        return False
    with path.open("rb") as file:
        start = file.read(64)
    is_packed = start.startswith(GZIP_MAGIC) and not path.name.endswith(PACKED_TABLES)
    return is_packed or start.lstrip().startswith(b"{")


FORMAT = FileFormat(
    "an fgtrack stream (.jsonl, .jsonl.gz)",
    _recognises,
    lambda path, config: partial(read_stream, path, LocalPlane(config.origin)),
    lambda path: read_header(path).get(SETTINGS, {}),
    validates=True,
)


def read_header(path: Path | str) -> Mapping[str, Any]:
    """Return the header record of the stream `path`, with JSON values; raises `DataError` if it is missing."""
    with closing(_records(Path(path))) as records:
        return next(records)[1]


def read_truth_records(path: Path | str) -> Iterator[Record]:
    """Yield the parsed truth records of the stream `path`, without validation and in the order of the file.

    Raises the exceptions of `read_stream`. It is ten times as fast, because other
    records are not parsed.
    """
    with closing(_records(Path(path), b'"truth"')) as records:
        next(records)
        for _, record in records:
            if record.get("type") == "truth":
                yield record


def write_stream(
    path: Path | str,
    messages: Iterable[Message],
    header: Mapping[str, object] | None = None,
    overwrite: bool = False,
) -> int:
    """Write `messages`, which must be in receipt order, to `path` and return their number.

    The file is gzipped if `path` ends in `.gz`. Equal messages give equal bytes. The file gets its name when it is
    complete; a killed writer leaves a readable `<path>.*.part`. `header` contains further entries of the header record.

    Raises `TruncatedInput` if `messages` broke off. The messages before the break are written to a new file, but an
    existing file is not replaced.
    """
    path = Path(path)
    count = 0
    with ExitStack() as stack:
        lines: BinaryIO | gzip.GzipFile = stack.enter_context(new_file(path, overwrite))
        if path.name.endswith(".gz"):
            lines = stack.enter_context(
                gzip.GzipFile(filename="", mode="wb", fileobj=lines, mtime=0)
            )
        lines.write(
            _line({"type": "header", "format": STREAM_FORMAT, **(header or {})})
        )
        readable = UntilBreak(messages)
        for message in readable:
            lines.write(_line(_record(message)))
            count += 1
        # A truncated stream does not replace an existing one.
        if path.exists():
            readable.raise_error()
    readable.raise_error()
    return count


def _line(record: Mapping[str, object]) -> bytes:
    # `item` converts a NumPy scalar.
    return json.dumps(record, default=methodcaller("item")).encode() + b"\n"


def _record(message: Message) -> Record:
    if isinstance(message, DetectionList):
        times = {"stamp_ns": message.stamp_ns, "receipt_ns": message.receipt_ns}
        objects = [_given(item) for item in message.objects]
        origin = (
            {} if message.origin_deg is None else {"origin_deg": message.origin_deg}
        )
        head = {
            "type": "detections",
            "sensor": message.sensor,
            **times,
            "frame": message.frame,
            **origin,
        }
        return {**head, "objects": objects}
    return {
        "type": "ego" if isinstance(message, EgoState) else "truth",
        **_given(message),
    }


def _given(value: EgoState | TruthState | Detection) -> Record:
    given = {name: getattr(value, name) for name in _FIELDS[type(value)]}
    return {
        name: field
        for name, field in given.items()
        if field is not None and (name, field) != ("ignored", False)
    }


def _records(
    path: Path, text_part: bytes = b""
) -> Generator[tuple[int, Record], None, None]:
    """Yield line number and JSON object of each line that is not blank; the first object is the header.

    After the header, lines without `text_part` are skipped.

    Raises `TruncatedInput` or `DataError` after the records before the fault.
    """
    line = 0
    num_records = 0
    try:
        with open_file(path) as raw:
            packed = raw.read(2) == GZIP_MAGIC
            raw.seek(0)
            file: BinaryIO | gzip.GzipFile = (
                gzip.GzipFile(fileobj=raw) if packed else raw
            )
            for line, text in enumerate(file, 1):
                if not text.strip() or (num_records and text_part not in text):
                    continue
                try:
                    record = json.loads(text.decode())
                except (ValueError, RecursionError) as error:
                    if num_records and not text.endswith(b"\n"):
                        raise TruncatedInput(
                            f"{path}:{line}: breaks off in the middle of record {num_records + 1}, "
                            "only the records before it can be read"
                        ) from error
                    raise DataError(f"{path}:{line}: is not JSON ({error})") from error
                if not isinstance(record, dict):
                    raise DataError(f"{path}:{line}: is not a JSON object")
                if not num_records and (record.get("type"), record.get("format")) != (
                    "header",
                    STREAM_FORMAT,
                ):
                    break
                num_records += 1
                yield line, record
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise TruncatedInput(
            f"{path}:{line + 1}: breaks off after record {num_records} ({error}), only the records up to it can be read"
        ) from error
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error
    if not num_records:
        raise DataError(
            f"{path}: is not a stream: its first line is no header record of format {STREAM_FORMAT!r}"
        )


def _message(record: Record, unknown: Counter[str]) -> Message:
    name = record.pop("type", None)
    kind = _KINDS.get(str(name))
    if kind is None:
        raise InvalidMessageError(
            f"unknown record type {name!r}: there are {', '.join(_KINDS)}"
        )
    if kind is DetectionList:
        objects = record.get("objects")
        if not isinstance(objects, list):
            raise InvalidMessageError(f"objects: a list expected, not {objects!r:.60}")
        record["objects"] = tuple(
            _from_json("objects", Detection, item, unknown) for item in objects
        )
    return validated_message(_from_json(str(name), kind, record, unknown))


def _in_plane(record: Record, plane: LocalPlane) -> Record:
    """Return `record`, and each of its objects, with a position in `plane` instead of latitude and longitude.

    Raises `InvalidMessageError` if a latitude or longitude is not a number.
    """
    objects = record.get("objects")
    if isinstance(objects, list) and any(
        isinstance(item, dict) and GEODETIC[0] in item for item in objects
    ):
        objects = [
            _in_plane(item, plane) if isinstance(item, dict) else item
            for item in objects
        ]
        record = {
            "frame": "map",
            **record,
            "objects": objects,
            "origin_deg": plane.origin_deg,
        }
    if GEODETIC[0] not in record:
        return record
    for name in GEODETIC:
        if not isinstance(record.get(name), int | float | None):
            raise InvalidMessageError(
                f"{name}: a number expected, not {record[name]!a:.60}"
            )
    return plane.in_plane(record)


def _from_json(
    name: str, kind: type[_Made], record: object, unknown: Counter[str]
) -> _Made:
    """Return an instance of `kind` from the JSON object `record`.

    Null counts as missing. Unknown keys are ignored and counted in `unknown`.

    Raises `InvalidMessageError` for a record that is not an object, or lacks a field.
    """
    if not isinstance(record, dict):
        raise InvalidMessageError(f"{name}: a JSON object expected, not {record!r}")
    required = _FIELDS[kind]
    if not record.keys() <= required.keys():
        unknown.update(f"{name}.{key}" for key in record.keys() - required.keys())
    given = {
        key: value if type(value) is float else _value(key, value)  # the usual case
        for key, value in record.items()
        if value is not None and key in required
    }
    for key, is_needed in required.items():
        if is_needed and key not in given:
            raise InvalidMessageError(f"{key}: is missing")
    return kind(**given)


def _value(key: str, value: Any) -> Any:
    """Return `value` in the type of the field `key`: a list becomes a tuple, an integer in a real field becomes a
    float.

    An integer that no float can represent is returned unchanged.
    """
    if type(value) is list:
        return tuple(
            [each if type(each) is float else _value(key, each) for each in value]
        )
    return (
        float(value)
        if type(value) is int and key not in _INTEGERS and value.bit_length() < 1000
        else value
    )


_INTEGERS = frozenset({"stamp_ns", "receipt_ns", "object_id"})
#: For each message type the names of the fields, with True if the field is required.
_FIELDS: dict[type, dict[str, bool]] = {
    kind: {
        field.name: field.default is MISSING
        for field in fields(kind)
        if field.name != "left_out"
    }
    for kind in (EgoState, DetectionList, TruthState, Detection)
}
