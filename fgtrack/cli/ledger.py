"""`fgtrack ledger`: causes of the error of the present estimate."""

from pathlib import Path
from typing import Annotated

from typer import Option

from fgtrack.advice.ledger import ledger as explained
from fgtrack.cli.arguments import (
    ConfigFile,
    Input,
    Json,
    Overwrite,
    PitMap,
    Settings,
    TrackMap,
)
from fgtrack.cli.show import progress, say, show
from fgtrack.core.errors import DataError
from fgtrack.core.output import check_output, new_file
from fgtrack.show.figures.ledger import waterfall
from fgtrack.show.figures.style import png


def ledger(
    recording: Input,
    config_file: ConfigFile = None,
    tuned: Annotated[
        str | None,
        Option(
            metavar="TUNED.yaml",
            help="Fitted noise and clocks from `fgtrack tune` or `advise --tune`.",
        ),
    ] = None,
    track_map: TrackMap = None,
    pit_map: PitMap = None,
    settings: Settings = None,
    figure: Annotated[
        Path | None, Option(metavar="FILE.png", help="Draw the shares as a waterfall.")
    ] = None,
    overwrite: Overwrite = False,
    as_json: Json = False,
) -> None:
    """Split the error of the present into lateness, policy, noise.

    Replays the associated measurements with every policy for late lists, once as
    received and once without delays. Without truth, predicted variances replace errors.
    INPUT may be a run folder.
    """
    if figure is not None:
        check_output(figure, overwrite)
    with progress("ledger"):
        result = explained(
            recording, config_file, tuned, map=track_map, pit_map=pit_map, set=settings
        )
    if figure is not None:
        with new_file(figure, overwrite) as file:
            parts = [(item.cause, item.mean_square_m2) for item in result.waterfall]
            predicted = "" if result.with_truth else ", predicted (no truth)"
            title = (
                f"Where the position error of {result.estimator} comes from{predicted}"
            )
            file.write(png(waterfall(parts, title)))
    show(result.tables, "json" if as_json else None)
    if not as_json:
        say("")
        say(result.sentence)
    if result.problem is not None:
        raise DataError(f"{recording}: {result.problem}")
