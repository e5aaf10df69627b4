"""What is installed: bounds in pyproject.toml, and the lock files that the Makefile installs from."""

import ast
import re
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.version import Version

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))[
    "project"
]
EXTRAS = PROJECT["optional-dependencies"]
REQUIRED = [Requirement(line) for line in PROJECT["dependencies"]]
ABSENT = {
    "asterix": "libasterix",
    "foxglove": "foxglove-sdk",
    "pyais": "pyais",
}  # packages of modules that may not be installed
LOCKED_EXTRAS = ("test", "dev", "docs")


def _name(text: str) -> str:
    return re.sub(r"[-_.]+", "-", text).lower()


LOCKS = ("install", "run", *LOCKED_EXTRAS)


def _packages(lock: str) -> dict[str, tuple[set[Version], int]]:
    """Versions (one for each range of Pythons) and number of hashes of every package of a lock file."""
    blocks = re.findall(
        r"^([A-Za-z0-9._-]+)(?:\[[^]]*\])?==([^ ;\\\n]+)[^\n]*\n((?:    --hash=[^\n]+\n)*)",
        (ROOT / "requirements" / f"{lock}.txt").read_text(encoding="utf-8"),
        re.MULTILINE,
    )
    packages: dict[str, tuple[set[Version], int]] = {}
    for name, version, hashes in blocks:
        versions, count = packages.get(_name(name), (set(), len(hashes.splitlines())))
        packages[_name(name)] = (
            versions | {Version(version)},
            min(count, len(hashes.splitlines())),
        )
    return packages


@pytest.fixture(scope="module")
def locked() -> dict[str, dict[str, tuple[set[Version], int]]]:
    return {lock: _packages(lock) for lock in LOCKS}


def test_what_is_imported_is_asked_for() -> None:
    """Not only by another package, whose next or last version may do without it."""
    asked = {_name(one.name) for one in REQUIRED}
    asked |= {
        _name(Requirement(line).name)
        for extra in ("dask", "foxglove", "ais", "asterix", "parquet")
        for line in EXTRAS[extra]
    }
    installed = packages_distributions()
    imported = {
        name.split(".")[0]
        for path in (ROOT / "fgtrack").rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        for name in _imported(node)
    }
    others = sorted(
        imported - sys.stdlib_module_names - {"fgtrack", "compression"}
    )  # the latter of Python 3.14
    assert len(others) > 10
    assert [
        name
        for name in others
        if not asked & {_name(one) for one in installed.get(name) or [ABSENT[name]]}
    ] == []


def _imported(node: ast.AST) -> list[str]:
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    return (
        [node.module]
        if isinstance(node, ast.ImportFrom) and node.module and not node.level
        else []
    )


@pytest.mark.parametrize("lock", LOCKS[1:])
def test_a_lock_file_holds_what_the_project_asks_for(
    lock: str, locked: dict[str, Any]
) -> None:
    extras = ("test", "rivals", "foxglove", "live") if lock == "test" else (lock,)
    lines = [
        *REQUIRED,
        *(Requirement(line) for extra in extras for line in EXTRAS.get(extra, [])),
    ]
    assert [one.name for one in lines if _name(one.name) not in locked[lock]] == []
    outside = [
        one
        for one in lines
        if not all(v in one.specifier for v in locked[lock][_name(one.name)][0])
    ]
    assert outside == []


@pytest.mark.parametrize("lock", LOCKS)
def test_every_locked_package_has_hashes(lock: str, locked: dict[str, Any]) -> None:
    assert len(locked[lock]) > 4
    assert [name for name, (_, hashes) in locked[lock].items() if not hashes] == []


def test_lock_files_agree_on_versions(locked: dict[str, Any]) -> None:
    """They are installed into one environment."""
    versions: dict[str, set[frozenset[Version]]] = {}
    for packages in locked.values():
        for name, (found, _) in packages.items():
            versions.setdefault(name, set()).add(frozenset(found))
    assert [name for name, found in versions.items() if len(found) > 1] == []


def test_the_makefile_installs_what_is_locked() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    recipes = makefile.split("$(BIN)/uv: requirements/install.txt\n")[1].split(
        "$(TOOLS):"
    )[0]
    installs = [
        part
        for line in recipes.splitlines()
        for part in line.split("||")
        if re.search(r"pip install|PIP", part)
    ]
    assert len(installs) == 5
    assert [
        part
        for part in installs
        if "--require-hashes -r $<" not in part and "--no-deps" not in part
    ] == []
    assert re.search(r"^demo: \$\(RUN\)\n", makefile, re.MULTILINE)
