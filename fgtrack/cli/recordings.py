"""`fgtrack simulate`, `convert` and `config`: writes recordings, and prints the configuration of a replay."""

from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, get_args

import numpy as np
from rich.table import Table as Grid
from rich.text import Text
from typer import Argument, Option

from fgtrack.cli.arguments import (
    ConfigFile,
    Input,
    Overwrite,
    Seed,
    Settings,
    StorageOption,
)
from fgtrack.cli.show import console, progress, say
from fgtrack.config.keys import commented
from fgtrack.config.reading import read_config, read_scenario
from fgtrack.config.recorded import recorded_of
from fgtrack.config.shipped import Kind, shipped, summary
from fgtrack.config.yaml_file import dump, load
from fgtrack.core.errors import CallError, DataError
from fgtrack.core.output import check_no_overlap
from fgtrack.core.types import DetectionList, Message
from fgtrack.evaluation.diagnostics import excluded_lines
from fgtrack.inputs.recording import check_recording, write_recording
from fgtrack.pipeline.simulation import path_files, simulated
from fgtrack.sim.new_delays import SensorDelays, redelay


def simulate(
    scenario_file: Annotated[
        str,
        Argument(metavar="SCENARIO", help="Scenario: a file (YAML) or a shipped name."),
    ],
    out: Annotated[
        Path,
        Option("-o", "--out", help="Stream (.jsonl, .jsonl.gz) or rosbag2 folder."),
    ],
    seed: Seed = 0,
    duration_s: Annotated[
        float | None,
        Option("--duration", help="Duration [s], instead of the scenario's."),
    ] = None,
    storage: StorageOption = "mcap",
    overwrite: Overwrite = False,
) -> None:
    """Simulate a scenario into a stream or a rosbag2 folder."""
    scenario = read_scenario(scenario_file, duration_s=duration_s)
    check_no_overlap(out, [scenario_file, scenario.map, *path_files(scenario)])
    check_recording(out, overwrite)
    with progress("simulate"):
        messages = simulated(scenario, np.random.default_rng(seed))
        count = write_recording(
            out, messages, storage, settings=recorded_of(scenario), overwrite=overwrite
        )
    say(f"{out}: {count} messages")


def convert(
    recording: Input,
    out: Annotated[
        Path,
        Argument(metavar="OUT", help="Stream (.jsonl, .jsonl.gz) or rosbag2 folder."),
    ],
    config_file: ConfigFile = None,
    delays_file: Annotated[
        Path | None,
        Option("--delays", help="File with new delays, losses and clocks (YAML)."),
    ] = None,
    seed: Seed = 0,
    storage: StorageOption = "mcap",
    overwrite: Overwrite = False,
) -> None:
    """Convert a recording into a stream or a rosbag2 folder."""
    config = read_config(config_file)
    check_no_overlap(out, [recording, config_file, delays_file])
    check_recording(out, overwrite)
    from fgtrack.meaning.draft import opened

    draft = opened(recording, config)
    source = draft.source
    unread: dict[str, Counter[str]] = {}
    with progress("convert"):
        messages = source.messages()
        lost = dict[str, int]()
        if delays_file is not None:
            delays = load(dict[str, SensorDelays], delays_file)
            messages, lost = redelay(messages, delays, np.random.default_rng(seed))
        kept = _with_unread(messages, unread)
        count = write_recording(
            out, kept, storage, settings=source.settings(), overwrite=overwrite
        )
    losses = ", ".join(
        f"{number} of {sensor}" for sensor, number in lost.items() if number
    )
    say(f"{out}: {count} messages{losses and f', lost {losses}'}")
    for line in excluded_lines({"left_out": unread}):
        say(line)
    if draft.problem is not None:
        raise DataError(f"{recording}: {draft.problem}")


def _with_unread(
    messages: Iterable[Message], unread: dict[str, Counter[str]]
) -> Iterator[Message]:
    """Yield `messages`, and add the counts of excluded detections to `unread`, by sensor and setting."""
    for message in messages:
        if isinstance(message, DetectionList) and message.left_out:
            unread.setdefault(message.sensor, Counter()).update(message.left_out)
        yield message


def config(
    config_file: ConfigFile = None,
    settings: Settings = None,
    scenario_name: Annotated[
        str | None,
        Option(
            "--scenario",
            metavar="SCENARIO",
            help="Print a scenario instead: a file (YAML) or a shipped name.",
        ),
    ] = None,
    listed: Annotated[
        bool,
        Option("--list", help="List the shipped configurations, scenarios and sweeps."),
    ] = False,
) -> None:
    """Print a configuration or a scenario, or list the shipped ones.

    A scenario is printed with the meaning and the default of each key. The printed text
    is a scenario file.
    """
    if scenario_name is not None:
        if config_file is not None or settings or listed:
            raise CallError(
                "--scenario: prints a scenario alone, give it without other options"
            )
        say(commented(read_scenario(scenario_name)).removesuffix("\n"))
        return
    if not listed:
        say(dump(read_config(config_file, settings)).removesuffix("\n"))
        return
    for kind in get_args(Kind):
        say(f"{kind}s")
        grid = Grid.grid(padding=(0, 0, 0, 2))
        for name, path in shipped(kind).items():
            grid.add_row(Text(name, no_wrap=True), Text(summary(path)))
        console().print(grid)
