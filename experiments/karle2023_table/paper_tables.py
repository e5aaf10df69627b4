"""The evaluation of Karle et al. 2023 as tables: residuals, precision, delays, computing time.

    python experiments/karle2023_table/paper_tables.py out/race

Prints what sections III-H and IV of the paper show of one drive, for every run given.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
import typer

from fgtrack import NS_PER_S, BoolArray, FloatArray, IntArray, Run, Tables
from fgtrack.evaluation import (
    LOCAL_NAMES,
    MS,
    RUN,
    Column,
    Columns,
    Distribution,
    EvaluatedRun,
    Moments,
    Table,
    ego_states,
    evaluated,
    local_innovations,
    message_delays,
    moments_of,
    named,
)

_HEADINGS = {
    "along_m": "along\n[m]",
    "across_m": "across\n[m]",
    "yaw_rad": "yaw\n[deg]",
    "speed_mps": "speed\n[m/s]",
}

#: Bounds between the groups, in the quantity's unit (the published evaluation's).
_OBSERVED_S = (1.0, 2.0, 3.0)
_SPEEDS_MPS = (40.0, 50.0)
_AHEAD_M = (0.0, 50.0)

_SPREADS = {
    "object_speed": ("mps", "speed\n[m/s]"),
    "relative_speed": ("mps", "relative\n[m/s]"),
    "distance": ("m", "distance\n[m]"),
    "ahead": ("m", "ahead\n[m]"),
}


@dataclass(frozen=True, eq=False)
class ResidualSamples:
    """Innovations of the tracks that were `confirmed`, n in all, by stamp.

    Attributes
    ----------
    sensors, track_ids
        Of each sample, shape (n,).
    values
        By name of `LOCAL_NAMES`, each of shape (n,); NaN where not measured.
    observed_s
        Time since the first detection of the track, shape (n,).
    object_speed_mps, relative_speed_mps
        Speed of the track, and the same less the ego's, shape (n,); NaN where the ego is not known.
    ahead_m, left_m, distance_m
        Position of the track relative to the ego, shape (n,); NaN where the ego is not known.
    """

    sensors: npt.NDArray[np.str_]
    track_ids: IntArray
    values: Mapping[str, FloatArray]
    observed_s: FloatArray
    object_speed_mps: FloatArray
    relative_speed_mps: FloatArray
    ahead_m: FloatArray
    left_m: FloatArray
    distance_m: FloatArray

    @classmethod
    def of(cls, run: Run) -> "ResidualSamples":
        """The samples of `run`. Raises `DataError` where the map that it names is not a map."""
        updates = run.tables["updates"]
        rows, values, states = local_innovations(run)
        order = np.argsort(updates["stamp_ns"][rows], kind="stable")
        rows, states = rows[order], states[order]
        track_ids, stamps_ns = updates["track_id"][rows], updates["stamp_ns"][rows]
        ego = ego_states(run.tables["ego"], stamps_ns)
        dx_m, dy_m = (states[:, :2] - ego[:, :2]).T
        c, s = np.cos(ego[:, 2]), np.sin(ego[:, 2])
        return cls(
            sensors=updates["sensor"][rows],
            track_ids=track_ids,
            values={name: column[order] for name, column in values.items()},
            observed_s=_observed_s(updates, track_ids, stamps_ns),
            object_speed_mps=states[:, 3],
            relative_speed_mps=states[:, 3] - ego[:, 3],
            ahead_m=c * dx_m + s * dy_m,
            left_m=c * dy_m - s * dx_m,
            distance_m=np.hypot(dx_m, dy_m),
        )

    def moments(self, chosen: BoolArray) -> dict[str, Moments]:
        """Mean and spread of every residual of the `chosen` samples, shape (n,)."""
        return {
            name: moments_of(name, values[chosen])
            for name, values in self.values.items()
        }


def main(
    runs: Annotated[
        list[Path], typer.Argument(help="Run folders, or folders of runs.")
    ],
) -> None:
    """Print the tables."""
    print(evaluation(evaluated(runs)))


def evaluation(runs: Sequence[EvaluatedRun]) -> Tables:
    """`residuals`, `residuals_by`, `sensors` and `latency` of `runs`.

    Raises `DataError` where the map that a run names is not a map.
    """
    makers = {
        "residuals": _residuals,
        "residuals_by": _residuals_by,
        "sensors": _sensors,
        "latency": _latency,
    }
    return Tables({name: make(runs) for name, make in makers.items()})


def _residuals(runs: Sequence[EvaluatedRun]) -> Table:
    """A row for each run: residuals of all sensors together, and the precision (table I)."""
    records = [
        {"run": one.label, **_moments(one.metrics.residuals)}
        | {
            "precision": one.metrics.precision,
            "num_confirmed": one.metrics.num_confirmed,
        }
        for one in runs
    ]
    columns = [
        RUN,
        *_residual_columns(),
        Column("preci-\nsion", "precision"),
        Column("con-\nfirmed", "num_confirmed"),
    ]
    notes = [
        "measured minus predicted, of confirmed tracks: mean ± standard deviation",
        "yaw: where no sensor measures it, against the heading of the map, as in the paper",
        "precision: visits of true objects that were tracked / confirmed tracks",
    ]
    title = "Residuals of all sensors, and precision (table I of Karle et al. 2023)"
    return Table(title, records, columns, notes=notes)


def _residuals_by(runs: Sequence[EvaluatedRun]) -> Table:
    """A row for each run, group of samples and sensor."""
    records = []
    for one in runs:
        samples = ResidualSamples.of(one.run)
        for group, inside in _groups(samples):
            for sensor in np.unique(samples.sensors).tolist():
                chosen = inside & (samples.sensors == sensor)
                if chosen.any():
                    moments = samples.moments(chosen)
                    record = {
                        "run": one.label,
                        "of": f"{group}, {sensor}",
                        "num_samples": moments["along_m"].count,
                    }
                    records.append(record | _moments(moments))
    columns = [
        RUN,
        Column("of", left=True),
        Column("samples", "num_samples"),
        *_residual_columns(),
    ]
    notes = [
        "observed: time since the first detection of the track (its transient)",
        "speed: of the track; ahead: of the ego",
    ]
    title = "Residuals by time, speed and position (mean ± standard deviation)"
    return Table(title, records, columns, ("run", "of"), notes)


def _groups(samples: ResidualSamples) -> Iterator[tuple[str, BoolArray]]:
    quantities: tuple[tuple[str, FloatArray, tuple[float, ...], str], ...] = (
        ("observed", samples.observed_s, _OBSERVED_S, "s"),
        ("speed", samples.object_speed_mps, _SPEEDS_MPS, "m/s"),
        ("ahead", samples.ahead_m, _AHEAD_M, "m"),
    )
    for name, values, bounds, unit in quantities:
        numbers = np.digitize(values, bounds)  # NaN comes last
        middle = (f"{low:g} to {high:g}" for low, high in pairwise(bounds))
        for k, text in enumerate(
            (f"below {bounds[0]:g}", *middle, f"{bounds[-1]:g} and more")
        ):
            yield f"{name} {text} {unit}", np.isfinite(values) & (numbers == k)


def _sensors(runs: Sequence[EvaluatedRun]) -> Table:
    """A row for each run and sensor: delays, way of the ego in them, and the detections that were fused."""
    records = [record for one in runs for record in _sensor_records(one)]
    columns = [
        RUN,
        Column("sensor", left=True),
        Column(
            "delay [ms]\nmean/p90/max",
            "delay_mean_s delay_p90_s delay_max_s",
            "{}/{}/{}",
            MS,
        ),
        Column("moved [m]\nmean/max", "moved_mean_m moved_max_m", "{}/{}"),
        Column("fused", "num_fused"),
        Column("ob-\njects", "num_objects"),
        *(
            Column(heading, " ".join(_ends(name, f"_{unit}")), "{}/{}/{}")
            for name, (unit, heading) in _SPREADS.items()
        ),
        Column("detections\nper object", " ".join(_ends("detections")), "{}/{}/{}"),
    ]
    notes = [
        "moved: way of the ego while a message was under way; fused: detections of confirmed tracks (objects)",
        "speed to detections: smallest/median/largest; relative: to the ego",
    ]
    title = "Detections by sensor (figures 5 and 6 of Karle et al. 2023)"
    return Table(title, records, columns, ("run", "sensor"), notes)


def _sensor_records(one: EvaluatedRun) -> Iterator[dict[str, Any]]:
    updates, samples = one.run.tables["updates"], ResidualSamples.of(one.run)
    for sensor in np.unique(updates["sensor"]).tolist():
        receipts_ns, delay_s = message_delays(
            updates.where(updates["sensor"] == sensor)
        )
        ego = ego_states(
            one.run.ego, receipts_ns - np.round(delay_s * NS_PER_S).astype(np.int64)
        )
        delay = Distribution.of(delay_s)
        moved_m = delay_s * ego[:, 3]
        moved = Distribution.of(moved_m[np.isfinite(moved_m)])
        mine = samples.sensors == sensor
        detections = np.unique(samples.track_ids[mine], return_counts=True)[1].astype(
            np.float64
        )
        record = {
            "run": one.label,
            "sensor": sensor,
            "delay_mean_s": delay.mean,
            "delay_p90_s": delay.p90,
        }
        record |= {
            "delay_max_s": delay.max,
            "moved_mean_m": moved.mean,
            "moved_max_m": moved.max,
        }
        record |= {"num_fused": int(mine.sum()), "num_objects": len(detections)}
        spreads = {
            (name, f"_{unit}"): getattr(samples, f"{name}_{unit}")[mine]
            for name, (unit, _) in _SPREADS.items()
        }
        for (name, unit), values in {**spreads, ("detections", ""): detections}.items():
            known = values[np.isfinite(values)]
            quantiles = (
                np.quantile(known, (0.0, 0.5, 1.0)).tolist()
                if len(known)
                else [math.nan] * 3
            )
            record |= zip(_ends(name, unit), quantiles, strict=True)
        yield record


def _ends(name: str, unit: str = "") -> list[str]:
    return [f"{name}_{moment}{unit}" for moment in ("min", "median", "max")]


def _latency(runs: Sequence[EvaluatedRun]) -> Table:
    """A row for each run: computing time of the ticks with detections."""
    records = []
    for one in runs:
        of = one.metrics.time_per_tick_s
        record = {
            "run": one.label,
            "num_ticks": of.count,
            "time_per_tick_mean_s": of.mean,
            "time_per_tick_p90_s": of.p90,
        }
        record |= {"time_per_tick_p99_s": of.p99, "time_per_tick_max_s": of.max}
        records.append(
            record | {"time_per_detection_s": one.metrics.time_per_detection_s}
        )
    names = " ".join(
        f"time_per_tick_{moment}_s" for moment in ("mean", "p90", "p99", "max")
    )
    columns = [
        RUN,
        Column("ticks", "num_ticks"),
        Column("ms/tick\nmean/p90/p99/max", names, "{}/{}/{}/{}", MS),
        Column("ms/\ndetection", "time_per_detection_s", scale=MS),
    ]
    notes = [
        "of ticks with a detection, on the machine that replayed; without prediction and logging"
    ]
    return Table("Latency", records, columns, notes=notes)


def _moments(of: Mapping[str, Moments]) -> dict[str, float]:
    ends = ((named(name, "mean"), named(name, "std"), of[name]) for name in LOCAL_NAMES)
    return {
        key: value
        for mean, std, one in ends
        for key, value in ((mean, one.mean), (std, one.std))
    }


def _residual_columns() -> list[Column]:
    return [
        Column(
            _HEADINGS[name],
            f"{named(name, 'mean')} {named(name, 'std')}",
            "{} ± {}",
            math.degrees(1.0) if name == "yaw_rad" else 1.0,
        )
        for name in LOCAL_NAMES
    ]


def _observed_s(
    updates: Columns, track_ids: IntArray, stamps_ns: IntArray
) -> FloatArray:
    """Time since the first detection of each track, shape (n,); a detection older than it counts as the first."""
    ids, numbers = np.unique(updates["track_id"], return_inverse=True)
    born_ns = np.full(len(ids), np.iinfo(np.int64).max)
    births = updates["disposition"] == "birth"
    np.minimum.at(born_ns, numbers[births], updates["stamp_ns"][births])
    return np.asarray(
        np.maximum(stamps_ns - born_ns[np.searchsorted(ids, track_ids)], 0) / NS_PER_S
    )


if __name__ == "__main__":
    typer.run(main)
