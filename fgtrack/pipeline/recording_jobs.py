"""Jobs of a sweep over recordings: each recording is replayed into run folders of its own."""

import json
from collections.abc import Iterable, Mapping
from dataclasses import replace
from hashlib import file_digest, sha256
from pathlib import Path

from fgtrack.config.settings import Config
from fgtrack.config.yaml_file import plain, validate
from fgtrack.core.errors import CallError, DataError
from fgtrack.estimation.registry import ESTIMATORS, MOTION_MODELS
from fgtrack.inputs.source import file_format, input_kind
from fgtrack.meaning.draft import drafted
from fgtrack.pipeline.replay import replay, versions
from fgtrack.pipeline.sweep import Cell, Score, failure
from fgtrack.pipeline.sweep_plan import RECORDING, Job, Plan, Recipe
from fgtrack.runs import Run, is_run_folder, load_run


def recordings_plan(
    recordings: Mapping[str, Path],
    config: Config,
    estimators: tuple[str, ...],
    out: Path,
    settings: Mapping[str, object] | None = None,
) -> Plan:
    """Return the plan of a sweep whose only axis is `recordings`, which are given by name.

    The folder of a recording is `out` with its name. `settings` are further values of
    the recipes. A recording whose files cannot be read becomes a job with a problem.
    """
    code = [ESTIMATORS.sources(), MOTION_MODELS.sources(), versions()]
    jobs = []
    for name, path in recordings.items():
        recipe = {
            "config": plain(config),
            "estimators": estimators,
            "code": code,
            **(settings or {}),
        }
        try:
            content = {**recipe, "files": _hashes(path)}
        except (CallError, DataError) as error:
            jobs.append(Job((name,), 0, "", None, str(error), True))
            continue
        text = json.dumps([name, content], sort_keys=True)
        recipe |= {"recording": str(path), "folder": str(out / name)}
        jobs.append(Job((name,), 0, sha256(text.encode()).hexdigest()[:32], recipe))
    return Plan((RECORDING,), tuple(jobs), estimators, (), tuple(recordings.values()))


def has_runs(job: Job) -> bool:
    """True if there is a run in the folder of `job`; a job without one must be repeated."""
    return job.recipe is not None and any(
        is_run_folder(file.parent)
        for file in Path(job.recipe["folder"]).glob("**/meta.json")
    )


def replay_job(key: str, recipe: Recipe, score: Score) -> tuple[str, tuple[Cell, ...]]:
    """Replay the recording of `recipe` into its run folders, and return `key` and a cell for each estimator.

    The folder of an estimator has its name, or is the recording's folder for a single
    estimator. An exception becomes the error of a cell.
    """
    names = tuple(recipe["estimators"])
    out = Path(recipe["folder"])
    folders = (
        {name: out / name for name in names} if len(names) > 1 else {names[0]: out}
    )
    try:
        draft = drafted(
            recipe["recording"], validate(Config, recipe["config"], "config")
        )
        replay(
            draft.source.messages,
            draft.config,
            folders,
            origin=recipe["recording"],
            kind=draft.source.kind,
            overwrite=True,
            table_format=recipe.get("table_format", "csv"),
            truth=recipe.get("truth"),
        )
        runs = [load_run(folder) for folder in folders.values()]
        cells = tuple(scored(run, score) for run in runs)
    except (
        Exception,
        SystemExit,
    ) as error:  # one failed recording must not end the others
        return key, tuple(Cell(name, {}, {}, failure(error)) for name in names)
    return key, tuple(replace(cell, problem=draft.problem) for cell in cells)


def scored(run: Run, score: Score) -> Cell:
    """Return the cell of a run; the reason of a run that broke off is its error."""
    if run.meta["broken_off"] is not None:
        return Cell(run.estimator, {}, {}, str(run.meta["broken_off"]))
    values, times = score(run)
    return Cell(run.estimator, values, {"replay_s": run.meta["wall_s"], **times})


def _hashes(path: Path) -> list[tuple[str, str]]:
    """Return folder and name of every file of a recording, and its SHA-256; raises `CallError` and `DataError`."""
    files: Iterable[Path] = file_format(input_kind(path)).files(path)
    hashes = []
    for file in sorted(files):
        if file.is_file():
            try:
                with file.open("rb") as content:
                    digest = file_digest(content, "sha256").hexdigest()
            except OSError as error:
                raise DataError(f"{file}: cannot be read ({error.strerror})") from error
            # The recording may move, but its files keep their names.
            hashes.append(("/".join(file.parts[-2:]), digest))
    return hashes
