"""`fgtrack rank`: ranks methods for late measurements against the exact estimate."""

import json
from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from fgtrack.cli.arguments import FormOption, Overwrite, Seed
from fgtrack.cli.show import progress, say, sentences, show
from fgtrack.core.errors import CallError, DataError
from fgtrack.core.output import check_output, new_files
from fgtrack.ranking.crowd_files import write_crowd, write_crowd_truth
from fgtrack.ranking.crowds import CROWDS
from fgtrack.ranking.files import write_exact, write_problem
from fgtrack.ranking.judge import judge
from fgtrack.ranking.methods import TIME_LIMIT_S
from fgtrack.ranking.public import method
from fgtrack.ranking.result import Ranking
from fgtrack.ranking.scenarios import SCENARIOS, draw


def rank(
    methods: Annotated[
        list[str] | None,
        Argument(
            metavar="METHOD...",
            help="Estimator of fgtrack, Python file (FILE.py or FILE.py:NAME), or executable program.",
        ),
    ] = None,
    scenarios: Annotated[
        list[str] | None,
        Option(
            "--scenario",
            help=f"Scenario; repeatable. One object (default): {', '.join(SCENARIOS)}. "
            f"Several objects: {', '.join(CROWDS)}.",
        ),
    ] = None,
    runs: Annotated[int, Option(min=2, help="Number of runs of each scenario.")] = 10,
    seed: Seed = 1,
    time_limit_s: Annotated[
        float,
        Option(
            "--time-limit",
            min=0.001,
            metavar="S",
            help="Longest time of a run of a program in s.",
        ),
    ] = TIME_LIMIT_S,
    form: FormOption = None,
    out: Annotated[
        Path | None,
        Option("-o", "--out", help="Folder for ranking.md, ranking.json and pages."),
    ] = None,
    export: Annotated[
        Path | None,
        Option("--export", help="Write the first run of each scenario into a folder."),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Rank methods for late measurements of one or several objects.

    Each method answers the same questions: where is the object now, and where was it?
    The answers are compared with the truth and with the exact joint estimate, the tracks
    of several objects with the truth.
    """
    names = list(dict.fromkeys(scenarios or SCENARIOS))
    if not methods and export is None:
        raise CallError("give at least one METHOD, or --export FOLDER")
    chosen = [method(text, time_limit_s) for text in methods or ()]
    for path in _outputs(out, [each.name for each in chosen]):
        check_output(path, overwrite)
    if export is not None:
        for name in names:
            _export(export / name, name, seed, overwrite)
    if not chosen:
        return
    with progress("rank") as step:
        found = judge(chosen, names, runs, seed, step)
    show(found.tables, form)
    if form is None:
        for each in chosen:
            say(f"{each.name}:")
            sentences(found.sentences(each.name))
    if out is not None:
        _write(out, found, [each.name for each in chosen], overwrite)
    failed = [each for each in found.results if each.problem and each.takes_part]
    if failed:
        raise DataError(
            f"{failed[0].method}: {failed[0].scenario}: {failed[0].problem}"
        )


def _write(out: Path, found: Ranking, names: list[str], overwrite: bool) -> None:
    """Write the tables, and a page for each method, into the folder `out`."""
    tables = found.tables
    with new_files(out, overwrite) as folder:
        (folder / "ranking.md").write_text(tables.to_markdown(), encoding="utf-8")
        (folder / "ranking.tex").write_text(tables.to_latex(), encoding="utf-8")
        (folder / "ranking.json").write_text(
            json.dumps(tables.to_dict(), indent=2), encoding="utf-8"
        )
        for name in names:
            (folder / f"{name}.md").write_text(found.page(name), encoding="utf-8")


def _outputs(out: Path | None, names: list[str]) -> list[Path]:
    """Return the files that a ranking of the methods `names` writes into `out`."""
    if out is None:
        return []
    tables = [out / f"ranking.{ending}" for ending in ("md", "tex", "json")]
    return [*tables, *(out / f"{name}.md" for name in names)]


def _export(folder: Path, name: str, seed: int, overwrite: bool) -> None:
    """Write measurements, truth and exact states of the scenario `name` into a folder."""
    with new_files(folder, overwrite) as into:
        if name in CROWDS:
            crowd = CROWDS[name].draw(name, seed)
            write_crowd(into, crowd)
            write_crowd_truth(into, crowd)
            return
        problem = draw(name, seed)
        write_problem(into, problem)
        write_exact(into, problem)
