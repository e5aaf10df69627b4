"""`fgtrack tune`: process and measurement noise from recordings."""

import json
from collections.abc import Sequence
from io import StringIO
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from fgtrack.cli.arguments import ConfigFile, Json, Overwrite, PitMap, Settings, TrackMap
from fgtrack.cli.show import console, progress, say, table
from fgtrack.core.errors import DataError
from fgtrack.core.types import FloatArray
from fgtrack.evaluation.consistency import position_nees
from fgtrack.evaluation.matching import match
from fgtrack.io.output import check_output
from fgtrack.io.run import Run
from fgtrack.io.source import open_input
from fgtrack.pipeline.shipped import read_config
from fgtrack.pipeline.tune import tuned
from fgtrack.pipeline.tune_file import TUNED, write_tuned
from fgtrack.pipeline.tune_report import HeldOut, TunedParameter, TuneReport
from fgtrack.pipeline.tune_rules import TuneRules

_KNOWN = {"yes": "yes", "roughly": "roughly", "limit": "a limit", "no": "not identifiable"}
_WIDTH = 78


def tune(
    recordings: Annotated[list[Path], typer.Argument(help="Recordings, as for replay; their noise is the same.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Tuned configuration to write (YAML).")],
    config_file: ConfigFile = None,
    track_map: TrackMap = None,
    pit_map: PitMap = None,
    settings: Settings = None,
    keep: Annotated[
        list[str] | None, typer.Option("--keep", metavar="KEY", help="Leave this key as configured; may be repeated.")
    ] = None,
    overwrite: Overwrite = False,
    as_json: Json = False,
) -> None:
    """Fit process and measurement noise to recordings.

    Maximum likelihood of the innovations; truth is not needed. Says which parameters are not identifiable.
    """
    check_output(out, TUNED, overwrite)
    config = read_config(config_file, settings or [], track_map=track_map, pit_map=pit_map)
    sources = {str(path): open_input(path, config.input).messages for path in recordings}
    with progress("tune") as show:
        report = tuned(sources, config, TuneRules(keep=tuple(keep or ())), show)
    tables = _tables(report)
    options = [*(f"--set '{setting}'" for setting in settings or []), *(f"--keep {key}" for key in keep or [])]
    lines = [_command(recordings, out, config_file, track_map, pit_map, options), ""]
    lines += _text(tables)
    write_tuned(out, config_file, report.config, lines, overwrite)
    if as_json:
        print(json.dumps(report.as_dict() | {"nees": _nees_values(report.held_out)}, indent=2, allow_nan=False))
    else:
        for one in tables:
            if isinstance(one, str):
                say(one)
            else:
                console().print(one)
        say(f"{out}: written")
    if report.broken:
        raise DataError(f"{next(iter(report.broken.values()))}; used up to there")


def _command(
    recordings: Sequence[Path],
    out: Path,
    config_file: str | None,
    track_map: str | None,
    pit_map: str | None,
    options: Sequence[str],
) -> str:
    words = ["  fgtrack tune", *map(str, recordings)]
    for flag, value in (("-c", config_file), ("-o", out), ("--map", track_map), ("--pit-map", pit_map)):
        words += [] if value is None else [flag, str(value)]
    return " ".join([*words, *options])


def _tables(report: TuneReport) -> list[Table | str]:
    shown: list[Table | str] = [_parameters(report.parameters)]
    shown += [f"{_short(one.key)}: {one.why}" for one in report.parameters if one.why]
    shown.append("")
    shown += _sensors(report)
    if report.held_out is not None:
        held_out = report.held_out
        shown += [
            "",
            f"Held out: the last {100.0 * held_out.share:.0f} % of the time, {held_out.count} innovations, "
            "by the noise fitted to the rest.",
            _judged(held_out),
        ]
    return shown


def _parameters(parameters: Sequence[TunedParameter]) -> Table:
    rows = table("parameter", ">configured", ">tuned", ">error", "known")
    for one in parameters:
        error = "–" if one.std_error is None or one.known in ("no", "limit") else f"{100.0 * one.std_error:.1f} %"
        rows.add_row(_short(one.key), f"{one.configured:.4g}", f"{one.tuned:.4g}", error, _KNOWN[one.known])
    return rows


def _short(key: str) -> str:
    """A key of the configuration without what all have in common."""
    return key.removeprefix("sensors.").replace(".std.", " ").replace("std_per_s.", "").replace("parameters.", "")


def _sensors(report: TuneReport) -> list[str]:
    lines = []
    for one in report.sensors:
        if one.outlier_share is not None:
            lines.append(f"{one.sensor}: {one.count} measurements, {100.0 * one.outlier_share:.1f} % outliers")
        if one.own_covariance:
            lines.append(f"{one.sensor}: {one.own_covariance} measurements have a covariance of their own; it stays")
    settled = "" if report.settled else ", not settled"
    lines.append(f"{report.num_tracks} tracks, {report.rounds} associations{settled}")
    if report.num_mixed:
        lines.append(f"{report.num_mixed} measurements left out: most around them are outliers (an exchanged object?)")
    if report.optima > 1:
        lines.append(f"{report.optima} maxima of the likelihood from several starts: this is the highest one")
    return lines


def _judged(held_out: HeldOut) -> Table:
    rows = table("", ">count", ">before", ">after", ">expected", ">95 %")
    for one in held_out.innovations:
        numbers = (str(one.count), f"{one.before:.2f}", f"{one.after:.2f}", "1", f"± {one.band:.2f}")
        rows.add_row(f"NIS {one.sensor} {one.component}", *numbers)
    found = _nees_values(held_out)
    if found is not None:
        rows.add_row("NEES of the position", "", f"{found['before']:.2f}", f"{found['after']:.2f}", "2", "")
    numbers = (str(held_out.count), f"{held_out.before:.3f}", f"{held_out.after:.3f}", "", "")
    rows.add_row("log-likelihood per innovation", *numbers)
    return rows


def _nees_values(held_out: HeldOut | None) -> dict[str, float] | None:
    """Mean NEES of the position on the time held out, before and after; None without truth there."""
    if held_out is None:
        return None
    found = {"before": held_out.runs_before, "after": held_out.runs_after}
    values = {
        name: np.concatenate([_nees(*one) for one in zip(runs, held_out.from_ns, strict=True)])
        for name, runs in found.items()
    }
    if not all(len(part) for part in values.values()):
        return None
    return {name: float(part.mean()) for name, part in values.items()}


def _nees(run: Run, from_ns: int) -> FloatArray:
    matching = match(run)
    if matching is None:
        return np.empty(0)
    nees = position_nees(matching)
    return nees.values[(nees.stamps_ns >= from_ns) & np.isfinite(nees.values)]


def _text(tables: Sequence[Table | str]) -> list[str]:
    """The tables as lines of text."""
    file = StringIO()
    plain = Console(file=file, width=_WIDTH, color_system=None)
    for one in tables:
        plain.print(one, highlight=False, soft_wrap=isinstance(one, str), markup=False)
    return [line.rstrip() for line in file.getvalue().splitlines()]
