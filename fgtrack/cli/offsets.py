"""`fgtrack offsets`: how wrong the clocks of a recording are."""

import json
import sys
from typing import Annotated

import typer
from rich import box
from rich.table import Table

from fgtrack.cli.arguments import ConfigFile, Input, Json, Settings
from fgtrack.cli.show import console, progress
from fgtrack.io.source import open_input
from fgtrack.pipeline.clock_offsets import OffsetReport, SensorOffset, estimate_offsets
from fgtrack.pipeline.replay import located
from fgtrack.pipeline.shipped import read_config


def offsets(
    recording: Input,
    config_file: ConfigFile = None,
    reference: Annotated[
        str | None, typer.Option("--reference", help="Sensor whose clock is right; else the one with most detections.")
    ] = None,
    track_map: Annotated[
        str | None, typer.Option("--map", help="Map of the track (CSV), or `oval` for the built-in one.")
    ] = None,
    pit_map: Annotated[str | None, typer.Option("--pit-map", help="Map of the pit lane (CSV), or `oval`.")] = None,
    settings: Settings = None,
    as_json: Json = False,
) -> int:
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
        console().print(_heading(report), highlight=False, soft_wrap=True)
        console().print(_table(report))
    if report.broken is None:
        return 0
    print(f"fgtrack: error: {located(report.broken, str(recording))}; used up to there", file=sys.stderr)
    return 1


def _heading(report: OffsetReport) -> str:
    return f"{report.num_detections} detections of {report.num_tracks} tracks; offset = reported stamp - true time"


def _table(report: OffsetReport) -> Table:
    table = Table(box=box.SIMPLE_HEAD, show_edge=False)
    table.add_column("sensor", overflow="fold")
    for heading in (r"offset \[ms]", r"std \[ms]", "detections", r"residual \[sigma]"):
        table.add_column(heading, justify="right")
    table.add_column("known")
    table.add_column("why", overflow="fold")
    for item in report.sensors:
        numbers = (_ms(item.offset_s), _ms(item.std_s), str(item.num_detections), _plain(item.residual))
        table.add_row(item.sensor, *numbers, _known(item, report.reference), item.why)
    return table


def _known(item: SensorOffset, reference: str) -> str:
    if item.sensor == reference:
        return "reference"
    return "yes" if item.identifiable else "no"


def _ms(value_s: float | None) -> str:
    return "–" if value_s is None else f"{1e3 * value_s:.1f}"


def _plain(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"
