"""`fgtrack study`: from a recording to a page in one command."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from fgtrack.calibration.study import Study, outputs
from fgtrack.calibration.study import study as studied
from fgtrack.cli.arguments import ConfigFile, Input, Overwrite, PitMap, Settings, TrackMap
from fgtrack.cli.show import command_line, progress, say, sentences, show, warn
from fgtrack.core.errors import DataError
from fgtrack.evaluation.diagnostics import diagnostics
from fgtrack.io.output import check_apart
from fgtrack.pipeline.replay import located
from fgtrack.pipeline.shipped import read_config


def study(
    recording: Input,
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for report, settings, runs and figures.")],
    config_file: ConfigFile = None,
    track_map: TrackMap = None,
    pit_map: PitMap = None,
    settings: Settings = None,
    overwrite: Overwrite = False,
) -> None:
    """Advise, replay with three estimators, compare, report.

    No configuration is needed: what is assumed is printed with its reason, and written to settings.yaml, to be changed
    and run again.
    """
    config = read_config(config_file, settings or [], track_map=track_map, pit_map=pit_map)
    for path in outputs(out):
        check_apart(path, [recording, config_file])
    with progress("study") as tell:
        found = studied(recording, out, config, overwrite=overwrite, on_step=tell)
    for line in dict.fromkeys(str(one) for run in found.runs for one in diagnostics(run)):
        warn(line)
    show_study(found, recording)


def show_study(found: Study, recording: Path) -> None:
    """Print a study. Raises `DataError` where the recording breaks off."""
    sentences(found.summary)
    show(replace(found.tables, verdict=()), None)
    say("")
    for assumption in found.assumptions:
        say(assumption)
    again = command_line("fgtrack", "study", recording, "-c", found.settings, "-o", "OTHER")
    say(f"settings: {found.settings}; change them and run again by `{again}`")
    say(f"every table and column: {command_line('fgtrack', 'compare', found.path / 'runs', '--all')}")
    say(f"report: {found.report}, open it in a browser")
    if found.broken is not None:
        raise DataError(f"{located(found.broken, str(recording))}; used up to there")
