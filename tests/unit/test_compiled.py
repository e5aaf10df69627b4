"""Compiled loops and where they are stored."""

import os
import pickle
import re
import subprocess
import sys
import tomllib
from collections.abc import Callable
from importlib import util
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from numba.core.caching import FunctionCache
from packaging.requirements import Requirement

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
def stored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[[str, str], Any]:
    """Function that loads the modules `callee` and `caller`, whose loops are stored in a folder of this test."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(compiled, "_said", set())
    # Python takes its own byte code for that of a source of the same size and second.
    monkeypatch.setattr(sys, "dont_write_bytecode", True)

    def load(callee: str, caller: str) -> Any:
        head = (
            "from fgtrack.core.compiled import inlined, merged, njit, shared\n"
            "OFFSET = 1\n"
        )
        loaded(tmp_path / "callee.py", head + callee)
        return loaded(
            tmp_path / "caller.py",
            "from callee import OFFSET, twice\n" + head.split("OFFSET")[0] + caller,
        )

    yield load
    for name in ("callee", "caller"):
        sys.modules.pop(name, None)
        compiled._stamps.pop(name, None)


CALLER = "@njit('float64(int64)')\ndef call(x):\n    return twice(x) + OFFSET\n"
SHARED = "@shared('int64(int64)')\ndef twice(x):\n    return 2 * x\n"


def test_loops_are_compiled_once_and_stored(
    stored, caplog: pytest.LogCaptureFixture
) -> None:
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
def test_what_is_stored_of_a_caller_is_not_used_after_another_module_changed(
    stored, changed: str
) -> None:
    assert stored(SHARED, CALLER).call(3) == 7.0
    after = stored(changed, CALLER).call
    assert after(3) == (7.5 if "OFFSET" in changed else 8.5)
    assert after.stats.cache_misses


@pytest.mark.parametrize("decorator", ["@inlined", "@merged"])
def test_what_is_stored_is_not_used_after_a_module_without_own_loops_changed(
    stored, decorator: str
) -> None:
    callee = f"{decorator}\ndef twice(x):\n    return 2 * x\n"
    assert stored(callee, CALLER).call(3) == 7.0
    after = stored(callee.replace("2 *", "4 *"), CALLER).call
    assert after(3) == 13.0
    assert after.stats.cache_misses


def test_loops_that_cannot_be_stored_are_compiled_with_one_line(
    stored,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    for name in ("cache", "__pycache__", "home"):
        (tmp_path / name).write_text(
            "a file, in which root cannot make a folder either"
        )
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

    monkeypatch.setattr(FunctionCache, "save_overload", full)
    assert stored(SHARED, CALLER).call(3) == 7.0
    assert sum("cannot be stored" in line for line in caplog.messages) == 1


def truncated(file: Path) -> None:
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def random_bytes(file: Path) -> None:
    file.write_bytes(np.random.default_rng(1).bytes(file.stat().st_size))


def one_bit(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 0b100
    file.write_bytes(content)


def nested(file: Path) -> None:
    file.write_bytes(b"[" * 100_000)


DAMAGES: dict[str, Callable[[Path], object]] = {
    "empty": lambda file: file.write_bytes(b""),
    "zeros": lambda file: file.write_bytes(bytes(file.stat().st_size)),
    "null": lambda file: file.write_bytes(b"null"),
    "truncated": truncated,
    "random bytes": random_bytes,
    "one bit": one_bit,
    "nested": nested,
    "longer": lambda file: file.write_bytes(file.read_bytes() + b"more"),
    "pickle": lambda file: file.write_bytes(pickle.dumps(("0.60", {}))),
}


def files(tmp_path: Path, pattern: str) -> list[Path]:
    """Stored files of the modules of this test."""
    return sorted((tmp_path / "cache").rglob(pattern))


@pytest.mark.parametrize("damage", DAMAGES, ids=lambda name: name.replace(" ", "-"))
@pytest.mark.parametrize(
    "pattern", ["caller*.nbc", "caller*.nbi", "callee*.nbc", "callee*.nbi", "*.nb[ci]"]
)
def test_damaged_files_are_replaced_with_one_line(
    stored, tmp_path: Path, caplog: pytest.LogCaptureFixture, pattern: str, damage: str
) -> None:
    assert stored(SHARED, CALLER).call(3) == 7.0
    caplog.clear()
    damaged = files(tmp_path, pattern)
    assert damaged
    for file in damaged:
        DAMAGES[damage](file)
    assert stored(SHARED, CALLER).call(3) == 7.0
    [line] = caplog.messages
    assert "damaged" in line
    caplog.clear()
    compiled._said.clear()
    healed = stored(SHARED, CALLER).call
    assert healed(3) == 7.0
    assert healed.stats.cache_hits
    assert not caplog.messages


def test_the_code_of_another_function_is_not_run(stored, tmp_path: Path) -> None:
    """Files that were mixed up by a copy are whole, but not those of the function."""
    body = "@njit('float64(int64)')\ndef other(x):\n    return 5.0 * twice(x)\n"
    module = stored(SHARED, CALLER + body)
    assert (module.call(3), module.other(3)) == (7.0, 30.0)
    for suffix in ("nbc", "nbi"):
        [call], [other] = (
            files(tmp_path, f"caller.call*.{suffix}"),
            files(tmp_path, f"caller.other*.{suffix}"),
        )
        call.write_bytes(other.read_bytes())
        module = stored(SHARED, CALLER + body)
        assert (module.call(3), module.other(3)) == (7.0, 30.0)


@pytest.mark.parametrize("pattern", ["caller*.nbc", "caller*.nbi"])
def test_a_file_that_cannot_be_read_is_replaced(
    stored,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    pattern: str,
) -> None:
    """Permissions mean nothing to root, so the reading itself is refused."""
    assert stored(SHARED, CALLER).call(3) == 7.0
    caplog.clear()
    [refused] = files(tmp_path, pattern)
    inode, read = refused.stat().st_ino, Path.read_bytes

    def read_bytes(path: Path) -> bytes:
        if path == refused and path.stat().st_ino == inode:
            raise PermissionError(13, "Permission denied")
        return read(path)

    monkeypatch.setattr(Path, "read_bytes", read_bytes)
    assert stored(SHARED, CALLER).call(3) == 7.0
    assert sum("damaged or cannot be read" in line for line in caplog.messages) == 1
    assert stored(SHARED, CALLER).call.stats.cache_hits


@pytest.mark.parametrize("pattern", ["caller*.nbc", "caller*.nbi"])
def test_a_folder_instead_of_a_file_is_no_error(
    stored, tmp_path: Path, caplog: pytest.LogCaptureFixture, pattern: str
) -> None:
    assert stored(SHARED, CALLER).call(3) == 7.0
    [file] = files(tmp_path, pattern)
    file.unlink()
    file.mkdir()
    assert stored(SHARED, CALLER).call(3) == 7.0
    assert sum("damaged or cannot be read" in line for line in caplog.messages) == 1
    assert not list(tmp_path.rglob("*.part"))


@pytest.mark.parametrize("part", [".nbc.", ".nbi."])
def test_a_disk_that_is_full_in_the_middle_leaves_no_part_and_no_damage(
    stored,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    part: str,
) -> None:
    write = Path.write_bytes

    def write_bytes(path: Path, content: bytes) -> int:
        if part in path.name:
            write(path, content[: len(content) // 2])
            raise OSError(28, "No space left on device")
        return write(path, content)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", write_bytes)
        assert stored(SHARED, CALLER).call(3) == 7.0
    assert sum("cannot be stored" in line for line in caplog.messages) == 1
    assert not list(tmp_path.rglob("*.part"))
    caplog.clear()
    compiled._said.clear()
    assert stored(SHARED, CALLER).call(3) == 7.0
    assert stored(SHARED, CALLER).call.stats.cache_hits
    assert not [line for line in caplog.messages if "damaged" in line]


def test_what_was_stored_of_an_earlier_source_does_not_pile_up(
    stored, tmp_path: Path
) -> None:
    for factor in (2, 3, 4):
        assert (
            stored(SHARED.replace("2 *", f"{factor} *"), CALLER).call(3)
            == 3.0 * factor + 1.0
        )
        assert (
            len(files(tmp_path, "callee*.nbc"))
            == len(files(tmp_path, "caller*.nbc"))
            == 1
        )
    again = stored(SHARED.replace("2 *", "4 *"), CALLER).call
    assert again.stats.cache_hits


@pytest.mark.long
def test_other_processes_find_what_is_stored_even_if_two_write_at_once(
    tmp_path: Path,
) -> None:
    (tmp_path / "callee.py").write_text(
        f"from fgtrack.core.compiled import shared\n{SHARED}"
    )
    head = (
        "from fgtrack.core.compiled import njit\nfrom callee import twice\nOFFSET = 1\n"
    )
    (tmp_path / "caller.py").write_text(
        f"{head}{CALLER}print(call(3), sum(call.stats.cache_hits.values()))\n"
    )
    environment = {
        **os.environ,
        "NUMBA_CACHE_DIR": str(tmp_path / "cache"),
        "PYTHONPATH": str(tmp_path),
    }
    command = sys.executable, str(tmp_path / "caller.py")

    def start() -> subprocess.Popen[str]:
        return subprocess.Popen(
            command,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    for process in [start(), start()]:
        out, error = process.communicate(timeout=120.0)
        assert out.startswith("7.0 "), error
    out, error = start().communicate(timeout=120.0)
    assert out == "7.0 1\n", error


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
    call = stored(
        SHARED, head + "@njit('float64(int64)')\ndef call(n):\n" + body + total
    ).call
    assert [call(n) for n in (1, 6)] == [
        1.0 + 4.0 + 18.0 + 3.0,
        6.0 + 24.0 + 108.0 + 3.0,
    ]


def test_a_loop_that_gives_a_number_allocates_nothing(stored) -> None:
    with pytest.raises(numba.core.errors.TypingError, match="empty"):
        stored(
            SHARED,
            "import numpy as np\n@njit('float64(int64)')\ndef call(n):\n    return np.empty(n)[0]\n",
        )


def test_an_array_on_the_stack_is_an_ordinary_array_outside_compiled_functions() -> (
    None
):
    array = compiled.scratch(2, 3)
    array[:] = 1.0
    assert array.sum() == 6.0


def test_versions_of_numba_with_other_internals_are_refused() -> None:
    file = Path(compiled.__file__).parents[2] / "pyproject.toml"
    lines = tomllib.loads(file.read_text())["project"]["dependencies"]
    requirements = {each.name: each for each in map(Requirement, lines)}
    for name in ("numba", "llvmlite"):
        limits = {each.operator for each in requirements[name].specifier}
        assert "<" in limits
        assert requirements[name].specifier.contains(version(name))


def test_the_inside_of_numba_is_imported_in_one_file() -> None:
    package = Path(compiled.__file__).parents[1]
    inside = re.compile(r"^\s*(from|import) numba\.(?!extending\b)", re.MULTILINE)
    found = [
        path.name for path in package.rglob("*.py") if inside.search(path.read_text())
    ]
    assert found == ["numba_internals.py"]


def test_the_makefile_compiles_every_module_of_loops_before_the_tests() -> None:
    root = Path(compiled.__file__).parents[2]
    decorator = re.compile(r"^@(njit|shared)\(", re.MULTILINE)
    modules = {
        ".".join(path.relative_to(root).with_suffix("").parts)
        for path in (root / "fgtrack").rglob("*.py")
        if decorator.search(path.read_text(encoding="utf-8"))
    }
    printed = subprocess.run(
        ["make", "-n", "test"], cwd=root, capture_output=True, text=True, check=True
    ).stdout
    halves = [
        set(re.findall(r"import (fgtrack[\w.]+)", half))
        for half in printed.split("&", 1)
    ]
    assert halves[0] | halves[1] == modules
    assert not halves[0] & halves[1]
