"""What is installed: bounds in pyproject.toml, and the lock file that the Makefile and CI install from."""

import ast
import re
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.version import Version

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS = PROJECT["optional-dependencies"]
REQUIRED = [Requirement(line) for line in PROJECT["dependencies"]]
LOCKED_EXTRAS = ("test", "dev", "docs")

# Bound above because fgtrack builds on more than their documented interface, or they promise none yet.
BOUND_ABOVE = {
    "gtsam",
    "numpy",
    "scipy",
    "rosbags",
    "ruamel.yaml",
    "pydantic",
    "typer",
    "joblib",
    "motrics",
    "matplotlib",
}


def _name(text: str) -> str:
    return re.sub(r"[-_.]+", "-", text).lower()


@pytest.fixture(scope="module")
def locked() -> dict[str, tuple[Version, int]]:
    """Version and number of hashes of every package of the lock file."""
    blocks = re.findall(
        r"^([A-Za-z0-9._-]+)(?:\[[^]]*\])?==([^ ;\\\n]+)[^\n]*\n((?:    --hash=[^\n]+\n)*)",
        (ROOT / "requirements.lock").read_text(encoding="utf-8"),
        re.MULTILINE,
    )
    return {_name(name): (Version(version), len(hashes.splitlines())) for name, version, hashes in blocks}


def test_what_is_imported_is_asked_for() -> None:
    """Not only by another package, whose next or last version may do without it."""
    asked = {_name(one.name) for one in REQUIRED}
    asked |= {_name(Requirement(line).name) for extra in ("dask", "foxglove", "fast") for line in EXTRAS[extra]}
    installed = packages_distributions()
    imported = {
        name.split(".")[0]
        for path in (ROOT / "fgtrack").rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        for name in _imported(node)
    }
    others = sorted(imported - sys.stdlib_module_names - {"fgtrack", "compression"})  # the latter of Python 3.14
    assert len(others) > 10
    assert [name for name in others if not asked & {_name(one) for one in installed.get(name, [])}] == []


def _imported(node: ast.AST) -> list[str]:
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    return [node.module] if isinstance(node, ast.ImportFrom) and node.module and not node.level else []


def test_every_dependency_has_a_lower_bound() -> None:
    lines = [*REQUIRED, *(Requirement(line) for group in EXTRAS.values() for line in group)]
    assert [one.name for one in lines if not any(part.operator == ">=" for part in one.specifier)] == []


def test_what_may_change_without_notice_is_bound_above() -> None:
    bound = {one.name for one in REQUIRED if any(part.operator == "<" for part in one.specifier)}
    assert bound == BOUND_ABOVE


def test_the_lock_file_holds_what_the_project_asks_for(locked: dict[str, tuple[Version, int]]) -> None:
    lines = [*REQUIRED, *(Requirement(line) for extra in LOCKED_EXTRAS for line in EXTRAS[extra])]
    assert [one.name for one in lines if _name(one.name) not in locked] == []
    assert [str(one) for one in lines if locked[_name(one.name)][0] not in one.specifier] == []


def test_every_locked_package_has_hashes(locked: dict[str, tuple[Version, int]]) -> None:
    assert len(locked) > len(REQUIRED)
    assert [name for name, (_, hashes) in locked.items() if not hashes] == []


def test_the_makefile_installs_what_is_locked() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    recipe = makefile.split("$(STAMP): pyproject.toml requirements.lock\n")[1].split("\n\n")[0]
    installs = [line for line in recipe.splitlines() if "pip install" in line]
    assert ["--require-hashes -r requirements.lock" in line or "--no-deps" in line for line in installs] == [True, True]


def test_packages_of_the_extras_are_locked(locked: dict[str, tuple[Version, int]]) -> None:
    asked = {_name(Requirement(line).name) for extra in ("dask", "foxglove", "fast") for line in EXTRAS[extra]}
    assert asked <= set(locked)
