"""
Your own out-of-sequence method
===============================

An estimator of one object is a class with `update`, `state_at`, `advance` and `window_ns`. Here: a filter that fuses
a late measurement now, with the innovation that it would have had at its own stamp.
"""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

import fgtrack

# %%
# The method. Everything in order is left to the filter that drops what is late (`drop`); a late measurement z is
# replaced by h(x now) + (z - h(x then)), and fused as if it were of now.


class ShiftedInnovation:
    """Fuses the innovation of a late measurement at the newest stamp."""

    def __init__(self, motion, start, lag_s):
        self._filter = fgtrack.estimator("drop", motion, start, lag_s=lag_s)

    @property
    def window_ns(self):
        return self._filter.window_ns

    def advance(self, now_ns):
        self._filter.advance(now_ns)

    def state_at(self, stamp_ns):
        return self._filter.state_at(stamp_ns)

    def update(self, measurement):
        oldest_ns, newest_ns = self.window_ns
        if not oldest_ns <= measurement.stamp_ns < newest_ns:
            return self._filter.update(measurement)
        model, pose = measurement.model, measurement.pose
        then = model.predict(self.state_at(measurement.stamp_ns).mean, pose)
        now = model.predict(self.state_at(newest_ns).mean, pose)
        shifted = replace(measurement, stamp_ns=newest_ns, z=now + model.residual(measurement.z, then))
        result = self._filter.update(shifted)
        if result.status == fgtrack.UpdateStatus.IN_SEQUENCE:
            result = replace(result, status=fgtrack.UpdateStatus.OUT_OF_SEQUENCE)
        return result


# %%
# Does it keep the promises of an estimator: too old is refused, nothing is mutated, covariances are positive definite
# ...? The contract suite reports which one breaks, and with which measurements.
from fgtrack.testing import check_estimator

check_estimator(ShiftedInnovation, exact=False)

# %%
# One object on a bend, LiDAR (0.3 m) 150 ms late and RADAR (1 m) 60 ms late, both at 20 Hz: every LiDAR measurement is
# out of sequence.
MS = 1_000_000
rng = np.random.default_rng(0)
motion = fgtrack.CTRV()


def truth(time_s):
    angle = 0.2 * time_s
    return 300.0 * np.sin(angle), 300.0 * (1.0 - np.cos(angle))


arrivals = []
for delay_ms, std_m, phase_ms in ((150, 0.3, 0), (60, 1.0, 20)):
    for stamp_ms in range(50 + phase_ms, 10_000, 50):
        x_m, y_m = truth(stamp_ms / 1e3) + std_m * rng.standard_normal(2)
        measurement = fgtrack.Measurement.of(stamp_ms * MS, x_m=x_m, y_m=y_m, std={"x_m": std_m, "y_m": std_m})
        arrivals.append((stamp_ms + delay_ms, measurement))
arrivals.sort(key=lambda arrival: arrival[0])
start = fgtrack.Start(yaw_rad=0.0, yaw_std_rad=0.1, speed_mps=60.0, speed_std_mps=5.0, yaw_rate_std_radps=0.3)


def errors_m(estimator):
    """Position error of the present state at every receipt after the first second."""
    found = []
    for now_ms, measurement in arrivals:
        estimator.update(measurement)
        x_m, y_m = estimator.state_at(now_ms * MS).mean[:2]
        found.append((now_ms / 1e3, np.hypot(x_m - truth(now_ms / 1e3)[0], y_m - truth(now_ms / 1e3)[1])))
    return np.array([row for row in found if row[0] > 1.0])


# %%
# The result, beside methods that come with fgtrack.
methods = {name: fgtrack.estimator(name, motion, start, lag_s=1.0) for name in ("ekf-replay", "rewind-forget", "drop")}
methods["shifted innovation"] = ShiftedInnovation(motion, start, 1.0)

figure, axes = plt.subplots()
for name, estimator in methods.items():
    time_s, error_m = errors_m(estimator).T
    rmse_m = np.sqrt(np.mean(error_m**2))
    print(f"{name:20} RMSE {rmse_m:.3f} m")
    axes.plot(time_s, error_m, label=f"{name}: {rmse_m:.3f} m")
axes.set(xlabel="time [s]", ylabel="position error [m]")
axes.legend()

# %%
# To have it by name in `fgtrack replay -e`, in sweeps (in every worker) and in `fgtrack verify`, put it into a package
# with an entry point and install that:
#
# .. code-block:: toml
#
#     [project.entry-points."fgtrack.oosm"]
#     shifted-innovation = "my_package:ShiftedInnovation"
