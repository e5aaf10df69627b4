"""The stream format `fgtrack-stream/1`: messages as JSON lines, plain or gzipped, in receipt order."""

import gzip
import json
import logging
import zlib
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import MISSING, fields
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

from fgtrack.core.errors import DataError
from fgtrack.core.files import open_file
from fgtrack.core.types import (
    Detection,
    DetectionList,
    EgoState,
    Message,
    TruthState,
)
from fgtrack.io.config import InputConfig
from fgtrack.io.errors import TruncatedInput, UntilBreak
from fgtrack.io.output import new_file
from fgtrack.io.source import FileFormat
from fgtrack.io.validation import InvalidMessageError, validated_message

STREAM_FORMAT = "fgtrack-stream/1"
SETTINGS = "settings"
"""Entry of the header record with what the recording carries of a configuration."""
GZIP_MAGIC = b"\x1f\x8b"

_logger = logging.getLogger(__name__)
_KINDS: dict[str, type[Message]] = {"ego": EgoState, "detections": DetectionList, "truth": TruthState}

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
            except InvalidMessageError as error:
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
    return partial(read_stream, path)


def _settings(path: Path) -> Mapping[str, object]:
    """Settings in the header."""
    found = read_header(path).get(SETTINGS)
    return found if isinstance(found, dict) else {}


FORMAT = FileFormat("an fgtrack stream (.jsonl, .jsonl.gz)", _recognises, _open, _settings, validates=True)


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
        Entries of the header record besides `type` and `format`.
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
    with new_file(path, overwrite) as file, _packed(file, path.name.endswith(".gz")) as lines:
        lines.write(_line({"type": "header", "format": STREAM_FORMAT, **(header or {})}))
        readable = UntilBreak(messages)
        for message in readable:
            lines.write(_line(_record(message)))
            count += 1
        readable.raise_before_replacing(path)
    readable.raise_error()
    return count


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


def _record(message: Message) -> Record:
    if isinstance(message, DetectionList):
        times = {"stamp_ns": message.stamp_ns, "receipt_ns": message.receipt_ns}
        objects = [_given(item) for item in message.objects]
        return {"type": "detections", "sensor": message.sensor, **times, "frame": message.frame, "objects": objects}
    return {"type": "ego" if isinstance(message, EgoState) else "truth", **_given(message)}


def _given(value: EgoState | TruthState | Detection) -> Record:
    given = {name: field for name in _FIELDS[type(value)] if (field := getattr(value, name)) is not None}
    if given.get("ignored") is False:
        del given["ignored"]
    return given


def _records(path: Path) -> Generator[tuple[int, Record], None, None]:
    """Line number and JSON object of every line that is not blank."""
    line, num_records = 0, 0
    try:
        with open_file(path) as raw:
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


def _message(record: Record, unknown: Counter[str]) -> Message:
    name = record.get("type")
    kind = _KINDS.get(name) if isinstance(name, str) else None
    if kind is None:
        raise InvalidMessageError(f"unknown record type {name!r}, known are {', '.join(_KINDS)}")
    values = _values(str(name), kind, record, unknown)
    if kind is DetectionList:
        values["objects"] = [_detection(index, item, unknown) for index, item in enumerate(values["objects"])]
    return validated_message(kind(**values))


def _detection(index: int, item: object, unknown: Counter[str]) -> Detection:
    if not isinstance(item, dict):
        raise InvalidMessageError(f"objects[{index}]: a JSON object expected, not {item!r}")
    return Detection(**_values("objects", Detection, item, unknown))


def _values(name: str, kind: type, record: Record, unknown: Counter[str]) -> Record:
    """Values of the fields of `kind` in `record`; null is not given. Unknown keys are counted."""
    given = {key: value for key, value in record.items() if value is not None and key != "type"}
    known = _FIELDS[kind]
    if given.keys() - known.keys():
        unknown.update(f"{name}.{key}" for key in given.keys() - known.keys())
    values = {}
    for key, is_needed in known.items():
        if key in given:
            value = given[key]
            is_list = isinstance(value, list)
            if is_list != (key in _LISTS):
                raise InvalidMessageError(
                    f"{key}: {'no list' if is_list else 'a list'} expected, not {str(value)[:60]}"
                )
            values[key] = tuple(map(_plain_number, value)) if is_list else value
            if key not in _INTEGERS:
                values[key] = _plain_number(values[key])
        elif is_needed:
            raise InvalidMessageError(f"{key}: is missing")
    return values


def _plain_number(value: Any) -> Any:
    """A float where `value` is an integer that can be one."""
    return float(value) if type(value) is int and value.bit_length() < 1000 else value


_INTEGERS = frozenset({"stamp_ns", "receipt_ns", "object_id"})
_LISTS = frozenset({"objects", "covariance", "outline_m"})
#: Names of the fields of messages and detections, and if they have to be given.
_FIELDS: dict[type, dict[str, bool]] = {
    kind: {field.name: field.default is MISSING for field in fields(kind) if field.name != "left_out"}
    for kind in (EgoState, DetectionList, TruthState, Detection)
}
