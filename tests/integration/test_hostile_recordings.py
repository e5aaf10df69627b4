"""Small recordings made to fill memory or time, each read by a command in a process of its own: below 1 GB and 20 s."""

import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from faults.cases import Server
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from support.mcap import CDR, END, HEADER, SEPARATOR, channel, chunk, mcap_of_type, message, poses, schema
from support.messages import drive

from fgtrack.io.ros.bag_writer import write_bag

MOST_MB, LONGEST_S = 1000.0, 20.0
_SENSOR = ("--set", "sensors={s: {std: {x_m: 1.0, y_m: 1.0}}}", "-o", "run")


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    made = Server()
    yield made
    made.close()


def replay(name: str, topic: str) -> tuple[str, ...]:
    return ("replay", name, "--set", f"input={{detections: {{s: {{topic: /x{topic}}}}}}}", *_SENSOR)


INFO = ("info", "x.mcap")
REPLAY = replay("x.mcap", ", fields: {x_m: x, y_m: x}")
OBJECTS = ", fields: {objects: objects, x_m: x, y_m: x}"
LIST = replay("x.mcap", OBJECTS)
KNOWN = replay("x.mcap", "")


def idl(constants: str) -> bytes:
    return mcap_of_type(f"module a {{ module msg {{ {constants} struct B {{ int32 x; }}; }}; }};", "ros2idl")


def nested(depth: int, line: str, last: str = "uint8[0] x\n") -> bytes:
    """`a/B` of `line` with the type `a/T0`, which is of it with `a/T1` ..."""
    parts = [line.replace("T", "a/T0")]
    parts += [f"MSG: a/T{k}\n{line.replace('T', f'a/T{k + 1}')}" for k in range(depth)]
    return mcap_of_type(SEPARATOR.join([*parts, f"MSG: a/T{depth}\n{last}"]))


def many_schemas(definition: Callable[[int], str], count: int, encoding: str = "ros2msg") -> bytes:
    records = [
        schema(k, f"a/msg/B{k}", definition(k), encoding) + channel(k, k, f"/t{k}") + message(k, 1, CDR)
        for k in range(1, count)
    ]
    body = b"".join(records)
    return HEADER + chunk(body, 1, 1) + END


def listed(num_bytes: int) -> bytes:
    """A list of objects of one byte each, so many of them."""
    definition = f"a/E[] objects\n{SEPARATOR}MSG: a/E\nuint8 x\n"
    body = schema(1, "a/msg/B", definition) + channel(1, 1, "/x")
    body += message(1, 10, CDR + struct.pack("<I", num_bytes) + bytes(num_bytes))
    return HEADER + chunk(body, 10, 10) + END


def pose_array(count: int) -> bytes:
    body = schema(1, "geometry_msgs/msg/PoseArray", "", "") + channel(1, 1, "/x") + message(1, 10, poses(count))
    return HEADER + chunk(body, 10, 10) + END


def of_sequence(definition: str, data: bytes) -> bytes:
    body = schema(1, "a/msg/B", definition) + channel(1, 1, "/x") + message(1, 10, CDR + data)
    return HEADER + chunk(body, 10, 10) + END


_SQUARES = "const int64 A0 = 1 << 62;" + "".join(f"const int64 A{k + 1} = A{k} * A{k};" for k in range(26))
HOSTILE: dict[str, tuple[Callable[[], bytes], tuple[str, ...], str]] = {
    "idl, a shift": (lambda: idl("const int64 A = 1 << 16000000000;"), INFO, "computes with"),
    "idl, squares of squares": (lambda: idl(_SQUARES), INFO, "computes with"),
    "idl, brackets": (lambda: idl("const int32 A = ((((1))));"), INFO, "computes with"),
    "idl, brackets behind an annotation": (lambda: idl("@a const int32 A = ((((1))));"), INFO, "computes with"),
    "idl, brackets behind a comment": (lambda: idl("@a /* ( */ const int32 A = ((((1))));"), INFO, "computes with"),
    "idl, squares behind a text": (lambda: idl(r'const string S = "\\"; ' + _SQUARES + '"'), INFO, "computes with"),
    "idl, sequences of sequences": (
        lambda: idl(f"struct C {{ {'sequence<' * 30}long{'>' * 30} x; }};"),
        INFO,
        "nested too deeply",
    ),
    "idl, 60,000 constants": (
        lambda: idl("".join(f"const long A{k} = {k};" for k in range(30_000))),
        INFO,
        "more than 2000 constants",
    ),
    "idl, constants of other constants": (
        lambda: idl("".join(f"const long A{k} = A{max(0, k - 1)};" for k in range(2_000))),
        INFO,
        "/x",
    ),
    "idl, structures": (lambda: idl("".join(f"struct C{k} {{ C0 x; }};" for k in range(30_000))), INFO, "/x"),
    "idl, open comments": (lambda: idl("/*" * 400_000), INFO, "/x"),
    "idl, open texts": (lambda: idl('\\"' * 400_000), INFO, "/x"),
    "msg, an array of texts": (lambda: mcap_of_type("string[50000] x\n"), REPLAY, "more than 4000 members"),
    "msg, a long array of texts": (lambda: mcap_of_type("string[1000000] x\n"), REPLAY, "more than 4000 members"),
    "msg, as many texts as may be": (lambda: mcap_of_type("string[3900] x\n"), REPLAY, "is not a a/msg/B"),
    "msg, as many members as may be": (
        lambda: mcap_of_type("".join(f"string[] x{k}\n" for k in range(1_990))),
        REPLAY,
        "is not a a/msg/B",
    ),
    "msg, arrays of arrays of nothing": (lambda: nested(3, "T[1000] x\n"), REPLAY, "more than"),
    "msg, two of two of two": (lambda: nested(30, "T x\nT y\n"), REPLAY, "more than 10000 values"),
    "msg, deep": (lambda: nested(1_500, "T x\n"), REPLAY, "nested more than 50 times"),
    "msg, in itself": (lambda: mcap_of_type("a/B x\n"), REPLAY, "contains itself"),
    "msg, a list of nothing": (
        lambda: of_sequence(f"a/E[] x\n{SEPARATOR}MSG: a/E\nuint8[0] y\n", b"\xff" * 4),
        REPLAY,
        "no bytes",
    ),
    "msg, 400,000 comments": (lambda: mcap_of_type("#\n" * 400_000 + "float64 x\n"), INFO, "/x"),
    "msg, 140,000 members": (lambda: mcap_of_type("int8 a\n" * 140_000), INFO, "more lines than"),
    "msg, a default of 400,000 numbers": (
        lambda: mcap_of_type(f"int8[] a [{'1,' * 400_000}1]\n"),
        INFO,
        "more lines than",
    ),
    "msg, 90 types of 900 kB": (
        lambda: many_schemas(lambda k: "#" * 900_000 + f"{k}\nint8 a\n", 90),
        INFO,
        "longer than",
    ),
    "msg, 60,000 types": (lambda: many_schemas(lambda k: "int8 a\n", 60_000), INFO, "more lines than"),
    "idl, 60,000 types": (
        lambda: many_schemas(
            lambda k: f"module a {{ module msg {{ struct B{k} {{ long x; }}; }}; }};", 60_000, "ros2idl"
        ),
        INFO,
        "more lines than",
    ),
    "a list of 2 million poses": (lambda: pose_array(2_200_000), KNOWN, "input.most_objects"),
    "a list of 400,000 poses": (lambda: pose_array(400_000), KNOWN, "input.most_objects"),
    "a list of 100 million objects": (lambda: listed(100_000_000), LIST, "input.most_objects"),
    "a list of 2 million objects": (lambda: listed(1_600_000), LIST, "input.most_objects"),
    "a list of 30 million texts": (
        lambda: of_sequence("string[] objects\n", struct.pack("<I", 15_000_000) + b"\1\0\0\0\0\0\0\0" * 15_000_000),
        LIST,
        "input.most_objects",
    ),
    "a list of 100 million numbers": (
        lambda: of_sequence("uint8[] objects\n", struct.pack("<I", 100_000_000) + bytes(100_000_000)),
        LIST,
        "not a list of objects",
    ),
    "a text of 120 MB for a list": (
        lambda: of_sequence(
            "string objects\n", struct.pack("<I", 120_000_001) + b"\xf0\x9f\x98\x80" * 30_000_000 + b"\0"
        ),
        LIST,
        "input.most_objects",
    ),
    "a text of 70 MB for a list": (
        lambda: of_sequence(
            "string objects\n", struct.pack("<I", 70_000_001) + b"\xf0\x9f\x98\x80" * 17_500_000 + b"\0"
        ),
        LIST,
        "not a list of objects",
    ),
    "15 chunks of 100 MB at once": (
        lambda: overlapping(15, lambda k: message(1, 10**9 + k, poses(2) + bytes(100_000_000))),
        INFO,
        "overlaps with the chunk at byte",
    ),
    "a chunk of two million messages": (
        lambda: overlapping(1, lambda k: message(1, 10**9, CDR) * 2_000_000),
        INFO,
        "2000000",
    ),
    "a covariance of 9 million numbers": (
        lambda: HEADER + chunk(_EGO + message(1, 10, _ego(9_000_000)), 10, 10) + END,
        ("replay", "x.mcap", "-c", "open_space", "-o", "run"),
        "no more than 100000 are read",
    ),
}


def overlapping(count: int, records: Callable[[int], bytes]) -> bytes:
    """Chunks that all say the same times."""
    start = schema(1, "geometry_msgs/msg/PoseArray", "", "") + channel(1, 1, "/x")
    return HEADER + b"".join(chunk(start + records(k), 10**9, 2 * 10**9) for k in range(count)) + END


_EGO = schema(1, "fgtrack_msgs/msg/Ego", "", "") + channel(1, 1, "/fgtrack/ego")


def _ego(count: int) -> bytes:
    from fgtrack.core.types import EgoState
    from fgtrack.io.ros.messages import MessageFactory

    factory = MessageFactory()
    state = EgoState(1, 1, 0.0, 0.0, 0.0, 0.0, 0.0, covariance=(0.0,) * 25)
    short = bytes(factory.serialize(factory.ego(state)))
    assert short[-204:-200] == struct.pack("<I", 25)
    return short[:-204] + struct.pack("<I", count) + bytes(8 * count)


def read_in_little(server: Server, folder: Path, words: tuple[str, ...], said: str) -> None:
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
        topic = writer.add_connection("/x", "a/msg/B", msgdef=definition, md5sum="0" * 32)
        writer.write(topic, 10**9, struct.pack("<I", 2**32 - 1))
    read_in_little(server, tmp_path, replay("x.bag", OBJECTS), "a list of what has no bytes")


_ALIASES = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]\n" for k in range(1, 9)
)
_MERGES = "m0: &m0 {a: 1, b: 1, c: 1, d: 1, e: 1}\n" + "".join(
    f"m{k}: &m{k}\n  <<: [{', '.join([f'*m{k - 1}'] * 10)}]\n" for k in range(1, 9)
)
_TOPIC = "name: /fgtrack/truth"
METADATA: dict[str, tuple[Callable[[str], str], str]] = {
    "a name of aliases": (
        lambda text: _ALIASES + text.replace(_TOPIC, "name: *a8"),
        "counting what its aliases repeat",
    ),
    "a name that is a list": (lambda text: text.replace(_TOPIC, "name: [a, b]"), "a text expected"),
    "merges of merges": (lambda text: _MERGES + text, "counting what its aliases repeat"),
    "an alias in itself": (lambda text: f"{text}x: &a [*a]\n", "contains itself"),
    "240,000 items": (lambda text: text + "x:\n" + "- a\n" * 240_000, "lines, commas and brackets"),
    "99,000 items": (lambda text: text + "x:\n" + "- a\n" * 99_000, "fgtrack/truth"),
    "brackets": (lambda text: f"{text}x: {'[' * 99_000}", "nested too deeply"),
    "two megabytes": (lambda text: f"{text}x: {'a' * 2_000_000}", "is larger than 1 MB"),
    "a file twice": (lambda text: text.replace("- bag.mcap\n", "- bag.mcap\n  - bag.mcap\n"), "names a file twice"),
    "a version without end": (lambda text: text.replace("version: 9", "version: 1e400"), "is no metadata"),
}


@pytest.mark.parametrize("name", METADATA)
def test_a_hostile_metadata_file(server: Server, tmp_path: Path, name: str) -> None:
    write_bag(tmp_path / "bag", drive())
    file, (change, said) = tmp_path / "bag/metadata.yaml", METADATA[name]
    before = file.read_text()
    file.write_text(change(before))
    assert file.read_text() != before
    read_in_little(server, tmp_path, ("info", "bag"), said)
    if "fgtrack/truth" in said:
        read_in_little(
            server, tmp_path, ("replay", "bag", "-c", "open_space", "-e", "smoother,ekf-replay", "-o", "run"), ""
        )
