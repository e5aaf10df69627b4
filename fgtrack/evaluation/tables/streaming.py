"""Streaming accuracy: published states against the truth at the time when they were ready.

So each run pays for its computing time. Sources: Li, Wang, Ramanan: Towards streaming
perception, ECCV 2020; Wang et al.: The ASAP benchmark, CVPR 2023. Times of ticks come
from timing.csv, so the result does not depend on the machine that compares.
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
from fgtrack.evaluation.truth import states_of
from fgtrack.runs import Node, Run, ready_times

#: Ways to evaluate a state: at its own stamp; as published, when it was ready; predicted by its user to that time.
ASKED, READY, PREDICTED = "asked", "ready", "predicted"
_TITLES = {ASKED: "at its stamp", READY: "when ready", PREDICTED: "predicted to then"}


def streaming_errors(run: Run, matching: Matching) -> TrackErrors:
    """Return the distances of the paired rows from the truth, for each way of evaluation.

    Only rows with truth when they were ready count. Predictions move the published
    position along the published yaw with the published speed, if both exist.
    """
    rows = np.flatnonzero(matching.paired)
    tracks = matching.tracks.where(matching.paired)
    object_index = matching.object_index[rows]
    ready_ns = _ready(run)[0][matching.tick_index[rows]]
    truth = states_of(matching.paths, object_index, ready_ns)[:, :2]
    published = np.stack([tracks["x_m"], tracks["y_m"]], axis=-1)
    way_m = tracks["speed_mps"] * (ready_ns - tracks["stamp_ns"]) / NS_PER_S
    moved = published + np.nan_to_num(
        cartesian(np.stack([tracks["yaw_rad"], way_m], axis=-1))
    )
    known = np.isfinite(truth[:, 0])
    at_stamp = published - matching.truth_of(rows)[:, :2]
    values = {
        ASKED: np.linalg.norm(at_stamp, axis=-1)[known],
        READY: np.linalg.norm(published - truth, axis=-1)[known],
        PREDICTED: np.linalg.norm(moved - truth, axis=-1)[known],
    }
    now_ns = matching.now_ns[matching.tick_index[rows[known]]]
    return TrackErrors(now_ns, object_index[known], tracks["track_id"][known], values)


def streaming_tables(
    runs: Sequence[EvaluatedRun],
) -> tuple[dict[str, Table], list[str]]:
    """Return the tables `streaming` and `load`, and sentences on the best runs.

    The load is the computing time over the length of the run. Runs with a load above 1
    are not ranked.
    """
    load = _load(runs)
    records = []
    sentences = []
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
                who_is_best(entries[READY], "evaluated when the states are ready"),
                who_is_best(
                    entries[PREDICTED],
                    "evaluated when ready, with states predicted to that time by the user",
                ),
            ]
        for when, of_runs in entries.items():
            records += [
                {"judged": when, **entry_record(entry, "position_rmse_m")}
                for entry in of_runs
            ]
    for label, share in late.items():
        sentences.append(
            f"{label} cannot keep up (load {share:.0%}): it is not ranked, as its delay grows with the run."
        )
    notes = [
        "when ready: the published state against the truth at the end of its computation",
        "predicted: the published state, moved straight ahead at its speed to that time",
        STANDING_NOTE,
    ]
    evaluated = Column(
        "evaluated", "judged", text=lambda name: _TITLES[str(name)], left=True
    )
    columns = [evaluated, RUN, *entry_columns("pos. [m]", "position_rmse_m")]
    title = (
        "Streaming accuracy (position RMSE, including the computing time of each run)"
    )
    return {
        "streaming": Table(title, records, columns, ("run", "judged"), notes),
        "load": load,
    }, sentences


def _ready(run: Run) -> tuple[IntArray, Node]:
    """Return the time at which the output of each tick was ready, shape (ticks,), and the node that ran them."""
    node_hz = (run.config.get("clock") or {}).get("node_hz")
    node = Node(None if node_hz is None else period_ns(float(node_hz)))
    return ready_times(run.tables["timing"], node), node


def _load(runs: Sequence[EvaluatedRun]) -> Table:
    """Return a table with a row for each run: time from tick to output, late ticks, load."""
    records = []
    for item in runs:
        timing = item.run.tables["timing"]
        ready_ns, node = _ready(item.run)
        now_ns = timing["now_ns"]
        is_periodic = node.period_ns is not None
        delay = Distribution.of((ready_ns - now_ns) / NS_PER_S)
        length_ns = np.ptp(now_ns) if len(now_ns) else 0
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
        "ticks run one after another: a tick begins when it is due, or when the previous tick has ended",
        "load: computing time over the length of the run; above 100 % the delay grows without bound",
    ]
    return Table("Load", records, columns, notes=notes)
