"""Runs into a file that a viewer opens."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from heapq import merge
from pathlib import Path

from fgtrack.core.errors import CallError, printable
from fgtrack.evaluation.palette import distinct_colours
from fgtrack.evaluation.roads import excluded_lines, roads
from fgtrack.evaluation.runs import Runs, evaluated, run_folders, same_recording
from fgtrack.io.output import check_apart
from fgtrack.io.ros.bag_writer import token
from fgtrack.io.run import Run
from fgtrack.viewers.ros2 import check_ros2, write_ros2
from fgtrack.viewers.run_messages import Look, ego_messages, map_messages, run_messages, truth_messages
from fgtrack.viewers.shapes import ViewerMessage
from fgtrack.viewers.states import start_ns


@dataclass(frozen=True)
class Exported:
    """Number of messages written, and notes on contents that could not be shown."""

    counts: Mapping[str, int]
    """Messages by topic."""
    notes: tuple[str, ...]
    """Contents that could not be shown, a line each."""


def export(runs: Runs, out: Path, *, ros2: bool = False, overwrite: bool = False) -> Exported:
    """Write `runs` of one recording to `out`: an MCAP file for Foxglove, or with `ros2` a rosbag2 recording.

    Log times are those at which something was known (receipt, tick), publish times and header stamps those that it is
    about. Several runs stand side by side, the topics of each below its name.

    Raises
    ------
    CallError
        The runs are not of the same recording, the package `foxglove-sdk` is missing, `out` does not end in `.mcap`,
        lies in a run, or something is there.
    DataError
        A run or its map is damaged, or a time does not fit into the file.
    """
    check, write = (check_ros2, write_ros2) if ros2 else _foxglove()
    check(out, overwrite)
    every = evaluated(runs)
    check_apart(out, run_folders(every))
    named = {one.label: one.run for one in every}
    messages, notes = viewer_messages(named)
    return Exported(write(out, messages, _metadata(named), overwrite), tuple(notes))


def _foxglove() -> tuple[Callable[..., None], Callable[..., dict[str, int]]]:
    try:
        from fgtrack.viewers.foxglove import check_foxglove, write_foxglove
    except ModuleNotFoundError as error:
        raise CallError("foxglove-sdk is not installed: `pip install foxglove-sdk`, or export with --ros2") from error
    return check_foxglove, write_foxglove


def viewer_messages(runs: Mapping[str, Run]) -> tuple[Iterator[ViewerMessage], list[str]]:
    """Messages that show `runs`, by name, in the order of log times, and a line for whatever cannot be shown."""
    (label, first), *others = runs.items()
    for name, run in others:
        if not same_recording(first, run) or not run.tables["ego"].equals(first.tables["ego"]):  # the file has one ego
            raise CallError(f"{label} and {name} are of different recordings, export each to a file of its own")
    at_ns = start_ns(first)
    maps, notes = roads(first)
    parts = [
        map_messages(maps, excluded_lines(first), at_ns),
        ego_messages(first.tables["ego"], at_ns),
        *truth_messages(first.tables["truth"]),
    ]
    for look, (name, run) in zip(_looks(runs), runs.items(), strict=True):
        parts += run_messages(run, look)
        if run.tables["updates"].num_rows and not run.tables["detections"].num_rows:
            notes.append(f"{name}: has no detections.csv, so no detections are shown; repeat the run")
    return merge(*parts, key=lambda message: message.log_ns), notes


def _looks(runs: Mapping[str, Run]) -> list[Look]:
    """One run alone has the topics for itself; of several, each has a name before its topics, and a colour."""
    if len(runs) == 1:
        return [Look()]
    names: list[str] = []
    for label in runs:
        names.append(token(label) if token(label) not in names else f"{token(label)}_{len(names) + 1}")
    colours = distinct_colours([str(run.meta.get("estimator", "")) for run in runs.values()])
    return [Look(f"/{name}", colour) for name, colour in zip(names, colours, strict=True)]


def _metadata(runs: Mapping[str, Run]) -> dict[str, dict[str, str]]:
    """Records of the file, by their names: origin and digest of each run."""
    records = {}
    for name, run in runs.items():
        facts = {
            "estimator": run.meta.get("estimator", ""),
            "input": (run.meta.get("input") or {}).get("path", ""),
            "digest": run.meta.get("digest", ""),
            "fgtrack": (run.meta.get("versions") or {}).get("fgtrack", ""),
        }
        record = "fgtrack" if len(runs) == 1 else f"fgtrack {name}"
        records[printable(record)] = {key: printable(str(value)) for key, value in facts.items()}
    return records
