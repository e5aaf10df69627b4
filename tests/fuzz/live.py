"""Feeds a live tracker with messages of which a few values are wrong, and looks at all that it gives.

`main` is a program for `support.server`, so that an abort ends a process of its own.
"""

import logging
import math
import sys
import time
import traceback
import warnings
import zlib
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

import fgtrack
from fgtrack.core.errors import printable
from fgtrack.estimation.failures import Failure
from fuzz import scene, values
from fuzz.scene import Record

ESTIMATORS = (
    "ekf-replay",
    "smoother-banded",
    "smoother",
    "imm-replay",
    "ekf-backward-forward",
    "larsen",
)
#: What a healthy drive is changed in: after its tracks have begun, and long before its end.
CHANGED_S = (0.4, 0.7)
_TICK_NS = 10**8
_SOURCES = ("ego", *scene.SENSORS)
_COUNTS = (1, 1, 2, 3, 4)
_NEAR_M = 4.0
#: Times that no clock gives; the integers among them are before the drive.
_ODD_NS: tuple[Any, ...] = (
    *(
        None,
        math.nan,
        math.inf,
        "1",
        1.5,
        1e18,
        -1,
        2**63,
        2**70,
        -(2**63),
        True,
        [],
        np.array([1, 2]),
        b"1",
    ),
    *(
        0,
        1,
        np.uint64(5),
        np.int32(7),
        scene.START_NS - 3600 * 10**9,
        np.float64(1e18),
        np.array(5),
        object(),
    ),
)
_LONGEST_S, _LONGEST_LINE = 20.0, 300
_HIDDEN = (
    Failure.LIST_FAILED,
    Failure.ESTIMATOR_RAISED,
    Failure.NOT_FINITE,
    Failure.NOT_DEFINITE,
)


@dataclass(frozen=True)
class Case:
    """A sequence of messages, some of them changed. A record may hold what is not a message, under `message`."""

    arrivals: list[Record]
    changes: tuple[str, ...]
    cars: tuple[str, ...]
    """Cars that are seen."""
    kept: frozenset[str]
    """Cars that must keep their tracks: neither their sensor nor the ego was changed."""


def case_of(
    name: str, seed: int, number: int, only: Sequence[int] | None = None
) -> Case:
    """Return case `number` of an estimator; `only` some of its changes, to find the ones that matter."""
    key = [seed, zlib.crc32(name.encode()), number]
    rng = np.random.default_rng(key)
    source = _SOURCES[rng.integers(len(_SOURCES))]
    sensors = _SOURCES[1:] if rng.integers(8) == 0 else ("lidar", source)
    begin_ns, end_ns = (scene.START_NS + round(s * 1e9) for s in CHANGED_S)
    chosen, rest = list[Any](), list[Record]()
    for record in scene.drive(sensors):
        is_chosen = (
            begin_ns <= record["at_ns"] < end_ns
            and record.get("sensor", "ego") == source
        )
        (chosen if is_chosen else rest).append(record)
    said = []
    for k in range(int(_COUNTS[rng.integers(len(_COUNTS))])):
        if only is None or k in only:
            said.append(
                values.change(
                    np.random.default_rng([*key, k]), chosen, of_programs=True
                )
            )
    changed = [
        {"at_ns": begin_ns, **(each if isinstance(each, dict) else {"message": each})}
        for each in chosen
    ]
    arrivals = sorted([*rest, *changed], key=lambda each: each["at_ns"])
    seen = {car: by for car, by in scene.SEEN_BY.items() if by in sensors}
    kept = {
        car
        for car, by in seen.items()
        if by == "lidar" and source not in ("ego", "lidar")
    }
    return Case(arrivals, tuple(said), tuple(seen), frozenset(kept))


def message_of(record: Record) -> Any:
    """Return the message of a record, as a program makes it. Raises what the constructors raise."""
    if "message" in record:
        return record["message"]
    given = {
        key: value
        for key, value in record.items()
        if key not in ("type", values.ARRIVAL)
    }
    if record.get("type") == "ego":
        if _are_floats(given.get("covariance")):
            given["covariance"] = tuple(given["covariance"])
        return fgtrack.EgoState(
            **_required(
                given, "stamp_ns", "receipt_ns", "x_m", "y_m", "yaw_rad", "speed_mps"
            )
        )
    if isinstance(given.get("objects"), list):
        given["objects"] = [_detection_of(item) for item in given["objects"]]
    return fgtrack.DetectionList(
        **_required(given, "sensor", "stamp_ns", "receipt_ns", "objects")
    )


def _detection_of(item: Any) -> Any:
    return fgtrack.Detection(**item) if isinstance(item, dict) else item


def _are_floats(value: Any) -> bool:
    return (
        isinstance(value, list)
        and len(value) == 25
        and all(isinstance(each, float) for each in value)
    )


def _required(given: Record, *names: str) -> Record:
    """`given`, with None for what is left out."""
    return {**dict.fromkeys(names), **given}


def tracker_of(name: str) -> fgtrack.Tracker:
    """Return a tracker of the sensors of the drive."""
    return fgtrack.Tracker(
        fgtrack.Config().replace(sensors=scene.SENSORS), estimator=name
    )


class Told(logging.Handler):
    """Keeps what is logged."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        """See `logging.Handler.emit`."""
        self.lines.append(record.getMessage())


def problems_of(name: str, case: Case) -> Iterator[str]:
    """Yield what is wrong with what a tracker makes of a case."""
    told = Told()
    logging.getLogger().addHandler(told)
    try:
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            yield from _problems(name, case)
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        place = next(
            each
            for each in reversed(traceback.extract_tb(error.__traceback__))
            if "/fuzz/" in each.filename
        )
        yield f"{place.line}: raises {type(error).__name__}: {error!s:.200} ({where.filename}:{where.lineno})"
    finally:
        logging.getLogger().removeHandler(told)
    yield from {
        f"warns {each.category.__name__}: {each.message} ({each.filename}:{each.lineno})"
        for each in warned
    }
    yield from (f"logs {line!r:.300}" for line in told.lines if not _is_line(line))


def _is_line(text: str) -> bool:
    return text.isprintable() and len(text) <= _LONGEST_LINE


def _problems(name: str, case: Case) -> Iterator[str]:
    tracker, began_s = tracker_of(name), time.process_time()
    received, kept = 0, {}
    arrivals = list(case.arrivals)
    begin_ns, last_ns = (
        scene.START_NS + round(CHANGED_S[0] * 1e9),
        arrivals[-1]["at_ns"],
    )
    for now_ns in range(scene.START_NS, last_ns + _TICK_NS, _TICK_NS):
        while arrivals and arrivals[0]["at_ns"] <= now_ns:
            try:
                message = message_of(arrivals.pop(0))
            except (fgtrack.FgtrackError, TypeError) as error:
                if not _is_line(str(error)):
                    yield f"the constructor says {error!s:.200}"
                continue
            tracker.receive(message)
            if isinstance(message, fgtrack.DetectionList):
                received += len(message.objects)
        report = tracker.tick(now_ns)
        yield from _unsound(report)
        if now_ns == begin_ns:
            _ask_oddly(tracker, report)
        if now_ns == begin_ns - _TICK_NS:
            kept = {car: _tracks_near(report, car) for car in case.cars}
            if not all(kept.values()):
                yield f"the drive that is right is not tracked: {kept}"
    for car in case.cars:
        tracks = _tracks_near(report, car)
        if not tracks:
            yield f"does not recover: car {car!r} is not tracked at the end"
        elif car in case.kept and not tracks & kept[car]:
            yield f"loses the track of car {car!r}, which others see"
    _ask(tracker, report)
    tracker.finish()
    tracker.tick(report.now_ns + _TICK_NS)
    counted = sum(sum(counts.values()) for counts in tracker.counts.values())
    if counted != received:
        yield f"{received} detections, {counted} counted: {tracker.counts}"
    yield from (
        f"refuses with {reason!r:.400}"
        for reason in tracker.refused
        if not _is_line(reason)
    )
    if failed := {
        kind: count
        for kind, count in tracker.failures.items()
        if Failure(kind) in _HIDDEN
    }:
        yield f"fails inside: {failed}, {str(tracker.last_failure)[-400:]}"
    if time.process_time() - began_s > _LONGEST_S:
        yield f"takes {time.process_time() - began_s:.0f} s"


def _ask(tracker: fgtrack.Tracker, report: fgtrack.TickReport) -> None:
    """Ask for all that a tracker gives besides its reports."""
    for stamp_ns in (report.now_ns, report.now_ns - 2 * 10**8, report.now_ns + 10**9):
        tracker.tracks_at(stamp_ns)
        for track in report.tracks[:3]:
            with suppress(fgtrack.CallError):
                tracker.state_at(track.track_id, stamp_ns)
    delays_s = [
        each.delay_worst_s
        for each in tracker.lateness.values()
        if each.delay_worst_s is not None
    ]
    assert all(map(math.isfinite, delays_s))
    assert tracker.timing.ticks > 0


def _ask_oddly(tracker: fgtrack.Tracker, report: fgtrack.TickReport) -> None:
    """Ask for impossible times and tracks: each is refused by a `CallError`, or an earlier tick by a count."""
    for odd in _ODD_NS:
        with suppress(fgtrack.CallError):
            again = tracker.tick(odd)
            assert again.now_ns == report.now_ns
            tracker.tick(
                report.now_ns
            )  # several early ticks in a row show that the clock was set back
        for track_id in (odd, *[track.track_id for track in report.tracks[:1]]):
            with suppress(fgtrack.CallError):
                tracker.state_at(track_id, odd)
        with suppress(fgtrack.CallError):
            tracker.tracks_at(odd)


def _unsound(report: fgtrack.TickReport) -> Iterator[str]:
    for track in report.tracks:
        P, scale = track.covariance, np.sqrt(np.abs(np.diag(track.covariance)))
        if not (np.isfinite(track.state.mean).all() and np.isfinite(P).all()):
            yield f"tick {report.tick}: the state of track {track.track_id} is not finite"
            return
        scale[scale == 0.0] = 1.0
        if (
            not np.array_equal(P, P.T)
            or np.linalg.eigvalsh(P / np.outer(scale, scale)).min() < -1e-8
        ):
            yield f"tick {report.tick}: the covariance of track {track.track_id} is not positive definite"
            return
    for update in report.updates:
        if update.nis is not None and not update.nis >= 0.0:
            yield f"tick {report.tick}: NIS {update.nis}"
            return


def _tracks_near(report: fgtrack.TickReport, car: str) -> set[int]:
    x_m, y_m = scene.place_m(car, report.now_ns)
    return {
        each.track_id
        for each in report.tracks
        if math.hypot(each.x_m - x_m, each.y_m - y_m) < _NEAR_M
    }


def healthy() -> Case:
    """Return the drive without a change."""
    return Case(scene.drive(), (), tuple(scene.CARS), frozenset())


def main(words: Sequence[str]) -> int:
    """Run cases until so many values were changed. Each is announced before it begins."""
    name, (seed, number, changes) = words[0], map(int, words[1:])
    while changes > 0:
        case = case_of(name, seed, number)
        count = max(len(case.changes), 1)
        _tell(f"case {number} {count}")
        for problem in problems_of(name, case):
            text = f"{' '.join(problem.split())}  [{'; '.join(_smallest(name, seed, number, case))}]"
            _tell(printable(text))
        number, changes = number + 1, changes - count
    return 0


def _tell(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def _smallest(name: str, seed: int, number: int, case: Case) -> tuple[str, ...]:
    """Return the one change that leads to a problem by itself, else all of them."""
    for k in range(len(case.changes) if len(case.changes) > 1 else 0):
        alone = case_of(name, seed, number, only=(k,))
        if any(problems_of(name, alone)):
            return alone.changes
    return case.changes
