"""The parts of numba outside its public interface that fgtrack uses, and the gain of each part.

numba may change these parts in any version. `pyproject.toml` therefore bounds numba and llvmlite; before a bound is
raised, `tests/unit/test_compiled.py` must pass. All other files use the public interface of numba only.

Measured with numba 0.68.1: the processor time without one part, for all loops, by the public interface alone:

- `WITHOUT_COUNTING`: a transition of CTRV takes 0.52 us instead of 0.30, and compiling 38 s instead of 29.
- `let_loops_call`: compiling takes 56 s instead of 29. A tick does not change.
- `LoopCache`: a start with stored loops takes 0.5 s more. numba's own cache runs a damaged file, and keeps the code
  of a caller after a function in another file changed.
"""

from collections.abc import Callable
from functools import wraps
from typing import Any

from llvmlite import ir
from llvmlite.binding import add_symbol
from numba.core.caching import FunctionCache
from numba.core.runtime.nrt import rtsys
from numba.extending import lower_builtin, type_callable

from fgtrack.core.code_store import CodeStore

NOT_STORED = "compiled loops cannot be stored, so every start compiles them: let NUMBA_CACHE_DIR name a folder"
DAMAGED = "stored loops are damaged or cannot be read: these are compiled again (all of them in some 40 s)"
COMPILING = "compiling numerical loops, once: some 40 s of processor time for all"

#: Option of `numba.njit`: references to arrays are not counted. The function can allocate no arrays then.
WITHOUT_COUNTING = {"_nrt": False}


# Any: numba has no types for compiled functions and signatures.
class LoopCache(FunctionCache):
    """Cache of one compiled function in a `CodeStore`; `report` gets the lines for the log."""

    def __init__(
        self,
        function: Callable[..., Any],
        stamp: bytes,
        report: Callable[[str], None],
    ) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        self._report = report
        # The files have another name than numba's own files, whose content differs.
        name = f"{self._impl.filename_base}-fgtrack"
        self._cache_file = CodeStore(self.cache_path, name, stamp)  # type: ignore[assignment]  # same methods

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the stored code of this signature, or None if it must be compiled.

        numba's own method first loads its tables of all types and functions, which only compiling needs.
        """
        rtsys.initialize(target_context)
        try:
            stored = self._load_overload(sig, target_context)  # type: ignore[no-untyped-call]
        except Exception:  # the reader of a damaged file raises any error
            self._report(DAMAGED)
            return None
        if stored is None:
            self._report(COMPILING)
        return stored

    def save_overload(self, sig: Any, data: Any) -> None:
        """Store the code of this signature; a full disk is no error."""
        try:
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]
        except OSError:
            self._report(NOT_STORED)


def use_cache(dispatcher: Any, cache: LoopCache) -> None:
    """Let a function of `numba.njit` load and store its code in `cache`."""
    dispatcher._cache = cache


def let_loops_call(function: Callable[..., Any], dispatcher: Any) -> None:
    """Let other compiled functions call `function` by the address of its compiled code, in `dispatcher`.

    By the public interface alone, each caller contains a copy of the function and is optimised with this copy.
    """
    (code,) = dispatcher.overloads.values()
    signature = code.signature
    name = f"{function.__module__}.{function.__name__} {signature}"
    address = code.library.get_pointer_to_function(code.fndesc.llvm_func_name)
    add_symbol(name, address)

    def type_call(_: Any) -> Callable[..., Any]:
        @wraps(function)
        def call_type(*_: Any) -> Any:
            return signature

        return call_type

    def write_call(context: Any, builder: Any, own: Any, args: Any) -> Any:
        convention = context.call_conv
        callee = builder.module.globals.get(name)
        if callee is None:
            kind = convention.get_function_type(own.return_type, own.args)
            callee = ir.Function(builder.module, kind, name)
        _, result = convention.call_function(
            builder, callee, own.return_type, own.args, args
        )
        return result

    type_callable(function)(type_call)
    lower_builtin(function, *signature.args)(write_call)  # type: ignore[no-untyped-call]
