"""Methods for late measurements, of fgtrack and of other packages, against the exact estimate.

    python experiments/leaderboard/leaderboard.py -o out/leaderboard

The methods of Stone Soup, PyRecEst and filterpy need the extra `rivals`; a method whose
package is missing is left out, and the script prints its name.
"""

import csv
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer

import fgtrack

METHODS = Path(__file__).parent / "methods"
SHIPPED = ("smoother-banded", "ekf-replay", "asd", "ekf-backward-forward", "drop")
#: Method by the name of its package and file.
OTHERS = (
    ("stonesoup", "stone_soup.py:Sorted"),
    ("stonesoup", "stone_soup.py:Accumulated"),
    ("stonesoup", "stone_soup.py:AtArrival"),
    ("stonesoup", "stone_soup.py:Buffered"),
    ("stonesoup", "stone_soup.py:InverseTime"),
    ("stonesoup", "stone_soup.py:Particles"),
    ("pyrecest", "pyrecest_replay.py:Replay"),
    ("filterpy", "filterpy_lag.py:FixedLag"),
)
SCENARIOS = ("late-by-1", "late-by-3", "late-by-10", "bursts", "linear")


def main(
    out: Annotated[Path, typer.Option("-o", help="Folder for the tables.")],
    runs: int = 10,
    seed: int = 1,
) -> None:
    """Rank all methods in five scenarios, and write `leaderboard.md`, `leaderboard.csv` and a page for each method."""
    methods = list(SHIPPED)
    for package, name in OTHERS:
        if find_spec(package) is None:
            print(f"{name}: left out, {package} is not installed")
        else:
            methods.append(str(METHODS / name))
    found = fgtrack.rank(methods, SCENARIOS, num_runs=runs, seed=seed)
    out.mkdir(parents=True, exist_ok=True)
    table = found.deviations()
    text = "\n".join([table.to_markdown(), found.tables.to_markdown()])
    (out / "leaderboard.md").write_text(text, encoding="utf-8")
    (out / "leaderboard.tex").write_text(table.to_latex(), encoding="utf-8")
    for name in found.methods:
        (out / f"{name}.md").write_text(found.page(name), encoding="utf-8")
    with (out / "leaderboard.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, ("method", *SCENARIOS))
        writer.writeheader()
        writer.writerows(table.plain())
    print(table.to_markdown())


if __name__ == "__main__":
    typer.run(main)
