"""Figures of runs: map, residuals, delays, errors, lags, time per tick. Drawn without pyplot: nothing is global."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from fgtrack.core.errors import CallError
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.evaluation.figure_style import (
    broken_line,
    colour,
    legend_above,
    line_style,
    log_axis,
    save,
    styled,
    usual_step_ns,
)
from fgtrack.evaluation.innovations import ANGULAR, RESIDUAL_NAMES, message_delays, residuals
from fgtrack.evaluation.lag_figure import figure_lag
from fgtrack.evaluation.lagged import lag_metrics
from fgtrack.evaluation.map_figure import figure_map
from fgtrack.evaluation.matching import Matching, match, track_errors
from fgtrack.evaluation.runs import labelled
from fgtrack.evaluation.statistics import Distribution, Moments
from fgtrack.io.run import EvaluationConfig, Run

_QUANTITIES = {
    "position_m": "position error [m]",
    "speed_mps": "speed error [m/s]",
    "yaw_rad": "yaw error [rad]",
}
_RESIDUALS = {
    "along_m": "along track [m]",
    "across_m": "across track [m]",
    "x_m": "x [m]",
    "y_m": "y [m]",
    "yaw_rad": "yaw [rad]",
    "speed_mps": "speed [m/s]",
    "range_m": "range [m]",
    "bearing_rad": "bearing [rad]",
    "range_rate_mps": "range rate [m/s]",
}
_MS = 1e3


def save_figures(runs: Sequence[Run], out_dir: Path, options: EvaluationConfig | None = None) -> list[Path]:
    """Write every figure that `runs` have data for as PNG into `out_dir`; gives the files.

    A figure that would show the same for several runs (delays of one input) is written once.

    Raises
    ------
    CallError
        The folder cannot be made or written to.
    DataError
        The map that a run names is no map.
    """
    out_dir = Path(out_dir)
    try:
        out_dir.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CallError(f"{out_dir}: cannot be made ({error.strerror}), choose another folder") from error
    named = labelled(runs)
    matchings = {label: match(run, options) for label, run in named.items()}
    files = []
    same_delays: dict[bytes, list[str]] = {}
    for label, run in named.items():
        if len(run.tracks):
            figure = figure_map(run, matchings[label], title=label)
            files.append(save(figure, out_dir / f"map_{_slug(label)}.png"))
        if any(np.isfinite(values).any() for values in residuals(run).values()):
            figure = figure_residuals(run, title=label)
            files.append(save(figure, out_dir / f"residuals_{_slug(label)}.png"))
        if len(run.updates):
            content = b"".join(part.tobytes() for by in _delays(run).values() for part in by)
            same_delays.setdefault(content, []).append(label)
    for labels in same_delays.values():
        every = len(same_delays) == 1
        figure = figure_delays(named[labels[0]], title="" if every else ", ".join(labels))
        files.append(save(figure, out_dir / ("delays.png" if every else f"delays_{_slug(labels[0])}.png")))
    judged = {label: matching for label, matching in matchings.items() if matching is not None}
    for object_id in sorted({k for one in judged.values() for k in one.object_ids}):
        files.append(save(figure_errors(judged, object_id), out_dir / f"errors_object_{object_id}.png"))
    lagged = {label: lag_metrics(named[label], matching) for label, matching in matchings.items()}
    if any(entry.is_lagged for one in lagged.values() for entry in one):
        files.append(save(figure_lag(lagged), out_dir / "error_against_lag.png"))
    if any((run.timing["num_detections"] > 0).any() for run in runs):
        files.append(save(figure_timing(named), out_dir / "timing.png"))
    return files


@styled
def figure_residuals(run: Run, title: str = "") -> Figure:
    """Residuals (innovations) per sensor, a row per component: over time, and how they are distributed.

    Bins and axes cover the bulk of every sensor's residuals; the legend says how many lie outside.
    """
    values = residuals(run)
    updates = run.updates
    time_s = (updates["stamp_ns"] - _start_ns([run])) / NS_PER_S
    sensors = np.unique(updates["sensor"]).tolist()
    names = [name for name in RESIDUAL_NAMES if np.isfinite(values[name]).any()]
    if "along_m" in names:
        names = [name for name in names if name not in ("x_m", "y_m")]
    figure = Figure(figsize=(10.0, 0.8 + 2.4 * len(names)))
    rows = figure.subplots(len(names), 2, squeeze=False, sharey="row", width_ratios=(2, 1))
    for (over_time, histogram), name in zip(rows, names, strict=True):
        known = {sensor: np.isfinite(values[name]) & (updates["sensor"] == sensor) for sensor in sensors}
        low, high = _core([values[name][mine] for mine in known.values() if mine.any()])
        bins = np.linspace(low, high, 41)
        for k, (sensor, mine) in enumerate(known.items()):
            sample = values[name][mine]
            if not len(sample):
                continue
            moments = (Moments.of_angles if name in ANGULAR else Moments.of)(sample)
            outside = int(((sample < low) | (sample > high)).sum())
            mean = round(moments.mean, 3) + 0.0  # no negative zero
            label = f"{sensor}: mean {mean:.3f}, std {moments.std:.3f}, n {moments.count}"
            label += f" ({outside} outside)" if outside else ""
            over_time.plot(time_s[mine], sample, ".", ms=3.0, alpha=0.6, mew=0, color=colour(k), label=label)
            density = np.histogram(sample, bins)[0] / (len(sample) * np.diff(bins))
            histogram.stairs(density, bins, orientation="horizontal", color=colour(k), lw=1.4)
        over_time.set_ylim(low, high)
        over_time.set_ylabel(_RESIDUALS[name])
        histogram.set_xlabel(f"density, in 1 / {_RESIDUALS[name].rpartition(' ')[2]}")
        over_time.set_xlabel("time [s]")
        over_time.sharex(rows[0][0])
        legend_above(over_time, width=80)
    figure.suptitle(_title(title, "residuals (measured minus predicted)"))
    return figure


@styled
def figure_delays(run: Run, title: str = "") -> Figure:
    """Delay of the messages from stamp to receipt, per sensor: histogram and share that has arrived."""
    figure = Figure(figsize=(10.0, 4.0))
    histogram, arrived = figure.subplots(1, 2)
    delays = {sensor: delay_s * _MS for sensor, (_, delay_s) in _delays(run).items()}
    everything = np.concatenate(list(delays.values()))
    low, high = min(0.0, float(everything.min())), max(float(everything.max()), 1.0)
    bins = np.linspace(low, high, 61)
    for k, (sensor, delay_ms) in enumerate(delays.items()):
        spread = Distribution.of(delay_ms)
        share = np.histogram(delay_ms, bins)[0] / len(delay_ms)
        label = f"{sensor}: mean {spread.mean:.0f} ms, q90 {spread.p90:.0f} ms, max {spread.max:.0f} ms"
        histogram.stairs(share, bins, color=colour(k), lw=1.4, label=label)
        arrived.ecdf(delay_ms, color=colour(k), lw=1.4)
        for axes in (histogram, arrived):
            axes.axvline(spread.mean, color=colour(k), lw=1.0, ls="-", alpha=0.5)
            axes.axvline(spread.p90, color=colour(k), lw=1.0, ls="--", alpha=0.5)
    histogram.set_ylabel("share of the messages per bin")
    arrived.set_ylabel("share of the messages received")
    for axes in (histogram, arrived):
        axes.set_xlabel("delay [ms] (lines: mean; dashed: 90 % quantile)")
        axes.set_xlim(low, high)
    legend_above(histogram, width=60)
    figure.suptitle(_title(title, "delay of the messages with detections"))
    return figure


@styled
def figure_errors(matchings: Mapping[str, Matching], object_id: int) -> Figure:
    """Error in position, speed and yaw of one true object over time, a line per run.

    Lines are broken where the object was not tracked; quantities that the truth does not hold are left out.
    """
    errors = {}
    for label, matching in matchings.items():
        if object_id in matching.object_ids:
            every = track_errors(matching)
            mine = every.object_index == matching.object_ids.index(object_id)
            values = {k: v[mine] for k, v in every.values.items()}
            errors[label] = every.stamps_ns[mine], values, usual_step_ns(matching.tracks["now_ns"])
    start_ns = min((int(stamps.min()) for stamps, _, _ in errors.values() if len(stamps)), default=0)
    names = [k for k in _QUANTITIES if any(np.isfinite(v[k]).any() for _, v, _ in errors.values())]
    names = names or ["position_m"]
    figure = Figure(figsize=(10.0, 1.4 + 2.0 * len(names)))
    rows = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    for axes, name in zip(rows, names, strict=True):
        for k, (label, (stamps_ns, values, step_ns)) in enumerate(errors.items()):
            moments = Moments.of(values[name])
            unit = _QUANTITIES[name].rpartition("[")[2][:-1]
            rmse = f"RMSE {moments.rmse:.3g} {unit}" if moments.count else "never tracked"
            line = broken_line(stamps_ns, (stamps_ns - start_ns) / NS_PER_S, values[name], step_ns)
            axes.plot(*line, color=colour(k), ls=line_style(k), lw=0.9, alpha=0.85, label=f"{label}: {rmse}")
        axes.set_ylabel(_QUANTITIES[name])
        legend_above(axes, width=140)
    rows[-1].set_xlabel("time [s]")
    figure.suptitle(f"Errors of the tracks of object {object_id}")
    return figure


@styled
def figure_timing(runs: Mapping[str, Run]) -> Figure:
    """Wall time of the ticks with detections: over the run, and the share of ticks done by then."""
    figure = Figure(figsize=(10.0, 4.0))
    over_time, done = figure.subplots(1, 2)
    start_ns = _start_ns(list(runs.values()))
    for k, (label, run) in enumerate(runs.items()):
        timing = run.timing.where(run.timing["num_detections"] > 0)
        if not len(timing):
            continue
        time_ms = timing["process_ns"] / NS_PER_S * _MS
        spread = Distribution.of(time_ms)
        text = f"{label}: median {spread.p50:.3g} ms, p99 {spread.p99:.3g} ms"
        time_s = (timing["now_ns"] - start_ns) / NS_PER_S
        over_time.plot(time_s, time_ms, ".", ms=2.0, alpha=0.5, mew=0, color=colour(k), label=text)
        done.ecdf(time_ms, color=colour(k), ls=line_style(k), lw=1.4)
    over_time.set_yscale("log")
    over_time.set_xlabel("time [s]")
    over_time.set_ylabel("time per tick with detections [ms]")
    done.set_xscale("log")
    done.set_xlabel("time per tick with detections [ms]")
    done.set_ylabel("share of the ticks")
    for axis in (over_time.yaxis, done.xaxis):
        log_axis(axis)
    legend_above(over_time, width=60)
    figure.suptitle("Processing time")
    return figure


def _slug(label: str) -> str:
    """`label` as part of a file name."""
    return re.sub(r"[^A-Za-z0-9.-]+", "_", label).strip("_")


def _title(run: str, what: str) -> str:
    return f"{run}: {what}" if run else what[0].upper() + what[1:]


def _core(samples: Sequence[FloatArray]) -> tuple[float, float]:
    """Range that holds the bulk of every one of `samples`: three interquartile ranges beyond the quartiles."""
    lows, highs = [], []
    for sample in samples:
        first, third = np.quantile(sample, (0.25, 0.75)).tolist()
        lows.append(max(float(sample.min()), first - 3.0 * (third - first)))
        highs.append(min(float(sample.max()), third + 3.0 * (third - first)))
    margin = max(0.05 * (max(highs) - min(lows)), 1e-6)
    return min(lows) - margin, max(highs) + margin


def _delays(run: Run) -> dict[str, tuple[IntArray, FloatArray]]:
    sensors = run.updates["sensor"]
    return {name: message_delays(run.updates.where(sensors == name)) for name in np.unique(sensors).tolist()}


def _start_ns(runs: Sequence[Run]) -> int:
    return min((int(run.timing["now_ns"][0]) for run in runs if len(run.timing)), default=0)
