"""Sweeps: the jobs of a plan on all cores or a cluster, every finished one kept at once."""

import importlib
import logging
import os
import signal
import threading
import time
import warnings
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from multiprocessing import resource_tracker
from pathlib import Path

import joblib  # type: ignore[import-untyped]  # has no stubs
import numpy as np
from joblib.externals.loky.process_executor import TerminatedWorkerError  # type: ignore[import-untyped]

from fgtrack.core.errors import CallError, DataError, FgtrackError
from fgtrack.core.types import Message
from fgtrack.io.output import claimed
from fgtrack.io.run import Run
from fgtrack.io.source import open_input
from fgtrack.pipeline.assumed import assumed
from fgtrack.pipeline.config import Config
from fgtrack.pipeline.load import validate
from fgtrack.pipeline.replay import replay_in_memory
from fgtrack.pipeline.sweep_plan import Job, Plan, Recipe
from fgtrack.pipeline.sweep_store import Cell, PartStore, Scalar, SweepResult, write_tables
from fgtrack.sim.redelay import SensorDelays, redelay
from fgtrack.sim.scenario import Scenario
from fgtrack.sim.simulate import simulate

_SCHEDULER_TIMEOUT_S = 10
_WATCH_S = 1.0  # how often a process checks that its sweep still runs
_HANDED_OUT = 2  # jobs per process that are handed out at a time


@dataclass(frozen=True)
class Scores:
    """A run in numbers, by column."""

    values: Mapping[str, Scalar]
    """What is the same wherever and whenever the run is made."""
    times: Mapping[str, Scalar]
    """Wall times."""


#: Judges a run. A function of a module, so that other processes find it.
Score = Callable[[Run], Scores]


@dataclass(frozen=True)
class Sweep:
    """A plan and the folder for its results, in which some jobs may be finished already."""

    plan: Plan
    folder: Path
    done: dict[str, Sequence[Cell]]
    """Cells of the finished jobs by key."""
    store: PartStore

    @classmethod
    def open(cls, plan: Plan, folder: Path, overwrite: bool = False) -> "Sweep":
        """The sweep `plan` in `folder`; what was finished there before is taken over, if all its cells are there.

        Raises as `PartStore`, and `DataError` for a damaged part.
        """
        store = PartStore(folder, overwrite)
        kept = store.keys()
        parts = {key: store.read(key) for key in dict.fromkeys(job.key for job in plan.jobs) if key in kept}
        names = sorted(plan.estimators)
        whole: dict[str, Sequence[Cell]] = {
            key: cells for key, cells in parts.items() if cells and _names(cells) == names
        }
        return cls(plan, folder, whole, store)

    @property
    def todo(self) -> list[Job]:
        """What is left: jobs without a result, and those with a bad cell, which are tried again.

        All points of the grid with the first seed come first: what is there at an interruption covers the grid,
        and the time that the rest takes is well known early.
        """
        seeds = {seed: rank for rank, seed in enumerate(dict.fromkeys(job.seed for job in self.plan.jobs))}
        left = {job.key: job for job in self.plan.jobs if job.recipe is not None and not self._is_good(job.key)}
        return sorted(left.values(), key=lambda job: seeds[job.seed])

    @property
    def num_unused(self) -> int:
        """Parts in the folder that belong to other settings, files or versions."""
        return len(self.store.keys() - {job.key for job in self.plan.jobs})

    def run(
        self,
        score: Score,
        *,
        jobs: int = -1,
        dask: str | None = None,
        on_job: Callable[[Sequence[Cell]], None] = lambda cells: None,
    ) -> SweepResult:
        """Do what is left, keep each finished job at once, and write the tables; also when interrupted.

        Parameters
        ----------
        score
            Judges a run.
        jobs
            Number of processes; -1 is one for each core, 1 is this one.
        dask
            Address of a dask scheduler, whose workers do the jobs instead.
        on_job
            Called with the cells of each finished job.

        Raises
        ------
        CallError
            There is no dask, no scheduler at the address, or another sweep is at work in the folder.
        DataError
            The cluster failed, or the folder cannot be written to.
        """
        tasks = [(job.key, job.recipe) for job in self.todo if job.recipe is not None]
        with claimed(self.folder):
            results = _local(tasks, score, jobs) if dask is None else _on_cluster(tasks, score, dask)
            try:
                for key, cells in results:
                    self.store.write(key, cells)
                    self.done[key] = cells
                    on_job(cells)
            finally:
                tables = write_tables(self.folder, self.plan, self.done)
        return tables

    def _is_good(self, key: str) -> bool:
        return key in self.done and all(cell.error is None for cell in self.done[key])


def _names(cells: Sequence[Cell]) -> list[str]:
    return sorted(cell.estimator for cell in cells)


def run_job(key: str, recipe: Recipe, score: Score) -> tuple[str, list[Cell]]:
    """The cells of a job, with its key. Whatever goes wrong becomes the error of a cell."""
    started = time.perf_counter()
    try:
        config = validate(Config, recipe.config, "configuration")
        messages = read_messages(recipe, config)
        if recipe.recording is not None:
            source = open_input(recipe.recording, config.input)
            config = assumed(config, replace(source, messages=lambda: iter(messages))).config
    except (
        Exception,
        SystemExit,
    ) as error:  # whatever is wrong with one job out of hundreds
        return key, [Cell(name, {}, {}, _reason(error)) for name in recipe.estimators]
    source_s = time.perf_counter() - started
    return key, [_cell(messages, replace(config, estimator=name), score, source_s) for name in recipe.estimators]


def read_messages(recipe: Recipe, config: Config) -> list[Message]:
    """The stream of a job: simulated, or recorded and perhaps delayed anew. All estimators get the same one."""
    rng = np.random.default_rng(recipe.seed)
    if recipe.recording is None:
        return simulate(validate(Scenario, recipe.scenario or {}, "scenario"), rng)
    source = open_input(recipe.recording, config.input)
    if not recipe.delays:
        return list(source.messages())
    return list(redelay(source.messages, validate(dict[str, SensorDelays], recipe.delays, "delays"), rng))


def _cell(messages: Sequence[Message], config: Config, score: Score, source_s: float) -> Cell:
    started = time.perf_counter()
    try:
        run, broken = replay_in_memory(messages, config)
        if broken is not None:
            raise DataError(broken)
        replayed = time.perf_counter()
        scores = score(run)
    except (Exception, SystemExit) as error:  # as in `run_job`
        return Cell(config.estimator, {}, {}, _reason(error))
    times = {"source_s": source_s, "replay_s": replayed - started, "score_s": time.perf_counter() - replayed}
    return Cell(config.estimator, scores.values, {**times, **scores.times})


def _reason(error: BaseException) -> str:
    """What went wrong, in a line; of a bug also what it is."""
    text = " ".join(str(error).split())
    return text if isinstance(error, FgtrackError) else f"{type(error).__name__}: {text}"


_Task = tuple[str, Recipe]
_Result = tuple[str, Sequence[Cell]]


def _local(tasks: Sequence[_Task], score: Score, jobs: int) -> Iterator[_Result]:
    """Results of processes of this machine, as they come.

    Where a process dies (out of memory, a crash in a library) joblib gives up all that were handed out. These are
    tried again alone; what kills its process again is bad.
    """
    with _told():
        count = joblib.effective_n_jobs(jobs)
    left = dict(tasks)
    while left:
        try:
            for key, cells in _in_processes(list(left.items()), score, count):
                del left[key]
                yield key, cells
        except TerminatedWorkerError:
            for key, recipe in list(left.items())[: _HANDED_OUT * count]:
                yield key, [_alone(key, replace(recipe, estimators=(name,)), score) for name in recipe.estimators]
                del left[key]


def _alone(key: str, recipe: Recipe, score: Score) -> Cell:
    """The cell of a recipe with one estimator, from a process of its own."""
    try:
        ((_, (cell,)),) = _in_processes([(key, recipe)], score, 2)  # one process would be this one
    except TerminatedWorkerError:
        error = "the process that ran it died: out of memory, or a crash in a library"
        return Cell(recipe.estimators[0], {}, {}, error)
    return cell


def _in_processes(tasks: Sequence[_Task], score: Score, count: int) -> Iterator[_Result]:
    # With several jobs at once, threads of BLAS would only wait for each other.
    settings = {"inner_max_num_threads": 1, "initializer": _leave_with, "initargs": (os.getpid(),)}
    with joblib.parallel_config("loky", n_jobs=count, **settings), _told():
        yield from _results(tasks, score)


@contextmanager
def _told() -> Iterator[None]:
    """What keeps processes from starting is said in a line; what goes wrong in a job is told by its cells."""
    try:
        yield
    except FileNotFoundError:  # names the folder, or there is no working directory
        raise
    except (OSError, ValueError) as error:
        raise CallError(
            f"processes cannot be started ({_reason(error)}): look at the environment variables of joblib "
            "(JOBLIB_..., LOKY_...) and at the limits of the system"
        ) from error


def _leave_with(parent: int) -> None:
    """End this process soon after its parent; when that was killed, joblib would let it wait for work for ever."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_WATCH_S)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _on_cluster(tasks: Sequence[_Task], score: Score, address: str) -> Iterator[_Result]:
    """Results of the workers of a dask cluster, as they come."""
    try:
        distributed = importlib.import_module("distributed")
    except ImportError as error:
        raise CallError("--dask needs the extra `dask`: pip install 'fgtrack[dask]'") from error
    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # what goes wrong comes as an error, in a line
    try:
        client = distributed.Client(address, timeout=_SCHEDULER_TIMEOUT_S)
    except (OSError, ValueError) as error:
        raise CallError(f"--dask {address}: no scheduler answers there, start one with `dask scheduler`") from error
    with client, joblib.parallel_config("dask", wait_for_workers_timeout=_SCHEDULER_TIMEOUT_S):
        try:
            yield from _results(tasks, score)
        except Exception as error:  # whatever a scheduler or a network may do; the jobs report their own errors
            reason = _reason(error)
            raise DataError(f"{address}: the cluster failed ({reason}), start the sweep again to go on") from error


def _results(tasks: Sequence[_Task], score: Score) -> Iterator[_Result]:
    """Results of the tasks in the backend of joblib that is set, as they come."""
    parallel = joblib.Parallel(return_as="generator_unordered", batch_size=1, pre_dispatch=f"{_HANDED_OUT}*n_jobs")
    with _interrupts_held():
        results: Generator[_Result] = parallel(joblib.delayed(run_job)(*task, score) for task in tasks)
    try:
        yield from results
    finally:
        with warnings.catch_warnings():  # an interrupt is said once, in one line
            warnings.filterwarnings("ignore", "[0-9]+ tasks (have|which)", UserWarning)
            results.close()


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """What is started in the block never sees Ctrl-C, which is for this process; here it has to wait for the end."""
    resource_tracker.ensure_running()  # started in the block, it would let interrupts through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
