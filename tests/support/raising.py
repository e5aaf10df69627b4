"""Fault injection: a call of a method of a running tracker that raises."""

import traceback
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fgtrack.config.reading import read_config
from fgtrack.core.types import Detection, DetectionList, FloatArray
from fgtrack.estimation.base import Measurement, UpdateResult, UpdateStatus
from fgtrack.estimation.filters.stepwise_replay import StepwiseReplay
from fgtrack.estimation.filters.track_initiation import Initiated
from fgtrack.estimation.registry import ESTIMATORS, Claims
from fgtrack.models.measurement import MeasurementModel
from fgtrack.models.sensors import SensorModel
from fgtrack.pipeline.live import Tracker

START_NS = 1_600_000_000_000_000_000
MS = 1_000_000
ERRORS = (
    ValueError,
    KeyError,
    MemoryError,
    FloatingPointError,
    np.linalg.LinAlgError,
    ZeroDivisionError,
)
SENSORS = {
    "lidar": SensorModel(std={"x_m": 0.3, "y_m": 0.3}, clutter_per_m2=1e-4),
    "radar": SensorModel(
        std={"range_m": 0.5, "bearing_rad": 0.01, "range_rate_mps": 0.3},
        clutter_per_m2=1e-4,
    ),
    "mixed": SensorModel(
        std={"x_m": 0.3, "y_m": 0.3, "yaw_rad": 0.1, "speed_mps": 0.5},
        clutter_per_m2=1e-4,
    ),
}
NUM_OBJECTS = 4
FUSED = (
    UpdateStatus.IN_SEQUENCE,
    UpdateStatus.OUT_OF_SEQUENCE,
    UpdateStatus.BEYOND_WINDOW,
)


def place_m(number: int, time_s: float) -> tuple[float, float]:
    """Position of an object, 200 m from any other one."""
    return 50.0 + 10.0 * time_s, 200.0 * number - 300.0


def lists(num_ticks: int) -> list[list[DetectionList]]:
    """The lists of each tick: late and in order, with classes, one object that comes and one that goes."""
    ticks = []
    for k in range(num_ticks):
        now_ns, messages = START_NS + 100 * k * MS, list[DetectionList]()
        for sensor, late_ms in (("lidar", 150), ("radar", 90), ("mixed", 0)):
            if k < 2 and late_ms:
                continue
            time_s = 0.1 * k - 1e-3 * late_ms
            items = []
            for number in range(NUM_OBJECTS):
                if (number == 2 and k < 4) or (number == 3 and k > 6):
                    continue
                x_m, y_m = place_m(number, time_s)
                if sensor == "radar":
                    polar = {
                        "range_m": float(np.hypot(x_m, y_m)),
                        "bearing_rad": float(np.arctan2(y_m, x_m)),
                    }
                    items.append(
                        Detection(**polar, range_rate_mps=10.0 * x_m / polar["range_m"])
                    )
                elif sensor == "mixed":
                    yaw_rad = 0.0 if number % 2 else None
                    items.append(
                        Detection(
                            x_m,
                            y_m,
                            yaw_rad,
                            10.0,
                            class_name="car",
                            id=f"object {number}",
                        )
                    )
                else:
                    items.append(Detection(x_m, y_m))
            stamp_ns = now_ns - late_ms * MS
            messages.append(
                DetectionList(sensor, stamp_ns, now_ns, tuple(items), "map")
            )
        ticks.append(messages)
    return ticks


def make(estimator: str, **settings: object) -> Tracker:
    """A live tracker of the `SENSORS`."""
    config = read_config(None, {"estimator": estimator, **settings})
    return Tracker(config.__class__(**{**vars(config), "sensors": SENSORS}))


@dataclass(frozen=True)
class Point:
    """A method that may raise."""

    owner: Any
    name: str

    def __str__(self) -> str:
        owner = self.owner if isinstance(self.owner, type) else type(self.owner)
        return f"{owner.__name__}.{self.name}"


def points(tracker: Tracker) -> list[Point]:
    """All methods of the parts of `tracker` that a tick may call."""
    parts = tracker._tracker._parts
    bank, factory = parts.bank._bank, ESTIMATORS.load(tracker.config.estimator)
    owners: list[tuple[Any, str]] = [
        (bank, "advance states_at states_of update birth remove present smoothed"),
        (parts.lifecycle, "born matched fused missed expired forget"),
        (parts.objects, "learn evidence forget is_stray former describes owner"),
        (parts.preprocess, "together posed"),
        (parts.ego, "pose_at start_tick"),
        (type(parts.birth), "prior"),
        (type(parts.association), "__call__"),
        (type(parts.motion), "predict jacobian process_noise transition kinematic"),
        (MeasurementModel, "linearised predict jacobian residual"),
    ]
    if not getattr(factory, "bank", False):
        owners.append((factory, "update state_at advance"))
    if hasattr(bank, "solver"):
        owners.append(
            (type(bank.solver), "fuse solve states_at damp iterate relinearise begin")
        )
        owners.append(
            (
                type(bank.solver.nodes),
                "linearise linearise_factors note windows transition begin_window",
            )
        )
    if hasattr(bank, "_rows") and hasattr(bank, "_allocate"):
        owners.append((bank, "_allocate _fused _fused_outside _keep_outside"))
        owners.append((StepwiseReplay, "fused _replay_step _expected"))
    return [
        Point(owner, name)
        for owner, names in owners
        for name in names.split()
        if hasattr(owner, name)
    ]


class Fault:
    """The call number `at` of a method raises what `error` makes; 0 for none."""

    def __init__(
        self, point: Point, at: int, error: type[BaseException] = ValueError
    ) -> None:
        self.point, self.at, self.error = point, at, error
        self.calls = 0
        """Number of calls so far."""
        self.paused = False
        """True while the test itself asks."""
        self.raised = False
        self.in_trial = False
        """True if it has raised while `Initiated` tried to start again along a line. The measurement is fused then, and
        the present estimator stays: its state is another one, and agrees with the report."""
        self.early_calls = 0
        """Calls before the last ticks."""

    def __enter__(self) -> "Fault":
        owner, name = self.point.owner, self.point.name
        own = getattr(owner, name)
        self._kept = vars(owner).get(name)

        def called(*arguments: Any, **named: Any) -> Any:
            self.calls += not self.paused
            if self.calls == self.at and not self.paused and not self.raised:
                self.raised = True
                names = {each.name for each in traceback.extract_stack()}
                self.in_trial = Initiated._begin_again.__name__ in names
                raise self.error("injected")
            return own(*arguments, **named)

        self._set(called)
        return self

    def __exit__(self, *_: object) -> None:
        if self._kept is None:
            delattr(self.point.owner, self.point.name)
        else:
            self._set(self._kept)

    def _set(self, value: Any) -> None:
        set_ = (
            type.__setattr__
            if isinstance(self.point.owner, type)
            else object.__setattr__
        )
        set_(self.point.owner, self.point.name, value)


#: Covariance intersection may give a late measurement the weight 0.
WEIGHING = ("ci",)
Key = tuple[str, int, int]
States = dict[int, tuple[FloatArray, FloatArray]]
"""State and covariance of each object that has a track."""


@dataclass
class Outcome:
    """A run: what each tick gives."""

    rows: list[tuple[Key, str]] = field(default_factory=list)
    """Detections and their dispositions, in order of report."""
    states: list[States | None] = field(default_factory=list)
    """After each tick; None for a tick that raised."""
    failures: dict[str, int] = field(default_factory=dict)
    first_failure: str | None = None
    raised: list[str] = field(default_factory=list)
    """Exceptions that came out of ticks."""
    lies: list[str] = field(default_factory=list)
    """Updates whose status and state do not agree."""

    def of(self, number: int) -> list[tuple[Key, str]]:
        """Rows of one object."""
        return [row for row in self.rows if numbers(row[0])[row[0][2]] == number]


def numbers(key: Key) -> list[int]:
    """Objects of the list that a detection is of, in order."""
    sensor, stamp_ns, _ = key
    late_ms = {"lidar": 150, "radar": 90, "mixed": 0}[sensor]
    k = round((stamp_ns - START_NS) / MS + late_ms) // 100
    return [
        each
        for each in range(NUM_OBJECTS)
        if not ((each == 2 and k < 4) or (each == 3 and k > 6))
    ]


def object_at(y_m: float) -> int:
    """Number of the object nearest to a position."""
    return round((y_m + 300.0) / 200.0)


def run(tracker: Tracker, *faults: Fault, num_ticks: int = 12) -> Outcome:
    """Run `lists` through a tracker, and one tick more without any; watch what its bank does."""
    outcome, guard = Outcome(), tracker._tracker._parts.bank
    update, claims = guard.update, Claims.of(ESTIMATORS.load(tracker.config.estimator))

    def asked(
        track_ids: Sequence[int], stamp_ns: int
    ) -> dict[int, tuple[FloatArray, FloatArray]]:
        known: dict[int, tuple[FloatArray, FloatArray]] = {}
        for at_ns in (guard.present_ns, stamp_ns):
            states = guard._bank.states_at(at_ns)
            for row, each in enumerate(states.track_ids):
                known[each if at_ns == stamp_ns else -1 - each] = (
                    states.means[row],
                    states.covariances[row],
                )
        return {
            each: known[each] for each in known if max(each, -1 - each) in track_ids
        }

    def pause(paused: bool) -> None:
        for fault in faults:
            fault.paused = paused

    def watched(
        stamp_ns: int, track_ids: Sequence[int], measurements: Sequence[Measurement]
    ) -> list[UpdateResult]:
        pause(True)
        before = asked(track_ids, stamp_ns)
        pause(False)
        results = update(stamp_ns, track_ids, measurements)
        pause(True)
        after = asked(track_ids, stamp_ns)
        for track_id, result in zip(track_ids, results, strict=True):
            same = all(
                np.allclose(a, b, rtol=1e-9, atol=1e-9)
                for each in (track_id, -1 - track_id)
                for a, b in zip(before.get(each, ()), after.get(each, ()), strict=False)
            )
            may_stay = claims.held_s or tracker.config.estimator in WEIGHING
            if result.status in FUSED and (
                track_id not in after or (same and not may_stay)
            ):
                outcome.lies.append(
                    f"track {track_id} is {result.status}, but its state is as before, or gone"
                )
            if result.status not in FUSED and track_id in after and not same:
                outcome.lies.append(
                    f"track {track_id} is {result.status}, but its state has changed"
                )
        pause(False)
        return results

    guard.update = watched  # type: ignore[method-assign]
    for k, messages in enumerate([*lists(num_ticks), []]):
        for message in messages:
            tracker.receive(message)
        if k == num_ticks - 3:
            for fault in faults:
                fault.early_calls = fault.calls
        try:
            report = tracker.tick(START_NS + 100 * k * MS)
        except BaseException as error:
            outcome.raised.append(f"{k}: {type(error).__name__}: {error}")
            outcome.states.append(None)
            continue
        outcome.rows += [
            ((row.sensor, row.stamp_ns, row.index), row.disposition.value)
            for row in report.updates
        ]
        outcome.states.append(
            {
                object_at(each.y_m): (each.state.mean, each.state.covariance)
                for each in report.tracks
            }
        )
    outcome.failures = {
        name: count for name, count in tracker.failures.items() if count
    }
    outcome.first_failure = tracker._tracker.failures.first
    del guard.update
    return outcome


def problems(
    reference: Outcome, faulty: Outcome, fault: Fault, tolerance: float
) -> list[str]:
    """What is wrong with a run in which something was raised."""
    result = list(faulty.lies)
    twice = [
        each
        for each, count in Counter(each for each, _ in faulty.rows).items()
        if count > 1
    ]
    missing = {each for each, _ in reference.rows} - {each for each, _ in faulty.rows}
    result += [f"twice: {twice}"] if twice else []
    result += [f"missing: {sorted(missing)}"] if missing else []
    may_raise = fault.error in (MemoryError, KeyboardInterrupt)
    result += [f"raised {faulty.raised}"] if len(faulty.raised) > may_raise else []
    if (
        fault.raised
        and faulty.rows != reference.rows
        and not faulty.failures
        and not faulty.raised
    ):
        result.append("something failed, and no failure is counted")
    first = str(faulty.first_failure)
    if faulty.failures and not ("injected" in first or "could not be fused" in first):
        result.append(
            f"the first failure is {faulty.first_failure}, of {faulty.failures}"
        )
    if (
        faulty.failures.keys() & {"not finite", "not positive definite"}
        and fault.error is not KeyboardInterrupt
    ):
        result.append(f"{faulty.failures}")
    for number in range(NUM_OBJECTS):
        if fault.in_trial or faulty.of(number) != reference.of(number):
            continue
        for k, (own, other) in enumerate(
            zip(reference.states, faulty.states, strict=True)
        ):
            if other is None or number not in own or number not in other:
                continue
            equal = all(
                a.tobytes() == b.tobytes()
                if tolerance == 0.0
                else np.allclose(a, b, tolerance, tolerance)
                for a, b in zip(own[number], other[number], strict=True)
            )
            if not equal:
                result.append(
                    f"object {number} differs at tick {k}, though its detections are as in the other run"
                )
                break
    if (
        faulty.states[-1] is None
        or faulty.states[-1].keys() != reference.states[-1].keys()
    ):  # type: ignore[union-attr]
        result.append(
            f"at the end there are {faulty.states[-1] and sorted(faulty.states[-1])}"
        )
    return result
