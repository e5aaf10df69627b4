"""Compiled loops and where they are stored."""

from typing import Any

import numba
import pytest

from fgtrack.core import compiled


def test_loops_that_cannot_be_stored_are_compiled_with_a_line(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def without_cache(signature: str, cache: bool = False, **options: Any) -> Any:
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return real(signature, **options)

    real = numba.njit
    monkeypatch.setattr(compiled.numba, "njit", without_cache)
    monkeypatch.setattr(compiled, "_said", set())
    doubled = [compiled.njit("int64(int64)")(lambda x: 2 * x) for _ in range(2)]
    assert [function(4) for function in doubled] == [8, 8]
    [line] = caplog.messages
    assert "cannot be stored" in line
    assert "NUMBA_CACHE_DIR" in line


def test_a_shared_function_is_not_part_of_its_callers() -> None:
    twice = compiled.shared("int64(int64)")(lambda x: 2 * x)
    caller = numba.njit("int64(int64)")(lambda x: twice(x) + 1)
    assert caller(4) == 9
    [code] = caller.inspect_llvm().values()
    assert "declare i32 @" in code.replace('@"', "@")
    assert "shl" not in code
