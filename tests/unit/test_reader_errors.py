"""Exceptions of readers become words about the file."""

import json
from collections.abc import Callable
from typing import Any

import pytest

from fgtrack.inputs.errors import cause


def named(value: Any) -> Any:
    return value["time"]


def raised(action: Callable[[Any], Any], value: Any) -> Exception:
    try:
        action(value)
    except Exception as error:
        return error
    raise AssertionError("nothing raised")


@pytest.mark.parametrize(
    ("action", "value", "said"),
    [
        (named, {}, "'time' is missing"),
        (named, None, "null where the format has another type of value"),
        (named, 3, "a number where the format has another type of value"),
        (named, "x", "a text where the format has another type of value"),
        (named, [1], "a list where the format has another type of value"),
        (named, True, "true or false where the format has another type of value"),
        (float, {}, "an object with names where the format has another type of value"),
        (
            lambda value: value.items(),
            "x",
            "a text where the format has another type of value",
        ),
        (
            lambda value: value + 1,
            object(),
            "a value where the format has another type of value",
        ),
        (
            lambda value: [a + b for a, b in value],
            [3],
            "a number where the format has another type of value",
        ),
        (lambda value: value[0], [], "a list has another length"),
        (
            lambda value: dict(zip(value, [], strict=True)),
            [1],
            "a list has another length",
        ),
        (lambda value: [a + b for a, b in value], [[1]], "a list has another length"),
        (int, float("inf"), "a number is out of range"),
        (float, "abc", "could not convert string to float: 'abc'"),
        (json.loads, "[" * 100_000, "values are nested too deeply"),
    ],
)
def test_the_cause_is_told_in_words(
    action: Callable[[Any], Any], value: Any, said: str
) -> None:
    assert cause(raised(action, value)) == said


def test_a_long_name_is_cut() -> None:
    assert len(cause(KeyError("x" * 5000))) < 100
