"""What a recording defines becomes names and numbers, never code."""

import pytest
from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat, Nodetype
from rosbags.typesys import Stores, get_typestore
from support.mcap import poses

from fgtrack.core.errors import DataError
from fgtrack.inputs.ros.typestore import MessageTypes, checked, typestore_of

NUMBER = (Nodetype.BASE, ("float64", 0))
NAME = "a_msgs/msg/B"


@pytest.mark.parametrize("store", Stores)
def test_every_definition_of_ros_passes(store: Stores) -> None:
    types = dict(get_typestore(store).fielddefs)
    assert checked(types) is types


@pytest.mark.parametrize(
    ("name", "definition", "problem"),
    [
        ("a/msg/B:\n  import os", ([], []), "not a valid name of a message type"),
        ("B", ([], []), "not a valid name of a message type"),
        (NAME, ([], [("x=__import__('os')", NUMBER)]), "not a valid name of a member"),
        (NAME, ([], [("ä", NUMBER)]), "not a valid name of a member"),
        (NAME, ([("X);f(", "int8", 1)], []), "not a valid name of a member"),
        (NAME, ([("X", "int8", [1])], []), "not a plain value"),
        (NAME, ([("X", "int8, y", 1)], []), "not a plain value"),
        (NAME, ([], [("x", (Nodetype.BASE, ("os.system", 0)))]), "unknown type"),
        (
            NAME,
            ([], [("x", (Nodetype.NAME, "a/msg/B()"))]),
            "not a valid name of a message type",
        ),
        (NAME, ([], [("x", (Nodetype.ARRAY, (NUMBER, 10**9)))]), "longer than"),
        (
            NAME,
            ([], [("x", (Nodetype.SEQUENCE, ((Nodetype.NAME, "x;y"), 0)))]),
            "not a valid name of a message type",
        ),
        (NAME, ([("A", "float64", float("inf"))], []), "not a plain value"),
        (NAME, ([("A", "int64", 1 << 64)], []), "not a plain value"),
        (
            NAME,
            ([], [("class", NUMBER), ("class_", NUMBER)]),
            "two members with the same name",
        ),
        (NAME, ([("x", "int8", 1)], [("x", NUMBER)]), "two members with the same name"),
        (NAME, ([], [("__class__", NUMBER)]), "not a valid name of a member"),
        ("a/" + "b" * 300, ([], []), "not a valid name of a message type"),
    ],
)
def test_what_is_no_name_and_no_number_is_refused(
    name: str, definition, problem: str
) -> None:
    with pytest.raises(ValueError, match=problem):
        checked({name: definition})


def test_a_definition_that_is_refused_is_a_problem_of_its_type_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Whatever the parser makes of a text."""
    typestore_of(("nav_msgs/msg/Odometry",))  # reads the shipped definitions once
    monkeypatch.setattr(
        "fgtrack.inputs.ros.typestore.get_types_from_msg",
        lambda *of: {NAME: ([], [("x);import os;(", NUMBER)])},
    )
    evil = (NAME, MessageDefinition(MessageDefinitionFormat.MSG, "float64 x"))
    types = MessageTypes([evil, ("nav_msgs/msg/Odometry", None)], ros1=False)
    assert list(types.problems) == [evil]
    assert "not a valid name of a member" in types.problems[evil]
    assert list(types.types) == [("nav_msgs/msg/Odometry", None)]


IDL = """// generated from rosidl_adapter/resource/msg.idl.em
#include "builtin_interfaces/msg/Time.idl"

module a_msgs {
  module msg {
    typedef double double__36[36];
    module B_Constants {
      const uint8 CAR = 1;
      const int8 NONE = -1;
      const double SMALL = -1.5e-3;
      @verbatim (language="comment", text="an example (of" "\\n" "1 << 99 \\" things")
      const string NAME = "a * (b << c";
    };
    @verbatim (language="comment", text=
      "One (thing" "\\n" " more)")
    struct B {
      builtin_interfaces::msg::Time stamp;
      /* here ( and * there */
      @default (value=3)
      @unit (value="m")
      long x;
      double__36 covariance;
      sequence<string<10>> names;
      sequence<a_msgs::msg::C, 4> parts;
    };
  };
};
"""


PART_OF_IDL = "module a_msgs { module msg { struct C { long x; }; }; };"


def test_what_ros_generates_in_idl_is_read() -> None:
    key = (NAME, MessageDefinition(MessageDefinitionFormat.IDL, f"{IDL}{PART_OF_IDL}"))
    constants, members = MessageTypes([key], ros1=False).types[key][NAME]
    assert [(name, value) for name, _, value in constants][:3] == [
        ("CAR", 1),
        ("NONE", -1),
        ("SMALL", -1.5e-3),
    ]
    assert [name for name, _ in members] == [
        "stamp",
        "x",
        "covariance",
        "names",
        "parts",
    ]
    assert dict(members)["covariance"] == (Nodetype.ARRAY, (NUMBER, 36))
    assert dict(members)["names"][0] == Nodetype.SEQUENCE


@pytest.mark.parametrize(
    "text",
    [
        "=",
        "/*x",
        '"',
        '\\"',
        "@",
        "@ ",
        "@(",
        "@a ",
        "//",
        "#\n",
        "=(",
        "sequence<",
        "sequence ",
        "= ",
        "a=1 ",
    ],
)
def test_a_hostile_definition_in_idl_is_refused_in_a_moment(text: str) -> None:
    """Expressions that look for an end from each beginning would take minutes for these 150,000 characters."""
    key = (
        NAME,
        MessageDefinition(MessageDefinitionFormat.IDL, text * (150_000 // len(text))),
    )
    assert NAME in "".join(name for name, _ in MessageTypes([key], ros1=False).problems)


def test_constants_that_compute_are_refused_wherever_they_stand() -> None:
    for constant in ("1 + 1 * 2", "(1)", "1 << 3", "a == b ? 1 : (2)", "= = 2 / 3"):
        text = IDL.replace("a_msgs::msg::C, 4", "long, 4").replace(
            "module a_msgs", f"const long K = {constant};\nmodule a_msgs", 1
        )
        key = (NAME, MessageDefinition(MessageDefinitionFormat.IDL, text))
        [problem] = MessageTypes([key], ros1=False).problems.values()
        assert "computes a constant" in problem


def test_every_type_of_ros_is_small_enough() -> None:
    for store in (Stores.ROS2_HUMBLE, Stores.ROS1_NOETIC):
        keys = [(name, None) for name in get_typestore(store).fielddefs]
        assert not MessageTypes(keys, ros1=store == Stores.ROS1_NOETIC).problems


def embedded(**texts: str) -> list[tuple[str, MessageDefinition]]:
    return [
        (f"a/msg/{name}", MessageDefinition(MessageDefinitionFormat.MSG, text))
        for name, text in texts.items()
    ]


PART = "a/C c\n" + "=" * 80 + "\nMSG: a/C\n"


def test_topics_that_contradict_each_other_are_each_read_by_their_own_definition() -> (
    None
):
    keys = embedded(A=f"{PART}uint8 x\n", B=f"{PART}uint16 y\n")
    types = MessageTypes(keys, ros1=False)
    assert not types.problems
    assert types.decode(keys[0], b"\0\1\0\0\7", "it").c.x == 7
    assert types.decode(keys[1], b"\0\1\0\0\0\1", "it").c.y == 256


def test_one_name_for_two_types_is_read_by_what_each_topic_says() -> None:
    keys = embedded(A="uint8 x\n") + embedded(A="uint16 y\n")
    types = MessageTypes(keys, ros1=False)
    assert types.decode(keys[0], b"\0\1\0\0\7", "it").x == 7
    assert types.decode(keys[1], b"\0\1\0\0\0\1", "it").y == 256


@pytest.mark.parametrize(
    "evil",
    ["float64 A=1e999\n", "int32 class\nint32 class_\n", f"int64 A=0x{'f' * 6000}\n"],
)
def test_a_definition_that_nobody_needs_leaves_the_others_readable(evil: str) -> None:
    keys = [*embedded(A=f"{evil}int32 x\n"), ("nav_msgs/msg/Odometry", None)]
    types = MessageTypes(keys, ros1=False)
    assert list(types.problems) == keys[:1]
    with pytest.raises(DataError, match="is not a nav_msgs/msg/Odometry"):
        types.decode(keys[1], b"\0\1\0\0", "it")


def test_a_message_may_be_large_up_to_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    key, types = (
        ("geometry_msgs/msg/PoseArray", None),
        MessageTypes([("geometry_msgs/msg/PoseArray", None)], ros1=False),
    )
    assert len(types.decode(key, poses(3), "it").poses) == 3
    monkeypatch.setattr("fgtrack.inputs.ros.typestore._LARGEST_BYTES", 100)
    with pytest.raises(DataError, match=r"it: has \d+ bytes, at most 100 are decoded"):
        types.decode(key, poses(3), "it")
