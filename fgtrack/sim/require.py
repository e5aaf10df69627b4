"""The check behind every setting of a scenario."""

import math


def require(condition: bool, key: str, rule: str, value: float) -> None:
    """Raise a `ValueError` that names `key` unless `condition` holds and `value` is finite."""
    if not (condition and math.isfinite(value)):
        raise ValueError(f"{key}: {rule}, is {value}")
