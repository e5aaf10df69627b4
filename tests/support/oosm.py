"""One object driving straight on, measured in time and late, for tests of out-of-sequence methods."""

from collections.abc import Sequence

import numpy as np

from fgtrack.core.time import nanoseconds
from fgtrack.core.types import TrackState
from fgtrack.estimation.base import Estimator, Measurement, Start
from fgtrack.estimation.filters.replay import ReplayEkf
from fgtrack.estimation.registry import ESTIMATORS, OOSM_GROUP, estimator
from fgtrack.models.measurement import measurement_model
from fgtrack.models.motion import CTRA, CTRV, CV, MotionModel

START_NS = 1_790_000_000_000_000_000
LAG_S = 5.0
STEP_S = 0.1
NUM_STEPS = 20
LINEAR = CV(velocity_density_m2ps3=5.0)
MOTIONS = {"cv": LINEAR, "ctrv": CTRV(), "ctra": CTRA()}

METHODS = tuple(ESTIMATORS.loaded(OOSM_GROUP))
ANY_LAG = ("rts", "zlz", "asd")
ONE_LAG = (*ANY_LAG, "a1", "al1", "fpfd")
IGNORING = ("drop",)
HOLDING = ("delayed-horizon", "reorder-buffer")
FUSING = tuple(name for name in METHODS if name not in (*IGNORING, *HOLDING))


def stamp(at_s: float) -> int:
    return START_NS + nanoseconds(at_s)


def prior(yaw_rad: float = 0.4) -> Start:
    position = np.array([3.0, -2.0])
    return Start(
        stamp_ns=START_NS,
        position_m=position,
        position_covariance=np.diag([0.5, 0.5]),
        yaw_rad=yaw_rad,
        yaw_std_rad=0.3,
        speed_mps=20.0,
        speed_std_mps=3.0,
        yaw_rate_radps=0.1,
        yaw_rate_std_radps=0.3,
    )


def started(name: str, motion: MotionModel = LINEAR, lag_s: float = LAG_S) -> Estimator:
    return estimator(name, motion, prior(), lag_s=lag_s)


def measured(
    rng: np.random.Generator,
    at_s: float,
    motion: MotionModel = LINEAR,
    std: float = 1.0,
    speed: bool = False,
) -> Measurement:
    truth = {
        "x_m": 3.0 + 20.0 * at_s * np.cos(0.4),
        "y_m": -2.0 + 20.0 * at_s * np.sin(0.4),
        "speed_mps": 20.0,
    }
    names = tuple(truth) if speed else ("x_m", "y_m")
    z = np.array([truth[name] for name in names]) + std * rng.standard_normal(
        len(names)
    )
    return Measurement(
        stamp(at_s), measurement_model(names, motion), z, std**2 * np.eye(len(names))
    )


def in_sequence(
    rng: np.random.Generator, motion: MotionModel = LINEAR
) -> list[Measurement]:
    return [measured(rng, k * STEP_S, motion) for k in range(1, NUM_STEPS + 1)]


def late(
    rng: np.random.Generator, lag: int, part: float = 0.3, motion: MotionModel = LINEAR
) -> Measurement:
    """Between the steps `lag` and `lag - 1` before the last one."""
    return measured(rng, (NUM_STEPS - lag + part) * STEP_S, motion, 0.3)


def fed(estimator: Estimator, measurements: Sequence[Measurement]) -> Estimator:
    for measurement in measurements:
        estimator.update(measurement)
    return estimator


def replayed(
    measurements: Sequence[Measurement], motion: MotionModel = LINEAR
) -> Estimator:
    return fed(ReplayEkf(motion, prior(), LAG_S), measurements)


def assert_same(
    found: TrackState, expected: TrackState, tolerance: float = 1e-9
) -> None:
    scale = np.sqrt(np.diag(expected.covariance))
    np.testing.assert_allclose(
        (found.mean - expected.mean) / scale, 0.0, atol=tolerance
    )
    difference = (found.covariance - expected.covariance) / np.outer(scale, scale)
    np.testing.assert_allclose(difference, 0.0, atol=tolerance)


def last(estimator: Estimator) -> TrackState:
    return estimator.state_at(stamp(NUM_STEPS * STEP_S))
