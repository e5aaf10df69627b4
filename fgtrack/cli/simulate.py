"""`fgtrack simulate`: a scenario to a stream or a bag."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from fgtrack.cli.arguments import Overwrite, StorageOption
from fgtrack.cli.completion import scenarios
from fgtrack.cli.show import progress, say, told
from fgtrack.io.output import check_apart
from fgtrack.io.recording import check_recording, write_recording
from fgtrack.pipeline.recorded import recorded_of
from fgtrack.pipeline.shipped import read_scenario
from fgtrack.sim.simulate import simulate as simulated


def simulate(
    scenario_file: Annotated[
        str,
        typer.Argument(
            metavar="SCENARIO",
            help="Scenario: a file (YAML) or a shipped name, as `default`.",
            autocompletion=scenarios,
        ),
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="Stream (.jsonl, .jsonl.gz), else a rosbag2 folder.")],
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the random generator.")] = 0,
    duration_s: Annotated[
        float | None, typer.Option("--duration", help="Length in seconds, instead of the scenario's.")
    ] = None,
    storage: StorageOption = "mcap",
    overwrite: Overwrite = False,
) -> None:
    """Simulate a scenario into a stream or a rosbag2 folder."""
    scenario = read_scenario(scenario_file, duration_s=duration_s)
    check_apart(out, [scenario_file, scenario.map])
    check_recording(out, overwrite)
    with progress("simulate") as tell:
        messages = simulated(scenario, np.random.default_rng(seed))
        count = write_recording(out, told(messages, tell), storage, settings=recorded_of(scenario), overwrite=overwrite)
    say(f"{out}: {count} messages")
