"""`fgtrack advise`: what is wrong with a recording and its configuration, and the settings that mend it."""

from pathlib import Path
from typing import Annotated

import typer

from fgtrack.calibration.advise import advise as advised
from fgtrack.cli.arguments import ConfigFile, FormOption, Input, Json, Overwrite, PitMap, Reference, Settings, TrackMap
from fgtrack.cli.show import chosen_form, command_line, progress, say, show
from fgtrack.core.errors import DataError
from fgtrack.io.output import check_apart, check_output, new_file
from fgtrack.pipeline.assumptions.assumed import Assumed
from fgtrack.pipeline.replay import located
from fgtrack.pipeline.shipped import read_config


def advise(
    recording: Input,
    config_file: ConfigFile = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Configuration to write that follows the advice (YAML).")
    ] = None,
    tune: Annotated[bool, typer.Option("--tune", help="Fit noise that does not fit, too.")] = False,
    reference: Reference = None,
    track_map: TrackMap = None,
    pit_map: PitMap = None,
    settings: Settings = None,
    overwrite: Overwrite = False,
    as_json: Json = False,
    form: FormOption = None,
) -> None:
    """Say what is late or wrong, and which settings mend it.

    Sentences in order of importance, and what windows of several lengths would lose.
    """
    form = chosen_form(as_json, form)
    if out is not None:
        check_output(out, overwrite)
    config = read_config(config_file, settings or [], track_map=track_map, pit_map=pit_map)
    if out is not None:
        check_apart(out, [recording, config_file])
    with progress("advise") as tell:
        advice = advised(recording, config, reference=reference, tune=tune, on_step=tell)
    if out is not None:
        head = [f"Settings for {recording} (fgtrack advise).", "", *advice.comments(), ""]
        with new_file(out, overwrite) as file:
            file.write(Assumed(advice.config, ()).to_yaml(head).encode())
    show(advice.tables, form, advice.as_dict())
    if out is not None and form is None:
        say(f"{out}: written; follow it by `{command_line('fgtrack', 'replay', recording, '-c', out, '-o', 'RUN')}`")
    if advice.broken is not None:
        raise DataError(f"{located(advice.broken, str(recording))}; used up to there")
