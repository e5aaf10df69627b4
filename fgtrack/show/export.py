"""Export of runs to a file for a viewer."""

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

    The log time of a message is the time at which its content was available (receipt or
    tick). Publish time and header stamp are the time of the content. Topics of several
    runs begin with the name of the run. Returns the number of messages by topic, and a
    line for each content that cannot be shown.

    Raises `CallError` for runs of different recordings, and without the package
    `foxglove-sdk`. Also if `out` is an invalid name, exists, or lies in a run. Raises
    `DataError` if a run or its map is damaged, or a time does not fit into the file.
    """
    if not ros2:
        try:
            from fgtrack.show.foxglove import write_foxglove
        except ModuleNotFoundError as error:
            text = "foxglove-sdk is not installed: `pip install foxglove-sdk`, or export with --ros2"
            raise CallError(text) from error
        if out.suffix != ".mcap":
            raise CallError(
                f"{out}: viewers recognise the format by the suffix, use a name that ends in .mcap"
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
    """Return the messages that show `runs`, in order of log times, and a line for each content that cannot be shown.

    The keys of `runs` are their names.

    Raises `CallError` for runs of different recordings.
    """
    (label, first), *others = runs.items()
    for name, run in others:
        if not same_recording(first, run) or not run.tables["ego"].equals(
            first.tables["ego"]
        ):  # the file has one ego
            raise CallError(
                f"{label} and {name} come from different recordings, export each to its own file"
            )
    at_ns = start_ns(first)
    maps, notes = roads(first)
    parts = [
        map_messages(maps, at_ns),
        ego_messages(first.tables["ego"], at_ns),
        truth_messages(first.tables["truth"]),
    ]
    for layer, run in zip(_layers(runs), runs.values(), strict=True):
        parts += run_messages(run, layer)
    return merge(*parts, key=lambda message: message.log_ns), notes


def _layers(runs: Mapping[str, Run]) -> list[RunLayer]:
    """Return a layer for each run.

    A single run has topics without prefix. Each of several runs has a topic prefix and
    a colour.
    """
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
