"""YAML of strangers: plain values only, and counted before they are made, with what aliases and merges repeat."""

import warnings
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, ReusedAnchorWarning, YAMLError
from ruamel.yaml.nodes import MappingNode, ScalarNode, SequenceNode

__all__ = ["MOST_VALUES", "YamlSizeError", "safe_yaml"]

MOST_VALUES = 100_000
_CHARACTERS_PER_VALUE = 100


class YamlSizeError(ValueError):
    """A text is longer, or stands for more values, than allowed; says which."""


def safe_yaml(text: str, longest: int) -> Any:  # Any: what YAML says is only known after validation
    """What the YAML 1.2 `text` says.

    Raises
    ------
    YamlSizeError
        It has more than `longest` characters, or `MOST_VALUES` lines or values; long texts count as several.
    YAMLError
        It is no YAML, a key of it is a list or a mapping, or a value is none of the type that it looks like.
    RecursionError
        It is nested too deeply, or has an alias that contains itself.
    """
    if len(text) > longest:
        raise YamlSizeError(f"is longer than {longest} characters")
    if sum(map(text.count, "\n,[{")) > MOST_VALUES:  # each takes some 0.1 ms
        raise YamlSizeError(f"has more than {MOST_VALUES} lines, commas and brackets")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ReusedAnchorWarning)  # YAML allows it
        yaml = YAML(typ="safe", pure=True)
        node = yaml.compose(text)
        if node is None:
            return None
        if _count(node, {}) > MOST_VALUES:
            raise YamlSizeError(f"has more than {MOST_VALUES} values, counting what its aliases repeat")
        try:
            return yaml.constructor.construct_document(node)
        except (ArithmeticError, LookupError, TypeError, ValueError) as error:
            raise YAMLError(f"a value cannot be read ({error})") from error


def _count(node: Any, counts: dict[Any, int | None]) -> int:  # nodes of ruamel.yaml have no types
    """Values in `node`, as often as they are in it; `counts` keeps those of nodes, None while it counts them."""
    if node in counts:
        known = counts[node]
        if known is None:
            raise RecursionError
        return known
    counts[node] = None
    match node:
        case ScalarNode():
            found = 1 + len(node.value) // _CHARACTERS_PER_VALUE
        case SequenceNode():
            found = 1 + sum(_count(item, counts) for item in node.value)
        case MappingNode():
            found = 1 + sum(_count(part, counts) for pair in node.value for part in pair)
            for key, _ in node.value:
                if not isinstance(key, ScalarNode):
                    raise MarkedYAMLError(problem="a key is a list or a mapping", problem_mark=key.start_mark)
    counts[node] = found
    return found
