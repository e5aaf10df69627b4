"""Streams on which the order of arrival is most likely to matter."""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial

import numpy as np
from support.oracle.sightings import Eye, Sighting, seen
from support.oracle_streams import FAST, Plan, Sense, Stream, drawn, observed, onboard, paper

from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement, Start
from fgtrack.models.measurement import SensorPose, measurement_model
from fgtrack.models.motion import CTRA, CTRV, CV, MotionModel
from fgtrack.models.sensors import RobustLoss

#: Ten rounds of the LiDAR at 20 Hz.
_ROUNDS = tuple((0.05 * k, "lidar_cluster") for k in range(1, 11))
_LAG_S, _REACH_S = 2.0, 1.9
_BOTH = ("lidar_cluster", "radar")
#: Of a sensor that sees the object from so far behind.
_BEHIND_M = {"near bearing": 40.0, "far bearing": 90.0}
_BEARING_STD_RAD = 0.02

Draw = Callable[[np.random.Generator], Stream]


def gathered(rng: np.random.Generator) -> Stream:
    """Three on the birth stamp, twelve on one stamp, stamps 1 ns, 100 ns and 1 us apart; of one CTRV object."""
    near = [(time_s + gap_s, "radar") for (time_s, _), gap_s in zip(_ROUNDS[6:], (1e-9, 1e-7, 1e-6), strict=False)]
    times = (*_at(0.0, 3), *_ROUNDS[::2], *_at(0.3, 12), *near)
    return _open(rng, "CTRV, all that is nasty", CTRV(), times)


def _at(time_s: float, count: int, apart_s: float = 0.0) -> list[tuple[float, str]]:
    return [(time_s + k * apart_s, _BOTH[k % 2]) for k in range(count)]


def _open(rng: np.random.Generator, name: str, motion: MotionModel, times: tuple[tuple[float, str], ...]) -> Stream:
    return drawn(rng, name, motion, _plan(times), _LAG_S, _REACH_S)


def _plan(times: tuple[tuple[float, str], ...]) -> Plan:
    stamps_s, sensors = zip(*sorted(times), strict=True)
    return np.array(stamps_s), np.array(sensors)


def _near(rng: np.random.Generator, name: str, motion: MotionModel, gap_s: float) -> Stream:
    return _open(rng, name, motion, (*_ROUNDS, *((time_s + gap_s, "radar") for time_s, _ in _ROUNDS)))


def _unknown(rng: np.random.Generator, name: str) -> Stream:
    """Heading and speed are found from the first positions, of which two lie on the birth stamp."""
    stream = _open(rng, name, CTRV(), (*_at(0.0, 2), *_ROUNDS))
    start: Start = replace(FAST, yaw_rad=None, yaw_std_rad=None, speed_mps=0.0, speed_std_mps=40.0)
    return replace(stream, prior=start)


def _outliers(
    rng: np.random.Generator, name: str, far_sd: float, share: float, loss: RobustLoss | None = None
) -> Stream:
    """Positions that are `far_sd` standard deviations off, to any side."""

    def sense(rng: np.random.Generator, x: FloatArray, stamp_ns: int, sensor: str) -> tuple[Measurement, Sighting]:
        measurement, sighting = paper(rng, x, stamp_ns, sensor)
        off = np.zeros(len(sighting.z))
        off[:2] = far_sd * np.sqrt(np.diag(sighting.R))[:2] * rng.choice([-1.0, 1.0], 2) * (rng.random() < share)
        z = sighting.z + off
        seen = None if loss is None else (loss.kind, loss.width)
        return replace(measurement, z=z, loss=loss), replace(sighting, z=z, loss=seen)

    return drawn(rng, name, CTRV(), _plan(_ROUNDS + tuple(_at(0.023, 10, 0.05))), _LAG_S, _REACH_S, sense=sense)


def _bearings(rng: np.random.Generator, name: str) -> Stream:
    """Two bearings of equal value and stamp, from two poses, at every other position."""

    def sense(rng: np.random.Generator, x: FloatArray, stamp_ns: int, sensor: str) -> tuple[Measurement, Sighting]:
        if sensor not in _BEHIND_M:
            return paper(rng, x, stamp_ns, sensor)
        bearing_rad, behind_m = 0.7 + 0.3 * math.sin(3e-9 * stamp_ns), _BEHIND_M[sensor]
        eye = Eye(x[0] - behind_m * math.cos(bearing_rad), x[1] - behind_m * math.sin(bearing_rad))
        names, z, R = ("bearing_rad",), np.array([bearing_rad]), np.array([[_BEARING_STD_RAD**2]])
        model = measurement_model(names, CTRV())
        return Measurement(stamp_ns, model, z, R, SensorPose(*eye)), Sighting(stamp_ns, names, z, R, eye)

    times = (*_ROUNDS, *((time_s, sensor) for time_s, _ in _ROUNDS[::2] for sensor in _BEHIND_M))
    return drawn(rng, name, CTRV(), _plan(times), _LAG_S, _REACH_S, sense=sense)


def _sensing(names: tuple[str, ...], std: tuple[float, ...], eyes: Mapping[str, Eye]) -> Sense:
    """Sensors that measure `names`, from `eyes` where they have one."""
    model, R = measurement_model(names, CTRV()), np.diag(np.square(std))

    def sense(rng: np.random.Generator, x: FloatArray, stamp_ns: int, sensor: str) -> tuple[Measurement, Sighting]:
        eye = eyes.get(sensor, Eye())
        z = seen(names, x, CTRV.state_names, eye) + std * rng.standard_normal(len(std))
        return Measurement(stamp_ns, model, z, R, SensorPose(*eye)), Sighting(stamp_ns, names, z, R, eye)

    return sense


def _bearings_alone(rng: np.random.Generator, name: str) -> Stream:
    """Bearings from two places by turns, of a car of which hardly more is known."""
    eyes = {"lidar_cluster": Eye(-20.0, 30.0), "radar": Eye(10.0, -60.0)}
    sense = _sensing(("bearing_rad",), (0.01,), eyes)
    times = (*_ROUNDS, *((time_s + 0.02, "radar") for time_s, _ in _ROUNDS))
    start = replace(FAST, position_std_m=15.0)
    return drawn(rng, name, CTRV(), _plan(times), _LAG_S, _REACH_S, start=start, sense=sense)


def _standing(rng: np.random.Generator, name: str) -> Stream:
    """Positions of a car that stands, whose heading they do not tell."""
    start = replace(FAST, speed_mps=0.0, yaw_rate_radps=0.0)
    sense = _sensing(("x_m", "y_m"), (0.3, 0.3), {})
    return drawn(
        rng, name, CTRV(), _plan(_ROUNDS + tuple(_at(0.023, 10, 0.05))), _LAG_S, _REACH_S, start=start, sense=sense
    )


def spinning(rng: np.random.Generator) -> Stream:
    """Positions and yaws of a car that turns by 0.2 rad from one to the next, and whose rate is not known.

    Not among `NASTY`: where few of them are known, several numbers of turns explain them, and a smoother may stay with
    that which the first to arrive suggest.
    """
    start = replace(FAST, speed_mps=12.0, yaw_rate_radps=2.5, yaw_rate_std_radps=3.0)
    sense = _sensing(("x_m", "y_m", "yaw_rad"), (0.3, 0.3, 0.1), {})
    times = tuple((0.08 * k, "lidar_cluster") for k in range(1, 19))
    stream = drawn(rng, "spinning", CTRV(), _plan(times), _LAG_S, _REACH_S, start=start, sense=sense)
    return replace(stream, prior=replace(start, yaw_rate_radps=0.0))


def _seen_by_radar(rng: np.random.Generator, name: str) -> Stream:
    return replace(observed(rng), name=name)


def _in_a_burst(rng: np.random.Generator, name: str, motion: MotionModel, apart_s: float) -> Stream:
    return _open(rng, name, motion, (*_ROUNDS, *_at(0.3, 12, apart_s)))


def _on_the_birth_stamp(rng: np.random.Generator, name: str) -> Stream:
    return _open(rng, name, CTRV(), (*_at(0.0, 3), *_ROUNDS))


def _radar_on_the_birth_stamp(rng: np.random.Generator, name: str) -> Stream:
    """Three of which the first to be fused decides where the others are linearised: by content, for the oracle too."""
    stream = onboard(rng, name, _plan((*((0.0, "radar") for _ in range(3)), *_ROUNDS)))
    own = [*sorted(range(3), key=lambda k: stream.measurements[k].content), *range(3, len(stream.measurements))]
    measurements, sightings = (tuple(each[k] for k in own) for each in (stream.measurements, stream.sightings))
    return replace(stream, measurements=measurements, sightings=sightings)


_NAMED: Mapping[str, Callable[..., Stream]] = {
    "burst of 12 within 11 ms": partial(_in_a_burst, motion=CTRV(), apart_s=0.001),
    "12 on one stamp": partial(_in_a_burst, motion=CTRV(), apart_s=0.0),
    "12 on one stamp, CTRA": partial(_in_a_burst, motion=CTRA(), apart_s=0.0),
    "three on the birth stamp": _on_the_birth_stamp,
    "three RADARs on the birth stamp": _radar_on_the_birth_stamp,
    "birth, heading unknown": _unknown,
    "outliers of 2.5 sd": partial(_outliers, far_sd=2.5, share=0.3),
    "outliers of 20 sd, no gate": partial(_outliers, far_sd=20.0, share=0.2),
    "outliers, Huber": partial(_outliers, far_sd=8.0, share=0.2, loss=RobustLoss("huber", 1.5)),
    "outliers, Cauchy": partial(_outliers, far_sd=8.0, share=0.2, loss=RobustLoss("cauchy", 2.5)),
    "outliers, Tukey": partial(_outliers, far_sd=8.0, share=0.2, loss=RobustLoss("tukey", 5.0)),
    "two bearings alike": _bearings,
    "range, bearing, Doppler": _seen_by_radar,
    "bearings alone": _bearings_alone,
    "standing": _standing,
    "CV, 1 ns apart": partial(_near, motion=CV(), gap_s=1e-9),
    "CV, 100 ns apart": partial(_near, motion=CV(), gap_s=1e-7),
    "CV, 1 us apart": partial(_near, motion=CV(), gap_s=1e-6),
    "CTRV, 1 ns apart": partial(_near, motion=CTRV(), gap_s=1e-9),
    "CTRV, 1 us apart": partial(_near, motion=CTRV(), gap_s=1e-6),
}

#: By name.
NASTY: Mapping[str, Draw] = {name: partial(draw, name=name) for name, draw in _NAMED.items()}
