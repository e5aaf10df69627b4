"""Diagnostics to read before a run is trusted: unused detections and why, inconsistent noise, broken tracks."""

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from fgtrack.core.diagnostic import EGO, Diagnostic, in_degrees, late_ego, too_late
from fgtrack.core.geometry import cartesian
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray
from fgtrack.evaluation.matching import confirmed
from fgtrack.evaluation.scores.innovations import by_sensor, num_measured
from fgtrack.evaluation.scores.statistics import ChiSquareMean
from fgtrack.models.measurement import ANGULAR
from fgtrack.models.road import OPEN_SPACE
from fgtrack.runs import Columns, Run

USED = ("birth", "in_sequence", "out_of_sequence", "beyond_window", "merged")
"""Dispositions of detections that took part."""
FAR_OFF = 1.5
"""A mean NIS farther from its expected value than by this factor is inconsistent."""
FEWEST = 30
"""Fewest updates of a sensor whose NIS is evaluated."""
CORRELATED = 0.3
"""Autocorrelation of innovations at lag 1 above which their errors are correlated in time."""
MOST_BREAKS_PER_MINUTE = 2.0
"""More breaks per object and minute than these are bad tracking."""
_FEWEST_BREAKS, _BREAKS_SHARE = (
    3,
    0.25,
)  # of all confirmed tracks; fewer are those of occlusions or of chance
_DEAD_SHARE = 0.5  # of the detections used, beginning a track that is never confirmed; of clutter it is below
_GAP_S, _OVERLAP_S = (
    5.0,
    2.0,
)  # a track continues one that ended at most so long before, or after, it began
_NEAR_M, _DEPARTURE = (
    3.0,
    0.3,
)  # from its prediction: noise, and a turn of 0.3 rad or 30 % of its speed
_YAWS_SHARE = 0.05  # of the yaws of a sensor that are half a turn off, or that misfit: fewer are outliers
_NO_FAILURE = "step damped"  # not a failure: with bearings damped steps are usual
#: Cause and cure of dispositions that most detections of a sensor may have.
_CURES = {
    "gated": "no track was near, none was started: check the gate of `association`, clock, ego.detection_origin_x_m",
    "out_of_bounds": "{reasons}: are these settings meant, is it the right map (--map), and frame of the detections?",
    "duplicate": "the same list repeatedly: check the recording: a sensor or a bridge repeats itself",
    "superseded": "another list of the sensor came in the same tick, and the inbox keeps one: raise clock.node_hz",
    "invalid": "no position, not finite, an invalid covariance, or stamped ahead of its receipt: compare the keys of "
    "sensors.{sensor}.std with what `fgtrack info` shows",
    "failed": "no ego state near the stamp, or a numerical failure: check the clock of the ego",
}
_STANDING = {"birth.ego_speed_factor": 0.0}
_NAME_EGO = "name its topic in the configuration (`fgtrack info` lists the topics)"


def diagnostics(run: Run) -> list[Diagnostic]:
    """Defects of `run`, as far as its files show them."""
    kinds = (
        _angles,
        _ego,
        _map,
        _sensors,
        _latency,
        _failures,
        _fragmentation,
        _identities,
        _yaws,
    )
    return [diagnostic for kind in kinds for diagnostic in kind(run)]


def _identities(run: Run) -> Iterator[Diagnostic]:
    """Identities that are not of one object."""
    counts = run.meta.get("id_conflicts") or {}
    texts = {
        "reused": "began with the identity of another track: two objects use it, or its stamps or noise are wrong",
        "changed": "detections of another identity than their track: lower the sensor's wrong_id_probability",
    }
    for name, text in texts.items():
        if counts.get(name):
            yield Diagnostic(
                "identities",
                f"{counts[name]} {'tracks ' if name == 'reused' else ''}{text}",
            )


def _yaws(run: Run) -> Iterator[Diagnostic]:
    """Sensors with many yaws that are half a turn off, or that misfit in another way."""
    for sensor, counts in dict(run.meta.get("yaws") or {}).items():
        total = counts.get("yaws", 0)
        flipped, unused_yaws = counts.get("flipped", 0), counts.get("unused", 0)
        if total >= FEWEST and flipped > _YAWS_SHARE * total:
            text = f"{flipped} of {total} yaws are half a turn off: they were turned, the front follows from all yaws"
            yield Diagnostic(sensor, text)
        if total >= FEWEST and unused_yaws > _YAWS_SHARE * total:
            text = (
                f"{unused_yaws} of {total} yaws misfit, only their positions were used: "
                "its yaw errors are larger than "
            )
            yield Diagnostic(
                sensor,
                f"{text}configured (sensors.{sensor}.std), or some yaws are those of another side",
            )


def noise_diagnostics(run: Run) -> Iterator[Diagnostic]:
    """Sensors whose innovations are inconsistent with the noise; see also the verdict of `compare`."""
    source = (run.meta.get("input") or {}).get("path")
    of_run = (
        f" {source} -c {run.path / 'config.yaml'}"
        if run.path is not None and source
        else ""
    )
    for sensor, nis in misfits(run):
        size = "small" if nis.mean > nis.dof else "large"
        factor = math.sqrt(
            max(nis.mean, 0.0) / nis.dof
        )  # below 0 by rounding, where one std is 1e9 of another
        text = (
            f"mean NIS {nis.mean:.3g}, expected {nis.dof:.3g}: the configured noise is too {size}, as if errors were "
            f"{factor:.2g} times what is configured; `fgtrack advise{of_run} --tune -o advised.yaml` fits it, or "
            "reports what has to be done first"
        )
        yield Diagnostic(sensor, text)


def misfits(run: Run) -> Iterator[tuple[str, ChiSquareMean]]:
    """The sensors whose mean and median NIS (not a few outliers) are far off on the same side, and their NIS."""
    for sensor, mine in by_sensor(run.tables["updates"]):
        nis = ChiSquareMean.without_band(mine["nis"], num_measured(mine))
        if nis.count >= FEWEST and is_far_off(nis):
            from scipy.special import (
                chdtri,
            )  # takes a quarter of a second, and a consistent run does not need it

            ratio = float(np.nanmedian(mine["nis"])) / float(chdtri(nis.dof, 0.5))
            if ratio > FAR_OFF if nis.mean > nis.dof else ratio < 1.0 / FAR_OFF:
                yield sensor, nis


def is_far_off(square: ChiSquareMean) -> bool:
    """True if a mean NEES or NIS is out of proportion to its expected value."""
    return not square.dof / FAR_OFF <= square.mean <= square.dof * FAR_OFF


def unused(run: Run) -> str | None:
    """Line on the dispositions of a run that used no detection; None where one was used, or none was received."""
    counts = Counter(run.tables["updates"]["disposition"].tolist())
    if not counts or counts.keys() & set(USED):
        return None
    names = ", ".join(f"{count} {name}" for name, count in sorted(counts.items()))
    return f"none of the {counts.total()} detections was used ({names})"


def reasons(counts: Mapping[str, int]) -> str:
    """`counts` by setting in words, the most first: `40 by filters.score, 2 by max_range_m`."""
    return ", ".join(
        f"{count} by {name}"
        for name, count in sorted(counts.items(), key=lambda item: -item[1])
    )


def excluded_lines(meta: Mapping[str, Any]) -> Iterator[str]:
    """Lines on the detections of each sensor that settings excluded in a run with this meta.json."""
    for sensor, counts in sorted(dict(meta.get("out_of_bounds") or {}).items()):
        total = sum(meta["counts"][sensor].values())
        yield f"{sensor}: {sum(counts.values())} of {total} detections out of bounds ({reasons(counts)})"
    for sensor, counts in sorted(dict(meta.get("left_out") or {}).items()):
        yield f"{sensor}: {sum(counts.values())} left out when read ({reasons(counts)})"


def _angles(run: Run) -> Iterator[Diagnostic]:
    """Angles that were recorded in degrees and read as radians."""
    for about, table in [
        (EGO, run.tables["ego"]),
        *by_sensor(run.tables["detections"]),
    ]:
        for name in ANGULAR:
            finite = [
                value
                for value in table.get(name, np.empty(0)).tolist()
                if math.isfinite(value)
            ]
            if wrong := in_degrees(
                about, name, min(finite, default=0.0), max(finite, default=0.0)
            ):
                yield wrong


def _ego(run: Run) -> Iterator[Diagnostic]:
    """No ego where it is needed, a late one, or reasons for which more than half of its states were refused."""
    num_states = run.tables["ego"].num_rows
    if not num_states and any(name == "failed" for _, _, name, _ in _mostly(run)):
        yield Diagnostic(
            EGO,
            f"no state was received, so nothing in its frame can be placed: {_NAME_EGO}",
        )
    elif not num_states and _ego_speeds_births(run):
        text = f"no state was received, so new objects are assumed to stand still: {_NAME_EGO}"
        yield Diagnostic(EGO, f"{text}, or set birth.ego_speed_factor to 0", _STANDING)
    if num_states and (
        late := late_ego(_delay_s(run.tables["ego"]), _placed_delays_s(run))
    ):
        yield late
    if jumps := run.meta.get("ego_jumps"):
        times = "once" if jumps == 1 else f"{jumps} times"
        yield Diagnostic(
            EGO,
            f"its position jumps {times}: detections are misplaced there, cut the recording in parts",
        )
    for reason, count in dict(run.meta.get("ego_refused") or {}).items():
        if 0 < num_states < 2 * count:
            text = f"{count} of {num_states} states not used, {reason}: look at the clock of its driver"
            yield Diagnostic(EGO, text)


def _placed_delays_s(run: Run) -> dict[str, float]:
    """Median delay [s] of the lists of each sensor that has detections in a moving frame."""
    detections = run.tables["detections"]
    moving = detections.where(detections["frame"] != "map")
    return {name: _delay_s(mine) for name, mine in by_sensor(moving)}


def _delay_s(table: Columns) -> float:
    """Median delay [s] of the rows of a table, from stamp to receipt."""
    return float(np.median(table["receipt_ns"] - table["stamp_ns"])) / NS_PER_S


def _map(run: Run) -> Iterator[Diagnostic]:
    """No map where new objects are as fast as the ego, in its direction."""
    if not _ego_speeds_births(run) or _section(run, "map").get("track") not in (
        None,
        OPEN_SPACE,
    ):
        return
    detections = run.tables["detections"]
    blind = [
        name
        for name, mine in by_sensor(detections)
        if not np.isfinite(mine["yaw_rad"]).any()
    ]
    if blind:
        text = f"there is none, and no heading from {', '.join(blind)}: new objects may drive in any direction"
        cure = "name it with --map (`oval` for the simulated races), or set birth.ego_speed_factor to 0 for open space"
        yield Diagnostic("map", f"{text}; {cure}", _STANDING)


def _ego_speeds_births(run: Run) -> bool:
    """True if new objects are assumed to be as fast as the ego, or nearly."""
    return bool(
        run.tables["updates"].num_rows
        and _section(run, "birth").get("ego_speed_factor")
    )


def _mostly(run: Run) -> Iterator[tuple[str, Columns, str, int]]:
    """Sensors and their updates, of which more than half were not used for one reason: it, and their number."""
    for sensor, mine in by_sensor(run.tables["updates"]):
        name, count = Counter(mine["disposition"].tolist()).most_common(1)[0]
        if name not in USED and 2 * count > mine.num_rows:
            yield sensor, mine, name, count


def _sensors(run: Run) -> Iterator[Diagnostic]:
    """Stamps that no driver sets, and the disposition of most detections, where no other diagnostic explains it."""
    unset = [
        name
        for name, mine in by_sensor(run.tables["updates"])
        if not mine["stamp_ns"].any()
    ]
    for sensor in unset:
        text = "all stamps are 0: its driver does not set them; `stamp_from: receipt` takes the receipt for the stamp"
        yield Diagnostic(sensor, text, {f"sensors.{sensor}.stamp_from": "receipt"})
    for sensor, mine, name, count in _mostly(run):
        if (name == "too_old" and sensor in unset) or (
            name == "failed" and not run.tables["ego"].num_rows
        ):
            continue
        if name == "duplicate" and (_section(run, "sensors").get(sensor) or {}).get(
            "copies_s"
        ):
            continue  # copies of messages that several receivers heard are expected
        by = reasons((run.meta.get("out_of_bounds") or {}).get(sensor, {}))
        cure = (
            _too_old(run, sensor, mine)
            if name == "too_old"
            else _CURES[name].format(sensor=sensor, reasons=by)
        )
        yield Diagnostic(sensor, f"{count} of {mine.num_rows} {name}: {cure}")


def _latency(run: Run) -> Iterator[Diagnostic]:
    """Delays longer than what the estimator or the inbox allows, where they do not explain most of the detections."""
    explained = {sensor for sensor, _, _, _ in _mostly(run)}
    for sensor, mine in by_sensor(run.tables["updates"]):
        if sensor not in explained and mine["stamp_ns"].any():
            delays_s, refused = (
                (mine["receipt_ns"] - mine["stamp_ns"]) / NS_PER_S,
                mine["disposition"] == "too_old",
            )
            if late := too_late(
                sensor, delays_s, _limits(run, sensor, "reach_s"), refused
            ):
                yield late


def _limits(run: Run, sensor: str, window_s: str) -> list[tuple[str, float | None]]:
    """Keys of a sensor's largest delay and of the window, with their times; `window_s` names the time of the window."""
    window, own = (
        run.meta.get("effective") or {},
        _section(run, "sensors").get(sensor) or {},
    )
    return [
        (f"sensors.{sensor}.max_delay_s", own.get("max_delay_s")),
        (str(window.get("lag_key")), window.get(window_s, window.get("lag_s"))),
    ]


def _too_old(run: Run, sensor: str, updates: Columns) -> str:
    delay_s = _delay_s(updates)
    for key, limit_s in _limits(run, sensor, "lag_s"):
        if limit_s is not None and delay_s > limit_s:
            return f"median delay {delay_s:.3g} s, allowed {limit_s:g} s: raise {key}, or correct the clock"
    return f"median delay {delay_s:.3g} s, but no track is as old as these detections: check births, gate and clock"


def _failures(run: Run) -> Iterator[Diagnostic]:
    """Failures inside the estimator."""
    counts = {
        kind: n
        for kind, n in dict(run.meta.get("failures") or {}).items()
        if n and kind != _NO_FAILURE
    }
    if counts:
        first = (
            f" (the first one: {run.meta['first_failure']})"
            if run.meta.get("first_failure")
            else ""
        )
        cure = "these tracks are less accurate; look at NIS by sensor, noise, clocks and starts"
        text = f"failures: {', '.join(f'{n} {kind}' for kind, n in counts.items())}{first}: {cure}"
        yield Diagnostic("estimator", text)


def _fragmentation(run: Run) -> Iterator[Diagnostic]:
    """Tracks that break off and restart, and births that die unconfirmed: bad tracking that needs no truth."""
    (lifetimes_s, num_breaks), now_ns = (
        lifetimes_and_breaks(run),
        run.tables["timing"]["now_ns"],
    )
    total, minutes = len(lifetimes_s), float(lifetimes_s.sum()) / 60.0
    if (
        num_breaks >= max(_FEWEST_BREAKS, _BREAKS_SHARE * total)
        and num_breaks > MOST_BREAKS_PER_MINUTE * minutes
    ):
        text = (
            f"{num_breaks} of {total} confirmed tracks begin where another one has just ended: "
            f"{num_breaks / minutes:.2g} breaks per object and minute, median life {np.median(lifetimes_s):.2g} of "
            f"{float(np.ptp(now_ns)) / NS_PER_S:.3g} s; likely causes: a field of view or range larger than what a "
            "sensor covers, detection_probability, lifecycle.lifetime_s, noise; `fgtrack advise` looks for them"
        )
        yield Diagnostic("tracks", text)
    dispositions = run.tables["updates"]["disposition"]
    used = int(np.isin(dispositions, USED).sum())
    dead = int(np.count_nonzero(dispositions == "birth")) - total
    if used >= FEWEST and dead > _DEAD_SHARE * used:
        text = (
            f"{dead} of {used} detections used began a track that was never confirmed; likely causes: clutter, errors "
            "or motion larger than configured, a wrong ego or clock; `fgtrack advise` looks for them"
        )
        yield Diagnostic("tracks", text)


def lifetimes_and_breaks(run: Run) -> tuple[FloatArray, int]:
    """Lifetimes [s] of the confirmed tracks, shape (tracks,), and how many begin where and when another one ends."""
    tracks = run.tables["tracks"]
    tracks = tracks.where(
        np.isin(tracks["track_id"], tracks["track_id"][confirmed(tracks)])
    )
    births = np.unique(tracks["track_id"], return_index=True)[1]
    ends = (
        tracks.num_rows - 1 - np.unique(tracks["track_id"][::-1], return_index=True)[1]
    )
    born_s, ended_s = (
        (tracks["now_ns"][each] - tracks["now_ns"][:1]) / NS_PER_S
        for each in (births, ends)
    )
    positions_m, speed_mps = (
        np.stack([tracks["x_m"], tracks["y_m"]], axis=-1),
        tracks["speed_mps"][ends],
    )
    velocities_mps = cartesian(np.stack([tracks["yaw_rad"][ends], speed_mps], axis=-1))
    free, num_breaks = np.ones(len(births), dtype=bool), 0
    for k in np.argsort(born_s, kind="stable").tolist():
        gap_s = born_s[k] - ended_s
        late = (
            (born_s < born_s[k])
            & (ended_s < ended_s[k])
            & (gap_s >= -_OVERLAP_S)
            & (gap_s <= _GAP_S)
        )
        before = np.flatnonzero(free & late)
        expected_m = (
            positions_m[ends[before]] + velocities_mps[before] * gap_s[before, None]
        )
        apart_m = np.linalg.norm(positions_m[births[k]] - expected_m, axis=-1)
        near = apart_m <= _NEAR_M + _DEPARTURE * np.abs(
            speed_mps[before] * gap_s[before]
        )
        if near.any():
            free[before[near][apart_m[near].argmin()]] = False
            num_breaks += 1
    return ended_s - born_s, num_breaks


def _section(run: Run, name: str) -> Mapping[str, Any]:
    return run.config.get(name) or {}
