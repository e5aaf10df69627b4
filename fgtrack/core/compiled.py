"""Compilation of loops by numba, kept on disk where a folder can be written, and loops over small dense matrices.

Calls of NumPy, BLAS and assignments of slices in compiled code take seconds to compile: loops do not.
"""

import gc
import json
import logging
import math
import pickle
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeVar, cast
from uuid import uuid4

import llvmlite
import numba
import numpy as np
from llvmlite.binding import add_symbol
from numba.core.caching import FunctionCache
from numba.core.cgutils import get_or_insert_function
from numba.core.compiler import Compiler
from numba.core.runtime.nrt import rtsys
from numba.core.serialize import dumps
from numba.core.typing.templates import ConcreteTemplate, infer_global
from numba.extending import lower_builtin
from numba.np.arrayobj import make_array, populate_array

from fgtrack.core.types import FloatArray, IntArray

_LOG = logging.getLogger(__name__)
_said = set[str]()
_Function = TypeVar("_Function", bound=Callable[..., Any])


def _say(text: str) -> None:
    if text not in _said:
        _said.add(text)
        _LOG.warning(text)


_NOT_STORED = "compiled loops cannot be stored, so every start compiles them: let NUMBA_CACHE_DIR name a folder"
_DAMAGED = "stored loops are damaged or cannot be read: these are compiled again (all of them in some 25 s)"
_stamps = dict[str, bytes]()


# Any: numba has no types of what is compiled.
def _stamp(scope: Mapping[str, Any]) -> bytes:
    """Digest of the source of a module with these global names, of its numbers, and of the compiled modules it uses."""
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


class _Store:
    """Files of the compiled code of one function: an index, `.nbi`, and the code of each signature, `.nbc`.

    It has the methods of numba's `IndexDataCacheFile`. The index is JSON and has the SHA-256 of each code, so that a
    damaged file is recognised before it is unpickled or run. A code file is named after its content, so that processes
    that write at the same time do not mix their files.
    """

    def __init__(self, folder: str, name: str, stamp: bytes) -> None:
        self._folder, self._name = Path(folder), name
        self._index_path = self._folder / f"{name}.nbi"
        versions = numba.__version__, llvmlite.__version__, sys.version
        self._stamp = sha256(stamp + repr(versions).encode()).hexdigest()

    def load(self, key: object) -> Any:
        """Return what was saved under `key`, or None. Raises `OSError` or `ValueError` for damaged files."""
        stamp, digests = self._read()
        digest = digests.get(_key_text(key))
        if digest is None or stamp != self._stamp:  # of another source or version
            return None
        try:
            code = self._code_path(digest).read_bytes()
        except FileNotFoundError:
            return None
        if sha256(code).hexdigest() != digest:
            raise ValueError(f"{self._code_path(digest)}: is damaged")
        return pickle.loads(code)

    def save(self, key: object, data: object) -> None:
        """Save `data`; damaged files are replaced. Raises `OSError`."""
        code: bytes = dumps(data)  # type: ignore[no-untyped-call]
        try:
            stamp, stored = self._read()
        except (OSError, ValueError):
            stamp, stored = "", {}
        kept = stored if stamp == self._stamp else {}
        digests = {**kept, _key_text(key): sha256(code).hexdigest()}
        _replace(self._code_path(digests[_key_text(key)]), code)
        self._write(digests)
        for unused in set(stored.values()) - set(digests.values()):
            self._code_path(unused).unlink(missing_ok=True)

    def flush(self) -> None:
        """Forget all codes. Raises `OSError`."""
        self._write({})

    def _code_path(self, digest: str) -> Path:
        return self._folder / f"{self._name}.{digest[:16]}.nbc"

    def _read(self) -> tuple[str, dict[str, str]]:
        """Return the stamp of the index and the digests of codes by key. Raises `OSError` or `ValueError`."""
        try:
            index = json.loads(self._index_path.read_bytes())
        except FileNotFoundError:
            return "", {}
        except RecursionError as error:
            raise ValueError(f"{self._index_path}: is damaged") from error
        if not isinstance(index, dict) or not isinstance(
            digests := index.get("digests"), dict
        ):
            raise ValueError(f"{self._index_path}: is damaged")
        if not all(
            isinstance(digest, str) and digest.isalnum() for digest in digests.values()
        ):
            raise ValueError(f"{self._index_path}: is damaged")
        return str(index.get("stamp")), digests

    def _write(self, digests: Mapping[str, str]) -> None:
        _replace(
            self._index_path,
            json.dumps({"stamp": self._stamp, "digests": digests}).encode(),
        )


def _key_text(key: object) -> str:
    """Return a text for a signature and a processor."""
    return sha256(repr(key).encode()).hexdigest()[:16]


def _replace(path: Path, content: bytes) -> None:
    """Write a file under another name, and let it replace the one at `path`. Raises `OSError`."""
    part = path.with_name(f"{path.name}.{uuid4().hex[:16]}.part")
    try:
        part.write_bytes(content)
        part.replace(path)
    except OSError:
        with suppress(OSError):
            part.unlink(missing_ok=True)
        raise


class _Cache(FunctionCache):
    """Stored results of a function, valid until its module or a compiled one that it uses changes.
    numba compares the function's own file only: a stored caller of a changed `shared` function crashes.
    """

    is_damaged = False
    """True if its files could not be read."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        # Another name than numba's own, whose files of earlier versions have other contents.
        name = f"{self._impl.filename_base}-fgtrack"
        self._cache_file = _Store(self.cache_path, name, _stamp(function.__globals__))  # type: ignore[assignment]  # same methods

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """See numba, without its tables of all types and functions: half a second that only compiling needs.
        Damaged files are the same as missing ones, with a line of the log.
        """
        rtsys.initialize(target_context)
        try:
            return self._load_overload(sig, target_context)  # type: ignore[no-untyped-call]
        except Exception:  # whatever the reader of a damaged file raises
            self.is_damaged = True
            _say(_DAMAGED)
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """See numba; a full disk is no error."""
        try:
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]
        except OSError:
            _say(_NOT_STORED)


_SKIPPED = {
    "inline_closure_likes",
    "with_lifting",
    "dead_branch_prune",
    "inline_overloads",
    "nopython_rewrites",
}


class _LoopCompiler(Compiler):
    """numba's compiler without what closures, `with`, branches on types and array expressions need: a twentieth."""

    def define_pipelines(self) -> list[Any]:
        """See numba."""
        (full,) = super().define_pipelines()  # type: ignore[no-untyped-call]
        full.passes[:] = [
            each for each in full.passes if each[0].name() not in _SKIPPED
        ]
        return [full]


_OPTIONS: dict[str, Any] = {"error_model": "numpy", "pipeline_class": _LoopCompiler}


def njit(signature: str, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles a function once: it is stored in a cache folder, if one can be written.
    One line of the log reports that loops are compiled, another one that they cannot be stored. A function whose
    signature begins with a number type or void must not allocate arrays, see `scratch`: no references are counted then.
    """
    returns_arrays = not signature.partition("(")[0].isidentifier()
    options |= {**_OPTIONS, "no_cfunc_wrapper": True, "_nrt": returns_arrays}

    def compiled(function: Callable[..., Any]) -> Any:
        result: Any = numba.njit(**options)(function)
        try:
            result._cache = _Cache(function)
        except RuntimeError:  # numba has no folder to write to
            _say(_NOT_STORED)
        collects = gc.isenabled()
        gc.disable()  # a compiler makes millions of objects that stay, and to look for cycles is a tenth of its time
        result.compile(signature)
        result.disable_compile()
        if collects:
            gc.enable()
        if (
            result.stats.cache_misses
            and isinstance(result._cache, _Cache)
            and not result._cache.is_damaged
        ):
            _say("compiling numerical loops, once: some 25 s of processor time for all")
        return result

    return compiled


def _declare(
    function: Callable[..., Any], signatures: list[Any], lower: Callable[..., Any]
) -> None:
    """Let compiled functions call one with these signatures: `lower` writes their code."""
    template = type(
        function.__name__, (ConcreteTemplate,), {"key": function, "cases": signatures}
    )
    infer_global(function, numba.types.Function(template))  # type: ignore[no-untyped-call]
    for each in signatures:
        lower_builtin(function, *each.args)(lower)  # type: ignore[no-untyped-call]


def shared(signature: str) -> Callable[[_Function], _Function]:
    """Return a decorator of functions that only compiled ones call, by an address: compiled and stored as by `njit`.
    Others are optimised and translated once more as a part of each function that calls them.
    """

    def compiled(function: _Function) -> _Function:
        (result,) = njit(signature, no_cpython_wrapper=True)(
            function
        ).overloads.values()
        name = f"{function.__module__}.{function.__name__} {result.signature}"
        add_symbol(
            name, result.library.get_pointer_to_function(result.fndesc.llvm_func_name)
        )

        def call(context: Any, builder: Any, own: Any, args: Any) -> Any:
            of = context.call_conv.get_function_type(own.return_type, own.args)
            callee = get_or_insert_function(builder.module, of, name)  # type: ignore[no-untyped-call]
            return context.call_conv.call_function(
                builder, callee, own.return_type, own.args, args
            )[1]

        _declare(function, [result.signature], call)
        return function

    return compiled


def inlined(function: _Function) -> _Function:
    """Decorate a function that only compiled ones call, which are optimised together with it."""
    options = {
        **_OPTIONS,
        "no_cpython_wrapper": True,
        "no_cfunc_wrapper": True,
        "_nrt": False,
    }
    return cast(_Function, numba.njit(**options)(function))


def merged(function: _Function) -> _Function:
    """Decorate a small function with one caller, which is compiled as a part of it: alone it would be compiled twice.
    A large one is better `shared`: it is copied statement by statement.
    """
    return cast(_Function, numba.njit(**_OPTIONS, inline="always")(function))


def scratch(*shape: int) -> FloatArray:
    """Return a small array on the stack of the compiled function that calls this, outside its loops."""
    raise NotImplementedError


def _lower_scratch(context: Any, builder: Any, own: Any, shape: Any) -> Any:
    array = make_array(own.return_type)(context, builder)  # type: ignore[no-untyped-call]
    strides: list[Any] = []
    count, size = (
        context.get_constant(numba.types.intp, 1),
        context.get_constant(numba.types.intp, 8),
    )
    for length in reversed(shape):
        strides.insert(0, builder.mul(count, size))
        count = builder.mul(count, length)
    data = builder.alloca(context.get_data_type(numba.types.float64), size=count)
    populate_array(
        array, data=data, shape=shape, strides=strides, itemsize=size, meminfo=None
    )  # type: ignore[no-untyped-call]
    return array._getvalue()


_SHAPES: Any = [(numba.types.int64,) * num for num in (1, 2, 3)]
_declare(
    scratch,
    [numba.types.Array(numba.types.float64, len(each), "C")(*each) for each in _SHAPES],
    _lower_scratch,
)

READ, MATRIX = "Array(float64, 2, 'C', readonly=True)", "float64[:, ::1]"


@inlined
def check_rows(rows: IntArray, first: int, end: int) -> None:
    """Raise `IndexError` for one of `rows` that is less than `first`, or not less than `end`.
    Compiled loops check no index: one beyond an end reads or writes other memory. Each call checks those that it gets.
    """
    for i in range(len(rows)):
        if rows[i] < first or rows[i] >= end:
            raise IndexError("a row number lies beyond the end of the arrays")


@inlined
def check(holds: bool) -> None:
    """Raise `IndexError` unless the arrays of a call are as large as its loops need them."""
    if not holds:
        raise IndexError("an array is smaller than another one of the same call")


@inlined
def copy(source: FloatArray, out: FloatArray) -> None:
    """Fill the matrix `out` from the first rows and columns of `source`."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = source[i, j]


@shared(f"void({READ}, {READ}, {MATRIX})")
def product(A: FloatArray, B: FloatArray, out: FloatArray) -> None:
    """Write A B; columns beyond those that meet are ignored."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            value = 0.0
            for k in range(min(A.shape[1], B.shape[0])):
                value += A[i, k] * B[k, j]
            out[i, j] = value


@shared(f"void({READ}, {READ}, {MATRIX})")
def add_product_transposed(A: FloatArray, B: FloatArray, out: FloatArray) -> None:
    """Add A B', which is symmetric, to `out`: its lower triangle, and the mirror of that."""
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
    """Add A P A' to `out`, and write A P."""
    product(A, P, AP)
    add_product_transposed(AP, A, out)


@shared(f"void({READ}, {READ}, {MATRIX}, {MATRIX})")
def add_weighted(K: FloatArray, R: FloatArray, KR: FloatArray, out: FloatArray) -> None:
    """Add K' R K of K (k, n) and the first k rows and columns of R, which is symmetric, to `out`; K' R is written."""
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
    """Write the lower Cholesky factor of the first n rows and columns to L, which may be S; False if there is none."""
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
    """Overwrite columns (n, m) by L^-1 columns, L (n, n) being lower triangular."""
    for i in range(len(columns)):
        for k in range(i):
            for c in range(columns.shape[1]):
                columns[i, c] -= L[i, k] * columns[k, c]
        for c in range(columns.shape[1]):
            columns[i, c] /= L[i, i]


@shared(f"b1({MATRIX}, {MATRIX})")
def solve(S: FloatArray, columns: FloatArray) -> bool:
    """Overwrite columns (n, m) by S^-1 columns, and the first n rows and columns of S by their Cholesky factor.
    False unless they are positive definite.
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


@shared(f"float64({MATRIX}, float64[::1])")
def whiten(S: FloatArray, y: FloatArray) -> float:
    """Overwrite y (n,) by L^-1 y, and S by its Cholesky factor L; return y' S^-1 y, NaN where there is no root."""
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
    """Return the angle in (-pi, pi], unchanged where it lies there."""
    if -math.pi < angle_rad <= math.pi:
        return angle_rad
    turned = math.pi - np.mod(math.pi - angle_rad, 2.0 * math.pi)
    return math.pi if turned <= -math.pi else turned
