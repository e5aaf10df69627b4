"""Random streams of measurements in random orders of arrival."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fgtrack.core.time import NS_PER_S, seconds
from fgtrack.estimation.base import Measurement, Start
from fgtrack.estimation.birth import initial_state
from fgtrack.models.measurement import SensorPose, measurement_model
from fgtrack.models.motion import CTRV, CV, MotionModel
from fgtrack.models.sensors import RobustLoss

MS, US = 1_000_000, 1_000
LAG_S = 1.0
START = Start(
    stamp_ns=1_790_000_000 * NS_PER_S,
    position_m=(3.0, -2.0),
    position_std_m=0.7,
    yaw_rad=0.4,
    yaw_std_rad=0.3,
    speed_mps=20.0,
    speed_std_mps=3.0,
    yaw_rate_radps=0.1,
)
LINEAR, NONLINEAR = CV(velocity_density_m2ps3=5.0), CTRV()
_POSITION = ("x_m", "y_m")
COMPONENTS = (_POSITION, (*_POSITION, "speed_mps"), (*_POSITION, "yaw_rad"), (*_POSITION, "range_m"))


@dataclass(frozen=True)
class Stream:
    """Measurements of one object in the order of their arrival."""

    motion: MotionModel
    measurements: tuple[Measurement, ...]
    start: Start = START

    @property
    def stamps_ns(self) -> list[int]:
        """Stamps of the start and of the measurements, each once, in order."""
        return sorted({self.start.stamp_ns, *(m.stamp_ns for m in self.measurements)})

    @property
    def newest_ns(self) -> int:
        """The newest stamp."""
        return self.stamps_ns[-1]

    def __str__(self) -> str:
        lines = [f"{type(self.motion).__name__}, measurements in the order of arrival (stamp after the start):"]
        for m in self.measurements:
            values = zip(m.model.components, m.z.tolist(), np.sqrt(np.diag(m.R)).tolist(), strict=True)
            text = ", ".join(f"{name} = {value!r} (std {std:g})" for name, value, std in values)
            lines.append(f"  {seconds(m.stamp_ns - self.start.stamp_ns):.9f} s: {text}")
        return "\n".join(lines)


def measured(
    rng: np.random.Generator, motion: MotionModel, offset_ns: int, names: Sequence[str] = _POSITION
) -> Measurement:
    """`names` of an object that drives straight on, `offset_ns` after the start."""
    travelled_m = 20.0 * seconds(offset_ns)
    x_m, y_m = 3.0 + travelled_m * np.cos(0.4), -2.0 + travelled_m * np.sin(0.4)
    truth = {"x_m": x_m, "y_m": y_m, "yaw_rad": 0.4, "speed_mps": 20.0, "range_m": np.hypot(x_m, y_m)}
    std = np.array([0.1 if name == "yaw_rad" else 0.5 for name in names])
    z = np.array([truth[name] for name in names]) + std * rng.standard_normal(len(names))
    return Measurement(START.stamp_ns + offset_ns, measurement_model(tuple(names), motion), z, np.diag(std**2))


def regular(motion: MotionModel, rng: np.random.Generator, num: int = 12) -> Stream:
    """In time order, every 50 ms; in a nonlinear model now and then with yaw, speed or range."""
    return Stream(motion, tuple(measured(rng, motion, k * 50 * MS, _names(rng, motion)) for k in range(1, num + 1)))


def shuffled(motion: MotionModel, rng: np.random.Generator, span_s: float = 0.95 * LAG_S) -> Stream:
    """3 to 12 measurements in any order within `span_s` after the start; some stamps equal, some 1 us apart."""
    num = int(rng.integers(2, 8))
    offsets = 2 * MS * rng.integers(1, round(span_s * NS_PER_S) // (2 * MS), num)
    again, close = offsets[rng.random(num) < 0.25], offsets[rng.random(num) < 0.25] + US
    all_ns = rng.permutation(np.concatenate([offsets, again, close, offsets[:1] + US]))
    return Stream(motion, tuple(measured(rng, motion, int(ns), _names(rng, motion)) for ns in all_ns))


def one_late(steps: int, rng: np.random.Generator) -> Stream:
    """In time order, every 100 ms, and then one measurement from between two stamps, `steps` of them late."""
    stamps_ns = [k * 100 * MS for k in range(1, 10)]
    late_ns = stamps_ns[-1] - steps * 100 * MS + int(rng.integers(20, 80)) * MS
    return Stream(LINEAR, tuple(measured(rng, LINEAR, ns) for ns in (*stamps_ns, late_ns)))


def mild(rng: np.random.Generator) -> Stream:
    """A car that is well known from the start and passes a yaw of pi, seen by LiDAR and RADAR of a turning observer.
    The LiDAR measures position and yaw, the RADAR range, bearing and Doppler from a pose with an arm and a velocity.
    """
    start = replace(
        START,
        position_m=(30.0, 12.0),
        position_std_m=0.3,
        yaw_rad=3.05,
        yaw_std_rad=0.03,
        speed_mps=12.0,
        speed_std_mps=0.3,
        yaw_rate_radps=0.5,
        yaw_rate_std_radps=0.05,
    )
    noise = {"x_m": 0.3, "y_m": 0.3, "yaw_rad": 0.15}, {"range_m": 0.5, "bearing_rad": 0.02, "range_rate_mps": 0.1}
    mean, P = initial_state(NONLINEAR, start)
    x, measurements = mean + np.linalg.cholesky(P) @ rng.standard_normal(len(mean)), list[Measurement]()
    for k in range(1, 25):
        root = np.linalg.cholesky(NONLINEAR.process_noise(x, 0.025))
        x = NONLINEAR.predict(x, 0.025) + root @ rng.standard_normal(len(x))
        std = np.array(list(noise[k % 2].values()))
        turned_rad = 0.01 * k - 0.3
        pose = SensorPose(np.sin(turned_rad) * 50.0, -np.cos(turned_rad) * 50.0, turned_rad - 1.95, 19.0, -6.0)
        model, pose = measurement_model(tuple(noise[k % 2]), NONLINEAR), pose if k % 2 else SensorPose()
        z = model.residual(model.predict(x, pose) + std * rng.standard_normal(3), np.zeros(3))
        measurements.append(Measurement(start.stamp_ns + k * 25 * MS, model, z, np.diag(std**2), pose))
    return Stream(NONLINEAR, tuple(measurements), start)


def mild_robust(rng: np.random.Generator) -> Stream:
    """The same with positions of which every other one is an outlier, under a Huber loss."""
    stream = mild(rng)
    measurements = []
    for item in stream.measurements[1::2]:
        off = np.sqrt(np.diag(item.R)) * rng.normal(0.0, 8.0, len(item.z)) * (rng.random() < 0.5)
        off[2:] = 0.0
        measurements.append(replace(item, z=item.z + off, loss=RobustLoss("huber", 1.5)))
    return replace(stream, measurements=tuple(measurements))


def _names(rng: np.random.Generator, motion: MotionModel) -> tuple[str, ...]:
    return _POSITION if motion.linear else COMPONENTS[rng.integers(len(COMPONENTS))]
