"""Compilation of loops by numba, kept on disk where a folder can be written."""

from collections.abc import Callable
from typing import Any

import numba

__all__ = ["inlined", "njit"]


# Any: numba has no types.
def njit(signature: str) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles a function once: it is stored in a cache folder, if one can be written."""

    def compiled(function: Callable[..., Any]) -> Any:
        try:
            return numba.njit(signature, cache=True, error_model="numpy")(function)
        except RuntimeError:  # no folder to store it in
            return numba.njit(signature, error_model="numpy")(function)

    return compiled


#: Decorator of functions that only compiled ones call.
inlined = numba.njit(error_model="numpy")
