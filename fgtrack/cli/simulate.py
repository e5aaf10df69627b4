"""`fgtrack simulate`: a scenario to a stream or a bag."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from fgtrack.cli.show import console, progress
from fgtrack.cli.storage import Storage, StorageOption, write_recording
from fgtrack.core.errors import CallError
from fgtrack.pipeline.load import load
from fgtrack.sim.paper import paper_scenario
from fgtrack.sim.scenario import Scenario
from fgtrack.sim.simulate import simulate as simulated


def simulate(
    scenario_file: Annotated[
        Path,
        typer.Argument(metavar="SCENARIO", help="Scenario (YAML), or `default` for the paper's sensors."),
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="Stream (.jsonl, .jsonl.gz), else a rosbag2 folder.")],
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the random generator.")] = 0,
    duration_s: Annotated[
        float | None, typer.Option("--duration", help="Length in seconds, instead of the scenario's.")
    ] = None,
    storage: StorageOption = Storage.MCAP,
) -> None:
    """Simulate a scenario: ego, detections with noise and delays, and the truth."""
    scenario = read_scenario(scenario_file)
    if duration_s is not None:
        try:
            scenario = replace(scenario, duration_s=duration_s)
        except ValueError as error:
            raise CallError(f"--duration: {error}") from error
    with progress("simulate"):
        count = write_recording(out, simulated(scenario, np.random.default_rng(seed)), storage)
    console().print(f"{out}: {count} messages", highlight=False, soft_wrap=True)


def read_scenario(path: Path) -> Scenario:
    """The scenario of a file, or the built-in one by the name `default`."""
    if str(path) == "default" and not path.exists():
        return paper_scenario()
    return load(Scenario, path)
