"""Compiled loops and where they are stored."""

import sys
from collections.abc import Callable
from importlib import util
from pathlib import Path
from typing import Any

import numba
import pytest

from fgtrack.core import compiled


def loaded(path: Path, source: str) -> Any:
    """The module of this `source` at `path`, as a new process would load it."""
    path.write_text(source)
    spec = util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = util.module_from_spec(spec)
    sys.modules[path.stem] = module
    compiled._stamps.pop(path.stem, None)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def stored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str, str], Any]:
    """Function that loads the modules `callee` and `caller`, whose loops are stored in a folder of this test."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(compiled, "_said", set())

    def load(callee: str, caller: str) -> Any:
        head = "from fgtrack.core.compiled import inlined, njit, shared\nOFFSET = 1\n"
        loaded(tmp_path / "callee.py", head + callee)
        return loaded(tmp_path / "caller.py", "from callee import OFFSET, twice\n" + head.split("OFFSET")[0] + caller)

    yield load
    for name in ("callee", "caller"):
        sys.modules.pop(name, None)
        compiled._stamps.pop(name, None)


CALLER = "@njit('float64(int64)')\ndef call(x):\n    return twice(x) + OFFSET\n"
SHARED = "@shared('int64(int64)')\ndef twice(x):\n    return 2 * x\n"


def test_loops_are_compiled_once_and_stored(stored, caplog: pytest.LogCaptureFixture) -> None:
    assert stored(SHARED, CALLER).call(3) == 7.0
    [line] = caplog.messages
    assert "compiling numerical loops, once" in line
    again = stored(SHARED, CALLER).call
    assert again(3) == 7.0
    assert again.stats.cache_hits
    assert not again.stats.cache_misses


@pytest.mark.parametrize(
    "changed",
    [
        "@shared('float64(float64)')\ndef twice(x):\n    return 2.5 * x\n",
        "@inlined\ndef twice(x):\n    return 2.5 * x\n",
        SHARED + "OFFSET = 1.5\n",
    ],
)
def test_what_is_stored_of_a_caller_is_not_used_after_another_module_changed(stored, changed: str) -> None:
    assert stored(SHARED, CALLER).call(3) == 7.0
    after = stored(changed, CALLER).call
    assert after(3) == (7.5 if "OFFSET" in changed else 8.5)
    assert after.stats.cache_misses


def test_loops_that_cannot_be_stored_are_compiled_with_one_line(
    stored, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    for name in ("cache", "__pycache__", "home"):
        (tmp_path / name).write_text("a file, in which root cannot make a folder either")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    assert stored(SHARED, CALLER).call(3) == 7.0
    [line] = caplog.messages
    assert "cannot be stored" in line
    assert "NUMBA_CACHE_DIR" in line


def test_a_disk_that_becomes_full_is_no_error(
    stored, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(compiled.FunctionCache, "save_overload", full)
    assert stored(SHARED, CALLER).call(3) == 7.0
    assert sum("cannot be stored" in line for line in caplog.messages) == 1


def test_a_shared_function_is_not_part_of_its_callers() -> None:
    twice = compiled.shared("int64(int64)")(lambda x: 2 * x)
    caller = numba.njit("int64(int64)")(lambda x: twice(x) + 1)
    assert caller(4) == 9
    [code] = caller.inspect_llvm().values()
    assert "declare i32 @" in code.replace('@"', "@")
    assert "shl" not in code


def test_scratch_arrays_do_not_overlap(stored) -> None:
    head = "from fgtrack.core.compiled import scratch\n"
    body = "    a, b, c = scratch(n), scratch(n, 2), scratch(2, 3, n)\n    a[:], b[:], c[:] = 1.0, 2.0, 3.0\n"
    total = "    return a.sum() + b.sum() + c.sum() + c[1, 2, n - 1]\n"
    call = stored(SHARED, head + "@njit('float64(int64)')\ndef call(n):\n" + body + total).call
    assert [call(n) for n in (1, 6)] == [1.0 + 4.0 + 18.0 + 3.0, 6.0 + 24.0 + 108.0 + 3.0]


def test_a_loop_that_gives_a_number_allocates_nothing(stored) -> None:
    with pytest.raises(numba.core.errors.TypingError, match="empty"):
        stored(SHARED, "import numpy as np\n@njit('float64(int64)')\ndef call(n):\n    return np.empty(n)[0]\n")
