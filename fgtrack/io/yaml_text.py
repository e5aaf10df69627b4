"""YAML 1.2 of users and recordings: plain values only."""

import warnings
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import ReusedAnchorWarning, YAMLError

__all__ = ["safe_yaml"]


def safe_yaml(text: str) -> Any:  # Any: the type is known after validation only
    """Value of the YAML 1.2 document `text`. Raises `YAMLError` for invalid YAML."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ReusedAnchorWarning)  # YAML allows it
        try:
            return YAML(typ="safe", pure=True).load(text)
        except RecursionError as error:
            raise YAMLError("is nested too deeply, or has an alias that contains itself") from error
        except (ArithmeticError, LookupError, TypeError, ValueError) as error:
            raise YAMLError(f"a key or value cannot be read ({error})") from error
