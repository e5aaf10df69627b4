"""Spoils files: bytes anywhere, and values where the format says that there are some."""

import csv
import gzip
import io
import json
import math
import re
import sqlite3
import struct
import sys
import tempfile
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

#: What numbers, texts and places are replaced by.
ODD: tuple[Any, ...] = (
    *(0, -1, 1, 3, 10**6, 10**18, 2**31, -(2**31) - 1, 2**63 - 1, 2**63, -(2**63) - 1, 10**30, -(10**30)),
    *(0.0, -0.0, 0.5, 1e-300, 1e-9, 1e9, -1e9, 1e19, 1e200, -1e308, float("nan"), float("inf"), float("-inf")),
    *(
        None,
        True,
        False,
        "",
        "x",
        "1",
        "nan",
        "[bold]",
        "\x1b[31m",
        "\u202eabc",
        "ä",
        "\x00",
        "x" * 5000,
        "a.b.c",
        "../x",
    ),
    *([], {}, [[]], [0], {"x": 0}, [None, None]),
)
_NUMBER = re.compile(rb"-?\d+(\.\d+)?([eE][-+]?\d+)?")
_FACTORS = (0.0, -1.0, 1e-12, 1e-9, 1e-3, 0.1, 2.0, 57.3, 1e3, 1e6, 1e9, 1e20)
Mutation = Callable[[np.random.Generator, bytes], bytes]


def mutated(rng: np.random.Generator, name: str, content: bytes) -> bytes:
    """`content` of the file `name` with one to four things spoilt."""
    for _ in range(int(rng.integers(1, 5))):
        text = (_numbers_in_text, _lines)
        known = next((ways for suffix, ways in _BY_SUFFIX.items() if name.endswith(suffix)), text)
        ways = [_bytes, _bytes, *known]
        try:
            content = ways[rng.integers(len(ways))](rng, content)
        except Exception:  # of the libraries that read what an earlier mutation has left
            content = _bytes(rng, content)
    return content


def _bytes(rng: np.random.Generator, content: bytes) -> bytes:
    """Bits turned, a part cut out, doubled, zeroed or replaced by noise, or the end cut off."""
    if not content:
        return bytes(rng.integers(0, 256, 20, dtype=np.uint8))
    place, length = int(rng.integers(len(content))), int(2 ** rng.uniform(0, 12))
    head, part, tail = content[:place], content[place : place + length], content[place + length :]
    match rng.integers(6):
        case 0:
            changed = bytearray(content)
            for at in rng.integers(len(content), size=int(rng.integers(1, 8))):
                changed[at] ^= 1 << int(rng.integers(8))
            return bytes(changed)
        case 1:
            return head + tail
        case 2:
            return head + part + part + tail
        case 3:
            return head + bytes(len(part)) + tail
        case 4:
            return head + bytes(rng.integers(0, 256, len(part), dtype=np.uint8)) + tail
    return head


def _packed(rng: np.random.Generator, content: bytes) -> bytes:
    """A number of four or eight bytes overwritten by something odd."""
    form = str(rng.choice(["<d", "<d", "<f", "<q", "<i"]))
    value = rng.choice([0.0, -1.0, 1e-300, 1e19, 1e308, math.nan, math.inf, -math.inf]).item()
    if form in ("<q", "<i"):
        most = 2 ** (8 * struct.calcsize(form) - 1)
        value = [0, -1, 1, 100_000, most // 2, most - 1, -most][rng.integers(7)]
    elif form == "<f":
        value = np.float32(min(max(value, -3e38), 3e38)).item()
    new, place = struct.pack(form, value), 4 * int(rng.integers(len(content) // 4 + 1))
    return (content[:place] + new + content[place + len(new) :])[: len(content)]


def _numbers_in_text(rng: np.random.Generator, content: bytes) -> bytes:
    """A number somewhere in a text replaced by something odd."""
    found = list(_NUMBER.finditer(content))
    one = found[rng.integers(len(found))]
    return content[: one.start()] + str(_odd(rng)).encode("utf-8", "replace") + content[one.end() :]


def _lines(rng: np.random.Generator, content: bytes) -> bytes:
    """Lines left out, doubled, exchanged or moved."""
    lines = content.splitlines(keepends=True)
    one, other = rng.integers(len(lines), size=2)
    match rng.integers(4):
        case 0:
            del lines[one]
        case 1:
            lines.insert(other, lines[one])
        case 2:
            lines[one], lines[other] = lines[other], lines[one]
        case 3:
            lines[min(one, other) : max(one, other)] = lines[min(one, other) : max(one, other)][::-1]
    return b"".join(lines)


def _json_line(rng: np.random.Generator, content: bytes) -> bytes:
    lines = content.splitlines()
    place = int(rng.integers(len(lines)))
    lines[place] = _json(rng, lines[place])
    return b"\n".join(lines) + b"\n"


def _json(rng: np.random.Generator, content: bytes) -> bytes:
    return json.dumps(_spoilt(rng, json.loads(content)), ensure_ascii=bool(rng.integers(2))).encode("utf-8", "replace")


def _yaml(rng: np.random.Generator, content: bytes) -> bytes:
    from ruamel.yaml import YAML  # slow

    text = io.StringIO()
    YAML(typ="safe", pure=True).dump(_spoilt(rng, YAML(typ="safe", pure=True).load(content)), text)
    return text.getvalue().encode("utf-8", "replace")


def _csv(rng: np.random.Generator, content: bytes) -> bytes:
    """A cell replaced, a cell too few or too many."""
    text = content.decode()
    mark = ";" if ";" in text[:200] else ","
    rows = list(csv.reader(io.StringIO(text), delimiter=mark))
    row = rows[rng.integers(len(rows))]
    match rng.integers(6):
        case 0:
            row.pop(int(rng.integers(len(row))))
        case 1:
            row.append("1")
        case _:
            row[int(rng.integers(len(row)))] = str(_odd(rng))
    out = io.StringIO()
    csv.writer(out, delimiter=mark, lineterminator="\n").writerows(rows)
    return out.getvalue().encode("utf-8", "replace")


def _everywhere(rng: np.random.Generator, content: bytes) -> bytes:
    """The numbers of a field changed in all lines, or in those of one sensor or object, in one way."""
    lines = [json.loads(line) for line in content.splitlines()]
    fields: dict[tuple[Any, ...], list[tuple[Any, Any]]] = {}
    for line in lines:
        _numbers(line, (line.get("type"), line.get("sensor"), line.get("object_id")), fields)
    _change_all(rng, list(fields.values()))
    return "\n".join(json.dumps(line) for line in lines).encode() + b"\n"


def _json_everywhere(rng: np.random.Generator, content: bytes) -> bytes:
    value = json.loads(content)
    fields: dict[tuple[Any, ...], list[tuple[Any, Any]]] = {}
    _numbers(value, (), fields)
    _change_all(rng, list(fields.values()))
    return json.dumps(value).encode()


def _column(rng: np.random.Generator, content: bytes) -> bytes:
    """The numbers of a column changed in all rows in one way."""
    text = content.decode()
    mark = ";" if ";" in text[:200] else "," if "," in text[:200] else " "
    rows = list(csv.reader(io.StringIO(text), delimiter=mark))
    columns: dict[int, list[tuple[Any, Any]]] = {}
    for row in rows:
        for place, cell in enumerate(row):
            if _NUMBER.fullmatch(cell.encode()):
                row[place] = float(cell) if "." in cell or "e" in cell else int(cell)
                columns.setdefault(place, []).append((row, place))
    _change_all(rng, list(columns.values()))
    out = io.StringIO()
    csv.writer(out, delimiter=mark, lineterminator="\n").writerows(rows)
    return out.getvalue().encode()


def _numbers(value: Any, path: tuple[Any, ...], fields: dict[tuple[Any, ...], list[tuple[Any, Any]]]) -> None:
    """Put where numbers stand inside `value` into `fields`, by the keys that lead there; places of lists are one."""
    for key in _keys(value):
        inner = value[key]
        below = (*path, key if isinstance(value, dict) and len(value) < 50 else None)
        if isinstance(inner, (int, float)) and not isinstance(inner, bool):
            fields.setdefault(below, []).append((value, key))
        else:
            _numbers(inner, below, fields)


def _change_all(rng: np.random.Generator, fields: list[list[tuple[Any, Any]]]) -> None:
    """Change the numbers at all places of one of `fields`: scaled, moved, noisy, exchanged, equal, odd."""
    places = fields[rng.integers(len(fields))]
    old = [inner[key] for inner, key in places]
    match rng.integers(8):
        case 0:
            new = [value * float(rng.choice(_FACTORS)) for value in old]
        case 1:
            move = float(rng.choice([-1.0, 1.0])) * 10.0 ** float(rng.uniform(-9.0, 20.0))
            new = [value + (round(move) if isinstance(value, int) else move) for value in old]
        case 2:
            size = 10.0 ** float(rng.uniform(-9.0, 12.0))
            noise = rng.normal(0.0, size, len(old)).tolist()
            new = [value + (round(e) if isinstance(value, int) else e) for value, e in zip(old, noise, strict=True)]
        case 3:
            new = [old[place] for place in rng.permutation(len(old)).tolist()]
        case 4:
            new = old[::-1]
        case 5:
            new = [old[rng.integers(len(old))]] * len(old)
        case 6:
            new = [_odd(rng)] * len(old)
        case _:
            others = [inner[key] for inner, key in fields[rng.integers(len(fields))]]
            new = [others[place % len(others)] for place in range(len(old))]
    for (inner, key), value in zip(places, new, strict=True):
        whole = isinstance(inner[key], int) and isinstance(value, float) and math.isfinite(value) and rng.integers(50)
        inner[key] = int(value) if whole else value


def _gzip(rng: np.random.Generator, content: bytes) -> bytes:
    return gzip.compress(mutated(rng, "inner.jsonl", gzip.decompress(content)), mtime=0)


def _zstd(rng: np.random.Generator, content: bytes, suffix: str) -> bytes:
    return zstd.compress(mutated(rng, f"inner{suffix}", zstd.decompress(content)))


def _message(rng: np.random.Generator, content: bytes) -> bytes:
    return (_packed if rng.integers(2) else _bytes)(rng, content)


def _sqlite(rng: np.random.Generator, content: bytes) -> bytes:
    """A cell of a table replaced, or the bytes of a message spoilt."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "x.db3"
        path.write_bytes(content)
        with closing(sqlite3.connect(path)) as base:
            tables = [row[0] for row in base.execute("select name from sqlite_master where type = 'table'")]
            table = str(rng.choice(tables))
            columns = [row[1] for row in base.execute(f"pragma table_info({table})")]
            rows = [row[0] for row in base.execute(f"select rowid from {table}")]
            column, row = str(rng.choice(columns)), int(rng.choice(rows))
            (old,) = base.execute(f"select {column} from {table} where rowid = ?", (row,)).fetchone()
            new = _message(rng, old) if isinstance(old, bytes) and rng.integers(4) else _odd(rng)
            if not isinstance(new, (int, float, str, bytes, type(None))) or (
                isinstance(new, int) and abs(new) >= 2**63
            ):
                new = str(new)
            base.execute(f"update {table} set {column} = ? where rowid = ?", (new, row))
            base.commit()
        return path.read_bytes()


def _mcap(rng: np.random.Generator, content: bytes) -> bytes:
    """The bytes, times or channel of a message spoilt, in a file whose checksums are right."""
    from mcap.reader import make_reader  # an extra
    from mcap.writer import CompressionType, Writer

    found = list(make_reader(io.BytesIO(content)).iter_messages(log_time_order=False))
    out = io.BytesIO()
    writer = Writer(out, chunk_size=int(rng.choice([100, 10_000, 10**6])), compression=CompressionType.ZSTD)
    writer.start(profile="ros2", library="")
    schemas: dict[int, int] = {}
    channels: dict[int, int] = {}
    chosen = int(rng.integers(len(found)))
    for place, (schema, channel, message) in enumerate(found):
        if schema.id not in schemas:
            data = _bytes(rng, schema.data) if not rng.integers(20) else schema.data
            schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, data)
        if channel.id not in channels:
            encoding = str(_odd(rng)) if not rng.integers(40) else channel.message_encoding
            channels[channel.id] = writer.register_channel(
                channel.topic, encoding, schemas[schema.id], dict(channel.metadata)
            )
        data, log_ns = message.data, message.log_time
        if place == chosen:
            data, log_ns = _message(rng, data), int(rng.choice([log_ns, 0, 2**63 - 1, log_ns + 10**10]))
        writer.add_message(channels[channel.id], log_ns, data, message.publish_time, message.sequence)
    writer.finish()
    return out.getvalue()


def _odd(rng: np.random.Generator) -> Any:
    return ODD[rng.integers(len(ODD))]


def _spoilt(rng: np.random.Generator, value: Any) -> Any:
    """A value inside `value` replaced by something odd, left out, doubled or renamed; `value` is changed."""
    places = [(value, key) for key in _keys(value)]
    for inner, key in places:  # grows
        places += [(inner[key], below) for below in _keys(inner[key])]
    if not places:
        return _odd(rng)
    inner, key = places[rng.integers(len(places))]
    match rng.integers(8):
        case 0:
            del inner[key]
        case 1 if isinstance(inner, list):
            inner.insert(key, inner[key])
        case 1:
            inner[str(_odd(rng))] = inner[key]
        case 2:
            inner[key] = [inner[key]]
        case _:
            inner[key] = _odd(rng)
    return value


def _keys(value: Any) -> list[Any]:
    return list(value) if isinstance(value, dict) else list(range(len(value))) if isinstance(value, list) else []


_BY_SUFFIX: dict[str, tuple[Mutation, ...]] = {
    ".jsonl": (_json_line, _json_line, _json_line, _everywhere, _everywhere, _numbers_in_text, _lines),
    ".json": (_json, _json, _json, _json_everywhere, _numbers_in_text),
    ".yaml": (_yaml, _yaml, _yaml, _yaml, _numbers_in_text, _lines),
    ".csv": (_csv, _csv, _csv, _column, _column, _numbers_in_text, _lines),
    ".txt": (_numbers_in_text, _numbers_in_text, _column, _lines),
    ".gz": (_gzip, _gzip, _gzip),
    ".db3": (_sqlite, _sqlite, _sqlite),
    ".mcap": (_mcap, _mcap, _mcap),
    ".bag": (_packed, _packed),
    ".mcap.zstd": (partial(_zstd, suffix=".mcap"),) * 3,
    ".db3.zstd": (partial(_zstd, suffix=".db3"),) * 3,
}
