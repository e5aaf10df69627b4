"""Runs into a file that a viewer opens."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from heapq import merge
from operator import attrgetter
from pathlib import Path

from fgtrack.core.errors import CallError, printable
from fgtrack.evaluation.palette import distinct_colours
from fgtrack.evaluation.recordings import same_recording
from fgtrack.evaluation.roads import excluded_lines, roads
from fgtrack.evaluation.runs import Runs, judged, run_folders
from fgtrack.io.output import check_apart
from fgtrack.io.ros.bag_writer import token
from fgtrack.io.run import Run
from fgtrack.viewers.detection_messages import detection_messages, outcome_messages
from fgtrack.viewers.foxglove import check_foxglove, write_foxglove
from fgtrack.viewers.look import Look, rgba
from fgtrack.viewers.ros2 import check_viewer_bag, write_viewer_bag
from fgtrack.viewers.shapes import ViewerMessage
from fgtrack.viewers.surroundings import (
    ego_messages,
    map_scene,
    start_ns,
    truth_messages,
)
from fgtrack.viewers.track_messages import past_messages, smoothed_messages, track_messages


@dataclass(frozen=True)
class Exported:
    """What was written."""

    counts: Mapping[str, int]
    """Messages by topic."""
    notes: tuple[str, ...]
    """What could not be shown, a line each."""


def export(runs: Runs, out: Path, *, ros2: bool = False, overwrite: bool = False) -> Exported:
    """Write `runs` of one recording to `out`: an MCAP file for Foxglove, or with `ros2` a rosbag2 recording.

    Log times are those at which something was known (receipt, tick), publish times and header stamps those that it is
    about. Several runs stand side by side, the topics of each below its name.

    Raises
    ------
    CallError
        The runs are not of the same recording, the package `mcap` is missing, `out` does not end in `.mcap`, lies in
        a run, or something is there.
    DataError
        A run or its map is damaged, or a time does not fit into the file.
    """
    (check_viewer_bag if ros2 else check_foxglove)(out, overwrite)
    every = judged(runs)
    check_apart(out, run_folders(every))
    named = {one.label: one.run for one in every}
    messages, notes = viewer_messages(named)
    if ros2:
        counts = write_viewer_bag(out, messages, overwrite=overwrite)
    else:
        counts = write_foxglove(out, messages, _metadata(named), overwrite=overwrite)
    return Exported(counts, tuple(notes))


def viewer_messages(runs: Mapping[str, Run]) -> tuple[Iterator[ViewerMessage], list[str]]:
    """What shows `runs`, by name, in the order of log times, and a line for whatever cannot be shown."""
    first = next(iter(runs.values()))
    _check_same_recording(runs)
    at_ns = start_ns(first)
    maps, notes = roads(first)
    parts: list[Iterable[ViewerMessage]] = [
        map_scene(maps, excluded_lines(first), at_ns),
        ego_messages(first.ego, at_ns),
    ]
    parts.append(truth_messages(first.truth))
    for look, (name, run) in zip(_looks(runs), runs.items(), strict=True):
        parts += [make(run, look) for make in _PARTS]
        if run.updates.num_rows and not run.detections.num_rows:
            notes.append(f"{name}: has no detections.csv, so no detections are shown; repeat the run")
    return merge(*parts, key=attrgetter("log_ns")), notes


_PARTS: tuple[Callable[[Run, Look], Iterator[ViewerMessage]], ...] = (
    detection_messages,
    outcome_messages,
    track_messages,
    past_messages,
    smoothed_messages,
)


def _looks(runs: Mapping[str, Run]) -> list[Look]:
    """One run alone has the topics for itself; of several, each has a name before its topics, and a colour."""
    if len(runs) == 1:
        return [Look()]
    names: list[str] = []
    for label in runs:
        name, same = token(label), 1
        while (unique := name if same == 1 else f"{name}_{same}") in names:
            same += 1
        names.append(unique)
    colours = distinct_colours([str(run.meta.get("estimator", "")) for run in runs.values()])
    return [Look(f"/{name}", rgba(colour)) for name, colour in zip(names, colours, strict=True)]


def _check_same_recording(runs: Mapping[str, Run]) -> None:
    (first, its), *others = runs.items()
    for name, run in others:
        if not same_recording(its, run) or run.ego != its.ego:  # the file has one ego
            raise CallError(f"{first} and {name} are of different recordings, export each to a file of its own")


def _metadata(runs: Mapping[str, Run]) -> dict[str, dict[str, str]]:
    """What the file says of each run, by a name of its record."""
    found = {}
    for name, run in runs.items():
        versions = run.meta.get("versions") or {}
        told = {
            "estimator": run.meta.get("estimator", ""),
            "input": (run.meta.get("input") or {}).get("path", ""),
            "digest": run.meta.get("digest", ""),
            "fgtrack": versions.get("fgtrack", ""),
        }
        kept = {key: printable(str(value)) for key, value in told.items()}  # names of files need not be UTF-8
        found["fgtrack" if len(runs) == 1 else printable(f"fgtrack {name}")] = kept
    return found
