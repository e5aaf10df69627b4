"""Compilation of loops by numba, and compiled loops over small dense matrices.

The machine code is stored on disk if a folder can be written. Calls of NumPy and BLAS, and assignments of slices, take
seconds to compile in compiled code. Loops do not.
"""

import gc
import logging
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba.extending import lower_builtin, type_callable

from fgtrack.core.numba_internals import (
    NOT_STORED,
    WITHOUT_COUNTING,
    LoopCache,
    let_loops_call,
    use_cache,
)
from fgtrack.core.types import FloatArray, IntArray

_LOG = logging.getLogger(__name__)
_said = set[str]()
_Function = TypeVar("_Function", bound=Callable[..., Any])


def _say(text: str) -> None:
    """Log a line, once."""
    if text not in _said:
        _said.add(text)
        _LOG.warning(text)


_stamps = dict[str, bytes]()


# Any: numba has no types for compiled functions.
def _stamp(scope: Mapping[str, Any]) -> bytes:
    """Return the digest of a module with these global names: of its source, its numbers, and the compiled modules
    it uses.

    numba compares the file of a function only. But a caller contains code, or addresses, of functions in other
    files.
    """
    if scope["__name__"] not in _stamps:
        numbers = [
            (name, value)
            for name, value in scope.items()
            if isinstance(value, (int, float))
        ]
        used = sorted(
            _stamps.keys()
            & {getattr(value, "__module__", None) for value in scope.values()}
        )
        parts = [
            Path(scope["__file__"]).read_bytes(),
            repr(numbers).encode(),
            *map(_stamps.__getitem__, used),
        ]
        _stamps[scope["__name__"]] = sha256(b"".join(parts)).digest()
    return _stamps[scope["__name__"]]


@contextmanager
def _no_garbage_collection() -> Iterator[None]:
    """Pause the garbage collection of cycles. A compiler makes millions of objects that stay, and searching costs
    10 %.
    """
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()


_OPTIONS: dict[str, Any] = {"error_model": "numpy"}


def njit(signature: str, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles a function once and stores its code in a cache folder.

    The log has one line when loops are compiled, and one line if they cannot be stored. If the signature begins
    with a number type or void, references to arrays are not counted. The function must not allocate arrays then:
    use `scratch`.
    """
    returns_arrays = not signature.partition("(")[0].isidentifier()
    options |= {**_OPTIONS, "no_cfunc_wrapper": True}
    if not returns_arrays:
        options |= WITHOUT_COUNTING

    def compiled(function: Callable[..., Any]) -> Any:
        result: Any = numba.njit(**options)(function)
        try:
            use_cache(result, LoopCache(function, _stamp(function.__globals__), _say))
        except RuntimeError:  # numba has no folder to write to
            _say(NOT_STORED)
        with _no_garbage_collection():
            result.compile(signature)
        result.disable_compile()
        return result

    return compiled


def shared(signature: str) -> Callable[[_Function], _Function]:
    """Return a decorator that compiles a function once, for callers that are compiled functions.

    The code is stored as by `njit`. Callers call the function by its address. A function without this decorator is
    compiled into each caller.
    """

    def compiled(function: _Function) -> _Function:
        let_loops_call(function, njit(signature, no_cpython_wrapper=True)(function))
        return function

    return compiled


def inlined(function: _Function) -> _Function:
    """Decorate a function that only compiled functions call: it becomes a part of the machine code of each caller."""
    _stamp(function.__globals__)  # the stored code of callers ends with this source
    options = {
        "forceinline": True,
        **_OPTIONS,
        **WITHOUT_COUNTING,
        "no_cpython_wrapper": True,
        "no_cfunc_wrapper": True,
    }
    return cast(_Function, numba.njit(**options)(function))


def merged(function: _Function) -> _Function:
    """Decorate a small function with few callers: its statements become statements of the callers before compiling.

    An `inlined` function is compiled alone, too, which takes longer. Decorate a large function with `shared`.
    """
    _stamp(function.__globals__)  # the stored code of callers ends with this source
    return cast(_Function, numba.njit(**_OPTIONS, inline="always")(function))


def scratch(*shape: int) -> FloatArray:
    """Return an uninitialised array of one to three dimensions, on the stack of the compiled function that calls
    this.

    The call must stand outside of loops: the memory is free only after the function returns.
    """
    return np.empty(shape)


@type_callable(scratch)
def _scratch_type(_: Any) -> Callable[..., Any]:
    def array(rows: Any, columns: Any = None, layers: Any = None) -> Any:
        shape = [length for length in (rows, columns, layers) if length is not None]
        result = numba.types.Array(numba.types.float64, len(shape), "C")
        return result(*[numba.types.intp] * len(shape))

    return array


def _write_scratch(context: Any, builder: Any, own: Any, shape: Any) -> Any:
    """Write the code of `scratch`: memory of the stack, and an array that owns no memory."""
    intp, float64 = (
        context.get_value_type(each) for each in (numba.types.intp, numba.types.float64)
    )
    lengths = numba.types.UniTuple(numba.types.intp, len(shape))  # type: ignore[no-untyped-call]
    strides = list[Any]()
    num_items, itemsize = intp(1), intp(8)
    for length in reversed(shape):
        strides.insert(0, builder.mul(num_items, itemsize))
        num_items = builder.mul(num_items, length)
    array = context.make_helper(builder, own.return_type)
    array.data = builder.alloca(float64, size=num_items)
    array.nitems, array.itemsize = num_items, itemsize
    array.shape = context.make_tuple(builder, lengths, shape)
    array.strides = context.make_tuple(builder, lengths, strides)
    return array._getvalue()


for _dimensions in (1, 2, 3):
    lower_builtin(scratch, *[numba.types.intp] * _dimensions)(_write_scratch)  # type: ignore[no-untyped-call]

READ, MATRIX = "Array(float64, 2, 'C', readonly=True)", "float64[:, ::1]"


@inlined
def check_rows(rows: IntArray, first: int, end: int) -> None:
    """Raise `IndexError` if one of `rows` is less than `first`, or not less than `end`.

    Compiled loops do not check indices: an index beyond the end reads or writes other memory. So each call of a
    loop checks its arguments.
    """
    for i in range(len(rows)):
        if rows[i] < first or rows[i] >= end:
            raise IndexError("a row number lies beyond the end of the arrays")


@inlined
def check(holds: bool) -> None:
    """Raise `IndexError` if `holds` is False: an array of a call is smaller than its loops need."""
    if not holds:
        raise IndexError("an array is smaller than another array of the same call")


@inlined
def copy(source: FloatArray, out: FloatArray) -> None:
    """Fill the matrix `out` from the first rows and columns of `source`."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = source[i, j]


@shared(f"void({READ}, {READ}, {MATRIX})")
def product(A: FloatArray, B: FloatArray, out: FloatArray) -> None:
    """Write A B. Columns of A and rows of B beyond the shorter of both are ignored."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            value = 0.0
            for k in range(min(A.shape[1], B.shape[0])):
                value += A[i, k] * B[k, j]
            out[i, j] = value


@shared(f"void({READ}, {READ}, {MATRIX})")
def add_product_transposed(A: FloatArray, B: FloatArray, out: FloatArray) -> None:
    """Add A B', which must be symmetric, to `out`. The lower triangle is computed and mirrored."""
    for i in range(A.shape[0]):
        for j in range(i + 1):
            value = out[i, j]
            for k in range(A.shape[1]):
                value += A[i, k] * B[j, k]
            out[i, j] = out[j, i] = value


@shared(f"void({READ}, {READ}, {MATRIX}, {MATRIX})")
def add_congruence(
    A: FloatArray, P: FloatArray, AP: FloatArray, out: FloatArray
) -> None:
    """Add A P A' to `out`, and write A P to `AP`."""
    product(A, P, AP)
    add_product_transposed(AP, A, out)


@shared(f"void({READ}, {READ}, {MATRIX}, {MATRIX})")
def add_weighted(K: FloatArray, R: FloatArray, KR: FloatArray, out: FloatArray) -> None:
    """Add K' R K to `out`, and write K' R to `KR`.

    K has the shape (k, n). The first k rows and columns of R, which is symmetric, are used.
    """
    k, n = K.shape
    for a in range(n):
        for c in range(k):
            value = 0.0
            for d in range(k):
                value += K[d, a] * R[d, c]
            KR[a, c] = value
        for b in range(a + 1):
            value = out[a, b]
            for c in range(k):
                value += KR[a, c] * K[c, b]
            out[a, b] = out[b, a] = value


@shared(f"b1({READ}, int64, {MATRIX})")
def cholesky(S: FloatArray, n: int, L: FloatArray) -> bool:
    """Write the lower Cholesky factor of the first n rows and columns of S to L, which may be S.

    False if S is not positive definite.
    """
    for i in range(n):
        for j in range(i + 1):
            value = S[i, j]
            for k in range(j):
                value -= L[i, k] * L[j, k]
            if j < i:
                L[i, j] = value / L[j, j]
            elif value > 0.0:
                L[i, i] = math.sqrt(value)
            else:
                return False
    return True


@shared(f"void({READ}, {MATRIX})")
def forward(L: FloatArray, columns: FloatArray) -> None:
    """Overwrite `columns` (n, m) by L^-1 columns. L (n, n) is lower triangular."""
    for i in range(len(columns)):
        for k in range(i):
            for c in range(columns.shape[1]):
                columns[i, c] -= L[i, k] * columns[k, c]
        for c in range(columns.shape[1]):
            columns[i, c] /= L[i, i]


@shared(f"b1({MATRIX}, {MATRIX})")
def solve(S: FloatArray, columns: FloatArray) -> bool:
    """Overwrite `columns` (n, m) by S^-1 columns, and the first n rows and columns of S by their Cholesky factor.

    False if S is not positive definite.
    """
    n = len(columns)
    if not cholesky(S, n, S):
        return False
    forward(S, columns)
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            for c in range(columns.shape[1]):
                columns[i, c] -= S[k, i] * columns[k, c]
        for c in range(columns.shape[1]):
            columns[i, c] /= S[i, i]
    return True


@inlined
def regularise(Q: FloatArray) -> None:
    """Add a small diagonal to process noise that is singular, as `fgtrack.core.linalg.regular` does."""
    for i in range(Q.shape[0]):
        Q[i, i] += 1e-12 * max(Q[i, i], 1e-6)


@shared(f"float64({MATRIX}, float64[::1])")
def whiten(S: FloatArray, y: FloatArray) -> float:
    """Overwrite y (n,) by L^-1 y, and S by its Cholesky factor L. Return y' S^-1 y; NaN if S is not positive
    definite.
    """
    total = 0.0
    if not cholesky(S, len(y), S):
        return np.nan
    for i in range(len(y)):
        for k in range(i):
            y[i] -= S[i, k] * y[k]
        y[i] /= S[i, i]
        total += y[i] * y[i]
    return total


@inlined
def wrapped(angle_rad: float) -> float:
    """Return the angle wrapped into (-pi, pi]. An angle inside is unchanged."""
    if -math.pi < angle_rad <= math.pi:
        return angle_rad
    turned = math.pi - np.mod(math.pi - angle_rad, 2.0 * math.pi)
    return math.pi if turned <= -math.pi else turned
