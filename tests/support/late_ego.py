"""A winding drive past an object, with an ego whose messages come late."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from fgtrack.config.settings import Config
from fgtrack.core.types import Detection, DetectionList, EgoState, FloatArray
from fgtrack.models.sensors import SensorModel
from fgtrack.pipeline.build import build_tracker
from fgtrack.pipeline.clock import clock_ticks, with_last

START_NS = 1_000_000_000_000
_STEP_S = 0.005


@dataclass(frozen=True)
class Drive:
    """An ego on a winding road, and an object that it measures."""

    speed_mps: float = 13.0
    yaw_rate_radps: float = 0.15
    """Amplitude of the yaw rate; 0 is a straight road."""
    period_s: float = 6.3
    """Period of the bends."""
    range_m: float = 60.0
    """First distance of the object."""
    list_hz: float = 10.0
    noise_m: float = 0.1
    delay_s: float = 0.05
    """Delay of the lists."""
    ego_hz: float = 50.0
    late_s: float = 0.3
    """Delay of the ego messages."""
    jitter_s: float = 0.0
    """Largest further delay of an ego message."""
    duration_s: float = 12.0
    ego_from_s: float = -1.0
    ego_until_s: float = math.inf


@dataclass
class Heard:
    """Messages in the order of their receipt, and the true positions of the object."""

    messages: list[EgoState | DetectionList]
    position_m: Callable[[float], FloatArray]


def drive(given: Drive, seed: int) -> Heard:
    """Return a drive; the object moves with the process noise of the default motion model."""
    rng = np.random.default_rng(seed)
    t = np.arange(-1.5, given.duration_s + 2.0, _STEP_S)
    w, phase = 2.0 * math.pi / given.period_s, rng.uniform(0.0, 2.0 * math.pi)
    yaws = given.yaw_rate_radps / w * np.sin(w * t + phase)
    rates = given.yaw_rate_radps * np.cos(w * t + phase)
    xs, ys = (
        np.cumsum(given.speed_mps * turn(yaws)) * _STEP_S for turn in (np.cos, np.sin)
    )

    def ego_at(time_s: float) -> tuple[float, float, float, float]:
        x_m, y_m, yaw_rad, rate_radps = (
            float(np.interp(time_s, t, each)) for each in (xs, ys, yaws, rates)
        )
        return x_m, y_m, yaw_rad, rate_radps

    x_m, y_m, yaw_rad, _ = ego_at(0.0)
    speed_mps, turn_radps, bearing_rad = given.speed_mps, 0.0, rng.uniform(-0.5, 0.5)
    at = np.array(
        [
            x_m + given.range_m * math.cos(bearing_rad),
            y_m + given.range_m * math.sin(bearing_rad),
        ]
    )
    times, positions = np.arange(0.0, given.duration_s + 1.0, _STEP_S), []
    for _ in times:
        positions.append(at.copy())
        shift = speed_mps * _STEP_S * np.array([math.cos(yaw_rad), math.sin(yaw_rad)])
        noise = math.sqrt(_STEP_S) * rng.normal(size=5) * [0.03, 0.03, 0.01, 1.5, 0.2]
        at, yaw_rad = at + shift + noise[:2], yaw_rad + turn_radps * _STEP_S + noise[2]
        speed_mps, turn_radps = speed_mps + noise[3], turn_radps + noise[4]
    path = np.array(positions)

    def position_m(time_s: float) -> FloatArray:
        return np.array([np.interp(time_s, times, path[:, k]) for k in range(2)])

    heard: list[EgoState | DetectionList] = []
    for k in range(math.ceil((given.duration_s + 1.0) * given.ego_hz)):
        time_s = k / given.ego_hz - 1.0
        if given.ego_from_s <= time_s <= given.ego_until_s:
            receipt_s = (
                time_s
                + given.late_s
                + (rng.uniform(0.0, given.jitter_s) if given.jitter_s else 0.0)
            )
            x_m, y_m, yaw_rad, rate_radps = ego_at(time_s)
            heard.append(
                EgoState(
                    _ns(time_s),
                    _ns(receipt_s),
                    x_m,
                    y_m,
                    yaw_rad,
                    given.speed_mps,
                    rate_radps,
                )
            )
    for k in range(math.ceil(given.duration_s * given.list_hz)):
        time_s = k / given.list_hz
        x_m, y_m, yaw_rad, _ = ego_at(time_s)
        (dx, dy), c, s = (
            position_m(time_s) - (x_m, y_m),
            math.cos(yaw_rad),
            math.sin(yaw_rad),
        )
        noise_m = given.noise_m * rng.normal(size=2)
        seen = Detection(
            x_m=c * dx + s * dy + noise_m[0], y_m=c * dy - s * dx + noise_m[1]
        )
        heard.append(
            DetectionList(
                "lidar", _ns(time_s), _ns(time_s + given.delay_s), (seen,), "ego"
            )
        )
    return Heard(sorted(heard, key=lambda message: message.receipt_ns), position_m)


def _ns(time_s: float) -> int:
    return START_NS + round(time_s * 1e9)


@dataclass
class Outcome:
    """What a tracker made of a drive."""

    nees: float
    """Mean of the NEES of the position over the ticks from 3 s on."""
    rmse_m: float
    tracked: float
    """Share of these ticks with a confirmed track."""
    dispositions: list[str] = field(default_factory=list)


def followed(
    given: Drive, seed: int, estimator: str = "ekf-replay", **settings: object
) -> Outcome:
    """Track a drive with the noise that it has; `settings` are those of the ego."""
    sensors = {"lidar": SensorModel(std={"x_m": given.noise_m, "y_m": given.noise_m})}
    config = replace(Config(sensors=sensors), estimator=estimator)
    config = config.replace({"motion.kind": "ctrv"})  # as the object moves
    config = config.replace({f"ego.{name}": value for name, value in settings.items()})
    tracker, heard, outcome = (
        build_tracker(config),
        drive(given, seed),
        Outcome(math.nan, math.nan, 0.0),
    )
    squares, nees, ticks = list[float](), list[float](), 0
    for tick, is_last in with_last(clock_ticks(heard.messages, config.clock.node_hz)):
        for message in tick.messages:
            tracker.receive(message)
        report = tracker.tick(tick.now_ns, is_last)
        outcome.dispositions += [str(update.disposition) for update in report.updates]
        time_s = (tick.now_ns - START_NS) / 1e9
        if not 3.0 <= time_s <= given.duration_s:
            continue
        ticks += 1
        truth_m = heard.position_m(time_s)
        confirmed = [each for each in report.tracks if each.status != "tentative"]
        if confirmed:
            errors = [np.array([each.x_m, each.y_m]) - truth_m for each in confirmed]
            k = int(np.argmin(np.linalg.norm(errors, axis=1)))
            squares.append(float(errors[k] @ errors[k]))
            nees.append(
                float(
                    errors[k]
                    @ np.linalg.solve(confirmed[k].covariance[:2, :2], errors[k])
                )
            )
    if nees:
        outcome.nees, outcome.rmse_m = float(np.mean(nees)), math.sqrt(np.mean(squares))
        outcome.tracked = len(nees) / ticks
    return outcome
