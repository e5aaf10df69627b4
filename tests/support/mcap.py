"""MCAP files made by hand, byte by byte, as no writer would make them."""

import struct

import zstandard

from fgtrack.inputs.ros.mcap_file import MCAP_MAGIC

SEPARATOR = "=" * 80 + "\n"


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


def schema(number: int, name: str, definition: str, encoding: str = "ros2msg") -> bytes:
    return record(
        0x03, struct.pack("<H", number) + text(name) + text(encoding) + text(definition)
    )


def channel(number: int, schema_number: int, topic: str) -> bytes:
    return record(
        0x04,
        struct.pack("<HH", number, schema_number)
        + text(topic)
        + text("cdr")
        + text(""),
    )


def message(number: int, log_ns: int, data: bytes) -> bytes:
    return record(0x05, struct.pack("<HIQQ", number, 0, log_ns, log_ns) + data)


def chunk(records: bytes, first_ns: int, last_ns: int) -> bytes:
    packed = zstandard.compress(records)
    head = struct.pack("<QQQI", first_ns, last_ns, len(records), 0)
    return record(0x06, head + text("zstd") + struct.pack("<Q", len(packed)) + packed)


HEADER = MCAP_MAGIC + record(0x01, text("ros2") + text(""))
END = record(0x0F, bytes(4)) + record(0x02, bytes(20)) + MCAP_MAGIC
CDR = b"\0\1\0\0"


def mcap_of_type(
    definition: str, encoding: str = "ros2msg", data: bytes = bytes(8)
) -> bytes:
    """A file with one message on `/x`, of the type `a/msg/B` of this definition."""
    return (
        HEADER
        + schema(1, "a/msg/B", definition, encoding)
        + channel(1, 1, "/x")
        + message(1, 10, CDR + data)
        + END
    )


def poses(count: int) -> bytes:
    """A `geometry_msgs/PoseArray` of so many poses that are all 0."""
    start = CDR + struct.pack("<iII", 1, 0, 1) + b"\0"
    start += bytes(-len(start) % 4) + struct.pack("<I", count)
    return start + bytes((len(CDR) - len(start)) % 8) + bytes(56 * count)
