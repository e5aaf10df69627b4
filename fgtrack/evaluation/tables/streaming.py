"""Accuracy when each run pays for its time: published states against the truth at the moment when they were ready.

The streaming accuracy of Li, Wang, Ramanan: Towards streaming perception, ECCV 2020, for object detection; Wang et al.:
Are we ready for vision-centric driving streaming perception? The ASAP benchmark, CVPR 2023, for tracking. Ticks are
done one after the other by one thread, and an output that took 30 ms is compared with the truth 30 ms later, as it was
published. Times come from timing.csv, so nothing here depends on the machine that compares.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from fgtrack.core.geometry import cartesian
from fgtrack.core.time import NS_PER_S, period_ns
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.evaluation.comparison import (
    STANDING_NOTE,
    Entry,
    common_samples,
    comparable,
    compared,
    entry_columns,
    entry_record,
)
from fgtrack.evaluation.intervals import UNKNOWN, by_stamp
from fgtrack.evaluation.runs import EvaluatedRun
from fgtrack.evaluation.scores.statistics import Distribution
from fgtrack.evaluation.tables import MS, PERCENT, RUN, Column, Table
from fgtrack.evaluation.tables.verdict import who_is_best
from fgtrack.evaluation.truth import true_states
from fgtrack.io.run import Node, Run, ready_times

#: A state is evaluated at its own stamp, as everywhere else; as published, at the moment when it was ready; the same
#: after its user has moved it to that moment.
ASKED, READY, PREDICTED = "asked", "ready", "predicted"

_TITLES = {ASKED: "at its stamp", READY: "when ready", PREDICTED: "predicted to then"}
_LARGE_SHARE = 0.9


def streaming_errors(one: EvaluatedRun) -> dict[str, FloatArray]:
    """Return distances to the truth of the paired rows of `one`, by when they are evaluated, shape (p,) each.

    Predictions move the published position along the published yaw at the published speed; a state without yaw or
    speed stays. NaN where there is no truth then.
    """
    matching = one.matching
    assert matching is not None
    rows = np.flatnonzero(matching.paired)
    tracks, ticks = matching.tracks.where(matching.paired), matching.tick_index[rows]
    object_index, ready_ns = matching.object_index[rows], _ready(one.run)[0][ticks]
    truth = true_states(one.run.tables["truth"], object_index, ready_ns)[:, :2]
    published = np.stack([tracks["x_m"], tracks["y_m"]], axis=-1)
    way_m = tracks["speed_mps"] * (ready_ns - tracks["stamp_ns"]) / NS_PER_S
    moved = published + np.nan_to_num(cartesian(np.stack([tracks["yaw_rad"], way_m], axis=-1)))
    return {
        ASKED: matching.distances_m[rows, object_index],
        READY: np.linalg.norm(published - truth, axis=-1),
        PREDICTED: np.linalg.norm(moved - truth, axis=-1),
    }


def streaming_tables(runs: Sequence[EvaluatedRun]) -> tuple[dict[str, Table], list[str]]:
    """Return tables `streaming` and `load` of `runs`, and sentences on the best run when each pays for its time.

    A run with a load above 1 is not ranked beside others that keep up: its loss has no bound, and the few samples
    before the truth ends would decide.
    """
    records: list[dict[str, Any]] = []
    notes, sentences = [], []
    load = _load(runs)
    loads = {record["run"]: record["load"] for record in load.records}
    for group in comparable(runs):
        late = [one for one in group if loads[one.label] > 1.0]
        ranked = [one for one in group if one not in late] or group
        entries, share = _compared(ranked)
        if share < _LARGE_SHARE:
            names = ", ".join(one.label for one in ranked)
            notes.append(f"{names}: {share:.0%} of the samples count: the truth ends before the others are ready")
        if len(ranked) > 1 and entries:
            sentences += [
                who_is_best(entries[READY], "where each is evaluated when it is ready"),
                who_is_best(entries[PREDICTED], "where users also predict what they get to that moment"),
            ]
        for one in late:
            behind = f"{one.label} falls behind for good (load {loads[one.label]:.0%})"
            sentences.append(f"{behind}: the longer the run, the worse.")
            if one not in ranked:
                alone, share = _compared([one])
                notes.append(f"{behind}: not ranked, evaluated at {share:.0%} of its samples, until the truth ends")
                for when, (entry,) in alone.items():
                    entries[when] = (*entries.get(when, ()), Entry(entry.name, entry.value, UNKNOWN, "worse"))
        for when, of_runs in entries.items():
            records += [{"judged": when, **entry_record(entry, "position_rmse_m")} for entry in of_runs]
    own = [
        "when ready: as published, against the truth when its computation was done",
        "predicted: the same, moved straight on to then at its own speed by its user",
        STANDING_NOTE,
    ]
    evaluated = Column("evaluated", "judged", text=lambda name: _TITLES[str(name)], left=True)
    columns = [evaluated, RUN, *entry_columns("pos. [m]", "position_rmse_m")]
    title = "Streaming accuracy (position RMSE, each run paying for its time)"
    streaming = Table(title, records, columns, ("run", "judged"), [*own, *notes])
    return {"streaming": streaming, "load": load}, sentences


def _compared(group: Sequence[EvaluatedRun]) -> tuple[dict[str, tuple[Entry, ...]], float]:
    """Runs of one recording by when they are evaluated, and the least share of a run's samples that counts.

    All numbers are of the objects and ticks that all runs have, with truth when they are ready.
    """
    every, objects, ticks_ns, most = [], [], [], 0
    for one in group:
        errors_m, matching = streaming_errors(one), one.matching
        assert matching is not None
        known = np.isfinite(errors_m[READY])
        every.append({name: values[known] for name, values in errors_m.items()})
        objects.append(matching.object_index[matching.paired][known])
        ticks_ns.append(matching.now_ns[matching.tick_index[matching.paired][known]])
        most = max(most, len(known))
    _, at_ns, rows = common_samples(objects, ticks_ns)
    if not len(at_ns):
        return {}, 0.0
    entries = {}
    for name in (ASKED, READY, PREDICTED):
        squares_m2 = [np.square(one[name][row]) for one, row in zip(every, rows, strict=True)]
        sums = by_stamp(at_ns, np.stack(squares_m2, axis=-1))
        entries[name] = compared(name, [one.label for one in group], sums)
    return entries, len(at_ns) / most


def _ready(run: Run) -> tuple[IntArray, Node]:
    """Time at which the output of every tick was ready, shape (ticks,), and the node that did them."""
    node_hz = (run.config.get("clock") or {}).get("node_hz")
    node = Node(None if node_hz is None else period_ns(float(node_hz)))
    return ready_times(run.tables["timing"], node), node


def _load(runs: Sequence[EvaluatedRun]) -> Table:
    """A row for each run: time from its tick until an output was ready, late ticks, load."""
    records: list[dict[str, Any]] = []
    for one in runs:
        timing, (ready_ns, node) = one.run.tables["timing"], _ready(one.run)
        now_ns = timing["now_ns"]
        delay, length_ns = Distribution.of((ready_ns - now_ns) / NS_PER_S), int(np.ptp(now_ns)) if len(now_ns) else 0
        record = {"run": one.label, "ready_after_p50_s": delay.p50, "ready_after_p99_s": delay.p99}
        record |= {"ready_after_max_s": delay.max}
        misses, ticks = (node.misses, len(now_ns)) if node.period_ns is not None else (None, None)
        load = float(timing["process_ns"].sum() / length_ns) if length_ns else np.nan
        records.append(record | {"deadline_misses": misses, "ticks": ticks, "load": load})
    columns = [
        RUN,
        Column("ready after\n[ms] p50/p99", "ready_after_p50_s ready_after_p99_s", "{}/{}", MS),
        Column("longest\n[ms]", "ready_after_max_s", scale=MS),
        Column("late\nticks", "deadline_misses ticks", "{}/{}"),
        Column("load\n[%]", "load", scale=PERCENT),
    ]
    notes = [
        "of all ticks, one after the other: a tick begins when it is due, or when the one before is done",
        "load: computing time over the length of the run; above 100 % it falls behind for good",
    ]
    return Table("Load", records, columns, notes=notes)
