"""Streaming accuracy: what was published is judged when it was ready, so that a slow method pays for its time.

Li, Wang, Ramanan: Towards streaming perception, ECCV 2020, for object detection; Wang et al.: Are we ready for
vision-centric driving streaming perception? The ASAP benchmark, CVPR 2023, for tracking. As there, ticks are done one
after the other by one thread, and what took 30 ms is compared with the truth 30 ms later, as it was published: its user
acts on it then. A user who knows the stamp may predict it to then; what is left of the error is given beside.

Times come from timing.csv, so nothing here depends on the machine that compares.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fgtrack.core.geometry import cartesian
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.evaluation.contest import judged_alike, quantity
from fgtrack.evaluation.deadlines import Deadlines, ready
from fgtrack.evaluation.paired import UNKNOWN, by_stamp
from fgtrack.evaluation.ranking import STANDING_NOTE, Entry, value_column, worse_columns
from fgtrack.evaluation.runs import JudgedRun
from fgtrack.evaluation.statistics import Distribution
from fgtrack.evaluation.table_rows import MS, PERCENT
from fgtrack.evaluation.tables import Column, Table, Tables
from fgtrack.evaluation.truth import true_paths
from fgtrack.evaluation.verdict import who_is_best

ASKED, READY, PREDICTED = "asked", "ready", "predicted"
"""When a state is judged: at its own stamp, as everywhere else; as published, at the moment when it was ready; the
same after its user has moved it to that moment."""

_TITLES = {ASKED: "at its stamp", READY: "when ready", PREDICTED: "predicted to then"}
_LARGE_SHARE = 0.9


@dataclass(frozen=True)
class Streamed:
    """The paired rows of a run, each array of shape (p,)."""

    object_index: IntArray
    now_ns: IntArray
    """Tick that published the row."""
    errors_m: dict[str, FloatArray]
    """Distance to the truth, by when it is judged; NaN where there is no truth then."""


@dataclass(frozen=True)
class _Row:
    judged: str
    entry: Entry


def streamed(one: JudgedRun) -> Streamed:
    """What `one`, a run with truth, is worth when it is ready. Pairs are those of its `matching`.

    A user predicts straight on: the published position, moved along the published yaw at the published speed. A state
    without yaw or speed stays where it is.
    """
    matching = one.matching
    assert matching is not None
    rows = np.flatnonzero(matching.paired)
    tracks, ticks = matching.tracks.where(matching.paired), matching.tick_index[rows]
    object_index, ready_ns = matching.object_index[rows], ready(one.run)[0][ticks]
    truth = np.full((len(rows), 2), np.nan)
    for index, path in enumerate(true_paths(one.run.tables["truth"])):
        mine = object_index == index
        truth[mine] = path.at(ready_ns[mine])[:, :2]
    published = np.stack([tracks["x_m"], tracks["y_m"]], axis=-1)
    way_m = tracks["speed_mps"] * (ready_ns - tracks["stamp_ns"]) / NS_PER_S
    moved = published + np.nan_to_num(cartesian(np.stack([tracks["yaw_rad"], way_m], axis=-1)))
    return Streamed(
        object_index,
        matching.now_ns[ticks],
        {
            ASKED: matching.distances_m[rows, object_index],
            READY: np.linalg.norm(published - truth, axis=-1),
            PREDICTED: np.linalg.norm(moved - truth, axis=-1),
        },
    )


def with_streaming(tables: Tables, runs: Sequence[JudgedRun]) -> Tables:
    """`tables` with `streaming` and `load` of `runs`; the verdict also says who is best when it pays for its time.

    Runs that fall behind for good are not ranked beside others that keep up: what they lose has no bound, and the few
    samples that they have before the truth ends would decide about all.
    """
    rows, notes, sentences = [], [], []
    for group in judged_alike(runs):
        late = [one for one in group if _load_of(one) > 1.0]
        ranked = [one for one in group if one not in late] or group
        entries, share = _compared(ranked)
        if share < _LARGE_SHARE:
            names = ", ".join(one.label for one in ranked)
            notes.append(f"{names}: {share:.0%} of the samples are judged: the truth ends before the others are ready")
        if len(ranked) > 1 and entries:
            sentences += [
                who_is_best(entries[READY], "where each is judged when it is ready"),
                who_is_best(entries[PREDICTED], "where users also predict what they get to that moment"),
            ]
        for one in late:
            behind = f"{one.label} falls behind for good (load {_load_of(one):.0%})"
            sentences.append(f"{behind}: the longer the run, the worse.")
            if one not in ranked:
                alone, share = _compared([one])
                notes.append(f"{behind}: not ranked, judged at {share:.0%} of its samples, until the truth ends")
                for judged, (entry,) in alone.items():
                    unranked = Entry(entry.name, entry.value, UNKNOWN, "worse")
                    entries[judged] = (*entries.get(judged, ()), unranked)
        rows += [_Row(judged, entry) for judged, found in entries.items() for entry in found]
    added = {"streaming": _streaming(rows, notes), "load": _load(runs)}
    return replace(tables, tables={**tables.tables, **added}, verdict=(*tables.verdict, *sentences))


def _load_of(one: JudgedRun) -> float:
    return one.metrics.deadlines.load


def _compared(group: Sequence[JudgedRun]) -> tuple[dict[str, tuple[Entry, ...]], float]:
    """Runs of one recording by when they are judged, and the least share of a run's samples that is.

    They are compared at the objects and ticks that all of them judge. A sample is judged where there is truth when it
    is ready, so that the same samples stand behind all numbers.
    """
    every = [streamed(one) for one in group]
    ticks_ns = np.unique(np.concatenate([one.now_ns for one in every]))
    codes = [one.object_index * len(ticks_ns) + np.searchsorted(ticks_ns, one.now_ns) for one in every]
    judged = [code[np.isfinite(one.errors_m[READY])] for code, one in zip(codes, every, strict=True)]
    common = functools.reduce(np.intersect1d, judged)
    if not len(common):
        return {}, 0.0
    orders = [np.argsort(code) for code in codes]
    rows = [order[np.searchsorted(code[order], common)] for code, order in zip(codes, orders, strict=True)]
    entries = {}
    for name in (ASKED, READY, PREDICTED):
        errors_m = [one.errors_m[name][mine] for one, mine in zip(every, rows, strict=True)]
        sums = by_stamp(ticks_ns[common % len(ticks_ns)], np.square(np.stack(errors_m, axis=-1)))
        entries[name] = quantity(name, [one.label for one in group], sums).entries
    return entries, len(common) / max(map(len, codes))


def _streaming(rows: Sequence[_Row], notes: Sequence[str]) -> Table:
    """A row for each time of judging and run."""
    columns: list[Column[_Row]] = [
        Column("", ("judged",), lambda row: (row.judged,)),
        Column("judged", (), lambda row: (_TITLES[row.judged],), left=True),
        Column("run", ("run",), lambda row: (row.entry.name,), left=True),
        value_column("pos. [m]", "position_rmse_m", lambda row: row.entry),
        *worse_columns(lambda row: row.entry),
    ]
    own = [
        "when ready: as published, against the truth when its computation was done",
        "predicted: the same, moved straight on to then at its own speed by its user",
        STANDING_NOTE,
    ]
    title = "Streaming accuracy (position RMSE, each run paying for its time)"
    return Table(title, columns, rows, row_keys=("run", "judged"), notes=[*own, *notes])


def _load(runs: Sequence[JudgedRun]) -> Table:
    """A row for each run: how long after its tick an output was ready, late ticks, load."""
    ages = {}
    for one in runs:
        delay_ns = ready(one.run)[0] - one.run.tables["timing"]["now_ns"]
        ages[one.label] = Distribution.of(delay_ns / NS_PER_S)

    def deadlines(one: JudgedRun) -> Deadlines:
        return one.metrics.deadlines

    columns: list[Column[JudgedRun]] = [
        Column("run", ("run",), lambda one: (one.label,), left=True),
        Column(
            "ready after\n[ms] p50/p99",
            ("ready_after_p50_s", "ready_after_p99_s"),
            lambda one: (ages[one.label].p50, ages[one.label].p99),
            "{}/{}",
            MS,
        ),
        Column("longest\n[ms]", ("ready_after_max_s",), lambda one: (deadlines(one).latest_s,), scale=MS),
        Column(
            "late\nticks",
            ("deadline_misses", "ticks"),
            lambda one: (deadlines(one).misses, deadlines(one).ticks) if deadlines(one).are_known else None,
            "{}/{}",
        ),
        Column("load\n[%]", ("load",), lambda one: (deadlines(one).load,), scale=PERCENT),
    ]
    notes = [
        "of all ticks, one after the other: a tick begins when it is due, or when the one before is done",
        "load: computing time over the length of the run; above 100 % it falls behind for good",
    ]
    return Table("Load", columns, list(runs), notes=notes)
