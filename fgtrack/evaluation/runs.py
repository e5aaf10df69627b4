"""Runs for a common evaluation: loaded, labelled, and each matched and evaluated once."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from fgtrack.core.errors import CallError
from fgtrack.core.types import MEASURABLE
from fgtrack.evaluation.matching import Matching, match
from fgtrack.evaluation.metrics import Metrics, evaluate_matched
from fgtrack.evaluation.settings import evaluation_settings
from fgtrack.runs import Run, is_run_folder, load_run


@dataclass(frozen=True, eq=False)
class EvaluatedRun:
    """A run with its evaluation, which is computed at first use."""

    label: str
    """Unique label among the compared runs."""
    run: Run

    @cached_property
    def matching(self) -> Matching | None:
        """Pairs of tracks and true objects; None for a run without truth."""
        return match(self.run)

    @cached_property
    def metrics(self) -> Metrics:
        """All metrics, with the evaluation settings of the run's configuration."""
        return evaluate_matched(self.run, self.matching, evaluation_settings(self.run))


OneRun = Run | EvaluatedRun | Path | str
Runs = OneRun | Mapping[str, OneRun] | Iterable["Runs"]


def evaluated(runs: Runs) -> list[EvaluatedRun]:
    """Return `runs` with unique labels.

    A path is a run folder, or a folder with run folders, at most two levels deeper, as
    in the study of several recordings. These are sorted by name. The keys of a mapping
    are labels. Raises `CallError` if there is no run, and `DataError` for a damaged run.
    """
    every = _flat(runs)
    if any(isinstance(item, Run) for item in every):
        read = [item.run if isinstance(item, EvaluatedRun) else item for item in every]
        every = [EvaluatedRun(label, run) for label, run in labelled(read).items()]
    return [item for item in every if isinstance(item, EvaluatedRun)]


def one_evaluated(run: OneRun) -> EvaluatedRun:
    """Return the single run in `run`.

    Raises like `evaluated`, and `CallError` for a folder with several runs.
    """
    every = evaluated(run)
    if len(every) > 1:
        raise CallError(f"{run}: contains {len(every)} runs, give one of them")
    return every[0]


def start_ns(runs: Sequence[EvaluatedRun]) -> int:
    """Return the time of the earliest tick of `runs`; 0 without ticks."""
    ticks_ns = [item.run.tables["timing"]["now_ns"] for item in runs]
    return min((int(ns[0]) for ns in ticks_ns if len(ns)), default=0)


def labelled(runs: Sequence[Run]) -> dict[str, Run]:
    """Return the runs by label: the shortest unique end of the path, with the estimator.

    Raises `CallError` if a run is given twice.
    """
    identities = Counter(
        str(run.path.resolve()) if run.path else id(run) for run in runs
    )
    for identity in (identity for identity, times in identities.items() if times > 1):
        raise CallError(
            f"{identity if isinstance(identity, str) else 'run'}: given twice, give every run once"
        )
    paths = [run.path.resolve() for run in runs if run.path]
    length = next(
        n for n in count(1) if len({path.parts[-n:] for path in paths}) == len(paths)
    )
    labels: dict[str, Run] = {}
    for run in runs:
        estimator = str(run.meta.get("estimator", "run"))
        label = "/".join(run.path.resolve().parts[-length:]) if run.path else estimator
        label = label if estimator in label else f"{label} ({estimator})"
        unique = (label if n == 1 else f"{label} #{n}" for n in count(1))
        labels[next(name for name in unique if name not in labels)] = run
    return labels


def same_recording(one: Run, other: Run) -> bool:
    """True if truth and detections of the common sensors agree in both runs.

    Delays and stamps may differ. Without a common sensor the truth decides, without
    truth the ego, and without both the path of the recording.
    """
    if not one.tables["truth"].equals(other.tables["truth"]):
        return False
    common = np.intersect1d(
        one.tables["updates"]["sensor"], other.tables["updates"]["sensor"]
    ).tolist()
    if common:
        return all(_same_detections(one, other, sensor) for sensor in common)
    for name in ("truth", "ego"):
        if one.tables[name].num_rows or other.tables[name].num_rows:
            return one.tables[name].equals(other.tables[name])
    return one.recording is not None and one.recording == other.recording


def by_recording(runs: Sequence[EvaluatedRun]) -> list[list[EvaluatedRun]]:
    """Return `runs` in groups of the same recording."""
    groups: list[list[EvaluatedRun]] = []
    for item in runs:
        group = next(
            (group for group in groups if same_recording(group[0].run, item.run)), None
        )
        if group is None:
            groups.append(group := [])
        group.append(item)
    return groups


def recordings_warning(runs: Sequence[EvaluatedRun]) -> list[str]:
    """Return a warning with the names of the runs if `runs` come from several recordings; else empty."""
    groups = by_recording(runs)
    texts = []
    for group in groups:
        source = (group[0].run.meta.get("input") or {}).get(
            "path"
        ) or "messages in memory"
        texts.append(f"{', '.join(one.label for one in group)} ({source})")
    text = (
        f"the runs come from {len(groups)} recordings, compare numbers only within one"
    )
    return [f"{text}: {'; '.join(texts)}"] if len(groups) > 1 else []


def _flat(given: Any) -> list[Run | EvaluatedRun]:  # Any: what a user gives
    if isinstance(given, Run | EvaluatedRun):
        return [given]
    if isinstance(given, Mapping):
        return [
            EvaluatedRun(str(label), one_evaluated(run).run)
            for label, run in given.items()
        ]
    if not isinstance(given, Path | str):
        if not isinstance(given, Iterable):
            raise CallError(
                f"runs: must be runs or paths of run folders, not {type(given).__name__}"
            )
        return [item for entry in given for item in _flat(entry)]
    path = Path(given)
    for pattern in ("", "*", "*/*", "*/*/*") if path.is_dir() else ():
        if folders := [
            each
            for each in (sorted(path.glob(pattern)) if pattern else [path])
            if is_run_folder(each)
        ]:
            return [load_run(folder) for folder in folders]
    raise CallError(f"{path}: not a run folder, make one with `fgtrack replay`")


def _same_detections(one: Run, other: Run, sensor: str) -> bool:
    """True if the detections of `sensor` have equal stamps or receipts, and equal values.

    Values are compared only if both runs have any.
    """
    (updates, others), (values, other_values) = (
        [
            run.tables[name].where(run.tables[name]["sensor"] == sensor)
            for run in (one, other)
        ]
        for name in ("updates", "detections")
    )
    if not any(
        np.array_equal(np.sort(updates[name]), np.sort(others[name]))
        for name in ("stamp_ns", "receipt_ns")
    ):
        return False
    known = values.num_rows and other_values.num_rows
    return not known or all(
        np.array_equal(
            np.sort(values[name]), np.sort(other_values[name]), equal_nan=True
        )
        for name in MEASURABLE
    )
