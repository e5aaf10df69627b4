"""Random streams of measurements in random orders of arrival."""

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fgtrack.core.time import NS_PER_S, seconds
from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement, Start
from fgtrack.estimation.birth import initial_state
from fgtrack.models.measurement import (
    AT_ORIGIN,
    RELATIVE,
    SensorPose,
    measurement_model,
)
from fgtrack.models.motion import CTRV, CV, MotionModel
from fgtrack.models.sensors import RobustLoss
from fgtrack.testing.equations import linearised, residual

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
#: Standard deviations of components other than 0.5.
_STD = {"yaw_rad": 0.1, "bearing_rad": 0.03, "range_rate_mps": 0.3}
LINEAR, NONLINEAR = CV(velocity_density_m2ps3=5.0), CTRV()
_POSITION = ("x_m", "y_m")
COMPONENTS = (
    _POSITION,
    (*_POSITION, "speed_mps"),
    (*_POSITION, "yaw_rad"),
    (*_POSITION, "range_m"),
    ("range_m", "bearing_rad"),
    ("range_m", "bearing_rad", "range_rate_mps"),
)


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
    def content(self) -> Hashable:
        """Value that is equal for equal streams."""
        return (
            self.motion,
            repr(self.start),
            tuple(item.order for item in self.measurements),
        )

    @property
    def newest_ns(self) -> int:
        """The newest stamp."""
        return self.stamps_ns[-1]

    def __str__(self) -> str:
        lines = [
            f"{type(self.motion).__name__}, measurements in the order of arrival (stamp after the start):"
        ]
        for m in self.measurements:
            values = zip(
                m.model.components,
                m.z.tolist(),
                np.sqrt(np.diag(m.R)).tolist(),
                strict=True,
            )
            text = ", ".join(
                f"{name} = {value!r} (std {std:g})" for name, value, std in values
            )
            lines.append(f"  {seconds(m.stamp_ns - self.start.stamp_ns):.9f} s: {text}")
        return "\n".join(lines)


def measured(
    rng: np.random.Generator,
    motion: MotionModel,
    offset_ns: int,
    names: Sequence[str] = _POSITION,
) -> Measurement:
    """Measurement of the components `names` of an object that drives straight on, `offset_ns` after the start.

    A range, a bearing or a Doppler is seen from a vehicle that follows beside the object and turns.
    """
    after_s = seconds(offset_ns)
    x = np.array(
        [
            3.0 + 20.0 * after_s * np.cos(0.4),
            -2.0 + 20.0 * after_s * np.sin(0.4),
            0.4,
            20.0,
            0.0,
        ]
    )
    beside = SensorPose(
        20.0 + 15.0 * after_s, -9.0 + 4.0 * after_s, 2.0 + 0.5 * after_s, 15.0, 4.0
    )
    pose = beside if set(names) & set(RELATIVE) else AT_ORIGIN
    seen = _seen(
        rng,
        START.stamp_ns + offset_ns,
        x,
        {name: _STD.get(name, 0.5) for name in names},
        pose,
    )
    return replace(seen, model=measurement_model(tuple(names), motion))


def regular(motion: MotionModel, rng: np.random.Generator, num: int = 12) -> Stream:
    """Stream in time order, every 50 ms; in a nonlinear model a measurement has any of `COMPONENTS`."""
    return Stream(
        motion,
        tuple(
            measured(rng, motion, k * 50 * MS, _names(rng, motion))
            for k in range(1, num + 1)
        ),
    )


def shuffled(
    motion: MotionModel, rng: np.random.Generator, span_s: float = 0.95 * LAG_S
) -> Stream:
    """Return a stream of 3 to 22 measurements in random order, within `span_s` after the start.

    Some stamps are equal, and some are 1 us apart.
    """
    num = int(rng.integers(2, 8))
    offsets = 2 * MS * rng.integers(1, round(span_s * NS_PER_S) // (2 * MS), num)
    again, close = offsets[rng.random(num) < 0.25], offsets[rng.random(num) < 0.25] + US
    all_ns = rng.permutation(np.concatenate([offsets, again, close, offsets[:1] + US]))
    return Stream(
        motion,
        tuple(measured(rng, motion, int(ns), _names(rng, motion)) for ns in all_ns),
    )


def one_late(steps: int, rng: np.random.Generator) -> Stream:
    """Stream in time order, every 100 ms, with a last measurement between two stamps that is `steps` steps late."""
    stamps_ns = [k * 100 * MS for k in range(1, 10)]
    late_ns = stamps_ns[-1] - steps * 100 * MS + int(rng.integers(20, 80)) * MS
    return Stream(
        LINEAR, tuple(measured(rng, LINEAR, ns) for ns in (*stamps_ns, late_ns))
    )


def informative(rng: np.random.Generator) -> Stream:
    """A turning car that passes a yaw of pi, seen from near by four sensors in turn, every 20 ms.

    Three of the four sensors measure a range, a bearing or a Doppler precisely, from a pose that moves and turns.
    Every row of every Jacobian therefore moves the result by many standard deviations.
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
    sensors = (
        {"range_m": 0.1, "bearing_rad": 0.005, "range_rate_mps": 0.1},
        {"x_m": 0.3, "y_m": 0.3, "yaw_rad": 0.15},
        {"speed_mps": 0.3, "bearing_rad": 0.01},
        {"range_m": 0.2, "range_rate_mps": 0.1},
    )
    mean, P = initial_state(NONLINEAR, start)
    x = mean + np.linalg.cholesky(P) @ rng.standard_normal(len(mean))
    measurements = []
    for k in range(1, 25):
        after_s = 0.02 * k
        pose = SensorPose(
            24.0 - 4.0 * after_s, 24.0 - 3.0 * after_s, 0.6 * after_s - 1.3, -4.0, -3.0
        )
        std = sensors[k % len(sensors)]
        measurements.append(
            _seen(rng, start.stamp_ns + k * 20 * MS, _turned(x, after_s), std, pose)
        )
    return Stream(NONLINEAR, tuple(measurements), start)


def _turned(x: FloatArray, after_s: float) -> FloatArray:
    """A state (n,) after a time at constant speed and yaw rate, which is not 0."""
    yaw_rad, radius_m = x[2] + x[4] * after_s, x[3] / x[4]
    east_m, north_m = np.sin(yaw_rad) - np.sin(x[2]), np.cos(x[2]) - np.cos(yaw_rad)
    return np.array(
        [x[0] + radius_m * east_m, x[1] + radius_m * north_m, yaw_rad, *x[3:]]
    )


def with_outliers(rng: np.random.Generator) -> Stream:
    """Stream of `informative` with a Huber loss; half of the measurements have errors of eight standard deviations."""
    stream = informative(rng)
    measurements = []
    for item in stream.measurements:
        off = (
            np.sqrt(np.diag(item.R))
            * rng.normal(0.0, 8.0, len(item.z))
            * (rng.random() < 0.5)
        )
        off[[name == "yaw_rad" for name in item.model.components]] = 0.0
        measurements.append(
            replace(item, z=item.z + off, loss=RobustLoss("huber", 1.5))
        )
    return replace(stream, measurements=tuple(measurements))


def _seen(
    rng: np.random.Generator,
    stamp_ns: int,
    x: FloatArray,
    std: Mapping[str, float],
    pose: SensorPose,
) -> Measurement:
    """A measurement of the nonlinear state x (n,) from `pose`, with the standard deviations `std` by component."""
    names, sigma = tuple(std), np.array(list(std.values()))
    z = linearised(
        names, NONLINEAR.state_names, x, pose
    ).z + sigma * rng.standard_normal(len(sigma))
    z = residual(names, z, np.zeros(len(z)))
    return Measurement(
        stamp_ns, measurement_model(names, NONLINEAR), z, np.diag(sigma**2), pose
    )


def _names(rng: np.random.Generator, motion: MotionModel) -> tuple[str, ...]:
    return _POSITION if motion.linear else COMPONENTS[rng.integers(len(COMPONENTS))]
