"""What a recording defines becomes names and numbers, never code."""

import pytest
from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat, Nodetype

from fgtrack.core.errors import DataError
from fgtrack.io.ros.typestore import MessageTypes

NUMBER = (Nodetype.BASE, ("float64", 0))
NAME = "a_msgs/msg/B"


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
    assert [(name, value) for name, _, value in constants][:3] == [("CAR", 1), ("NONE", -1), ("SMALL", -1.5e-3)]
    assert [name for name, _ in members] == ["stamp", "x", "covariance", "names", "parts"]
    assert dict(members)["covariance"] == (Nodetype.ARRAY, (NUMBER, 36))
    assert dict(members)["names"][0] == Nodetype.SEQUENCE


def embedded(**texts: str) -> list[tuple[str, MessageDefinition]]:
    return [(f"a/msg/{name}", MessageDefinition(MessageDefinitionFormat.MSG, text)) for name, text in texts.items()]


PART = "a/C c\n" + "=" * 80 + "\nMSG: a/C\n"


def test_topics_that_contradict_each_other_are_each_read_by_their_own_definition() -> None:
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


EVIL = [
    "float64 x=__import__('os').getcwd()\n",
    "float64 ä\n",
    "os.system x\n",
    "float64[__import__('os')] x\n",
    f"float64 x\n{'=' * 80}\nMSG: a/B:\n  import os\n",
]


@pytest.mark.parametrize("evil", EVIL)
def test_a_definition_that_nobody_needs_leaves_the_others_readable(evil: str) -> None:
    keys = [*embedded(A=f"{evil}int32 x\n"), ("nav_msgs/msg/Odometry", None)]
    types = MessageTypes(keys, ros1=False)
    assert list(types.problems) == keys[:1]
    with pytest.raises(DataError, match="is not a nav_msgs/msg/Odometry"):
        types.decode(keys[1], b"\0\1\0\0", "it")
