"""Runs that are evaluated together: read, labelled, and each matched and evaluated once."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from fgtrack.core.errors import CallError
from fgtrack.core.types import MEASURABLE, IntArray
from fgtrack.evaluation.matching import Matching, match
from fgtrack.evaluation.metrics import Metrics, evaluate_matched
from fgtrack.io.run import EvaluationConfig, Run, Table, is_run_folder, load_run


@dataclass(frozen=True, eq=False)
class EvaluatedRun:
    """A run and its evaluation, computed when it is first used."""

    label: str
    """Name among the runs that it is shown with."""
    run: Run

    @cached_property
    def matching(self) -> Matching | None:
        """Pairs of tracks and true objects; None for a run without truth."""
        return match(self.run, self.options)

    @cached_property
    def options(self) -> EvaluationConfig:
        """Settings of the evaluation."""
        return self.run.evaluation

    @cached_property
    def metrics(self) -> Metrics:
        """All metrics, by the settings of the run's configuration."""
        return evaluate_matched(self.run, self.matching, self.options)


OneRun = Run | EvaluatedRun | Path | str
Runs = OneRun | Mapping[str, OneRun] | Iterable[OneRun | Iterable[OneRun] | Mapping[str, OneRun]]


def evaluated(runs: Runs) -> list[EvaluatedRun]:
    """Runs under labels of their own; a path is a run folder, or a folder that holds some; a mapping gives labels.

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
    if all(isinstance(one, EvaluatedRun) for one in every):
        return every
    plain = [one.run if isinstance(one, EvaluatedRun) else one for one in every]
    read = [found for one in plain for found in ([one] if isinstance(one, Run) else _read(Path(one)))]
    return [EvaluatedRun(label, run) for label, run in labelled(read).items()]


def one_evaluated(run: OneRun) -> EvaluatedRun:
    """The one run that `run` stands for.

    Raises
    ------
    CallError
        It is a folder that holds several.
    DataError
        A run folder is damaged.
    """
    every = evaluated(run)
    if len(every) > 1:
        raise CallError(f"{run}: holds {len(every)} runs, name one of them")
    return every[0]


def run_folders(runs: Iterable[EvaluatedRun]) -> list[Path]:
    """The folders of `runs`, of those that have one."""
    return [one.run.path for one in runs if one.run.path is not None]


def start_ns(runs: Sequence[EvaluatedRun]) -> int:
    """Time of the first tick of `runs`; 0 without one."""
    return min((int(ns[0]) for ns in map(_ticks_ns, runs) if len(ns)), default=0)


def starts_ns(runs: Sequence[EvaluatedRun]) -> dict[str, int]:
    """Start of the recording of each run, by label: the first tick of it and of those that ran at the same time."""
    ends = {one.label: (int(ns[0]), int(ns[-1])) if len(ns) else (0, 0) for one in runs for ns in [_ticks_ns(one)]}
    return {
        label: min(first for first, last in ends.values() if first <= end and last >= begin)
        for label, (begin, end) in ends.items()
    }


def labelled(runs: Sequence[Run]) -> dict[str, Run]:
    """Runs by a label of their own: the end of their path, as long as it must be to be unique.

    The estimator follows where the path does not name it, and alone for a run in memory.

    Raises
    ------
    CallError
        A run is given twice.
    """
    for identity, times in Counter(run.path.resolve() if run.path else id(run) for run in runs).items():
        if times > 1:
            raise CallError(f"{identity if isinstance(identity, Path) else 'run'}: is given twice, name every run once")
    paths = [run.path.resolve() for run in runs if run.path]
    length = next(n for n in count(1) if len({path.parts[-n:] for path in paths}) == len(paths))
    labels: dict[str, Run] = {}
    for run in runs:
        estimator = str(run.meta.get("estimator", "run"))
        label = "/".join(run.path.resolve().parts[-length:]) if run.path else estimator
        label = label if estimator in label else f"{label} ({estimator})"
        unique = (label if n == 1 else f"{label} #{n}" for n in count(1))
        labels[next(name for name in unique if name not in labels)] = run
    return labels


def same_recording(one: Run, other: Run) -> bool:
    """True if two runs are of the same scene, detected by the same sensors.

    The truth is the same, and of every sensor that both have the detections are as many and have the same values, at
    the same stamps (a recording with other delays) or the same receipts (a configuration with other stamps). Without a
    common sensor and without truth the ego decides, without that the path of the recording.
    """
    if not one.tables["truth"].equals(other.tables["truth"]):
        return False
    common = np.intersect1d(one.tables["updates"]["sensor"], other.tables["updates"]["sensor"]).tolist()
    if common:
        return all(_same_detections(one, other, sensor) for sensor in common)
    if one.tables["truth"].num_rows:
        return True
    if one.tables["ego"].num_rows or other.tables["ego"].num_rows:
        return one.tables["ego"].equals(other.tables["ego"])
    return one.recording is not None and one.recording == other.recording


def by_recording(runs: Sequence[EvaluatedRun]) -> list[list[EvaluatedRun]]:
    """`runs` in groups, those of the same recording together."""
    groups: list[list[EvaluatedRun]] = []
    for one in runs:
        group = next((group for group in groups if same_recording(group[0].run, one.run)), [])
        groups += [] if group else [group]
        group.append(one)
    return groups


def recordings_warning(runs: Sequence[EvaluatedRun]) -> list[str]:
    """A line where `runs` are of different recordings, with their names; empty otherwise."""
    groups = by_recording(runs)
    texts = [f"{', '.join(one.label for one in group)} ({_source(group[0].run)})" for group in groups]
    what = f"the runs are of {len(groups)} recordings, so their numbers cannot be compared across them"
    return [f"{what}: {'; '.join(texts)}"] if len(groups) > 1 else []


def _several(given: Any) -> list[Any]:  # Any: what a user gives
    if isinstance(given, Mapping):
        return [EvaluatedRun(str(label), one_evaluated(run).run) for label, run in given.items()]
    return [given] if isinstance(given, OneRun) or not isinstance(given, Iterable) else list(given)


def _read(path: Path) -> list[Run]:
    if is_run_folder(path):
        return [load_run(path)]
    for pattern in ("*", "*/*") if path.is_dir() else ():
        below = [load_run(child) for child in sorted(path.glob(pattern)) if is_run_folder(child)]
        if below:
            return below
    raise CallError(f"{path}: no run folder, make one with `fgtrack replay`")


def _ticks_ns(one: EvaluatedRun) -> IntArray:
    return one.run.tables["timing"]["now_ns"]


def _same_detections(one: Run, other: Run, sensor: str) -> bool:
    """True if the detections of a sensor are the same, in the order of the stamps or of the receipts."""
    runs = (one, other)
    updates = [run.tables["updates"].where(run.tables["updates"]["sensor"] == sensor) for run in runs]
    tables = [run.tables["detections"].where(run.tables["detections"]["sensor"] == sensor) for run in runs]
    same = [k for k in ("stamp_ns", "receipt_ns") if np.array_equal(np.sort(updates[0][k]), np.sort(updates[1][k]))]
    known = all(table.num_rows for table in tables)
    return any(not known or _same_values(tables, time) for time in same)


def _same_values(tables: Sequence[Table], time: str) -> bool:
    """True if two sensors measured the same in the order of `time`, as far as both have values."""
    if tables[0].num_rows != tables[1].num_rows:
        return False
    orders = [np.lexsort((table["index"], table[time])) for table in tables]
    for name in MEASURABLE:
        a, b = (table[name][order] for table, order in zip(tables, orders, strict=True))
        if (np.isfinite(a) & np.isfinite(b) & (a != b)).any():
            return False
    return True


def _source(run: Run) -> str:
    source = run.meta.get("input") or {}
    words = [str(source["path"])] if source.get("path") else []
    if run.meta.get("messages_received"):
        words.append(f"{run.meta['messages_received']} messages")
    return ", ".join(words) or f"{run.tables['updates'].num_rows} detections"
