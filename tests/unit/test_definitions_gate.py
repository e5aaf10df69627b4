"""What a recording defines becomes names and numbers, never code."""

import pytest
from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat, Nodetype
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

from fgtrack.io.ros.typestore import build_typestore, check_definition

NUMBER = (Nodetype.BASE, ("float64", 0))
NAME = "a_msgs/msg/B"


@pytest.mark.parametrize("store", Stores)
def test_every_definition_of_ros_passes(store: Stores) -> None:
    for name, definition in get_typestore(store).fielddefs.items():
        check_definition(name, definition)


@pytest.mark.parametrize(
    ("name", "definition", "problem"),
    [
        ("a/msg/B:\n  import os", ([], []), "no name of a message type"),
        ("a b/msg/B", ([], []), "no name of a message type"),
        ("B", ([], []), "no name of a message type"),
        (NAME, ([], [("x=__import__('os')", NUMBER)]), "no name of a member"),
        (NAME, ([], [("x\ny", NUMBER)]), "no name of a member"),
        (NAME, ([], [("ä", NUMBER)]), "no name of a member"),
        (NAME, ([("X);f(", "int8", 1)], []), "no name of a member"),
        (NAME, ([("X", "int8", [1])], []), "no plain value"),
        (NAME, ([("X", "int8, y", 1)], []), "no plain value"),
        (NAME, ([], [("x", (Nodetype.BASE, ("os.system", 0)))]), "no known type"),
        (NAME, ([], [("x", (Nodetype.NAME, "a/msg/B()"))]), "no name of a message type"),
        (NAME, ([], [("x", (Nodetype.ARRAY, (NUMBER, 10**9)))]), "longer than"),
        (NAME, ([], [("x", (Nodetype.SEQUENCE, ((Nodetype.NAME, "x;y"), 0)))]), "no name of a message type"),
        (NAME, ([], [(f"x{k}", NUMBER) for k in range(3000)]), "more than 2000 members"),
    ],
)
def test_what_is_no_name_and_no_number_is_refused(name: str, definition, problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        check_definition(name, definition)


def test_a_definition_that_is_refused_is_a_problem_of_its_type_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the parser makes of a text."""
    evil = {NAME: ([], [("x);import os;(", NUMBER)])}
    monkeypatch.setattr("fgtrack.io.ros.typestore._embedded_types", lambda *of: evil)
    given = {NAME: MessageDefinition(MessageDefinitionFormat.MSG, "float64 x"), "nav_msgs/msg/Odometry": None}
    store, problems = build_typestore(given, ros1=False)
    assert "no name of a member" in problems[NAME]
    assert list(problems) == [NAME]
    assert NAME not in store.fielddefs
    assert "nav_msgs/msg/Odometry" in store.fielddefs


def test_a_definition_as_long_as_a_book_is_refused() -> None:
    given = {NAME: MessageDefinition(MessageDefinitionFormat.MSG, "# " + "x" * 2_000_000)}
    assert "more than 1000000 characters" in build_typestore(given, ros1=False)[1][NAME]


def test_both_parsers_give_what_is_checked() -> None:
    for types in (
        get_types_from_msg("float64[3] x\nint8 A=1\n", NAME),
        get_types_from_idl("module a_msgs { module msg { struct B { double x; sequence<double, 3> y; }; }; };"),
    ):
        for name, definition in types.items():
            check_definition(name, definition)
