"""`fgtrack study` and `demo`: from a recording, or a simulated race, to a report in one command."""

import shlex
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
from typer import Option

from fgtrack.cli.arguments import (
    ConfigFile,
    Input,
    Overwrite,
    PitMap,
    Seed,
    Settings,
    TrackMap,
)
from fgtrack.cli.show import progress, say, sentences, show, warn
from fgtrack.config.reading import read_config, read_scenario
from fgtrack.config.recorded import recorded_of
from fgtrack.core.errors import DataError
from fgtrack.core.output import check_no_overlap, locked_folder
from fgtrack.evaluation.diagnostics import diagnostics
from fgtrack.inputs.recording import check_recording, write_recording
from fgtrack.models.oval import OVAL
from fgtrack.pipeline.replay import with_origin
from fgtrack.recording_study import Study, outputs
from fgtrack.recording_study import study as studied
from fgtrack.show.figures.plot import error_against_delay
from fgtrack.sim.simulate import simulate


def study(
    recording: Input,
    out: Annotated[
        Path,
        Option("-o", "--out", help="Folder for report, settings, runs and figures."),
    ],
    config_file: ConfigFile = None,
    track_map: TrackMap = None,
    pit_map: PitMap = None,
    settings: Settings = None,
    overwrite: Overwrite = False,
) -> None:
    """Advise, replay with three estimators, compare, report.

    No configuration is needed. Assumptions are printed with their reasons, and written
    to settings.yaml. Change this file and run the command again.
    """
    config = read_config(config_file, settings, track_map=track_map, pit_map=pit_map)
    for path in outputs(out):
        check_no_overlap(path, [recording, config_file])
    with progress("study") as tell:
        result = studied(recording, out, config, overwrite=overwrite, on_step=tell)
    for line in dict.fromkeys(
        str(item) for run in result.runs for item in diagnostics(run)
    ):
        warn(line)
    show_study(result, recording)


def show_study(found: Study, recording: Path) -> None:
    """Print a study; raises `DataError` if the recording breaks off."""
    sentences(found.summary)
    show(replace(found.tables, verdict=()), None)
    say("")
    for assumption in found.assumptions:
        say(assumption)
    again = shlex.join(
        ["fgtrack", "study", str(recording), "-c", str(found.settings), "-o", "OTHER"]
    )
    say(f"settings: {found.settings}; change the file and run `{again}`")
    say(f"report: {found.report}, open the file in a browser")
    if found.broken is not None:
        problem = with_origin(found.broken, str(recording))
        raise DataError(f"{problem}; the messages before are used")


def demo(
    out: Annotated[
        Path,
        Option("-o", "--out", help="Folder for recording, runs, figures and report."),
    ] = Path("fgtrack-demo"),
    seed: Seed = 1,
    overwrite: Overwrite = False,
) -> None:
    """Simulate a race, record it, and study the recording."""
    scenario = read_scenario("default")
    with locked_folder(out):
        bag = out / "recording"
        check_recording(bag, overwrite)
        with progress("simulate"):
            messages = simulate(scenario, np.random.default_rng(seed))
            write_recording(
                bag, messages, overwrite=overwrite, settings=recorded_of(scenario)
            )
        config = read_config("tuned", track_map=OVAL, pit_map=OVAL)
    with progress("study") as tell:
        sweep = {"error_against_delay": error_against_delay()}
        result = studied(
            bag,
            out,
            config,
            advice=False,
            figures=sweep,
            overwrite=overwrite,
            on_step=tell,
        )
    say(
        f"{scenario.duration_s:g} s of a simulated race ({bag}), with noise tuned on other races (-c tuned):"
    )
    show_study(result, bag)
    say(
        f"error against delay, from a sweep over ten races: {out / 'figures/error_against_delay.png'}"
    )
