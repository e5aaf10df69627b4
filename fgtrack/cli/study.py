"""`fgtrack study` and `demo`: from a recording, or a simulated race, to a report in one command."""

import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
from typer import Argument, Option

from fgtrack.cli.arguments import (
    ConfigFile,
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
from fgtrack.core.errors import CallError, DataError, FgtrackError
from fgtrack.core.output import check_no_overlap, locked_folder
from fgtrack.evaluation.diagnostics import (
    diagnostics,
    received_nothing,
    repeated,
    unused,
)
from fgtrack.inputs.recording import check_recording, write_recording
from fgtrack.models.oval import OVAL
from fgtrack.pipeline.replay import with_origin
from fgtrack.pipeline.simulation import simulated
from fgtrack.recording_study import Study, outputs
from fgtrack.recording_study import study as studied
from fgtrack.show.figures.plot import error_against_delay


def study(
    recordings: Annotated[
        list[Path],
        Argument(
            metavar="INPUT...",
            help="Recordings of one vehicle: rosbag2, .mcap, .db3, .bag, stream, CSV or data set.",
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
    overwrite: Overwrite = False,
) -> None:
    """Read a recording, replay three estimators, compare, report.

    No configuration is needed. Assumptions are printed with their reasons, and written
    to settings.yaml. Change this file and run the command again. The settings hold for
    other recordings of the vehicle.
    """
    config = read_config(config_file, settings, track_map=track_map, pit_map=pit_map)
    if len(recordings) > 1:
        _study_each(recordings, out, config, config_file, overwrite)
        return
    [recording] = recordings
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


def _study_each(
    recordings: Sequence[Path],
    out: Path,
    config: Config,
    config_file: str | None,
    overwrite: bool,
) -> None:
    """Study each recording in its own folder, and print a line for each.

    Raises `DataError` at the end if a recording has an error or an open question.
    """
    failed = 0
    for recording, folder in zip(recordings, _folders(recordings, out), strict=True):
        try:
            found = _studied(recording, folder, config, config_file, overwrite)
            problem = _problem(found, recording)
            line = f"{folder.name}: {found.report}; {found.summary[1]}"
        except FgtrackError as error:
            problem = str(error)
            line = f"{folder.name}: no study"
        failed += problem is not None
        say(f"{line}{'' if problem is None else f' error: {problem}'}")
    if failed:
        raise DataError(
            f"{failed} of {len(recordings)} recordings have an error or an open question"
        )


def _folders(recordings: Sequence[Path], out: Path) -> list[Path]:
    """Return a folder in `out` for each recording: its name, with the ending if names are equal otherwise.

    Raises `CallError` for equal names.
    """
    stems = [
        path.name if path.is_dir() else path.name.split(".")[0] for path in recordings
    ]
    names = [
        stem if stems.count(stem) == 1 else path.name
        for path, stem in zip(recordings, stems, strict=True)
    ]
    if len(set(names)) < len(names):
        raise CallError("two recordings have the same name: study them one by one")
    return [out / name for name in names]


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
