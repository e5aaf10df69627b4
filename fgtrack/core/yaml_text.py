"""YAML 1.2 documents of users and recordings; plain values only."""

import re
import warnings
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import ReusedAnchorWarning, YAMLError

__all__ = ["safe_yaml"]

#: Longest document in characters.
_LONGEST = 2_000_000
_MOST_ALIASES = 25
_ALIAS = re.compile(r"(?:^|[\s\[{,:-])\*[\w-]", re.MULTILINE)


def safe_yaml(text: str) -> Any:  # Any: the type is known after validation only
    """Return the value of the YAML 1.2 document `text`.

    Raises `YAMLError` if the document is invalid, too long, too deeply nested, or has
    too many aliases.
    """
    if len(text) > _LONGEST:
        raise YAMLError(f"is longer than {_LONGEST} characters")
    if len(_ALIAS.findall(text)) > _MOST_ALIASES:
        raise YAMLError(f"has more than {_MOST_ALIASES} aliases")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ReusedAnchorWarning)  # YAML allows it
        try:
            return YAML(typ="safe", pure=True).load(text)
        except RecursionError as error:
            raise YAMLError(
                "is nested too deeply, or has an alias that contains itself"
            ) from error
        except (ArithmeticError, LookupError, TypeError, ValueError) as error:
            raise YAMLError(f"cannot be read ({error})") from error
