"""Which runs are of one recording, so that they may be compared, drawn and exported together."""

from collections.abc import Sequence

import numpy as np

from fgtrack.core.types import MEASURABLE, BoolArray
from fgtrack.evaluation.runs import JudgedRun
from fgtrack.io.run import Run, Table

_TIMES = ("stamp_ns", "receipt_ns")


def same_recording(one: Run, other: Run) -> bool:
    """Whether two runs are of the same scene as the same sensors saw it.

    The truth is the same, and of every sensor that both have the detections are as many and say the same, at the same
    stamps (a recording with other delays) or the same receipts (a configuration with other stamps). Without a common
    sensor and without truth the ego decides, without that the place of the recording.
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
    place = one.recording
    return place is not None and place == other.recording


def by_recording(runs: Sequence[JudgedRun]) -> list[list[JudgedRun]]:
    """`runs` in groups, those of the same recording together."""
    groups: list[list[JudgedRun]] = []
    for one in runs:
        group = next((group for group in groups if same_recording(group[0].run, one.run)), None)
        if group is None:
            groups.append([one])
        else:
            group.append(one)
    return groups


def recordings_caution(runs: Sequence[JudgedRun]) -> list[str]:
    """A line where `runs` are of different recordings, and which of what; nothing otherwise."""
    groups = by_recording(runs)
    if len(groups) < 2:
        return []
    texts = [f"{', '.join(one.label for one in group)} ({_told(group[0].run)})" for group in groups]
    return [
        f"the runs are of {len(groups)} recordings, so their numbers cannot be compared across them: {'; '.join(texts)}"
    ]


def _same_detections(one: Run, other: Run, sensor: str) -> bool:
    mine, its = (run.tables["updates"].where(run.tables["updates"]["sensor"] == sensor) for run in (one, other))
    same = [name for name in _TIMES if np.array_equal(np.sort(mine[name]), np.sort(its[name]))]
    return any(_same_values(one.tables["detections"], other.tables["detections"], sensor, time) for time in same)


def _same_values(mine: Table, its: Table, sensor: str, time: str) -> bool:
    """Whether what was measured is the same where both know it, in the order of `time`; also where one has no table."""
    found = [table.where(table["sensor"] == sensor) for table in (mine, its)]
    if not all(table.num_rows for table in found) or found[0].num_rows != found[1].num_rows:
        return not all(table.num_rows for table in found)
    orders = [np.lexsort((table["index"], table[time])) for table in found]
    for name in MEASURABLE:
        if name in found[0] and name in found[1]:
            a, b = (table[name][order] for table, order in zip(found, orders, strict=True))
            known: BoolArray = np.isfinite(a) & np.isfinite(b)
            if not np.array_equal(a[known], b[known]):
                return False
    return True


def _told(run: Run) -> str:
    source = run.meta.get("input") or {}
    words = [str(source["path"])] if source.get("path") else []
    if run.meta.get("messages_received"):
        words.append(f"{run.meta['messages_received']} messages")
    return ", ".join(words) or f"{run.tables['updates'].num_rows} detections"
