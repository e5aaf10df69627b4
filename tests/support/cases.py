"""Cases of parametrized tests."""

from collections.abc import Sequence
from itertools import product
from typing import Any

import pytest


def each_once(*axes: Sequence[Any]) -> list[Any]:
    """All combinations of the values of `axes`, for `pytest.mark.parametrize`.

    As many are fast as it takes for each value to be in one; all others are slow.
    """
    sizes = [len(values) for values in axes]
    fast = {tuple(k % size for size in sizes) for k in range(max(sizes))}
    return [
        pytest.param(
            *(values[k] for values, k in zip(axes, index, strict=True)),
            marks=() if index in fast else pytest.mark.slow,
        )
        for index in product(*map(range, sizes))
    ]
