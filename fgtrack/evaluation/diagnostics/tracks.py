"""Diagnostics of the tracks of a run: breaks, unconfirmed births, identities, flipped yaws, failures."""

from collections.abc import Iterator

import numpy as np

from fgtrack.core.diagnostic import Diagnostic
from fgtrack.core.geometry import cartesian
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.evaluation.diagnostics.noise import FEWEST
from fgtrack.evaluation.diagnostics.outcomes import USED
from fgtrack.evaluation.matching import confirmed
from fgtrack.runs import Run

MOST_BREAKS_PER_MINUTE = 2.0
"""Number of breaks per object and minute above which tracking is fragmented."""
DEAD_SHARE = 0.5
"""Share of the used detections that start a track which is never confirmed. Clutter alone stays below it."""
# Least number of breaks, and least share of the confirmed tracks. Fewer breaks are due to occlusion or chance.
_FEWEST_BREAKS = 3
_BREAKS_SHARE = 0.25
# A track continues an earlier track if it begins at most this time after, or before, the earlier track ends.
_GAP_S = 5.0
_OVERLAP_S = 2.0
# Largest distance from the predicted position: noise, and a share of the predicted way for turns and changes of speed.
_NEAR_M = 3.0
_DEPARTURE = 0.3
# Share of a sensor's yaws that are flipped, or rejected, above which it is reported. Fewer are outliers.
_YAWS_SHARE = 0.05
# A damped step is no failure: it is usual with bearings.
_NO_FAILURE = "step damped"


def identities(run: Run) -> Iterator[Diagnostic]:
    """Yield identities that belong to several objects, and conflicting identities."""
    counts = run.meta.get("id_conflicts") or {}
    texts = {
        "reused": "started with the identity of another track: two objects use it, or its stamps or noise are wrong",
        "changed": "detections have another identity than their track: lower the sensor's wrong_id_probability",
    }
    for name, text in texts.items():
        if counts.get(name):
            yield Diagnostic(
                "identities",
                f"{counts[name]} {'tracks ' if name == 'reused' else ''}{text}",
            )


def yaws(run: Run) -> Iterator[Diagnostic]:
    """Yield sensors with many yaws that are half a turn off, or that are inconsistent otherwise."""
    for sensor, counts in dict(run.meta.get("yaws") or {}).items():
        total = counts.get("yaws", 0)
        flipped = counts.get("flipped", 0)
        rejected = counts.get("unused", 0)
        if total >= FEWEST and flipped > _YAWS_SHARE * total:
            text = f"{flipped} of {total} yaws are half a turn off and were turned; the front follows from all yaws"
            yield Diagnostic(sensor, text)
        if total >= FEWEST and rejected > _YAWS_SHARE * total:
            text = (
                f"{rejected} of {total} yaws are inconsistent, only their positions were used: its yaw errors are "
                f"larger than configured (sensors.{sensor}.std), or some yaws belong to another side of the object"
            )
            yield Diagnostic(sensor, text)


def failures(run: Run) -> Iterator[Diagnostic]:
    """Yield failures inside the estimator."""
    counts = {
        kind: n
        for kind, n in dict(run.meta.get("failures") or {}).items()
        if n and kind != _NO_FAILURE
    }
    if counts:
        first = (
            f" (the first failure: {run.meta['first_failure']})"
            if run.meta.get("first_failure")
            else ""
        )
        remedy = "these tracks are less accurate; check NIS by sensor, noise, clocks and first states"
        text = f"failures: {', '.join(f'{n} {kind}' for kind, n in counts.items())}{first}: {remedy}"
        yield Diagnostic("estimator", text)


def fragmentation(run: Run) -> Iterator[Diagnostic]:
    """Yield tracks that break off and restart, and births that are never confirmed; both need no truth."""
    lifetimes_s, num_breaks = lifetimes_and_breaks(run)
    now_ns = run.tables["timing"]["now_ns"]
    total = len(lifetimes_s)
    minutes = float(lifetimes_s.sum()) / 60.0
    if (
        num_breaks >= max(_FEWEST_BREAKS, _BREAKS_SHARE * total)
        and num_breaks > MOST_BREAKS_PER_MINUTE * minutes
    ):
        text = (
            f"{num_breaks} of {total} confirmed tracks begin where another track has just ended: "
            f"{num_breaks / minutes:.2g} breaks per object and minute, median life {np.median(lifetimes_s):.2g} of "
            f"{float(np.ptp(now_ns)) / NS_PER_S:.3g} s; likely causes: a configured field of view or range that the "
            "sensor does not cover, detection_probability, lifecycle.lifetime_s, noise; `fgtrack advise` checks these"
        )
        yield Diagnostic("tracks", text)
    dispositions = run.tables["updates"]["disposition"]
    used = int(np.isin(dispositions, USED).sum())
    dead = int(np.count_nonzero(dispositions == "birth")) - total
    if used >= FEWEST and dead > DEAD_SHARE * used:
        text = (
            f"{dead} of {used} used detections started a track that was never confirmed; likely causes: clutter, "
            "errors or motion larger than configured, a wrong ego or clock; `fgtrack advise` checks these"
        )
        yield Diagnostic("tracks", text)


def lifetimes_and_breaks(run: Run) -> tuple[FloatArray, int]:
    """Return the lifetimes [s] of the confirmed tracks, shape (tracks,), and the number of breaks.

    A break is a track that begins near the end of another track, in time and position.
    """
    tracks = run.tables["tracks"]
    ids = tracks["track_id"]
    known = np.unique(ids[confirmed(tracks)])
    births = _first_rows(ids, known)
    ends = len(ids) - 1 - _first_rows(ids[::-1], known)
    first, last = tracks.where(births), tracks.where(ends)
    start_ns = int(first["now_ns"].min()) if len(known) else 0
    born_s = (first["now_ns"] - start_ns) / NS_PER_S
    ended_s = (last["now_ns"] - start_ns) / NS_PER_S
    births_m, ends_m = (
        np.stack([each["x_m"], each["y_m"]], axis=-1) for each in (first, last)
    )
    speed_mps = last["speed_mps"]
    velocities_mps = cartesian(np.stack([last["yaw_rad"], speed_mps], axis=-1))
    free = np.ones(len(births), dtype=bool)  # tracks without a continuation
    num_breaks = 0
    for k in np.argsort(born_s, kind="stable").tolist():
        gap_s = born_s[k] - ended_s
        late = (
            (born_s < born_s[k])
            & (ended_s < ended_s[k])
            & (gap_s >= -_OVERLAP_S)
            & (gap_s <= _GAP_S)
        )
        before = np.flatnonzero(free & late)
        expected_m = ends_m[before] + velocities_mps[before] * gap_s[before, None]
        distance_m = np.linalg.norm(births_m[k] - expected_m, axis=-1)
        way_m = np.abs(speed_mps[before] * gap_s[before])
        near = distance_m <= _NEAR_M + _DEPARTURE * way_m
        if near.any():
            free[before[near][distance_m[near].argmin()]] = False
            num_breaks += 1
    return ended_s - born_s, num_breaks


def _first_rows(ids: IntArray, wanted: IntArray) -> IntArray:
    """Return the first row of each id in `wanted`, all of which are in `ids`."""
    every, first = np.unique(ids, return_index=True)
    return np.asarray(first[np.searchsorted(every, wanted)])
