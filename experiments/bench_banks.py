"""Time of one list of detections in the estimators of 50 objects, by what the sensor measures.

    python experiments/bench_banks.py

Each list has one measurement of every object, all of one stamp; every fourth list is late. Times are of the processor.
Kinds of measurements are measured in turns, round after round, so a ratio compares times of the same minute.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np

import fgtrack
from fgtrack import SensorPose
from fgtrack.estimation.registry import estimator_bank

NUM_OBJECTS = 50
ESTIMATORS = ("ekf-replay", "smoother-banded")
LAG_S, PERIOD_S, NUM_LISTS, NUM_WARM = 1.0, 0.05, 120, 40
_STD = {
    "x_m": 0.3,
    "y_m": 0.3,
    "range_m": 0.3,
    "bearing_rad": 0.01,
    "range_rate_mps": 0.2,
}


@dataclass(frozen=True)
class Kind:
    """What a sensor measures, and its robust loss."""

    label: str
    components: tuple[str, ...]
    loss: fgtrack.RobustLoss | None = None


POSITION = Kind("x and y", ("x_m", "y_m"))
KINDS = (
    Kind("range and bearing", ("range_m", "bearing_rad")),
    Kind("range, bearing and range rate", ("range_m", "bearing_rad", "range_rate_mps")),
    Kind("x and y, Huber loss", ("x_m", "y_m"), fgtrack.RobustLoss("huber", 1.345)),
)


def list_ms(estimator: str, kind: Kind, seed: int = 0) -> float:
    """Return the median processor time of the update of all objects by one list, in ms."""
    rng, motion = np.random.default_rng(seed), fgtrack.CTRV()
    model = fgtrack.measurement_model(kind.components, motion)
    std = np.array([_STD[name] for name in kind.components])
    pose, ids = SensorPose(-60.0, 0.0, 0.1, 20.0, 0.0), list(range(NUM_OBJECTS))
    first = np.zeros((NUM_OBJECTS, 5))
    first[:, :2], first[:, 3] = rng.uniform(-40.0, 40.0, (NUM_OBJECTS, 2)), 20.0
    bank, times_ms = estimator_bank(estimator, motion, LAG_S, {}), list[float]()
    bank.advance(0)
    for track_id, state in enumerate(first):
        bank.birth(
            track_id,
            fgtrack.Start(position_m=state[:2], yaw_rad=0.0, speed_mps=20.0),
        )
    for k in range(1, NUM_LISTS):
        at_s = PERIOD_S * (k if k % 4 else k - 2.5)
        z = model.predict(motion.predict(first, at_s), pose)
        z += std * rng.standard_normal(z.shape)
        stamp_ns = round(1e9 * at_s)
        measurements = [
            fgtrack.Measurement(stamp_ns, model, own, np.diag(std**2), pose, kind.loss)
            for own in z
        ]
        bank.advance(round(1e9 * PERIOD_S * k))
        before_ns = time.thread_time_ns()
        bank.update(stamp_ns, ids, measurements)
        if k > NUM_WARM:
            times_ms.append((time.thread_time_ns() - before_ns) / 1e6)
    return median(times_ms)


def measured(
    rounds: int, say: Callable[[str], None] = lambda _: None
) -> dict[tuple[str, str], list[float]]:
    """Return times in ms of each estimator and kind of measurement, by round."""
    times_ms: dict[tuple[str, str], list[float]] = {}
    for _ in range(rounds):
        for estimator in ESTIMATORS:
            for kind in (POSITION, *KINDS):
                say(f"{estimator}, {NUM_OBJECTS} objects, {kind.label}")
                found = times_ms.setdefault((estimator, kind.label), [])
                found.append(list_ms(estimator, kind))
    return times_ms


def ratios(
    times_ms: dict[tuple[str, str], Sequence[float]], estimator: str, kind: Kind
) -> list[float]:
    """Return the time of a kind over the time of x and y, by round."""
    own, plain = times_ms[estimator, kind.label], times_ms[estimator, POSITION.label]
    return [a / b for a, b in zip(own, plain, strict=True)]


if __name__ == "__main__":
    found = measured(3)
    for estimator in ESTIMATORS:
        for kind in (POSITION, *KINDS):
            least_ms = min(found[estimator, kind.label])
            ratio = median(ratios(found, estimator, kind))
            print(f"{estimator:16} {kind.label:32} {least_ms:8.3f} ms {ratio:8.2f}")
