"""`fgtrack tune`: fits process and measurement noise to recordings."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from fgtrack.advice.run_quality import noise_fits
from fgtrack.cli.arguments import (
    ConfigFile,
    Json,
    Overwrite,
    PitMap,
    Settings,
    TrackMap,
)
from fgtrack.cli.show import progress, say, show
from fgtrack.config.reading import read_config
from fgtrack.core.errors import DataError
from fgtrack.core.output import check_no_overlap, check_output, write_file
from fgtrack.evaluation.tables import NO_VALUE, Column, Table, Tables, Value
from fgtrack.meaning.assumption import Assumed
from fgtrack.meaning.draft import opened_together
from fgtrack.noise.parameters import HeldOut, TunedParameter, TuneReport, TuneRules
from fgtrack.noise.tune import tune_sources

#: Words for `TunedParameter.known`.
_KNOWN = {
    "yes": "yes",
    "roughly": "roughly",
    "limit": "a limit",
    "no": "not identifiable",
}


def tune(
    recordings: Annotated[
        list[Path], Argument(metavar="INPUT...", help="Recordings with the same noise.")
    ],
    out: Annotated[
        Path, Option("-o", "--out", help="Tuned configuration to write (YAML).")
    ],
    config_file: ConfigFile = None,
    track_map: TrackMap = None,
    pit_map: PitMap = None,
    settings: Settings = None,
    keep: Annotated[
        list[str] | None,
        Option(metavar="KEY", help="Do not fit this configuration key; repeatable."),
    ] = None,
    overwrite: Overwrite = False,
    as_json: Json = False,
) -> None:
    """Fit process and measurement noise to recordings.

    Maximises the likelihood of the innovations; truth is not needed. Reports parameters
    that are not identifiable.
    """
    check_output(out, overwrite)
    config = read_config(config_file, settings, track_map=track_map, pit_map=pit_map)
    check_no_overlap(out, [*recordings, config_file])
    sources, config, problems = opened_together(recordings, config)
    with progress("tune") as tell:
        report = tune_sources(sources, config, TuneRules(keep=tuple(keep or ())), tell)
    shown = {"parameters": _parameters(report.parameters)}
    if report.held_out is not None:
        shown["held_out"] = _validation(report.held_out)
    tables = Tables(shown)
    result = _sensors(report)
    # Maps from the command line belong to these recordings, so the output does not contain them.
    tuned_config = replace(report.config, map=read_config(config_file).map)
    title = f"Noise of {config_file or 'the defaults'}, fitted to {', '.join(sources)} (fgtrack tune)."
    head = [title, "", *str(tables).splitlines(), "", *result, ""]
    write_file(out, Assumed(tuned_config, ()).to_yaml(head), overwrite)
    show(tables, "json" if as_json else None, report.as_dict())
    if not as_json:
        say("\n".join(["", *result, f"{out}: written"]))
    if report.broken:
        problem = next(iter(report.broken.values()))
        raise DataError(f"{problem}; the messages before are used")
    if problems:
        raise DataError("; ".join(problems))


def _parameters(parameters: Sequence[TunedParameter]) -> Table:
    records = [
        {
            "key": one.key,
            "configured": one.configured,
            "tuned": one.tuned,
            "known": _KNOWN[one.known],
        }
        | {"std_error": None if one.known in ("no", "limit") else one.std_error}
        for one in parameters
    ]
    columns = [
        Column("parameter", "key", text=_short, left=True),
        Column("configured", text=_four_digits),
        Column("tuned", text=_four_digits),
        Column("error", "std_error", "{} %", 100.0, text=lambda value: f"{value:.1f}"),
        Column("known", left=True),
    ]
    notes = [f"{_short(one.key)}: {one.why}" for one in parameters if one.why]
    return Table("Noise, as standard deviations", records, columns, ("key",), notes)


def _four_digits(value: Value) -> str:
    return f"{value:.4g}" if math.isfinite(float(value)) else NO_VALUE


def _short(key: Value) -> str:
    """Short form of a configuration key: `radar x_m` for `sensors.radar.std.x_m`."""
    return (
        str(key)
        .removeprefix("sensors.")
        .replace(".std.", " ")
        .replace("std_per_s.", "")
        .replace("parameters.", "")
    )


def _sensors(report: TuneReport) -> list[str]:
    lines = []
    for one in report.sensors:
        if one.outlier_share is not None:
            lines.append(
                f"{one.sensor}: {one.count} measurements, {100.0 * one.outlier_share:.1f} % outliers"
            )
        if one.own_covariance:
            lines.append(
                f"{one.sensor}: {one.own_covariance} measurements report their covariance, which is not fitted"
            )
    lines += [
        f"{one.sensor}: innovations remain correlated in time (autocorrelation {one.lag1:.2f}), so white noise is too "
        "small: model time-correlated errors of this sensor, or of the most accurate sensor"
        for run in report.runs
        for one in noise_fits(run)
        if one.is_correlated
    ]
    settled = "" if report.settled else ", not converged"
    lines.append(f"{report.num_tracks} tracks, {report.rounds} associations{settled}")
    if report.num_mixed:
        lines.append(
            f"{report.num_mixed} measurements are left out: most measurements around them are outliers "
            "(is the track on another object?)"
        )
    return lines


def _validation(held_out: HeldOut) -> Table:
    records: list[dict[str, object]] = [
        {
            "of": f"{one.sensor} {one.component}",
            "count": one.count,
            "before": one.before,
            "after": one.after,
        }
        | {"expected": 1.0, "band": one.band}
        for one in held_out.innovations
    ]
    columns = [
        Column("NIS of", "of", left=True),
        Column("count"),
        Column("before"),
        Column("after"),
        Column("expected", text=_four_digits),
        Column("95 %", "band", "± {}"),
    ]
    share = f"the last {100.0 * held_out.share:.0f} % of the time"
    title = (
        f"Validation on {share}: {held_out.count} innovations, noise fitted to the rest"
    )
    notes = [
        f"log-likelihood per innovation: {held_out.before:.4g} before, {held_out.after:.4g} after"
    ]
    return Table(title, records, columns, ("of",), notes)
