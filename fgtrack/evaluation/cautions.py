"""What a person must know before believing a run: detections that were not used, and why; noise that does not fit."""

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from scipy.special import chdtri

from fgtrack.core.caution import EGO, Caution, in_degrees
from fgtrack.core.time import NS_PER_S, wrong_unit
from fgtrack.core.types import FloatArray
from fgtrack.estimation.failures import Failure
from fgtrack.evaluation.innovations import autocorrelations, num_measured
from fgtrack.evaluation.left_out import because
from fgtrack.evaluation.lives import MOST_BREAKS_PER_MINUTE, Lives
from fgtrack.evaluation.statistics import ChiSquareMean
from fgtrack.io.run import Run, Table, digest
from fgtrack.models.measurement import ANGULAR
from fgtrack.models.road import OPEN_SPACE
from fgtrack.tracking.soundness import IN_A_ROW

USED = ("birth", "in_sequence", "out_of_sequence", "beyond_window", "merged")
"""Dispositions of detections that took part."""
FAR_OFF = 1.5
"""A mean NIS farther from its expected value than by this factor says that the noise does not fit."""
FEWEST = 30
"""Updates of a sensor whose NIS says something."""
LASTING = 0.3
"""Autocorrelation of innovations at lag 1 above which their errors are correlated in time."""
_FEWEST_BREAKS, _BREAKS_SHARE = 3, 0.25
"""Breaks, and their share of all confirmed tracks, that are not those of occlusions or of chance."""
_DEAD_SHARE = 0.5
"""Share of the detections used that begin a track which is never confirmed; of clutter it is below."""

#: Cause and cure of what can happen to most detections of a sensor, by disposition.
_CURES = {
    "gated": "no track was near enough and none was started: check the gate of `association`, the clock, and "
    "ego.detection_origin_x_m",
    "out_of_bounds": "{because}: are these settings meant, and is it the right map (--map), and the frame of the "
    "detections?",
    "duplicate": "the same list again and again: look at the recording, a sensor or a bridge repeats itself",
    "superseded": "another list of the sensor came in the same tick, and the inbox keeps one: raise clock.node_hz",
    "invalid": "no position, a value that is not finite, a covariance that is none, or a stamp ahead of its receipt: "
    "compare the keys of sensors.{sensor}.std with what `fgtrack info` shows",
    "failed": "no ego state near the stamp, or a numerical failure: check the clock of the ego",
}
_STANDING = {"birth.ego_speed_factor": 0.0}
_NAME_EGO = "name its topic in the configuration (`fgtrack info` lists the topics)"


def cautions(run: Run) -> list[Caution]:
    """What is wrong with `run` as far as its files say."""
    found = (_changed, _clocks, _angles, _ego, _map, _lost, _window, _failures, _lives)
    return [one for of_kind in found for one in of_kind(run)]


def noise_cautions(run: Run) -> list[Caution]:
    """Sensors whose innovations say that the noise does not fit; see also the verdict of `compare`.

    The median must be off as the mean is: the mean alone may be that of a few outliers, or of the first innovations of
    new tracks.
    """
    found = []
    for sensor, nis in misfits(run):
        size = "small" if nis.mean > nis.dof else "large"
        factor = math.sqrt(max(nis.mean, 0.0) / nis.dof)  # below 0 by rounding, where one std is 1e9 of another
        text = (
            f"mean NIS {nis.mean:.3g}, expected {nis.dof:.3g}: the configured noise is too {size}, as if "
            f"errors were {factor:.2g} times what is configured"
        )
        fit = _advise(run, " --tune -o advised.yaml")
        lag1 = innovation_lag1(run, sensor)
        if lag1 is not None and lag1 > LASTING:
            text += f", and errors are correlated in time ({lag1:.2f}), which fitted white noise cannot express"
        found.append(Caution(sensor, f"{text}; `{fit}` fits it, or says what has to be done first"))
    return found


def innovation_lag1(run: Run, sensor: str) -> float | None:
    """Autocorrelation of the position innovations of a sensor at lag 1; None where no track has enough of them.

    It is near 0 where its errors are white and the noise is consistent. Of a sensor without positions it is that of the
    first component.
    """
    found = autocorrelations(run.tables["updates"].where(run.tables["updates"]["sensor"] == sensor))
    first = next(iter(found.values()), None)
    return None if first is None else first.lag1


def misfits(run: Run) -> Iterator[tuple[str, ChiSquareMean]]:
    """The sensors of `noise_cautions`, and their NIS."""
    measured = num_measured(run.tables["updates"])
    for sensor, mine in _by_sensor(run.tables["updates"]):
        nis = ChiSquareMean.of(run.tables["updates"]["nis"][mine], measured[mine])
        if nis.count >= FEWEST and is_far_off(nis) and _median_is_off(run.tables["updates"]["nis"][mine], nis):
            yield sensor, nis


def _advise(run: Run, options: str = "") -> str:
    """The command that judges the settings of `run`."""
    source = str((run.meta.get("input") or {}).get("path") or "")
    named = f" {source} -c {run.path / 'config.yaml'}" if run.path is not None and source else ""
    return f"fgtrack advise{named}{options}"


def _median_is_off(values: FloatArray, nis: ChiSquareMean) -> bool:
    """Whether the median of `values` is as far off as their mean, on the same side."""
    ratio = float(np.nanmedian(values)) / float(chdtri(nis.dof, 0.5))
    return ratio > FAR_OFF if nis.mean > nis.dof else ratio < 1.0 / FAR_OFF


def is_far_off(square: ChiSquareMean) -> bool:
    """Whether a mean NEES or NIS is out of proportion to what it should be."""
    return not square.dof / FAR_OFF <= square.mean <= square.dof * FAR_OFF


def unused(run: Run) -> str | None:
    """What became of the detections of `run` where not one was used; None where one was, or there are none."""
    updates = run.tables["updates"]
    if not updates.num_rows or np.isin(updates["disposition"], USED).any():
        return None
    fates = zip(*np.unique(updates["disposition"], return_counts=True), strict=True)
    return f"none of the {updates.num_rows} detections was used ({', '.join(f'{n} {fate}' for fate, n in fates)})"


def _changed(run: Run) -> Iterator[Caution]:
    """Whether the files of a finished run are those that it has written."""
    if run.path is not None and run.meta.get("complete") and digest(run.path) != run.meta.get("digest"):
        yield Caution("tracks.csv or updates.csv", "changed since the run: the digest is another; repeat the run")


def _clocks(run: Run) -> Iterator[Caution]:
    for sensor, mine in _by_sensor(run.tables["updates"]):
        if (run.tables["updates"]["stamp_ns"][mine] == 0).all():
            text = (
                "all stamps are 0: its driver does not set them, so nothing is known of its delay; "
                f"`stamp_from: receipt` on its topic, or sensors.{sensor}.stamp_from, takes the receipt for the stamp"
            )
            yield Caution(sensor, text, {f"sensors.{sensor}.stamp_from": "receipt"})
        receipts_ns = np.unique(run.tables["updates"]["receipt_ns"][mine])
        if unit := wrong_unit(len(receipts_ns), int(receipts_ns[0]), int(receipts_ns[-1])):
            yield Caution(sensor, unit)


def _angles(run: Run) -> Iterator[Caution]:
    """Angles that were recorded in degrees and read as radians."""
    by_sensor = ((sensor, run.tables["detections"], mine) for sensor, mine in _by_sensor(run.tables["detections"]))
    for about, table, mine in [(EGO, run.tables["ego"], slice(None)), *by_sensor]:
        for name in ANGULAR:
            values = table[name][mine] if name in table else np.empty(0)
            finite = values[np.isfinite(values)]
            found = in_degrees(about, name, float(finite.min(initial=0.0)), float(finite.max(initial=0.0)))
            yield from () if found is None else (found,)


def _ego(run: Run) -> Iterator[Caution]:
    """No ego where it is needed, or reasons for which more than half of its states were refused."""
    failed = [f"{count} of {total} of {sensor}" for sensor, fate, count, total in _mostly(run) if fate == "failed"]
    if run.tables["ego"].num_rows:
        if jumps := run.meta.get("ego_jumps"):
            text = (
                f"its place jumps {jumps} times, as where a clock is set or a localisation starts anew: what is seen "
                "from it is misplaced there, cut the recording in parts"
            )
            yield Caution(EGO, text.replace("1 times", "once") if jumps == 1 else text)
        for reason, count in dict(run.meta.get("ego_refused") or {}).items():
            if 2 * count > run.tables["ego"].num_rows:
                states = f"{count} of {run.tables['ego'].num_rows} states"
                text = f"{states} not used, {reason}: look at the clock of its driver"
                yield Caution(EGO, text)
    elif failed:
        text = f"no state was received, so nothing in its frame can be placed ({', '.join(failed)} failed)"
        yield Caution(EGO, f"{text}: {_NAME_EGO}")
    elif _ego_speeds_births(run):
        text = (
            "no state was received, so new objects are assumed to stand still, and what the sensors could see is not "
            f"known: {_NAME_EGO}, or set birth.ego_speed_factor to 0"
        )
        yield Caution(EGO, text, _STANDING)


def _map(run: Run) -> Iterator[Caution]:
    """No map where new objects are as fast as the ego, in its direction."""
    if not _ego_speeds_births(run) or _section(run, "map").get("track") not in (None, OPEN_SPACE):
        return
    measured = run.tables["detections"]
    blind = [sensor for sensor, mine in _by_sensor(measured) if not np.isfinite(measured["yaw_rad"][mine]).any()]
    if blind:
        text = (
            f"there is none, and no heading from {', '.join(blind)}: new objects may drive in any direction; name the "
            "map with --map (`oval` for the simulated races), or set birth.ego_speed_factor to 0 for open space"
        )
        yield Caution("map", text, _STANDING)


def _ego_speeds_births(run: Run) -> bool:
    """Whether new objects are assumed to be as fast as the ego, or nearly."""
    return bool(run.tables["updates"].num_rows and _section(run, "birth").get("ego_speed_factor"))


def _mostly(run: Run) -> Iterator[tuple[str, str, int, int]]:
    """Sensors of which more than half of the detections were not used for one reason: it, how many, and of how many."""
    for sensor, mine in _by_sensor(run.tables["updates"]):
        for fate, count in zip(*np.unique(run.tables["updates"]["disposition"][mine], return_counts=True), strict=True):
            if fate not in USED and 2 * count > mine.sum():
                yield sensor, str(fate), int(count), int(mine.sum())


def _lost(run: Run) -> Iterator[Caution]:
    """Dispositions that hit more than half of the detections of a sensor, where nothing else tells it already."""
    for sensor, fate, count, total in _mostly(run):
        unset = (
            fate == "too_old" and not run.tables["updates"]["stamp_ns"][run.tables["updates"]["sensor"] == sensor].any()
        )
        if unset or (fate == "failed" and not run.tables["ego"].num_rows):
            continue
        told = {"sensor": sensor, "because": because((run.meta.get("out_of_bounds") or {}).get(sensor, {}))}
        cure = _too_old(run, sensor) if fate == "too_old" else _CURES[fate].format_map(told)
        yield Caution(sensor, f"{count} of {total} {fate}: {cure}")


def _too_old(run: Run, sensor: str) -> str:
    mine = run.tables["updates"]["sensor"] == sensor
    delay_s = (
        float(np.median(run.tables["updates"]["receipt_ns"][mine] - run.tables["updates"]["stamp_ns"][mine])) / NS_PER_S
    )
    limit_s = (_section(run, "sensors").get(sensor) or {}).get("max_delay_s")
    if limit_s is not None and delay_s > limit_s:
        cure = f"raise sensors.{sensor}.max_delay_s or correct its clock"
        return f"median delay {delay_s:.3g} s, allowed {limit_s:g} s: {cure}"
    window, lag_s = _told_window(run)
    if delay_s > lag_s:
        return f"median delay {delay_s:.3g} s, older than {window}: raise it, or correct the clock"
    if run.meta.get("estimator") == "drop":
        return (
            f"median delay {delay_s:.3g} s, and `drop` ignores by design what is older than the newest detection that "
            "a track has fused, whatever the window: use an estimator that fuses it, such as ekf-replay"
        )
    return (
        f"median delay {delay_s:.3g} s, within {window}: no track is as old as these detections, check births, gate "
        "and clock"
    )


def _window(run: Run) -> Iterator[Caution]:
    """A window that holds less than two lists of a sensor."""
    window, lag_s = _told_window(run)
    for sensor, mine in _by_sensor(run.tables["updates"]):
        stamps_ns = np.unique(run.tables["updates"]["stamp_ns"][mine])
        if len(stamps_ns) < FEWEST:
            continue
        period_s = float(np.median(np.diff(stamps_ns))) / NS_PER_S
        if lag_s < period_s:
            yield Caution(sensor, f"one list every {period_s:.3g} s, longer than {window}: raise it")


def _failures(run: Run) -> Iterator[Caution]:
    """What failed inside the estimator; damped steps alone are none: with bearings they belong to the work."""
    counts = {kind: n for kind, n in dict(run.meta.get("failures") or {}).items() if n and kind != Failure.STEP_DAMPED}
    if counts:
        first = run.meta.get("first_failure")
        cure = "what these tracks say is worth less; look at the noise and the starts, or take another estimator"
        if counts.keys() == {Failure.DIVERGED}:
            cure = f"{IN_A_ROW} measurements in a row contradicted a track: look at NIS by sensor, clocks and noise"
        text = f"failures: {', '.join(f'{n} {kind}' for kind, n in counts.items())}"
        yield Caution("estimator", f"{text}{f' (the first one: {first})' if first else ''}: {cure}")


def _lives(run: Run) -> Iterator[Caution]:
    """Tracks that break off and begin again, and births that die unconfirmed: bad tracking that needs no truth."""
    lives, now_ns = Lives.of(run), run.tables["timing"]["now_ns"]
    total, recorded_s = len(lives.lives_s), float(np.ptp(now_ns)) / NS_PER_S if len(now_ns) else 0.0
    enough = lives.breaks >= max(_FEWEST_BREAKS, _BREAKS_SHARE * total)
    if enough and lives.breaks_per_minute > MOST_BREAKS_PER_MINUTE:
        text = (
            f"{lives.breaks} of {total} confirmed tracks begin where another one has just ended: "
            f"{lives.breaks_per_minute:.2g} breaks per object and minute, median life {lives.median_s:.2g} of "
            f"{recorded_s:.3g} s; likely causes: a field of view or range larger than what a sensor covers, "
            f"detection_probability, lifecycle.lifetime_s, noise; `{_advise(run)}` looks for them"
        )
        yield Caution("tracks", text)
    used = int(np.isin(run.tables["updates"]["disposition"], USED).sum())
    dead = int(np.count_nonzero(run.tables["updates"]["disposition"] == "birth")) - total
    if used >= FEWEST and dead > _DEAD_SHARE * used:
        text = (
            f"{dead} of {used} detections used began a track that was never confirmed; likely causes: clutter, errors "
            f"or motion larger than configured, a wrong ego or clock; `{_advise(run)}` looks for them"
        )
        yield Caution("tracks", text)


def _told_window(run: Run) -> tuple[str, float]:
    """The window with the key that sets its length, and its length; runs of older versions do not say them."""
    found = run.meta.get("effective") or {}
    if "lag_key" not in found:
        return "the window", np.inf
    return f"the window ({found['lag_key']} {found['lag_s']:g} s)", float(found["lag_s"])


def _section(run: Run, name: str) -> Mapping[str, Any]:
    return run.config.get(name) or {}


def _by_sensor(updates: Table) -> Iterator[tuple[str, Any]]:
    for sensor in np.unique(updates["sensor"]).tolist():
        yield sensor, updates["sensor"] == sensor
