"""The numbers of a configuration for LiDAR and RADAR on vessels, by rules from their truth."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2
from scores import scans

from fgtrack import Config, FloatArray, TruthState, open_input, seconds
from fgtrack.config import NOISE_HZ, Correlation, ExistenceRules

#: A jump between successive errors counts as one of so many standard deviations at most: larger ones are another end of
#: the hull, which the robust loss is for.
LARGEST_JUMP = 3.0
#: An error that differs from the last one by more than this gate is a jump.
GATE_PROBABILITY = 0.9999
#: At most so much of the variance lasts: something of every error is new.
LARGEST_SHARE = 0.999
#: Clutter is counted in discs of this radius around each false detection.
CLUTTER_RADIUS_M = 50.0
#: The density of the process noise is what the velocity changes by in this time.
MANOEUVRE_S = 5.0
SENSORS = ("lidar", "radar")


class Seen(NamedTuple):
    """One scan and one vessel: where it was, and the nearest detection up to the gate away."""

    time_s: float
    range_m: float
    line_of_sight: FloatArray
    """Unit vector from the ego to the vessel, shape (2,)."""
    error_m: FloatArray | None
    """Detection minus truth, shape (2,); None where nothing was detected."""


@dataclass(frozen=True)
class Recorded:
    """What a scenario says of its sensors and vessels."""

    seen: Mapping[str, tuple[tuple[Seen, ...], ...]]
    """By sensor, of each vessel."""
    crowding_per_m2: Mapping[str, tuple[float, ...]]
    """By sensor: of each false detection the density of others around it, in its list."""
    speeds_mps: FloatArray
    """Velocities of the vessels, both axes, over 2 s."""
    changes_mps: FloatArray
    """What they change by in `MANOEUVRE_S`, both axes."""


def recorded(source: Path, config: Config) -> Recorded:
    """Compare every list of LiDAR and RADAR in `source` with the interpolated truth."""
    messages = list(open_input(source, config.input).messages())
    fixes: dict[str, list[tuple[float, float, float]]] = {}
    for one in messages:
        if isinstance(one, TruthState):
            fixes.setdefault(str(one.object_id), []).append(
                (seconds(one.stamp_ns), one.x_m, one.y_m)
            )
    truth = [np.array(sorted(each)) for each in fixes.values()]
    seen: dict[str, list[list[Seen]]] = {
        sensor: [[] for _ in truth] for sensor in SENSORS
    }
    crowding: dict[str, list[float]] = {sensor: [] for sensor in SENSORS}
    for sensor, stamp_ns, ego_m, points_m, _ in scans(messages, config):
        time_s, far_m = (
            seconds(stamp_ns),
            config.sensors[sensor].max_range_m or math.inf,
        )
        false = np.hypot(*(points_m - ego_m).T) <= far_m
        for vessel, track in zip(seen[sensor], truth, strict=True):
            if not track[0, 0] <= time_s <= track[-1, 0]:
                continue
            at_m = _at(track, time_s)
            distances_m = np.hypot(*(points_m - at_m).T)
            false &= distances_m > config.evaluation.gate_m
            away_m = at_m - ego_m
            range_m = float(np.hypot(*away_m))
            hit = len(points_m) > 0 and distances_m.min() <= config.evaluation.gate_m
            error_m = points_m[distances_m.argmin()] - at_m if hit else None
            vessel.append(Seen(time_s, range_m, away_m / range_m, error_m))
        ghosts_m = points_m[false]
        others = (np.hypot(*(ghosts_m[:, None] - ghosts_m).T) <= CLUTTER_RADIUS_M).sum(
            axis=0
        ) - 1.0
        crowding[sensor] += (others / (math.pi * CLUTTER_RADIUS_M**2)).tolist()
    moved = [
        np.array([_velocity(one, time_s) for time_s in _inner_s(one, 0.0)]).reshape(
            -1, 2
        )
        for one in truth
    ]
    changes = [
        np.array(
            [
                _velocity(one, at_s + MANOEUVRE_S) - _velocity(one, at_s)
                for at_s in _inner_s(one, MANOEUVRE_S)
            ]
        )
        for one in truth
    ]
    return Recorded(
        {sensor: tuple(map(tuple, vessels)) for sensor, vessels in seen.items()},
        {sensor: tuple(values) for sensor, values in crowding.items()},
        np.concatenate(moved),
        np.concatenate([one.reshape(-1, 2) for one in changes]),
    )


def ruled(config: Config, recordings: Sequence[Recorded]) -> Config:
    """`config` with the numbers that `recordings` give by the rules."""
    sensors, gate = dict(config.sensors), float(chi2.ppf(GATE_PROBABILITY, 2))
    for name in SENSORS:
        vessels = [vessel for one in recordings for vessel in one.seen[name]]
        hits = [
            (one, one.error_m)
            for vessel in vessels
            for one in vessel
            if one.error_m is not None
        ]
        near_m = -float(np.mean([one.line_of_sight @ error_m for one, error_m in hits]))
        tracks = [
            [
                (one.time_s, _moved(one, near_m))
                for one in vessel
                if one.error_m is not None
            ]
            for vessel in vessels
        ]
        variance = float(np.mean([np.square(_moved(one, near_m)) for one, _ in hits]))
        share, time_s = lasting(tracks, variance)
        crowding = np.median(
            [
                np.mean(one.crowding_per_m2[name])
                for one in recordings
                if one.crowding_per_m2[name]
            ]
        )
        sensors[name] = replace(
            sensors[name],
            std={
                "x_m": _digits(math.sqrt(variance)),
                "y_m": _digits(math.sqrt(variance)),
            },
            near_side_m=_digits(near_m),
            correlation=Correlation(
                _digits(share, 3),
                _digits(time_s),
                _digits(_jump_probability(tracks, gate)),
            ),
            detection_probability=_digits(_detection_probability(vessels)),
            clutter_per_m2=_digits(float(crowding)),
        )
    speed_mps = _rms([one.speeds_mps for one in recordings])
    per_root_s = _rms([one.changes_mps for one in recordings]) / math.sqrt(MANOEUVRE_S)
    assert isinstance(config.lifecycle, ExistenceRules)
    stds_m = [sensors[name].std["x_m"] for name in SENSORS]
    return replace(
        config,
        sensors=sensors,
        motion=replace(
            config.motion,
            std_per_s={"velocity": _digits(per_root_s * math.sqrt(NOISE_HZ))},
        ),
        birth=replace(config.birth, speed_std_mps=_digits(speed_mps)),
        lifecycle=replace(config.lifecycle, min_travel_m=_digits(3.0 * max(stds_m))),
    )


def _at(track: FloatArray, time_s: float) -> FloatArray:
    return np.array([np.interp(time_s, track[:, 0], track[:, axis]) for axis in (1, 2)])


def _velocity(track: FloatArray, time_s: float) -> FloatArray:
    """Over 2 s, shape (2,)."""
    return (_at(track, time_s + 1.0) - _at(track, time_s - 1.0)) / 2.0


def _inner_s(track: FloatArray, ahead_s: float) -> list[float]:
    """Times of the fixes at which, and so much later, a velocity is known."""
    times_s = track[:, 0]
    return times_s[
        (times_s >= times_s[0] + 1.0) & (times_s <= times_s[-1] - 1.0 - ahead_s)
    ].tolist()


def _moved(one: Seen, near_m: float) -> FloatArray:
    """The error after the near side is moved back."""
    assert one.error_m is not None
    return np.asarray(one.error_m + near_m * one.line_of_sight)


def lasting(
    tracks: Sequence[Sequence[tuple[float, FloatArray]]], variance: float
) -> tuple[float, float]:
    """Share of the `variance` of errors that lasts, and its time constant T in s, from the times and errors of tracks.

    Half the mean square of what errors one period apart differ by is variance (1 - share exp(-period / T)): what is new
    in each, and what the lasting part has changed by since.
    """
    period_s = float(
        np.median(
            np.concatenate([np.diff([at_s for at_s, _ in one]) for one in tracks])
        )
    )
    kept = variance - _half_square_of_jumps(tracks)
    time_s = _correlation_time_s(tracks, kept, period_s)
    return min(kept / variance * math.exp(period_s / time_s), LARGEST_SHARE), time_s


def _half_square_of_jumps(
    tracks: Sequence[Sequence[tuple[float, FloatArray]]],
) -> float:
    """Half the mean square of what successive errors differ by; larger jumps count as the largest."""
    jumps, typical = _jumps(tracks)
    return 0.5 * float(
        np.mean(np.minimum(np.square(jumps), (LARGEST_JUMP * typical) ** 2))
    )


def _jump_probability(
    tracks: Sequence[Sequence[tuple[float, FloatArray]]], gate: float
) -> float:
    """Share of successive errors that differ by more than the `gate`, a squared Mahalanobis distance, lets pass."""
    jumps, typical = _jumps(tracks)
    return float(np.mean(np.square(jumps / typical).sum(axis=1) > gate))


def _jumps(
    tracks: Sequence[Sequence[tuple[float, FloatArray]]],
) -> tuple[FloatArray, float]:
    """What successive errors differ by, shape (n, 2), and its standard deviation on an axis, were they normal."""
    jumps = np.concatenate(
        [np.diff([error for _, error in one], axis=0) for one in tracks if len(one) > 1]
    )
    return jumps, 1.4826 * float(np.median(np.abs(jumps)))


def _correlation_time_s(
    tracks: Sequence[Sequence[tuple[float, FloatArray]]], kept: float, period_s: float
) -> float:
    """Time constant of the lasting part, in steps of 5 s.

    The first after which no more of the autocovariance is left than an exponential with that time constant leaves of
    `kept`, the autocovariance after one period.
    """
    lags: list[tuple[float, float]] = []
    for one in tracks:
        for k, (time_s, error) in enumerate(one):
            lags += [
                (later_s - time_s, 0.5 * float(error @ later))
                for later_s, later in one[k + 1 :]
            ]
    table = np.array(lags)
    for low_s in range(5, 200, 5):
        chosen = (table[:, 0] >= low_s - 2.5) & (table[:, 0] < low_s + 2.5)
        if not chosen.any() or table[chosen, 1].mean() < kept * math.exp(
            (period_s - low_s) / low_s
        ):
            return float(low_s)
    return 200.0


def _detection_probability(vessels: Sequence[Sequence[Seen]]) -> float:
    """That a list shows a vessel between two that do, so that it was visible.

    One hit and one miss are added to the counts (the rule of succession), so that it lies between 0 and 1.
    """
    triples = [
        triple
        for vessel in vessels
        for triple in zip(vessel, vessel[1:], vessel[2:], strict=False)
    ]
    hits = [
        b.error_m is not None
        for a, b, c in triples
        if a.error_m is not None and c.error_m is not None
    ]
    return (sum(hits) + 1.0) / (len(hits) + 2.0)


def _rms(parts: Sequence[FloatArray]) -> float:
    return float(np.sqrt(np.mean(np.square(np.concatenate(parts)))))


def _digits(value: float, count: int = 2) -> float:
    return float(f"{value:.{count}g}")


def numbers(config: Config) -> dict[str, float]:
    """What the rules have given, by key."""
    found: dict[str, float] = {}
    for name in SENSORS:
        one = config.sensors[name]
        assert one.correlation is not None
        values = {
            "std": one.std["x_m"],
            "near_side_m": one.near_side_m,
            "share": one.correlation.share,
        }
        values |= {"jump_probability": one.correlation.jump_probability}
        values |= {
            "time_s": one.correlation.time_s,
            "detection_probability": one.detection_probability,
        }
        values |= {"clutter_per_m2": one.clutter_per_m2}
        found |= {f"{name}.{key}": value for key, value in values.items()}
    found["motion.std_per_s.velocity"] = config.motion.std_per_s["velocity"]
    found["birth.speed_std_mps"] = config.birth.speed_std_mps
    found["lifecycle.min_travel_m"] = getattr(
        config.lifecycle, "min_travel_m", math.nan
    )
    return found
