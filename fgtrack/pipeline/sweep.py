"""Sweeps: runs the jobs of a plan on all cores or on a cluster, stores each finished job, and writes tables."""

import fnmatch
import importlib
import json
import logging
import os
import signal
import threading
import time
import warnings
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from multiprocessing import resource_tracker
from pathlib import Path

import joblib  # type: ignore[import-untyped]  # has no stubs
import numpy as np
import pandas as pd
from pydantic import ConfigDict, TypeAdapter

from fgtrack.config.settings import Config
from fgtrack.config.yaml_file import validate
from fgtrack.core.errors import CallError, DataError, FgtrackError
from fgtrack.core.output import check_output, locked_folder, write_file
from fgtrack.core.types import Message
from fgtrack.evaluation.scalars import Scalar
from fgtrack.meaning.assumed import assumed
from fgtrack.meaning.draft import opened
from fgtrack.pipeline.replay import replay_in_memory
from fgtrack.pipeline.simulation import simulated
from fgtrack.pipeline.sweep_plan import KEY_COLUMNS, Job, Plan, Recipe, Value, compact
from fgtrack.runs import Run
from fgtrack.sim.new_delays import SensorDelays, redelay
from fgtrack.sim.scenario import Scenario

SWEEP_TABLE = "sweep.csv"
TIMING_TABLE = "timing.csv"
ERROR_TABLE = "errors.csv"
PAIRED_TABLE = "paired.csv"
SUMMARY_TABLE = "summary.csv"
_PARTS = "parts"
_TABLES = (SWEEP_TABLE, TIMING_TABLE, ERROR_TABLE, PAIRED_TABLE, SUMMARY_TABLE)
PRODUCTS = (*_TABLES, _PARTS)
_SCHEDULER_TIMEOUT_S = 10
#: Period in which a worker process checks that the sweep is still running.
_WATCH_S = 1.0
#: Jobs that are dispatched ahead for each process.
_HANDED_OUT = 2
_logger = logging.getLogger(__name__)

#: Function that returns reproducible metrics and wall times of a run, by column. Other processes must be able to import
#: the function.
Score = Callable[[Run], tuple[Mapping[str, Scalar], Mapping[str, Scalar]]]


@dataclass(frozen=True)
class Cell:
    """Result of one estimator in one job."""

    estimator: str
    values: Mapping[str, Scalar]
    """Metrics by column."""
    times: Mapping[str, Scalar]
    """Wall times by column."""
    error: str | None = None
    """Reason on one line if there is no result, else None."""
    problem: str | None = None
    """Line on open questions about the recording, whose sensors are left out; None without such questions."""


_Result = tuple[str, Sequence[Cell]]
#: Function that returns key and cells of a job. Other processes must be able to import the function.
Work = Callable[[str, Recipe, Score], _Result]
_CELLS = TypeAdapter(tuple[Cell, ...], config=ConfigDict(strict=True, extra="forbid"))


@dataclass(frozen=True)
class SweepResult:
    """Summary of the tables that a sweep has written."""

    num_good: int
    """Number of cells with metrics."""
    errors: tuple[str, ...]
    """Reasons of the failed cells."""
    unknown_metrics: tuple[str, ...]
    """Metrics of the plan that match no column."""
    problems: tuple[str, ...] = ()
    """Lines on open questions about recordings."""


@dataclass(frozen=True)
class Sweep:
    """A plan, and the folder for its results, which may contain finished jobs of an earlier run."""

    plan: Plan
    folder: Path
    done: dict[str, Sequence[Cell]]
    """Cells of the finished jobs by key."""

    @classmethod
    def open(cls, plan: Plan, folder: Path, overwrite: bool = False) -> "Sweep":
        """Return the sweep `plan` in `folder`.

        Raises `CallError` if the folder contains tables but no finished jobs, unless
        `overwrite` is true.
        """
        parts = {path.stem: path for path in (folder / _PARTS).glob("*.json")}
        for name in _TABLES:
            check_output(folder / name, overwrite or bool(parts))
        cells = {
            key: _read_part(parts[key])
            for key in parts.keys() & {job.key for job in plan.jobs}
        }
        return cls(
            plan, folder, {key: result for key, result in cells.items() if result}
        )

    @property
    def todo(self) -> list[Job]:
        """Jobs without a result, or with a failed cell.

        They are ordered by seed, so an interrupted sweep covers the whole grid with the
        first seeds.
        """
        good = {
            key
            for key, cells in self.done.items()
            if all(cell.error is None for cell in cells)
        }
        left = {
            job.key: job
            for job in self.plan.jobs
            if job.recipe is not None and job.key not in good
        }
        seeds = [job.seed for job in self.plan.jobs]
        return sorted(left.values(), key=lambda job: seeds.index(job.seed))

    def run(
        self,
        score: Score,
        *,
        jobs: int = -1,
        dask: str | None = None,
        on_job: Callable[[], None] = lambda: None,
        work: Work | None = None,
    ) -> SweepResult:
        """Run the remaining jobs, store each finished job, and write the tables, even if interrupted.

        `work` runs a job; the default is `run_job`. `jobs` is the number of processes,
        -1 means one for each core. `dask` is the address of a scheduler to use instead.
        Raises `CallError` if dask or the scheduler is missing, `DataError` if a process
        dies.
        """
        tasks = {job.key: job.recipe for job in self.todo if job.recipe is not None}
        given = (tasks, score, work or run_job)
        with locked_folder(self.folder):
            (self.folder / _PARTS).mkdir(exist_ok=True)
            try:
                for key, cells in (
                    _local(*given, jobs) if dask is None else _on_cluster(*given, dask)
                ):
                    write_file(
                        self.folder / _PARTS / f"{key}.json",
                        json.dumps([asdict(cell) for cell in cells]),
                    )
                    self.done[key] = cells
                    on_job()
            finally:
                result = write_tables(self.folder, self.plan, self.done)
        return result


def _read_part(path: Path) -> tuple[Cell, ...]:
    """Return the cells of a finished job; a damaged file gives a warning and no cells."""
    try:
        return _CELLS.validate_json(path.read_bytes())
    except (OSError, ValueError):
        _logger.warning("%s: is damaged, so its job is repeated", path)
        return ()


def write_tables(
    folder: Path, plan: Plan, done: Mapping[str, Sequence[Cell]]
) -> SweepResult:
    """Write sweep.csv, timing.csv and errors.csv from the cells of the finished jobs, by key."""
    rows: list[tuple[tuple[Value, ...], Cell]] = []
    for job in plan.jobs:
        cells = (
            done.get(job.key, ())
            if job.recipe
            else [Cell(name, {}, {}, job.problem) for name in plan.estimators]
        )
        rows += [((*job.cells, job.seed, cell.estimator), cell) for cell in cells]
    good = [(keys, cell) for keys, cell in rows if cell.error is None]
    bad = [
        (keys, {"error": cell.error}) for keys, cell in rows if cell.error is not None
    ]
    columns = list(dict.fromkeys(name for _, cell in good for name in cell.values))
    matching = {
        pattern: fnmatch.filter(columns, pattern) for pattern in plan.metrics or ("*",)
    }
    chosen = list(
        dict.fromkeys(column for result in matching.values() for column in result)
    )
    times = list(dict.fromkeys(name for _, cell in good for name in cell.times))
    for name, wanted, values in (
        (SWEEP_TABLE, chosen, [(keys, cell.values) for keys, cell in good]),
        (TIMING_TABLE, times, [(keys, cell.times) for keys, cell in good]),
        (ERROR_TABLE, ["error"], bad),
    ):
        texts = [
            [_text(value) for value in (*keys, *map(row.get, wanted))]
            for keys, row in values
        ]
        table = pd.DataFrame(
            texts, columns=[*plan.columns, *KEY_COLUMNS, *wanted], dtype=str
        )
        write_file(folder / name, table.to_csv(index=False, lineterminator="\n"))
    unknown = tuple(
        pattern for pattern, result in matching.items() if good and not result
    )
    return SweepResult(
        len(good),
        tuple(str(cell.error) for _, cell in rows if cell.error is not None),
        unknown,
        tuple(dict.fromkeys(cell.problem for _, cell in rows if cell.problem)),
    )


def _text(value: Value) -> str:
    """Text of a table cell: floats with all digits, lists and mappings as JSON."""
    if value is None or isinstance(value, str):
        return value or ""
    return repr(value) if isinstance(value, float) else compact(value)


def run_job(key: str, recipe: Recipe, score: Score) -> tuple[str, list[Cell]]:
    """Return key and cells of a job; an exception becomes the error of a cell."""
    try:
        config = validate(Config, recipe["config"], "config")
        rng = np.random.default_rng(recipe["seed"])
        problem = None
        if recipe["recording"] is None:
            scenario = validate(Scenario, recipe["scenario"], "scenario")
            messages = list(simulated(scenario, rng))
        else:
            draft = opened(recipe["recording"], config)
            source = draft.source
            problem = draft.problem
            delays = validate(dict[str, SensorDelays], recipe["delays"], "delays")
            messages = list(
                redelay(source.messages(), delays, rng)[0]
                if delays
                else source.messages()
            )
            config = assumed(
                draft.config, replace(source, messages=lambda: iter(messages))
            ).config
    except (Exception, SystemExit) as error:  # one failed job must not end the sweep
        return key, [
            Cell(name, {}, {}, failure(error)) for name in recipe["estimators"]
        ]
    return key, [
        replace(
            _cell(messages, replace(config, estimator=name), score), problem=problem
        )
        for name in recipe["estimators"]
    ]


def _cell(messages: Sequence[Message], config: Config, score: Score) -> Cell:
    try:
        run = replay_in_memory(messages, config)
        if run.meta["broken_off"] is not None:
            raise DataError(str(run.meta["broken_off"]))
        values, times = score(run)
    except (Exception, SystemExit) as error:  # as in `run_job`
        return Cell(config.estimator, {}, {}, failure(error))
    return Cell(config.estimator, values, {"replay_s": run.meta["wall_s"], **times})


def failure(error: BaseException) -> str:
    """Message of an error on one line; the error's type is added if it is a bug."""
    text = " ".join(str(error).split())
    return (
        text if isinstance(error, FgtrackError) else f"{type(error).__name__}: {text}"
    )


def _local(
    tasks: Mapping[str, Recipe], score: Score, work: Work, jobs: int
) -> Iterator[_Result]:
    """Yield results from processes on this machine, as they finish."""
    # With several processes, several BLAS threads in each would only wait for each other.
    settings = {
        "inner_max_num_threads": 1,
        "initializer": _end_with_parent,
        "initargs": (os.getpid(),),
    }
    with joblib.parallel_config(
        "loky", n_jobs=joblib.effective_n_jobs(jobs), **settings
    ):
        yield from _results(tasks, score, work)


def _end_with_parent(parent: int) -> None:
    """End this process soon after its parent ends.

    Without this, joblib's workers would wait for ever for jobs of a killed parent.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_WATCH_S)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _on_cluster(
    tasks: Mapping[str, Recipe], score: Score, work: Work, address: str
) -> Iterator[_Result]:
    """Yield results from the workers of a dask cluster, as they finish."""
    try:
        distributed = importlib.import_module("distributed")
    except ImportError as error:
        raise CallError(
            "--dask needs the extra `dask`: pip install 'fgtrack[dask]'"
        ) from error
    for name in ("distributed", "distributed.client"):
        # Failures are raised below, on one line.
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        client = distributed.Client(address, timeout=_SCHEDULER_TIMEOUT_S)
    except (OSError, ValueError) as error:
        raise CallError(
            f"--dask {address}: no scheduler is reachable, start one with `dask scheduler`"
        ) from error
    with (
        client,
        joblib.parallel_config("dask", wait_for_workers_timeout=_SCHEDULER_TIMEOUT_S),
    ):
        yield from _results(tasks, score, work)


def _results(
    tasks: Mapping[str, Recipe], score: Score, work: Work
) -> Iterator[_Result]:
    """Yield results of the tasks from the selected joblib backend, as they finish."""
    parallel = joblib.Parallel(
        return_as="generator_unordered",
        batch_size=1,
        pre_dispatch=f"{_HANDED_OUT}*n_jobs",
    )
    # The resource tracker must be running before interrupts are blocked, because it unblocks them when it starts.
    resource_tracker.ensure_running()
    # Ctrl-C must reach this process only. The workers inherit the blocked signal.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        results: Generator[_Result] = parallel(
            joblib.delayed(work)(*task, score) for task in tasks.items()
        )
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    try:
        yield from results
    except Exception as error:  # jobs report their own errors, so a process, the scheduler or the network failed
        raise DataError(
            f"the workers failed, perhaps out of memory ({failure(error):.120}): "
            "run the sweep once more to continue, perhaps with fewer --jobs"
        ) from error
    finally:
        with warnings.catch_warnings():  # an interrupt is reported once, in one line
            warnings.filterwarnings("ignore", "[0-9]+ tasks (have|which)", UserWarning)
            results.close()
