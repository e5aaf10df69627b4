"""Settings of several runs side by side."""

import json
from collections.abc import Iterable, Mapping
from typing import Any


def flattened(config: Mapping[str, Any], above: str = "") -> dict[str, str]:
    """The values of `config` as text, by the path of their key (`smoother.lag_s`)."""
    found: dict[str, str] = {}
    for key, value in config.items():
        path = f"{above}{key}"
        if isinstance(value, Mapping) and value:
            found |= flattened(value, f"{path}.")
        else:
            found[path] = value if isinstance(value, str) else json.dumps(value, default=str)
    return found


def differing(settings: Iterable[Mapping[str, str]]) -> list[str]:
    """The keys whose values are not the same in all of `settings`, in their order."""
    every = list(settings)
    keys = dict.fromkeys(key for one in every for key in one)
    return [key for key in keys if len({one.get(key) for one in every}) > 1]
