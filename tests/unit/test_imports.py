"""Imports among the modules of fgtrack."""

import ast
import re
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import fgtrack

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "fgtrack"
PUBLIC = ("config", "evaluation", "show", "sim", "testing")


def module_name(path: Path) -> str:
    name = ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)
    return name.removesuffix(".__init__")


MODULES = {module_name(path): path for path in PACKAGE.rglob("*.py")}


def imported(node: ast.AST) -> Iterator[str]:
    """Modules imported anywhere below a node, without those for type checkers."""
    if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
        return
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    if isinstance(node, ast.ImportFrom) and node.module:
        for alias in node.names:
            inner = f"{node.module}.{alias.name}"
            yield inner if inner in MODULES else node.module
    for child in ast.iter_child_nodes(node):
        yield from imported(child)


#: Private modules that a script may import, with the reason.
PRIVATE = {
    "experiments/association/association.py": "replaces the association in the tracker",
    "experiments/advise/noise_intervals.py": "evaluates the likelihood of the noise itself",
    "experiments/real_delays/real_delays.py": "reads the tracker between the ticks of a replay",
    "experiments/bench_banks.py": "times a bank without a tracker",
    "experiments/bench_deadlines.py": "times the tracker without the replay around it",
    "experiments/bench_memory.py": "measures memory inside a replay",
    "experiments/bench_soak.py": "hashes the rows of a run that is never stored",
    "experiments/bench_tracker.py": "times the tracker without the replay around it",
    "docs/_ext/reference.py": "reads docstrings of private classes",
}
BLOCK = re.compile(r"^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)


def scripts() -> Iterator[tuple[str, str]]:
    """Paths and texts of the experiments, the example, the tutorials, and of the Python on the pages."""
    for path in sorted([*ROOT.glob("experiments/**/*.*"), *ROOT.glob("docs/**/*.*")]):
        name = path.relative_to(ROOT).as_posix()
        if name.startswith("docs/generated/"):
            continue
        if path.suffix == ".py":
            yield name, path.read_text(encoding="utf-8")
        elif path.suffix == ".md":
            for number, text in enumerate(BLOCK.findall(path.read_text("utf-8"))):
                if "behind:" not in text and "import" in text:
                    yield f"{name} {number}", text


def private_imports(text: str) -> list[str]:
    """Names that a script imports from fgtrack, without the public ones."""
    found = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            found += [each.name for each in node.names if "fgtrack." in each.name]
        if isinstance(node, ast.ImportFrom) and (node.module or "")[:7] == "fgtrack":
            for alias in node.names:
                _, _, module = (node.module or "").partition(".")
                home = getattr(fgtrack, module, None) if module else fgtrack
                if module not in ("", *PUBLIC) or alias.name not in home.__all__:
                    found.append(f"{node.module}.{alias.name}")
    return [name for name in found if not name.startswith("fgtrack_")]


def test_experiments_and_pages_import_public_names_alone() -> None:
    private = {name: private_imports(text) for name, text in scripts()}
    assert len(private) > 60
    assert {name for name, found in private.items() if found} == set(PRIVATE), private


def test_no_module_imports_itself_through_others() -> None:
    """Imports inside functions count, so that no circle hides there."""
    graph = {
        name: set(imported(ast.parse(path.read_text(encoding="utf-8")))) - {name}
        for name, path in MODULES.items()
    }
    order = list(TopologicalSorter(graph).static_order())
    assert order.index("fgtrack.core.types") < order.index("fgtrack.cli.main")
