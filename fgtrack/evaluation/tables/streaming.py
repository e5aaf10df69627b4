"""Accuracy when each run pays for its time: published states against the truth at the moment when they were ready.

Li, Wang, Ramanan: Towards streaming perception, ECCV 2020; Wang et al.: The ASAP benchmark, CVPR 2023. Times of ticks
are those of timing.csv, so nothing depends on the machine that compares.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fgtrack.core.geometry import cartesian
from fgtrack.core.time import NS_PER_S, period_ns
from fgtrack.core.types import IntArray
from fgtrack.evaluation.comparison import (
    STANDING_NOTE,
    common_sums,
    comparable,
    compared,
    entry_columns,
    entry_record,
)
from fgtrack.evaluation.matching import Matching, TrackErrors
from fgtrack.evaluation.runs import EvaluatedRun
from fgtrack.evaluation.scores.statistics import Distribution
from fgtrack.evaluation.tables import MS, PERCENT, RUN, Column, Table
from fgtrack.evaluation.tables.verdict import who_is_best
from fgtrack.evaluation.truth import true_states
from fgtrack.runs import Node, Run, ready_times

#: A state is evaluated at its own stamp, as everywhere else; as published, at the moment when it was ready; the same
#: after its user has moved it to that moment.
ASKED, READY, PREDICTED = "asked", "ready", "predicted"
_TITLES = {ASKED: "at its stamp", READY: "when ready", PREDICTED: "predicted to then"}


def streaming_errors(run: Run, matching: Matching) -> TrackErrors:
    """Return distances to the truth of the paired rows by when they are evaluated, where there is truth when ready.
    Predictions move the published position along the published yaw at the published speed, if there are both.
    """
    rows = np.flatnonzero(matching.paired)
    tracks, object_index = (
        matching.tracks.where(matching.paired),
        matching.object_index[rows],
    )
    ready_ns = _ready(run)[0][matching.tick_index[rows]]
    truth = true_states(run.tables["truth"], object_index, ready_ns)[:, :2]
    published = np.stack([tracks["x_m"], tracks["y_m"]], axis=-1)
    way_m = tracks["speed_mps"] * (ready_ns - tracks["stamp_ns"]) / NS_PER_S
    moved = published + np.nan_to_num(
        cartesian(np.stack([tracks["yaw_rad"], way_m], axis=-1))
    )
    known = np.isfinite(truth[:, 0])
    values = {
        ASKED: matching.distances_m[rows, object_index][known],
        READY: np.linalg.norm(published - truth, axis=-1)[known],
        PREDICTED: np.linalg.norm(moved - truth, axis=-1)[known],
    }
    now_ns = matching.now_ns[matching.tick_index[rows[known]]]
    return TrackErrors(now_ns, object_index[known], tracks["track_id"][known], values)


def streaming_tables(
    runs: Sequence[EvaluatedRun],
) -> tuple[dict[str, Table], list[str]]:
    """Return tables `streaming` and `load`, and sentences on the best of the `runs` with a load of at most 1."""
    load, records, sentences = _load(runs), [], []
    late = {
        record["run"]: record["load"] for record in load.records if record["load"] > 1.0
    }
    for group in comparable([item for item in runs if item.label not in late]):
        errors = [
            streaming_errors(item.run, item.matching)
            for item in group
            if item.matching is not None
        ]
        squares = [
            replace(
                item, values={when: np.square(m) for when, m in item.values.items()}
            )
            for item in errors
        ]
        labels = [item.label for item in group]
        entries = {
            when: compared(when, labels, sums)
            for when, sums in common_sums(squares)[2].items()
        }
        if len(group) > 1 and entries:
            sentences += [
                who_is_best(entries[READY], "where each is evaluated when it is ready"),
                who_is_best(
                    entries[PREDICTED],
                    "where users also predict what they get to that moment",
                ),
            ]
        for when, of_runs in entries.items():
            records += [
                {"judged": when, **entry_record(entry, "position_rmse_m")}
                for entry in of_runs
            ]
    for label, share in late.items():
        sentences.append(
            f"{label} falls behind for good (load {share:.0%}): not ranked, the longer the run, the worse."
        )
    notes = [
        "when ready: as published, against the truth when its computation was done",
        "predicted: the same, moved straight on to then at its own speed by its user",
        STANDING_NOTE,
    ]
    evaluated = Column(
        "evaluated", "judged", text=lambda name: _TITLES[str(name)], left=True
    )
    columns = [evaluated, RUN, *entry_columns("pos. [m]", "position_rmse_m")]
    title = "Streaming accuracy (position RMSE, each run paying for its time)"
    return {
        "streaming": Table(title, records, columns, ("run", "judged"), notes),
        "load": load,
    }, sentences


def _ready(run: Run) -> tuple[IntArray, Node]:
    """Time at which the output of every tick was ready, shape (ticks,), and the node that did them."""
    node_hz = (run.config.get("clock") or {}).get("node_hz")
    node = Node(None if node_hz is None else period_ns(float(node_hz)))
    return ready_times(run.tables["timing"], node), node


def _load(runs: Sequence[EvaluatedRun]) -> Table:
    """A row for each run: time from its tick until an output was ready, late ticks, load."""
    records = []
    for item in runs:
        timing, (ready_ns, node) = item.run.tables["timing"], _ready(item.run)
        now_ns, is_periodic = timing["now_ns"], node.period_ns is not None
        delay, length_ns = (
            Distribution.of((ready_ns - now_ns) / NS_PER_S),
            np.ptp(now_ns) if len(now_ns) else 0,
        )
        times = {
            "ready_after_p50_s": delay.p50,
            "ready_after_p99_s": delay.p99,
            "ready_after_max_s": delay.max,
        }
        misses = (
            {"deadline_misses": node.misses, "ticks": len(now_ns)}
            if is_periodic
            else {}
        )
        load = float(timing["process_ns"].sum() / length_ns) if length_ns else np.nan
        records.append(
            {
                "run": item.label,
                **times,
                "deadline_misses": None,
                "ticks": None,
                **misses,
                "load": load,
            }
        )
    columns = [
        RUN,
        Column(
            "ready after\n[ms] p50/p99",
            "ready_after_p50_s ready_after_p99_s",
            "{}/{}",
            MS,
        ),
        Column("longest\n[ms]", "ready_after_max_s", scale=MS),
        Column("late\nticks", "deadline_misses ticks", "{}/{}"),
        Column("load\n[%]", "load", scale=PERCENT),
    ]
    notes = [
        "of all ticks, one after the other: a tick begins when it is due, or when the one before is done",
        "load: computing time over the length of the run; above 100 % it falls behind for good",
    ]
    return Table("Load", records, columns, notes=notes)
