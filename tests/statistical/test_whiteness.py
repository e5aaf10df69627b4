"""Truth drawn from the motion model itself: innovations in the order of arrival are white, late ones too."""

import numpy as np
from scipy.stats import binom

from fgtrack.core.time import NS_PER_S, nanoseconds
from fgtrack.core.types import MEASURABLE, FloatArray
from fgtrack.estimation.base import Measurement, Start
from fgtrack.estimation.filters.replay import ReplayEkf
from fgtrack.evaluation.scores.innovations import Autocorrelation, autocorrelations
from fgtrack.models.measurement import measurement_model
from fgtrack.models.motion import CTRV
from fgtrack.sim.vehicles import drawn

MOTION = CTRV()
SENSORS = {"lidar": ({"x_m": 0.3, "y_m": 0.3}, 0.151), "radar": ({"x_m": 1.0, "y_m": 1.0, "speed_mps": 0.2}, 0.062)}
START = Start(yaw_rad=0.4, speed_mps=60.0, yaw_rate_radps=0.1, speed_std_mps=3.0, position_std_m=0.3)
NUM_RUNS, NUM_STEPS, STEP_S = 20, 240, 0.025


def stream(rng: np.random.Generator) -> list[tuple[str, Measurement]]:
    """Measurements of both sensors in turn, each with its own delay, in order of receipt."""
    std = np.array([0.3, 0.3, 0.1, 3.0, 0.3])
    x = np.array([0.0, 0.0, 0.4, 60.0, 0.1]) + std * rng.standard_normal(5)
    found = []
    for k in range(1, NUM_STEPS + 1):
        x = drawn(MOTION, x, STEP_S, rng)
        name = "lidar" if k % 2 else "radar"
        components, delay_s = SENSORS[name]
        model, sigma = measurement_model(tuple(components), MOTION), np.array(list(components.values()))
        z = model.predict(x) + sigma * rng.standard_normal(len(sigma))
        receipt_s = k * STEP_S + rng.gamma(4.0, delay_s / 4.0)
        found.append((receipt_s, name, Measurement(nanoseconds(k * STEP_S), model, z, np.diag(sigma**2))))
    return [(name, measurement) for _, name, measurement in sorted(found, key=lambda item: item[0])]


def lag1(rng: np.random.Generator) -> list[Autocorrelation]:
    """Autocorrelation of the position innovations of each sensor along one track, past its first second."""
    estimator = ReplayEkf(MOTION, START, 2.0)
    rows: dict[str, list[FloatArray]] = {name: [] for name in SENSORS}
    for name, measurement in stream(rng):
        innovation = estimator.update(measurement).innovation
        assert innovation is not None
        if measurement.stamp_ns > NS_PER_S:
            rows[name].append(innovation[:2])
    found = []
    for values in rows.values():
        columns: dict[str, np.ndarray] = {f"res_{name}": np.full(len(values), np.nan) for name in MEASURABLE}
        columns["res_x_m"], columns["res_y_m"] = np.array(values).T
        columns["track_id"] = np.zeros(len(values), np.int64)
        found.append(autocorrelations(columns)["position_m"])  # type: ignore[arg-type]  # as good as a table
    return found


def test_the_replaying_filter_is_white_on_matched_noise_whatever_is_late() -> None:
    found = [lag1(np.random.default_rng(seed)) for seed in range(NUM_RUNS)]
    inside = [abs(each.lag1) < each.lag1_band for run in found for each in run]
    assert sum(inside) >= binom.ppf(0.005, len(inside), 0.95)
    for of_sensor in zip(*found, strict=True):
        values = [each.lag1 for each in of_sensor]
        assert abs(np.mean(values)) < 2.6 * np.std(values) / np.sqrt(NUM_RUNS - 1)
