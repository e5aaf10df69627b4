"""Motion of the vehicles: prescribed on a track, or drawn from the motion model."""

import math
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat

from fgtrack.core.geometry import wrap_angles
from fgtrack.core.settings import require, settings
from fgtrack.core.types import STATE_NAMES, YAW, FloatArray
from fgtrack.models.motion import CTRV, MotionModel
from fgtrack.models.path import Path


@settings
class LaneChange:
    """A change of the lateral offset along a quintic; lateral speed and acceleration are 0 at both ends."""

    start_s: NonNegativeFloat
    """Time at which the lane change starts."""
    duration_s: PositiveFloat
    """Time from the start to the end of the lane change."""
    lateral_m: float
    """Lateral offset at the end, positive to the left of the reference line."""


SpeedKnots = Annotated[tuple[tuple[float, NonNegativeFloat], ...], Field(min_length=1)]
"""Knots (time [s], speed [m/s])."""


@settings
class TrackVehicle:
    """A vehicle that follows the track; overtaking results from speeds and lane changes."""

    arc_m: float
    """Arc length along the reference line at the start."""
    speed: SpeedKnots
    """Knots (time [s], speed along the reference line [m/s]); the speed is smooth between them and constant outside."""
    lateral_m: float = 0.0
    """Lateral offset at the start, positive to the left."""
    lane_changes: tuple[LaneChange, ...] = ()
    """Lane changes in the order of time, without overlap."""
    kind: Literal["track"] = "track"

    def __post_init__(self) -> None:
        for (before_s, _), (time_s, _) in pairwise(self.speed):
            require(
                time_s > before_s, "speed", "times of the knots must increase", time_s
            )
        for before, change in pairwise(self.lane_changes):
            end_s = before.start_s + before.duration_s
            require(
                change.start_s >= end_s,
                "lane_changes",
                "a lane change must end before the next one starts",
                change.start_s,
            )

    def states(self, path: Path, times_s: FloatArray) -> FloatArray:
        """Return the states at `times_s`, shape (n,), since the start of the scenario: shape (n, 6), as `STATE_NAMES`.

        The path parameter u and the lateral offset d are functions of time with
        derivatives u1, u2 and d1, d2. The tangent of the path has the direction psi,
        and the scale g is in metres of path per unit of u. A prime is the derivative by
        u. Then the velocity is w = u1 (g - d psi') along the tangent and d1 across it,
        and yaw = psi + atan2(d1, w). Yaw rate and acceleration along the heading are
        the exact derivatives of yaw and speed. A vehicle at rest points along the path.
        """
        u, u1, u2 = self._along(times_s)
        d, d1, d2 = self._across(times_s)
        frame = path.frame(u)
        stretch = frame.scale - d * frame.turn
        w = u1 * stretch
        w1 = u2 * stretch + u1 * (
            u1 * (frame.scale_rate - d * frame.turn_rate) - d1 * frame.turn
        )
        speed = np.hypot(w, d1)
        # A vehicle at rest neither turns nor accelerates.
        divisor = np.where(speed > 0.0, speed, 1.0)
        return np.stack(
            [
                frame.x_m - d * np.sin(frame.heading_rad),
                frame.y_m + d * np.cos(frame.heading_rad),
                wrap_angles(frame.heading_rad + np.arctan2(d1, w)),
                speed,
                frame.turn * u1 + (d2 * w - d1 * w1) / divisor**2,
                (w * w1 + d1 * d2) / divisor,
            ],
            axis=1,
        )

    def _along(self, times_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the path parameter and its first two derivatives by time."""
        from scipy.interpolate import CubicHermiteSpline

        knots = np.array(self.speed, dtype=np.float64)
        if len(knots) == 1:
            knots = np.vstack([knots, knots + np.array([1.0, 0.0])])
        # The speed has slope 0 at every knot, so the acceleration does not jump where the speed becomes constant.
        speed = CubicHermiteSpline(knots[:, 0], knots[:, 1], np.zeros(len(knots)))
        times = np.append(times_s, 0.0)
        inside = np.clip(times, knots[0, 0], knots[-1, 0])
        distance = speed.antiderivative()(inside) + speed(inside) * (times - inside)
        u = self.arc_m + distance[:-1] - distance[-1]
        # Rounding must not turn a vehicle at rest around.
        return u, np.maximum(speed(inside[:-1]), 0.0), speed(inside[:-1], 1)

    def _across(self, times_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the lateral offset and its first two derivatives by time."""
        d = np.full(len(times_s), self.lateral_m)
        d1, d2 = np.zeros((2, len(times_s)))
        lateral_m = self.lateral_m
        for change in self.lane_changes:
            x = np.clip((times_s - change.start_s) / change.duration_s, 0.0, 1.0)
            step = change.lateral_m - lateral_m
            d += step * x**3 * (10.0 + x * (6.0 * x - 15.0))
            d1 += step / change.duration_s * 30.0 * (x * (1.0 - x)) ** 2
            d2 += step / change.duration_s**2 * 60.0 * x * (1.0 - x) * (1.0 - 2.0 * x)
            lateral_m = change.lateral_m
        return d, d1, d2


@settings
class DrawnVehicle:
    """A vehicle whose motion is drawn from the CTRV model, so that a filter with this model is consistent."""

    x_m: float
    """Position at the start, in the map frame."""
    y_m: float
    """Position at the start, in the map frame."""
    yaw_rad: float
    """Direction of travel at the start, 0 along +x, counter-clockwise."""
    speed_mps: float
    """Speed at the start."""
    yaw_rate_radps: float = 0.0
    """Yaw rate at the start."""
    motion: CTRV = field(default_factory=CTRV)
    """Process noise of the CTRV model."""
    step_s: PositiveFloat = 0.01
    """Time between two draws of the process noise. Between the draws, the noise is a Brownian bridge.

    The distribution is exact if all sensors together measure at most once in a step.
    """
    kind: Literal["drawn"] = "drawn"

    def trajectory(
        self, rng: np.random.Generator, duration_s: float
    ) -> "DrawnTrajectory":
        """Draw one motion of this vehicle over `duration_s`."""
        num_steps = math.ceil(duration_s / self.step_s) + 1
        normals = rng.standard_normal((num_steps, self.motion.dim, 2))
        states = np.empty((num_steps + 1, self.motion.dim))
        noise = np.empty_like(normals)
        states[0] = [getattr(self, name) for name in STATE_NAMES[: self.motion.dim]]
        for k in range(num_steps):
            # With a noise density of 0 the covariance is singular and has no Cholesky factor, but a symmetric root.
            variances, axes = np.linalg.eigh(
                self.motion.process_noise(states[k], self.step_s)
            )
            noise[k] = (
                (axes * np.sqrt(np.maximum(variances, 0.0))) @ axes.T @ normals[k]
            )
            states[k + 1] = self.motion.predict(states[k], self.step_s) + noise[k, :, 0]
        return DrawnTrajectory(self, states, noise[:, :, 0], noise[:, :, 1])


@dataclass(frozen=True, eq=False)
class DrawnTrajectory:
    """A drawn motion: x(t) = prediction from the previous step + f noise + sqrt(f (1 - f)) bridge.

    f is the elapsed fraction of the step. So the noise before t and the noise after t
    are independent, and the covariance of each is proportional to its time.
    """

    vehicle: DrawnVehicle
    step_states: FloatArray
    """States at the beginning of the m steps and at the end of the last one, shape (m + 1, 5)."""
    noise: FloatArray
    """Process noise of each step, shape (m, 5)."""
    bridge: FloatArray
    """Independent noise with the same covariance, shape (m, 5)."""

    def states(self, times_s: FloatArray) -> FloatArray:
        """Return the states at `times_s` as `TrackVehicle.states`; the acceleration is 0, because CTRV has none."""
        step_s = self.vehicle.step_s
        motion = self.vehicle.motion
        k = np.clip((times_s / step_s).astype(np.int64), 0, len(self.noise) - 1)
        within_s = times_s - k * step_s
        part = np.clip(within_s / step_s, 0.0, 1.0)[:, None]
        noise = part * self.noise[k] + np.sqrt(part * (1.0 - part)) * self.bridge[k]
        states = np.zeros((len(times_s), len(STATE_NAMES)))
        states[:, : motion.dim] = motion.predict(self.step_states[k], within_s) + noise
        states[:, YAW] = wrap_angles(states[:, YAW])
        return states


def draw_states(
    motion: MotionModel, x: FloatArray, dt_s: float, rng: np.random.Generator
) -> FloatArray:
    """Draw the states `dt_s` after the states `x`, both of shape (..., n): the prediction plus N(0, Q(x, dt_s)).

    Raises `numpy.linalg.LinAlgError` if Q is singular, for example with a noise density
    of 0.
    """
    roots = np.linalg.cholesky(motion.process_noise(x, dt_s))
    noise = rng.standard_normal((*x.shape[:-1], 1, x.shape[-1]))
    return np.asarray(motion.predict(x, dt_s) + np.vecdot(roots, noise))
