"""Simulated streams, each as measurements for estimators, and as sightings for the oracle."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
from support.oracle import (
    Dynamics,
    Eye,
    Problem,
    Sighting,
    Solution,
    Vehicle,
    kinematic_start,
    mounted,
    seen,
    smoothed,
)

from fgtrack.core.time import NS_PER_S, nanoseconds
from fgtrack.core.types import Detection, DetectionList, EgoState, FloatArray, Frame
from fgtrack.estimation.base import Measurement, Start
from fgtrack.models.measurement import measurement_model
from fgtrack.models.motion import CTRA, CTRV, CV, MotionModel
from fgtrack.models.road import Road
from fgtrack.models.sensors import Mount, RobustLoss, SensorModel
from fgtrack.tracking.detections import NoMerge
from fgtrack.tracking.ego.trajectory import EgoTrajectory
from fgtrack.tracking.inbox import Batch
from fgtrack.tracking.preprocess import Preprocess

_START_NS = NS_PER_S
_RADAR_PHASE_S = 0.023
_POSITION = ("x_m", "y_m")
_LOSS_WIDTH = 1.5

#: A fast car that begins to turn; one that passes a yaw of pi before a turning observer.
FAST = Start(
    stamp_ns=_START_NS,
    position_m=(20.0, -5.0),
    yaw_rad=0.6,
    yaw_std_rad=0.35,
    speed_mps=65.0,
    speed_std_mps=3.0,
    yaw_rate_radps=0.1,
    yaw_rate_std_radps=0.1,
)
_TURNING = replace(
    FAST,
    position_m=(30.0, 12.0),
    yaw_rad=3.0,
    yaw_std_rad=0.2,
    speed_mps=12.0,
    yaw_rate_radps=0.5,
)


#: Seen from the observer: its detections' frame, and the pose of its RADAR in that frame. The object is behind it.
_FRAME_M = (-1.2, 0.3)
_ARM = Mount(4.9, 0.6, -1.86)
_PAPER = {
    "lidar_cluster": SensorModel(std={"x_m": 0.3, "y_m": 0.3}),
    "radar": SensorModel(std={"x_m": 3.0, "y_m": 3.0, "speed_mps": 0.2}),
}
_ONBOARD: Mapping[str, SensorModel] = {
    "lidar_cluster": SensorModel(std={"x_m": 0.5, "y_m": 0.2, "yaw_rad": 0.15}),
    "radar": SensorModel(
        std={"range_m": 0.5, "bearing_rad": 0.02, "range_rate_mps": 0.1}, mount=_ARM
    ),
}


@dataclass(frozen=True)
class Stream:
    """Measurements in the order of their stamps, and their order of arrival."""

    motion: MotionModel
    prior: Start
    measurements: tuple[Measurement, ...]
    sightings: tuple[Sighting, ...]
    """The same as `measurements`, for the oracle."""
    order: Sequence[int]
    """Order of arrival."""
    lag_s: float

    @property
    def newest_ns(self) -> int:
        """Stamp of the last measurement."""
        return self.measurements[-1].stamp_ns

    def probes_ns(self) -> list[int]:
        """Stamps of nodes inside the window and one between them."""
        oldest_ns = self.newest_ns - nanoseconds(0.9 * self.lag_s)
        past = [m.stamp_ns for m in self.measurements if m.stamp_ns >= oldest_ns]
        return sorted(
            {*past[:: max(len(past) // 5, 1)], (past[0] + self.newest_ns) // 2}
        )

    @cached_property
    def problem(self) -> Problem:
        """The same, for the oracle."""
        return problem_of(self.motion, self.prior, self.sightings)

    @cached_property
    def solution(self) -> Solution:
        """The oracle's least squares."""
        return smoothed(self.problem)


def problem_of(
    motion: MotionModel, prior: Start, sightings: Sequence[Sighting]
) -> Problem:
    """What the oracle is given: a model of fgtrack, a start whose entries are not correlated, sightings."""
    values = (
        *prior.position_m,
        prior.yaw_rad or 0.0,
        prior.speed_mps,
        prior.yaw_rate_radps,
        prior.accel_mps2,
    )
    std = (
        prior.position_std_m,
        prior.position_std_m,
        prior.yaw_std_rad or 0.0,
        prior.speed_std_mps,
    )
    start = kinematic_start(
        motion.state_names,
        values,
        (*std, prior.yaw_rate_std_radps, prior.accel_std_mps2),
    )
    names = motion.density_names() if isinstance(motion, CTRV | CV) else ()
    density = {name.partition("_density_")[0]: getattr(motion, name) for name in names}
    dynamics = Dynamics.of(motion.state_names, density)
    if isinstance(motion, CTRV):
        relaxation_hz = (
            0.5 * motion.yaw_rate_density_rad2ps3 / motion.yaw_rate_std_radps**2
        )
        dynamics = replace(
            dynamics,
            relaxation_hz=relaxation_hz,
            slow_mps=motion.slow_mps,
            resting_yaw=motion.resting_yaw_rad2ps,
        )
    return Problem(dynamics, prior.stamp_ns, start, tuple(sightings))


# A sensor measures the state x at a stamp.
Sense = Callable[
    [np.random.Generator, FloatArray, int, str], tuple[Measurement, Sighting]
]
Plan = tuple[FloatArray, npt.NDArray[np.str_]]


def linear(rng: np.random.Generator) -> Stream:
    """Positions of the paper's LiDAR and RADAR in a linear model."""
    return drawn(rng, CV(), paper_stamps(1.2), lag_s=1.0, reach_s=0.95)


def whole(rng: np.random.Generator) -> Stream:
    """A car at 65 m/s in a bend, the RADAR with its speed; shorter than the window."""
    return drawn(rng, CTRV(), paper_stamps(0.7), lag_s=2.0, reach_s=1.9)


def observed(rng: np.random.Generator) -> Stream:
    """Range, bearing and Doppler of a RADAR far from the centre of an observer that turns, beside a LiDAR with yaw.

    The object passes a yaw of pi, and the RADAR sees it about a bearing of pi. Through the tracker's own preparation.
    """
    stamps_s, sensors = paper_stamps(0.6)
    stamps_s = np.where(stamps_s > 0.3, stamps_s + 0.7, stamps_s)  # nothing for a while
    plan = stamps_s, sensors
    return drawn(
        rng,
        CTRV(),
        plan,
        lag_s=2.0,
        reach_s=1.9,
        start=_TURNING,
        sense=_Onboard(stamps_s),
    )


def robust(rng: np.random.Generator) -> Stream:
    """Outliers among the positions, and a Huber loss."""
    return drawn(
        rng, CTRV(), paper_stamps(0.45), lag_s=2.0, reach_s=1.9, sense=_with_outliers
    )


def accelerated(rng: np.random.Generator) -> Stream:
    """A short stream in CTRA."""
    return drawn(rng, CTRA(), paper_stamps(0.4), lag_s=2.0, reach_s=1.9)


def leaving(rng: np.random.Generator) -> Stream:
    """As `whole`, longer than the window."""
    return drawn(rng, CTRV(), paper_stamps(1.25), lag_s=1.0, reach_s=0.4)


def paper_stamps(duration_s: float) -> Plan:
    """Stamps of LiDAR and RADAR at 20 Hz each, and which is which."""
    rounds = 0.05 * np.arange(1, round(20 * duration_s) + 1)
    stamps_s = np.stack([rounds, rounds + _RADAR_PHASE_S], axis=-1).ravel()
    return stamps_s, np.tile(["lidar_cluster", "radar"], len(rounds))


def paper(
    rng: np.random.Generator, x: FloatArray, stamp_ns: int, sensor: str
) -> tuple[Measurement, Sighting]:
    """What the paper's `sensor` measures of `x`; in a linear model its position only."""
    noise, motion = (
        _PAPER[sensor],
        next(m for m in (CV(), CTRV(), CTRA()) if m.dim == len(x)),
    )
    names = _POSITION if motion.linear else tuple(noise.std)
    std = np.array([noise.std[name] for name in names])
    z = seen(names, x, motion.state_names, Eye()) + std * rng.standard_normal(
        len(names)
    )
    measurement = Measurement(
        stamp_ns, measurement_model(names, motion), z, noise.noise(names)
    )
    return measurement, Sighting(stamp_ns, names, z, np.diag(std**2))


def _with_outliers(
    rng: np.random.Generator, x: FloatArray, stamp_ns: int, sensor: str
) -> tuple[Measurement, Sighting]:
    measurement, sighting = paper(rng, x, stamp_ns, sensor)
    outlier = np.sqrt(np.diag(sighting.R)) * rng.normal(0.0, 8.0, len(sighting.z))
    z = sighting.z + outlier * (rng.random() < 0.2)
    measurement = replace(measurement, z=z, loss=RobustLoss("huber", _LOSS_WIDTH))
    return measurement, replace(sighting, z=z, loss=_LOSS_WIDTH)


class _Onboard:
    """Sensors of an observer that drives on a circle: prepared by the tracker's own code, and by the oracle's."""

    def __init__(self, stamps_s: FloatArray) -> None:
        self._ego = EgoTrajectory(yaw_weight=1.0, yaw_rate_weight=1.0, memory_s=60.0)
        self._prepare = Preprocess(Road(), NoMerge(), CTRV(), _FRAME_M)
        for stamp_s in sorted({0.0, *stamps_s.tolist()}):
            stamp_ns = _START_NS + nanoseconds(stamp_s)
            self._ego.receive(EgoState(stamp_ns, stamp_ns, *_observer(stamp_ns)))

    def __call__(
        self, rng: np.random.Generator, x: FloatArray, stamp_ns: int, sensor: str
    ) -> tuple[Measurement, Sighting]:
        """See `Sense`."""
        model, vehicle = _ONBOARD[sensor], _observer(stamp_ns)
        names, std = tuple(model.std), np.array(list(model.std.values()))
        noise, state_names = std * rng.standard_normal(len(std)), CTRV.state_names
        if sensor == "radar":
            eye = mounted(
                vehicle, _FRAME_M[0] + _ARM.x_m, _FRAME_M[1] + _ARM.y_m, _ARM.yaw_rad
            )
            z = seen(names, x, state_names, eye) + noise
            values = dict(zip(names, z.tolist(), strict=True))
            values["bearing_rad"] = math.remainder(values["bearing_rad"], 2.0 * math.pi)
            measurement = self._prepared(
                Detection(**values), stamp_ns, sensor, "sensor"
            )
            return measurement, Sighting(stamp_ns, names, z, np.diag(std**2), eye)
        eye = mounted(vehicle, *_FRAME_M, 0.0)
        c, s = math.cos(eye.yaw_rad), math.sin(eye.yaw_rad)
        turn = np.array(
            [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]
        )  # map from the frame of detections
        there = turn.T @ (x[:3] - np.array([eye.x_m, eye.y_m, eye.yaw_rad])) + noise
        z = turn @ there + np.array([eye.x_m, eye.y_m, eye.yaw_rad])
        z[2] = math.remainder(z[2], 2.0 * math.pi)
        measurement = self._prepared(
            Detection(*there.tolist()), stamp_ns, sensor, "ego"
        )
        sight = np.eye(3)
        sight[:2, 0] = there[:2] / np.hypot(*there[:2])
        sight[:2, 1] = (
            -sight[1, 0],
            sight[0, 0],
        )  # deviations lie along and across the line of sight
        R = turn @ sight @ np.diag(std**2) @ sight.T @ turn.T
        return measurement, Sighting(stamp_ns, names, z, R)

    def _prepared(
        self, detection: Detection, stamp_ns: int, sensor: str, frame: Frame
    ) -> Measurement:
        batch = Batch(
            DetectionList(sensor, stamp_ns, stamp_ns, [detection], frame),
            stamp_ns,
            (0,),
        )
        [candidate], _ = self._prepare(
            batch, _ONBOARD[sensor], self._ego.pose_at(stamp_ns, stamp_ns)
        )
        return candidate.measurement


def _observer(stamp_ns: int) -> Vehicle:
    """On a circle to the left, at 20 m/s."""
    yaw_rate, speed_mps = 0.4, 20.0
    yaw_rad = -0.3 + yaw_rate * (stamp_ns - _START_NS) / NS_PER_S
    radius_m = speed_mps / yaw_rate
    return Vehicle(
        radius_m * math.sin(yaw_rad),
        -radius_m * math.cos(yaw_rad),
        yaw_rad,
        speed_mps,
        yaw_rate,
    )


def drawn(
    rng: np.random.Generator,
    motion: MotionModel,
    plan: Plan,
    lag_s: float,
    reach_s: float,
    start: Start = FAST,
    sense: Sense = paper,
) -> Stream:
    """Truth with the motion model's own noise, measured as `plan` says; each arrives up to `reach_s` late."""
    stamps_s, sensors = plan
    empty = Stream(motion, start, (), (), (), lag_s)
    dynamics, x = empty.problem.dynamics, empty.problem.start.mean
    measurements, sightings, last_s = list[Measurement](), list[Sighting](), 0.0
    for stamp_s, sensor in zip(stamps_s.tolist(), sensors.tolist(), strict=True):
        if stamp_s > last_s:
            moved = dynamics.move(x, stamp_s - last_s)
            x = moved.mean + np.linalg.cholesky(moved.Q) @ rng.standard_normal(
                motion.dim
            )
            last_s = stamp_s
        measurement, sighting = sense(rng, x, _START_NS + nanoseconds(stamp_s), sensor)
        measurements.append(measurement)
        sightings.append(sighting)
    order = np.argsort(
        stamps_s + rng.uniform(0.0, reach_s, len(stamps_s)), kind="stable"
    ).tolist()
    return Stream(motion, start, tuple(measurements), tuple(sightings), order, lag_s)
