"""Draws docs/architecture.svg from the imports: `make picture`.

A box is a folder of `fgtrack`, on the layer that import-linter holds it to, with its number of modules. An arrow leads
to what a folder imports, as wide as the number of modules that do; imports that follow from others are left out.
"""

import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path

import grimp
from matplotlib import rc_context
from matplotlib.figure import Figure

ROOT = Path(__file__).resolve().parents[2]
FILE = ROOT / "docs/architecture.svg"
Edges = Mapping[tuple[str, str], int]
_X = {"testing": -4.4, "tracking": -2.2}  # beside the arrows that pass them


def layers() -> list[list[str]]:
    """Return the folders of every layer, the highest first."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    [floors] = [contract["layers"] for contract in contracts if contract["type"] == "layers"]
    return [[name.strip().removeprefix("fgtrack.") for name in floor.split("|")] for floor in floors]


def imports() -> tuple[Edges, Mapping[str, int]]:
    """Return by pairs of folders the number of modules of the first that import the second, and modules by folder."""
    graph = grimp.build_graph("fgtrack", exclude_type_checking_imports=True)
    edges, modules = dict[tuple[str, str], int](), dict[str, int]()
    for module in sorted(graph.modules):
        own, *_ = [*module.split(".")[1:], ""]
        modules[own] = modules.get(own, 0) + 1
        imported = {name.split(".")[1] for name in graph.find_modules_directly_imported_by(module) if "." in name}
        for other in sorted(imported - {own}):
            edges[own, other] = edges.get((own, other), 0) + 1
    return edges, modules


def reduced(edges: Edges) -> Edges:
    """Return the edges that no longer path implies."""

    def reaches(start: str, end: str, direct: bool) -> bool:
        following = [other for one, other in edges if one == start and (direct or other != end)]
        return any(other == end or reaches(other, end, True) for other in following)

    return {pair: count for pair, count in edges.items() if not reaches(*pair, False)}


def described(edges: Edges) -> str:
    """Return the pairs of folders as the text that the picture carries."""
    return ", ".join(sorted(f"{one} > {other}" for one, other in edges))


def draw(floors: Sequence[Sequence[str]], edges: Edges, modules: Mapping[str, int], file: Path) -> None:
    """Write the picture."""
    figure = Figure(figsize=(7.0, 5.6), layout="constrained")
    axes = figure.subplots()
    at = {
        name: (_X.get(name, 4.4 * (k - (len(floor) - 1) / 2)), float(-row))
        for row, floor in enumerate(floors)
        for k, name in enumerate(floor)
    }
    for (one, other), count in reduced({pair: n for pair, n in edges.items() if set(pair) <= set(at)}).items():
        (x, y), (to_x, to_y) = at[one], at[other]
        arrow = {"arrowstyle": "-|>", "color": "0.45", "lw": 0.6 + 0.12 * min(count, 20), "shrinkA": 0, "shrinkB": 0}
        axes.annotate("", (to_x, to_y + 0.24), (x, y - 0.24), arrowprops=arrow)
    for name, (x, y) in at.items():
        box = {"boxstyle": "round,pad=0.45", "fc": "#e8eef7", "ec": "#39557d"}
        axes.text(x, y, f"{name} ({modules[name]})", ha="center", va="center", color="black", bbox=box)
    axes.set(xlim=(-6.0, 6.0), ylim=(-len(floors) + 0.5, 0.5))
    axes.axis("off")
    with rc_context({"svg.hashsalt": "fgtrack", "svg.fonttype": "none"}):
        figure.savefig(file, metadata={"Date": None, "Creator": None, "Description": described(edges)})


def main() -> None:
    """Draw the picture."""
    draw(layers(), *imports(), FILE)


if __name__ == "__main__":
    main()
