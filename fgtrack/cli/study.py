"""`fgtrack study` and `demo`: from a recording, or a simulated race, to a report in one command."""

import shlex
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
from typer import Argument, Option

from fgtrack.cli.arguments import (
    ConfigFile,
    Dask,
    Jobs,
    Overwrite,
    PitMap,
    Seed,
    Settings,
    TrackMap,
)
from fgtrack.cli.show import progress, say, sentences, show, warn
from fgtrack.config.reading import read_config, read_scenario
from fgtrack.config.recorded import recorded_of
from fgtrack.config.settings import Config
from fgtrack.core.errors import DataError
from fgtrack.core.output import check_no_overlap, locked_folder
from fgtrack.evaluation.diagnostics import (
    diagnostics,
    received_nothing,
    repeated,
    unused,
)
from fgtrack.inputs.folders import recordings_by_name
from fgtrack.inputs.recording import check_recording, write_recording
from fgtrack.models.oval import OVAL
from fgtrack.pipeline.replay import with_origin
from fgtrack.pipeline.simulation import simulated
from fgtrack.recording_study import ESTIMATORS, Study, outputs, study_job
from fgtrack.recording_study import study as studied
from fgtrack.show.figures.plot import error_against_delay


def study(
    recordings: Annotated[
        list[Path],
        Argument(
            metavar="INPUT...",
            help="Recordings of one vehicle, or a folder: rosbag2, .mcap, .db3, .bag, stream, CSV or data set.",
        ),
    ],
    out: Annotated[
        Path,
        Option(
            "-o",
            "--out",
            help="Folder for report, settings, runs and figures; several recordings: one subfolder for each.",
        ),
    ],
    config_file: ConfigFile = None,
    track_map: TrackMap = None,
    pit_map: PitMap = None,
    settings: Settings = None,
    jobs: Jobs = None,
    dask: Dask = None,
    overwrite: Overwrite = False,
) -> None:
    """Read a recording, replay three estimators, compare, report.

    No configuration is needed. Assumptions are printed with their reasons, and written
    to settings.yaml. Change this file and run the command again. The settings hold for
    other recordings of the vehicle.

    Of several recordings, or a folder, each is studied with the same settings, and a
    table shows the worst recordings first. Finished recordings are kept.
    """
    read = partial(read_config, settings=settings, track_map=track_map, pit_map=pit_map)
    config = read(config_file)
    several = recordings_by_name(recordings, config.input)
    if len(several) > 1:
        from fgtrack.cli.recording_folders import Folder

        every = Folder(several, out, jobs, dask, overwrite)
        config_file = every.config_file(config_file)
        config = read(config_file)
        config = every.confirmed(config, config_file is not None)
        every.run(config, ESTIMATORS, study_job, {"kind": "study"}, "report.html")
        return
    [recording] = several.values()
    result = _studied(recording, out, config, config_file, overwrite)
    for line in dict.fromkeys(
        str(item) for run in result.runs for item in diagnostics(run)
    ):
        warn(line)
    show_study(result, recording)


def _studied(
    recording: Path,
    out: Path,
    config: Config,
    config_file: str | None,
    overwrite: bool,
) -> Study:
    for path in outputs(out):
        check_no_overlap(path, [recording, config_file])
    with progress("study") as tell:
        return studied(recording, out, config, overwrite=overwrite, on_step=tell)


def show_study(found: Study, recording: Path) -> None:
    """Print a study; raises `DataError` if the recording breaks off, has an open question, or no used detection."""
    for assumption in found.assumptions:
        say(assumption)
    say("")
    sentences(found.summary)
    show(replace(found.tables, verdict=()), None)
    say("")
    again = shlex.join(
        ["fgtrack", "study", str(recording), "-c", str(found.settings), "-o", "OTHER"]
    )
    say(f"settings: {found.settings}; change the file and run `{again}`")
    say(f"report: {found.report}, open the file in a browser")
    if (problem := _problem(found, recording)) is not None:
        raise DataError(problem)


def _problem(found: Study, recording: Path) -> str | None:
    """Return the reason for the exit code 1, or None."""
    if found.broken is not None:
        problem = with_origin(found.broken, str(recording))
        return f"{problem}; the messages before are used"
    run = found.runs[0]
    loop = repeated(run)
    reason = received_nothing(run)
    if reason is not None and found.problem is not None:
        reason = found.problem  # the sensors are left out
    reason = reason or unused(run)
    if reason is None and loop is not None:
        reason = loop.text
    reason = reason or found.problem
    return None if reason is None else f"{recording}: {reason}"


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
            messages = simulated(scenario, np.random.default_rng(seed))
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
