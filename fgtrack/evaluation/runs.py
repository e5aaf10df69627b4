"""Runs that are looked at together: read, labelled, and each matched and evaluated once."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from fgtrack.core.errors import CallError
from fgtrack.core.types import IntArray
from fgtrack.evaluation.lagged import LagMetrics, lag_metrics
from fgtrack.evaluation.matching import Matching, match, recorded
from fgtrack.evaluation.metrics import Metrics, evaluate_matched
from fgtrack.evaluation.residual_samples import ResidualSamples, residual_samples
from fgtrack.io.run import EvaluationConfig, Run, is_run_folder, load_run


@dataclass(frozen=True, eq=False)
class JudgedRun:
    """A run and what evaluation finds, computed when it is first asked for."""

    label: str
    """Name among the runs that it is shown with."""
    run: Run

    @cached_property
    def matching(self) -> Matching | None:
        """Pairs of tracks and true objects; None for a run without truth."""
        return match(self.run, self.options)

    @cached_property
    def options(self) -> EvaluationConfig:
        """How the run is judged."""
        return self.run.evaluation

    @cached_property
    def scored_ticks_ns(self) -> IntArray:
        """Times of the ticks that scores over all objects are made of, shape (t,); none without truth."""
        if self.matching is None:
            return np.zeros(0, dtype=np.int64)
        return self.matching.now_ns[recorded(self.run, self.matching)]

    @cached_property
    def samples(self) -> ResidualSamples:
        """Innovations of the confirmed tracks. Raises `DataError` where the map that the run names is no map."""
        return residual_samples(self.run)

    @cached_property
    def lagged(self) -> tuple[LagMetrics, ...]:
        """Errors of present, lagged and final states; empty for a run without truth."""
        return lag_metrics(self.run, self.matching)

    @cached_property
    def metrics(self) -> Metrics:
        """All metrics, judged as the run's configuration says."""
        return evaluate_matched(self.run, self.matching, self.options, self.samples)


OneRun = Run | JudgedRun | Path | str
Runs = OneRun | Iterable[OneRun | Iterable[OneRun]]


def judged(runs: Runs) -> list[JudgedRun]:
    """Runs under labels of their own; a path is a run folder, or a folder that holds some.

    Runs of a folder come by name; they may be one folder deeper, as in that of `fgtrack demo`.

    Raises
    ------
    CallError
        A path is neither, or a run is given twice.
    DataError
        A run folder is damaged.
    """
    every = [one for entry in _several(runs) for one in _several(entry)]
    for one in every:
        if not isinstance(one, OneRun):
            raise CallError(f"runs: must be runs or paths of run folders, there is a {type(one).__name__}")
    if every and all(isinstance(run, JudgedRun) for run in every):
        return [run for run in every if isinstance(run, JudgedRun)]
    plain = [run.run if isinstance(run, JudgedRun) else run for run in every]
    read = [found for run in plain for found in ([run] if isinstance(run, Run) else _read(Path(run)))]
    return [JudgedRun(label, run) for label, run in labelled(read).items()]


def run_folders(runs: Iterable[JudgedRun]) -> list[Path]:
    """The folders of `runs`, of those that have one."""
    return [one.run.path for one in runs if one.run.path is not None]


def _several(given: Any) -> list[Any]:  # Any: what a user gives
    return [given] if isinstance(given, OneRun) or not isinstance(given, Iterable) else list(given)


def one_judged(run: OneRun) -> JudgedRun:
    """The one run that `run` stands for.

    Raises
    ------
    CallError
        It is a folder that holds several.
    DataError
        A run folder is damaged.
    """
    every = judged(run)
    if len(every) > 1:
        raise CallError(f"{run}: holds {len(every)} runs, name one of them")
    return every[0]


def start_ns(runs: Sequence[JudgedRun]) -> int:
    """Time of the first tick of `runs`; 0 where there is none."""
    return min(
        (int(one.run.tables["timing"]["now_ns"][0]) for one in runs if one.run.tables["timing"].num_rows), default=0
    )


def starts_ns(runs: Sequence[JudgedRun]) -> dict[str, int]:
    """By label when the recording of each run begins: the first tick of it and of those that ran at the same time."""
    ticks = {one.label: one.run.tables["timing"]["now_ns"] for one in runs}
    spans = {label: (int(now_ns[0]), int(now_ns[-1])) if len(now_ns) else (0, 0) for label, now_ns in ticks.items()}
    return {
        label: min(first for first, last in spans.values() if first <= end and last >= begin)
        for label, (begin, end) in spans.items()
    }


def labelled(runs: Sequence[Run]) -> dict[str, Run]:
    """Runs by a label of their own: the end of their path, as long as it must be to be unique.

    The estimator follows where the path does not name it, and alone for a run in memory.

    Raises
    ------
    CallError
        A run is given twice.
    """
    for identity, count in Counter(run.path.resolve() if run.path else id(run) for run in runs).items():
        if count > 1:
            raise CallError(f"{identity if isinstance(identity, Path) else 'run'}: is given twice, name every run once")
    paths = [run.path.resolve() for run in runs if run.path]
    length = 1
    while len({path.parts[-length:] for path in paths}) < len(paths):
        length += 1
    labels: dict[str, Run] = {}
    for run in runs:
        estimator = str(run.meta.get("estimator", "run"))
        label = "/".join(run.path.resolve().parts[-length:]) if run.path else estimator
        label = label if estimator in label else f"{label} ({estimator})"
        same = 1
        while (unique := label if same == 1 else f"{label} #{same}") in labels:
            same += 1
        labels[unique] = run
    return labels


def _read(path: Path) -> list[Run]:
    if is_run_folder(path):
        return [load_run(path)]
    for pattern in ("*", "*/*") if path.is_dir() else ():
        below = [load_run(child) for child in sorted(path.glob(pattern)) if is_run_folder(child)]
        if below:
            return below
    raise CallError(f"{path}: no run folder, make one with `fgtrack replay`")
