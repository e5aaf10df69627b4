"""Corrupts files: bytes anywhere, and values where the format holds some."""

import gzip
import io
import json
import math
import re
import struct
from collections.abc import Callable
from typing import Any

import numpy as np

from fuzz import values

#: What numbers and texts are replaced by.
ODD: tuple[Any, ...] = (
    *(
        0,
        -1,
        1,
        3,
        10**6,
        10**18,
        -(2**31) - 1,
        2**63 - 1,
        2**63,
        10**30,
        0.0,
        -0.0,
        0.5,
        1e-300,
        1e-9,
        1e9,
        -1e19,
    ),
    *(
        1e200,
        -1e308,
        math.nan,
        math.inf,
        -math.inf,
        None,
        True,
        "",
        "x",
        "1",
        "nan",
        "[bold]",
        "\x1b[31m",
    ),
    *(
        "\u202eabc",
        "ä",
        "\x00",
        "x" * 5000,
        "a.b.c",
        "../x",
        [],
        {},
        [[]],
        [0],
        {"x": 0},
        [None, None],
    ),
)
_NUMBER = rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?"
_FACTORS = (0.0, -1.0, 1e-12, 1e-9, 1e-3, 1.0, 2.0, 57.3, 1e3, 1e6, 1e9, 1e20)
Mutation = Callable[[np.random.Generator, bytes], bytes]


def mutated(rng: np.random.Generator, name: str, content: bytes) -> bytes:
    """`content` of the file `name` with one to four things corrupted."""
    for _ in range(int(rng.integers(1, 5))):
        known = next(
            (ways for suffix, ways in _BY_SUFFIX.items() if name.endswith(suffix)),
            (_number, _lines),
        )
        ways = [_bytes, _bytes, *known]
        try:
            content = ways[rng.integers(len(ways))](rng, content)
        except (
            Exception
        ):  # of the libraries that read what an earlier mutation has left
            content = _bytes(rng, content)
    return content


def _bytes(rng: np.random.Generator, content: bytes) -> bytes:
    """Bits turned, a part cut out, doubled, zeroed or replaced by noise, or the end cut off."""
    if not content:
        return bytes(rng.integers(0, 256, 20, dtype=np.uint8))
    place, length = int(rng.integers(len(content))), int(2 ** rng.uniform(0, 12))
    head, part, tail = (
        content[:place],
        content[place : place + length],
        content[place + length :],
    )
    noise = bytes(rng.integers(0, 256, len(part), dtype=np.uint8))
    flipped = bytes([part[0] ^ 1 << int(rng.integers(8))]) + part[1:]
    middle = (b"", part + part, bytes(len(part)), noise, flipped)
    choice = int(rng.integers(len(middle) + 1))
    return head if choice == len(middle) else head + middle[choice] + tail


def _packed(rng: np.random.Generator, content: bytes) -> bytes:
    """A number of four or eight bytes overwritten by something odd."""
    form, values = (
        ("<d", (0.0, -1.0, 1e-300, 1e19, 1e308, math.nan, math.inf)),
        ("<f", (0.0, -1.0, 1e19, 3e38, math.nan, math.inf)),
        ("<q", (0, -1, 1, 100_000, 2**62, 2**63 - 1, -(2**63))),
        ("<i", (0, -1, 1, 100_000, 2**30, 2**31 - 1, -(2**31))),
    )[rng.integers(4)]
    new, place = (
        struct.pack(form, values[rng.integers(len(values))]),
        4 * int(rng.integers(len(content) // 4 + 1)),
    )
    return (content[:place] + new + content[place + len(new) :])[: len(content)]


def _number(rng: np.random.Generator, content: bytes) -> bytes:
    """A number somewhere in a text replaced by something odd."""
    found = list(re.finditer(_NUMBER, content))
    one = found[rng.integers(len(found))]
    return (
        content[: one.start()]
        + str(_odd(rng)).encode("utf-8", "replace")
        + content[one.end() :]
    )


def _field(rng: np.random.Generator, content: bytes) -> bytes:
    """All numbers behind one name scaled, moved, noisy or replaced by one thing that is odd."""
    names = sorted(set(re.findall(rb'(\w+)"?: *(?=-?\d)', content)))
    name = names[rng.integers(len(names))]
    factor, size = (
        float(rng.choice(_FACTORS)),
        10.0 ** float(rng.uniform(-9.0, 19.0)) * float(rng.integers(2)),
    )
    odd, is_noisy = None if rng.integers(4) else str(_odd(rng)), bool(rng.integers(2))

    def change(match: re.Match[bytes]) -> bytes:
        value = float(match[2]) * factor + size * (
            rng.standard_normal() if is_noisy else 1.0
        )
        is_whole = match[2].lstrip(b"-").isdigit() and math.isfinite(value)
        return match[1] + (odd or str(round(value) if is_whole else value)).encode(
            "utf-8", "replace"
        )

    return re.sub(rb'(\b%s"?: *)(%s)' % (name, _NUMBER), change, content)


def _lines(rng: np.random.Generator, content: bytes) -> bytes:
    """Lines left out, doubled, exchanged or moved."""
    lines = content.splitlines(keepends=True)
    one, other = sorted(rng.integers(len(lines), size=2).tolist())
    changed = (lines[:one], [lines[one]] * 2, [lines[other]], lines[one:other][::-1])[
        rng.integers(4)
    ]
    return b"".join(lines[:one] + changed + lines[other:])


def _columns(rng: np.random.Generator, content: bytes) -> bytes:
    """A cell replaced, or a cell too few or too many."""
    mark = b";" if b";" in content[:200] else b"\t" if b"\t" in content[:200] else b","
    lines = content.splitlines(keepends=True)
    row = int(rng.integers(len(lines)))
    cells = lines[row].split(mark)
    cells[rng.integers(len(cells))] = (
        b"",
        b"1" + mark + b"1",
        str(_odd(rng)).encode(),
    )[rng.integers(3)]
    lines[row] = mark.join(cells)
    return b"".join(lines)


def _json(rng: np.random.Generator, content: bytes) -> bytes:
    """A value anywhere in a document of JSON, or in one of its lines."""
    lines = (
        [content]
        if content[:1] not in b"{[" or b"\n{" not in content
        else content.splitlines()
    )
    place = int(rng.integers(len(lines)))
    document = {"": json.loads(lines[place])}
    values.change(rng, document)
    lines[place] = json.dumps(document.get("")).encode()
    return b"\n".join(lines) + b"\n"


def _yaml(rng: np.random.Generator, content: bytes) -> bytes:
    from ruamel.yaml import YAML  # slow

    text, document = io.StringIO(), YAML(typ="safe", pure=True).load(content)
    values.change(rng, document)
    YAML(typ="safe", pure=True).dump(document, text)
    return text.getvalue().encode("utf-8", "replace")


def _gzip(rng: np.random.Generator, content: bytes) -> bytes:
    return gzip.compress(mutated(rng, "inner.jsonl", gzip.decompress(content)), mtime=0)


def _mcap(rng: np.random.Generator, content: bytes) -> bytes:
    """The bytes or time of a message corrupted, in a file whose checksums are right."""
    from mcap.reader import make_reader  # slow
    from mcap.writer import CompressionType, Writer

    found = list(make_reader(io.BytesIO(content)).iter_messages(log_time_order=False))
    out, chosen = io.BytesIO(), int(rng.integers(len(found)))
    writer = Writer(
        out, chunk_size=int(rng.choice([100, 10_000])), compression=CompressionType.ZSTD
    )
    writer.start(profile="ros2", library="")
    channels: dict[int, int] = {}
    for place, (schema, channel, message) in enumerate(found):
        if channel.id not in channels:
            data = _bytes(rng, schema.data) if not rng.integers(20) else schema.data
            number = writer.register_schema(schema.name, schema.encoding, data)
            channels[channel.id] = writer.register_channel(
                channel.topic, channel.message_encoding, number
            )
        data, log_ns = message.data, message.log_time
        if place == chosen:
            data = (_packed if rng.integers(2) else _bytes)(rng, data)
            log_ns = int(rng.choice([log_ns, 0, 2**63 - 1, log_ns + 10**10]))
        writer.add_message(
            channels[channel.id], log_ns, data, message.publish_time, message.sequence
        )
    writer.finish()
    return out.getvalue()


def _odd(rng: np.random.Generator) -> Any:
    return ODD[rng.integers(len(ODD))]


_BY_SUFFIX: dict[str, tuple[Mutation, ...]] = {
    ".jsonl": (_json, _json, _json, _field, _field, _number, _lines),
    ".json": (_json, _json, _json, _field, _number),
    ".yaml": (_yaml, _yaml, _yaml, _number, _lines),
    ".csv": (_columns, _columns, _columns, _number, _lines),
    ".tsv": (_columns, _columns, _columns, _number, _lines),
    ".gz": (_gzip, _gzip, _gzip),
    ".mcap": (_mcap, _mcap, _mcap),
    ".bag": (_packed, _packed),
    ".db3": (_packed, _packed),
}
