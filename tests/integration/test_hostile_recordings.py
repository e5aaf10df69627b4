"""Small recordings made to fill memory or time: each command stays below --max-memory and 20 s of processor."""

import struct
from collections.abc import Callable
from pathlib import Path

import pytest
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from support.mcap import (
    CDR,
    END,
    HEADER,
    SEPARATOR,
    channel,
    chunk,
    mcap_of_type,
    message,
    poses,
    schema,
)
from support.messages import drive
from support.server import Server

from fgtrack.inputs.ros.bag_writer import write_bag

pytestmark = pytest.mark.slow

MOST_MB, LONGEST_S = 4096.0, 20.0
_SENSOR = ("--set", "sensors={s: {std: {x_m: 1.0, y_m: 1.0}}}", "-o", "run")


def replay(name: str, topic: str) -> tuple[str, ...]:
    return (
        "replay",
        name,
        "--set",
        f"input={{detections: {{s: {{topic: /x{topic}}}}}}}",
        *_SENSOR,
    )


INFO = ("info", "x.mcap")
REPLAY = replay("x.mcap", ", fields: {x_m: x, y_m: x}")
OBJECTS = ", fields: {objects: objects, x_m: x, y_m: x}"
KNOWN = replay("x.mcap", "")


def idl(constants: str) -> bytes:
    return mcap_of_type(
        f"module a {{ module msg {{ {constants} struct B {{ int32 x; }}; }}; }};",
        "ros2idl",
    )


def nested(depth: int, line: str, last: str = "uint8[0] x\n") -> bytes:
    """`a/B` of `line` with the type `a/T0`, which is of it with `a/T1` ..."""
    parts = [line.replace("T", "a/T0")]
    parts += [f"MSG: a/T{k}\n{line.replace('T', f'a/T{k + 1}')}" for k in range(depth)]
    return mcap_of_type(SEPARATOR.join([*parts, f"MSG: a/T{depth}\n{last}"]))


def pose_array(count: int) -> bytes:
    body = (
        schema(1, "geometry_msgs/msg/PoseArray", "", "")
        + channel(1, 1, "/x")
        + message(1, 10, poses(count))
    )
    return HEADER + chunk(body, 10, 10) + END


def of_sequence(definition: str, data: bytes) -> bytes:
    body = (
        schema(1, "a/msg/B", definition)
        + channel(1, 1, "/x")
        + message(1, 10, CDR + data)
    )
    return HEADER + chunk(body, 10, 10) + END


_SQUARES = "const int64 A0 = 1 << 62;" + "".join(
    f"const int64 A{k + 1} = A{k} * A{k};" for k in range(26)
)
HOSTILE: dict[str, tuple[Callable[[], bytes], tuple[str, ...], str]] = {
    "idl, squares of squares": (lambda: idl(_SQUARES), INFO, "computes a constant"),
    "idl, sequences of sequences": (
        lambda: idl(f"struct C {{ {'sequence<' * 30}long{'>' * 30} x; }};"),
        INFO,
        "nests sequences",
    ),
    "idl, open comments": (
        lambda: idl("/*" * 400_000),
        INFO,
        "more than 200000 characters",
    ),
    "msg, an array of texts": (
        lambda: mcap_of_type("string[50000] x\n"),
        REPLAY,
        "more than 4000 values",
    ),
    "msg, two of two of two": (
        lambda: nested(30, "T x\nT y\n", "uint8 x\n"),
        REPLAY,
        "more than 4000 values",
    ),
    "msg, in itself": (lambda: mcap_of_type("a/B x\n"), REPLAY, "contains itself"),
    "msg, a list of nothing": (
        lambda: of_sequence(f"a/E[] x\n{SEPARATOR}MSG: a/E\nuint8[0] y\n", b"\xff" * 4),
        REPLAY,
        "elements are empty",
    ),
    "a list of 2 million poses": (
        lambda: pose_array(2_200_000),
        KNOWN,
        "at most 32000000 are decoded",
    ),
    "a list of 400,000 poses": (
        lambda: pose_array(400_000),
        KNOWN,
        "at most 100000 are read",
    ),
}


def read_in_little(
    server: Server, folder: Path, words: tuple[str, ...], said: str
) -> None:
    done = server(words, folder, kill_after_s=120.0)
    assert done.peak_mb < MOST_MB
    assert done.cpu_s < LONGEST_S
    assert done.code in (0, 1)
    assert "internal error" not in done.said
    assert said in " ".join(done.said.split())


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_mcap_file(server: Server, tmp_path: Path, name: str) -> None:
    make, words, said = HOSTILE[name]
    (tmp_path / "x.mcap").write_bytes(make())
    read_in_little(server, tmp_path, words, said)


def test_a_ros1_list_of_what_has_no_bytes(server: Server, tmp_path: Path) -> None:
    definition = f"a/E[] objects\n{SEPARATOR}MSG: a/E\n"
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(definition, "a/msg/B"))
    with Rosbag1Writer(tmp_path / "x.bag") as writer:
        topic = writer.add_connection(
            "/x", "a/msg/B", msgdef=definition, md5sum="0" * 32
        )
        writer.write(topic, 10**9, struct.pack("<I", 2**32 - 1))
    read_in_little(server, tmp_path, replay("x.bag", OBJECTS), "elements are empty")


_ALIASES = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]\n" for k in range(1, 9)
)
METADATA: dict[str, tuple[Callable[[str], str], str]] = {
    "aliases of aliases": (lambda text: _ALIASES + text, "more than 25 aliases"),
    "brackets": (lambda text: f"{text}x: {'[' * 99_000}", "nested too deeply"),
    "two megabytes": (
        lambda text: f"{text}x: {'a' * 2_000_000}",
        "is larger than 1 MB",
    ),
    "a file twice": (
        lambda text: text.replace("- bag.mcap\n", "- bag.mcap\n  - bag.mcap\n"),
        "have the same content",
    ),
}


@pytest.mark.parametrize("name", METADATA)
def test_a_hostile_metadata_file(server: Server, tmp_path: Path, name: str) -> None:
    write_bag(tmp_path / "bag", drive())
    file, (change, said) = tmp_path / "bag/metadata.yaml", METADATA[name]
    before = file.read_text()
    file.write_text(change(before))
    assert file.read_text() != before
    read_in_little(server, tmp_path, ("info", "bag"), said)
