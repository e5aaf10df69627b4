"""Runs into a file that a viewer opens."""

from collections.abc import Iterator, Mapping
from heapq import merge
from pathlib import Path

from fgtrack.core.errors import CallError
from fgtrack.core.output import check_no_overlap, check_output
from fgtrack.evaluation.placement import roads
from fgtrack.evaluation.runs import Runs, evaluated, same_recording
from fgtrack.inputs.ros.bag_writer import check_bag, topic_part
from fgtrack.runs import Run
from fgtrack.show.geojson import origin_of
from fgtrack.show.palette import distinct_colours
from fgtrack.show.ros2 import write_ros2
from fgtrack.show.run_messages import (
    RunLayer,
    ego_messages,
    map_messages,
    run_messages,
    truth_messages,
)
from fgtrack.show.shapes import ViewerMessage
from fgtrack.show.states import start_ns


def export(
    runs: Runs, out: Path, *, ros2: bool = False, overwrite: bool = False
) -> tuple[dict[str, int], list[str]]:
    """Write `runs` of one recording to `out`: an MCAP file for Foxglove, or with `ros2` a rosbag2 recording.

    Log times are those at which something was known (receipt, tick), publish times and header stamps those that it is
    about. Several runs stand side by side, the topics of each below its name. Returns the number of messages by topic,
    and a line for whatever could not be shown. Raises `CallError` if the runs are not of the same recording, the
    package `foxglove-sdk` is missing, or `out` is no name for the file, exists or lies in a run, and `DataError` if a
    run or its map is damaged, or a time does not fit into the file.
    """
    if not ros2:
        try:
            from fgtrack.show.foxglove import write_foxglove
        except ModuleNotFoundError as error:
            text = "foxglove-sdk is not installed: `pip install foxglove-sdk`, or export with --ros2"
            raise CallError(text) from error
        if out.suffix != ".mcap":
            raise CallError(
                f"{out}: viewers recognise such a file by its name, let it end in .mcap"
            )
    (check_output if out.suffix == ".mcap" else check_bag)(out, overwrite)
    every = evaluated(runs)
    check_no_overlap(out, [item.run.path for item in every])
    messages, notes = viewer_messages({item.label: item.run for item in every})
    if ros2:
        return write_ros2(out, messages, overwrite), notes
    return write_foxglove(out, messages, overwrite, origin_of(every[0].run)), notes


def viewer_messages(
    runs: Mapping[str, Run],
) -> tuple[Iterator[ViewerMessage], list[str]]:
    """Messages that show `runs`, by name, in the order of log times, and a line for whatever cannot be shown."""
    (label, first), *others = runs.items()
    for name, run in others:
        if not same_recording(first, run) or not run.tables["ego"].equals(
            first.tables["ego"]
        ):  # the file has one ego
            raise CallError(
                f"{label} and {name} are of different recordings, export each to a file of its own"
            )
    at_ns = start_ns(first)
    maps, notes = roads(first)
    parts = [
        map_messages(maps, at_ns),
        ego_messages(first.tables["ego"], at_ns),
        *truth_messages(first.tables["truth"]),
    ]
    for layer, run in zip(_layers(runs), runs.values(), strict=True):
        parts += run_messages(run, layer)
    return merge(*parts, key=lambda message: message.log_ns), notes


def _layers(runs: Mapping[str, Run]) -> list[RunLayer]:
    """One run alone has the topics for itself; of several, each has a name before its topics, and a colour."""
    if len(runs) == 1:
        return [RunLayer()]
    names: list[str] = []
    for label in runs:
        names.append(
            topic_part(label)
            if topic_part(label) not in names
            else f"{topic_part(label)}_{len(names) + 1}"
        )
    colours = distinct_colours(
        [str(run.meta.get("estimator", "")) for run in runs.values()]
    )
    return [
        RunLayer(f"/{name}", colour)
        for name, colour in zip(names, colours, strict=True)
    ]
