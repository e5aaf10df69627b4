"""`fgtrack offsets`: how wrong the clocks of a recording are."""

import json
from typing import Annotated

import typer
from rich.table import Table

from fgtrack.cli.arguments import ConfigFile, Input, Json, PitMap, Settings, TrackMap
from fgtrack.cli.show import console, progress, say, table
from fgtrack.core.errors import DataError
from fgtrack.io.source import open_input
from fgtrack.pipeline.clock_offsets import OffsetReport, estimate_offsets
from fgtrack.pipeline.replay import located
from fgtrack.pipeline.shipped import read_config


def offsets(
    recording: Input,
    config_file: ConfigFile = None,
    reference: Annotated[
        str | None, typer.Option("--reference", help="Sensor whose clock is right; else the one with most detections.")
    ] = None,
    track_map: TrackMap = None,
    pit_map: PitMap = None,
    settings: Settings = None,
    as_json: Json = False,
) -> None:
    """Estimate constant clock offsets of sensors.

    Says which ones are not identifiable.
    """
    config = read_config(config_file, settings or [], track_map=track_map, pit_map=pit_map)
    source = open_input(recording, config.input)
    with progress("offsets"):
        report = estimate_offsets(source.messages(), config, reference)
    if as_json:
        print(json.dumps(report.as_dict(), indent=2, allow_nan=False))
    else:
        say(f"{report.num_detections} detections of {report.num_tracks} tracks; offset = reported stamp - true time")
        console().print(_table(report))
    if report.broken is not None:
        raise DataError(f"{located(report.broken, str(recording))}; used up to there")


def _table(report: OffsetReport) -> Table:
    rows = table("sensor", ">offset [ms]", ">std [ms]", ">detections", ">residual [sigma]", "known", "why")
    for item in report.sensors:
        numbers = (_ms(item.offset_s), _ms(item.std_s), str(item.num_detections), _plain(item.residual))
        known = "reference" if item.sensor == report.reference else "yes" if item.identifiable else "no"
        rows.add_row(item.sensor, *numbers, known, item.why)
    return rows


def _ms(value_s: float | None) -> str:
    return "–" if value_s is None else f"{1e3 * value_s:.1f}"


def _plain(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"
