"""How many examples hypothesis draws where each takes long, and which parameters are for `make test-slow`."""

from typing import Any

import pytest
from hypothesis import settings

few = settings(max_examples=settings().max_examples // 3)


def slow(*values: Any) -> list[Any]:
    """Parameters that are marked slow; a tuple holds several arguments."""
    return [
        pytest.param(
            *(one if isinstance(one, tuple) else (one,)), marks=pytest.mark.slow
        )
        for one in values
    ]
