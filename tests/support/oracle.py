"""The oracle: motion, measurements and estimates once more, with NumPy and SciPy.

It imports nothing of fgtrack: an equation that is broken there is not broken here.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import linalg, stats
from scipy.integrate import solve_ivp

FloatArray = npt.NDArray[np.float64]
NS_PER_S = 1e9
_ACCURACY = 1e-12
#: In units of the state over 1 s, and of the densities.
_SMALLEST = 1e-15


class Flow(NamedTuple):
    """Where m states are after their durations."""

    mean: FloatArray
    """Shape (m, n); angles are not wrapped."""
    F: FloatArray
    """Derivative by the state before, shape (m, n, n)."""
    Q: FloatArray
    """Covariance of the accumulated noise, shape (m, n, n)."""


@dataclass(frozen=True)
class Dynamics:
    """dx = f(x) dt + noise, white, independent of that of the other entries.

    `names` of the state are those of CTRV (x, y, yaw, speed, yaw rate), CTRA (and acceleration) or CV (x, y, vx, vy).
    """

    names: tuple[str, ...]
    densities: tuple[float, ...]
    """Spectral density of the noise of each entry."""
    relaxation_hz: float = 0.0
    """Rate at which the yaw rate relaxes to zero."""
    slow_mps: float = 1.0
    """Speed below which the yaw has more noise."""
    resting_yaw: float = 0.0
    """Density that is added to that of the yaw at rest."""

    @classmethod
    def of(cls, names: tuple[str, ...], density: Mapping[str, float]) -> "Dynamics":
        """From densities by what they drive: position, yaw, speed, yaw_rate, accel or velocity."""
        drives = {
            "x_m": "position",
            "y_m": "position",
            "vx_mps": "velocity",
            "vy_mps": "velocity",
        }
        keys = [drives.get(name, name.rpartition("_")[0]) for name in names]
        return cls(names, tuple(density.get(key, 0.0) for key in keys))

    def diffusion(self, x: FloatArray) -> FloatArray:
        """Spectral densities at the states `x` as diagonal matrices, shape (m, n, n)."""
        D = np.tile(np.diag(self.densities), (len(x), 1, 1))
        if "yaw_rad" in self.names:
            yaw, speed = self._column["yaw_rad"], x[:, self._column["speed_mps"]]
            D[:, yaw, yaw] += (
                self.resting_yaw / (1.0 + (speed / self.slow_mps) ** 2) ** 2
            )
        return D

    @property
    def _column(self) -> dict[str, int]:
        return {name: k for k, name in enumerate(self.names)}

    def rates(self, x: FloatArray) -> FloatArray:
        """f(x), shape (m, n)."""
        at, f = self._column, np.zeros_like(x)
        if "vx_mps" in at:
            f[:, 0], f[:, 1] = x[:, at["vx_mps"]], x[:, at["vy_mps"]]
            return f
        yaw, speed = x[:, at["yaw_rad"]], x[:, at["speed_mps"]]
        f[:, 0], f[:, 1] = speed * np.cos(yaw), speed * np.sin(yaw)
        f[:, at["yaw_rad"]] = x[:, at["yaw_rate_radps"]]
        f[:, at["yaw_rate_radps"]] = -self.relaxation_hz * x[:, at["yaw_rate_radps"]]
        if "accel_mps2" in at:
            f[:, at["speed_mps"]] = x[:, at["accel_mps2"]]
        return f

    def slopes(self, x: FloatArray) -> FloatArray:
        """Derivative A of f by x, shape (m, n, n)."""
        at, A = self._column, np.zeros((*x.shape, x.shape[1]))
        if "vx_mps" in at:
            A[:, 0, at["vx_mps"]] = A[:, 1, at["vy_mps"]] = 1.0
            return A
        yaw, speed = x[:, at["yaw_rad"]], x[:, at["speed_mps"]]
        A[:, 0, at["yaw_rad"]], A[:, 0, at["speed_mps"]] = (
            -speed * np.sin(yaw),
            np.cos(yaw),
        )
        A[:, 1, at["yaw_rad"]], A[:, 1, at["speed_mps"]] = (
            speed * np.cos(yaw),
            np.sin(yaw),
        )
        A[:, at["yaw_rad"], at["yaw_rate_radps"]] = 1.0
        A[:, at["yaw_rate_radps"], at["yaw_rate_radps"]] = -self.relaxation_hz
        if "accel_mps2" in at:
            A[:, at["speed_mps"], at["accel_mps2"]] = 1.0
        return A

    def flow(self, x: FloatArray, t: FloatArray) -> Flow:
        """The states `x`, shape (m, n), after `t`, shape (m,).

        Integrates x' = f, F' = A F and Q' = A Q + Q A' + D together, the last one in the unit of t, so that small
        durations keep their digits.
        """
        m, n = x.shape
        start = np.concatenate(
            [x, np.tile(np.eye(n).ravel(), (m, 1)), np.zeros((m, n * n))], axis=1
        )

        def derivative(_: float, flat: FloatArray) -> FloatArray:
            packed = flat.reshape(m, -1)
            F, Q = (
                packed[:, n : n + n * n].reshape(m, n, n),
                packed[:, n + n * n :].reshape(m, n, n),
            )
            A = self.slopes(packed[:, :n]) * t[:, None, None]
            AQ, D = A @ Q, self.diffusion(packed[:, :n])
            rates = self.rates(packed[:, :n]) * t[:, None]
            return np.concatenate(
                [
                    rates,
                    (A @ F).reshape(m, -1),
                    (AQ + np.swapaxes(AQ, 1, 2) + D).reshape(m, -1),
                ],
                axis=1,
            ).ravel()

        found = solve_ivp(
            derivative,
            (0.0, 1.0),
            start.ravel(),
            method="DOP853",
            rtol=_ACCURACY,
            atol=_SMALLEST,
        )
        packed = found.y[:, -1].reshape(m, -1)
        F, Q = (
            packed[:, n : n + n * n].reshape(m, n, n),
            packed[:, n + n * n :].reshape(m, n, n),
        )
        return Flow(packed[:, :n], F, Q * t[:, None, None])

    def move(self, x: FloatArray, t: float) -> Flow:
        """`flow` of one state, shapes (n,), (n, n) and (n, n)."""
        return Flow(*(part[0] for part in self.flow(x[None], np.array([t]))))


_STEP = 1e-5
_ANGLES = ("yaw_rad", "bearing_rad")


class Vehicle(NamedTuple):
    """Pose of a vehicle in the map and how it moves, along its heading, and turns."""

    x_m: float
    y_m: float
    yaw_rad: float
    speed_mps: float
    yaw_rate_radps: float


class Eye(NamedTuple):
    """Pose and velocity of a sensor in the map."""

    x_m: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0
    vx_mps: float = 0.0
    vy_mps: float = 0.0


_AT_ORIGIN = Eye()


def mounted(vehicle: Vehicle, forward_m: float, left_m: float, yaw_rad: float) -> Eye:
    """A sensor on `vehicle`; what turns with it moves across its arm."""
    c, s = math.cos(vehicle.yaw_rad), math.sin(vehicle.yaw_rad)
    east_m, north_m = c * forward_m - s * left_m, s * forward_m + c * left_m
    return Eye(
        vehicle.x_m + east_m,
        vehicle.y_m + north_m,
        vehicle.yaw_rad + yaw_rad,
        vehicle.speed_mps * c - vehicle.yaw_rate_radps * north_m,
        vehicle.speed_mps * s + vehicle.yaw_rate_radps * east_m,
    )


def slopes(function: Callable[[FloatArray], FloatArray], x: FloatArray) -> FloatArray:
    """Derivative of `function`, (n,) -> (k,), at `x` (n,): difference quotients, shape (k, n)."""
    steps = _STEP * np.eye(len(x))
    return np.stack(
        [(function(x + step) - function(x - step)) / (2.0 * _STEP) for step in steps],
        axis=-1,
    )


@dataclass(frozen=True)
class Sighting:
    """z of `names` at a stamp, shape (k,), with covariance `R`, (k, k)."""

    stamp_ns: int
    names: tuple[str, ...]
    z: FloatArray
    R: FloatArray
    eye: Eye = _AT_ORIGIN
    loss: float | None = None
    """Width of a Huber loss of one component; None: a Gaussian."""

    def residual(self, x: FloatArray, state_names: tuple[str, ...]) -> FloatArray:
        """z - h(x), whitened, shape (k,); angles go the short way round."""
        y = self.z - seen(self.names, x, state_names, self.eye)
        for k, name in enumerate(self.names):
            if name in _ANGLES:
                y[k] = math.remainder(y[k], 2.0 * math.pi)
        return np.asarray(
            linalg.solve_triangular(linalg.cholesky(self.R, lower=True), y, lower=True)
        )

    def slope(self, x: FloatArray, state_names: tuple[str, ...]) -> FloatArray:
        """Derivative of h by x, whitened, shape (k, n): difference quotients."""
        return -slopes(lambda there: self.residual(there, state_names), x)

    def weight(self, y: FloatArray) -> float:
        """What the sighting counts at the whitened residual `y`."""
        if self.loss is None:
            return 1.0
        beyond = 2.0 * stats.norm.sf(
            self.loss
        )  # the same share of good measurements, whatever is measured
        return 1.0 / max(
            float(np.linalg.norm(y)) / float(stats.chi.isf(beyond, len(y))), 1.0
        )


def seen(
    names: tuple[str, ...], x: FloatArray, state_names: tuple[str, ...], eye: Eye
) -> FloatArray:
    """What `eye` sees of the state `x` (n,), without noise, shape (k,); angles are not wrapped."""
    state = dict(zip(state_names, x.tolist(), strict=True))
    if "vx_mps" in state:
        vx_mps, vy_mps = state["vx_mps"], state["vy_mps"]
        yaw_rad, speed_mps = math.atan2(vy_mps, vx_mps), math.hypot(vx_mps, vy_mps)
    else:
        yaw_rad, speed_mps = state["yaw_rad"], state["speed_mps"]
        vx_mps, vy_mps = speed_mps * math.cos(yaw_rad), speed_mps * math.sin(yaw_rad)
    east_m, north_m = state["x_m"] - eye.x_m, state["y_m"] - eye.y_m
    range_m = math.hypot(east_m, north_m)
    closing = (vx_mps - eye.vx_mps) * east_m + (vy_mps - eye.vy_mps) * north_m
    everything = {
        "x_m": state["x_m"],
        "y_m": state["y_m"],
        "yaw_rad": yaw_rad,
        "speed_mps": speed_mps,
        "range_m": range_m,
        "bearing_rad": math.atan2(north_m, east_m) - eye.yaw_rad,
        "range_rate_mps": closing / range_m if range_m else 0.0,
    }
    return np.array([everything[name] for name in names])


class Estimate(NamedTuple):
    """Mean (n,) and covariance (n, n) of a state."""

    mean: FloatArray
    covariance: FloatArray


@dataclass(frozen=True)
class Problem:
    """An object that starts as `start` at `start_ns` and is seen at or after that."""

    dynamics: Dynamics
    start_ns: int
    start: Estimate
    sightings: tuple[Sighting, ...]

    @property
    def stamps_ns(self) -> list[int]:
        """Stamps of the start and of the sightings, each once, in order."""
        return sorted({self.start_ns, *(one.stamp_ns for one in self.sightings)})

    @property
    def durations_s(self) -> FloatArray:
        """Between the stamps, shape (N - 1,)."""
        return np.asarray(np.diff(np.array(self.stamps_ns)) / NS_PER_S)


def conditioned(
    P: FloatArray, H: FloatArray, R: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Gain K (n, k) of H x + N(0, R) on x of covariance P (n, n), and the covariance that it leaves."""
    K = linalg.solve(H @ P @ H.T + R, H @ P, assume_a="pos").T
    A = np.eye(len(P)) - K @ H
    return K, A @ P @ A.T + K @ R @ K.T


def whitening(covariance: FloatArray) -> FloatArray:
    """W with W' W the inverse of `covariance`."""
    return np.asarray(
        linalg.solve_triangular(
            linalg.cholesky(covariance, lower=True), np.eye(len(covariance)), lower=True
        )
    )


_NAMES = ("x_m", "y_m", "yaw_rad", "speed_mps", "yaw_rate_radps", "accel_mps2")


def kinematic_start(
    names: tuple[str, ...], values: Sequence[float], std: Sequence[float]
) -> Estimate:
    """The start of a state `names` from x, y, yaw, speed, yaw rate and acceleration that are not correlated.

    A velocity (vx, vy) is linearised; across the heading it has the product of the errors of yaw and speed as well.
    """
    own = dict(zip(_NAMES, values, strict=False))
    P, c, s, speed = (
        np.diag(np.square(std)),
        math.cos(own["yaw_rad"]),
        math.sin(own["yaw_rad"]),
        own["speed_mps"],
    )
    own.update(vx_mps=speed * c, vy_mps=speed * s)
    J = np.array([[float(name == shown) for shown in _NAMES] for name in names])
    covariance = np.zeros((len(names), len(names)))
    if "vx_mps" in names:
        J[2:4, 2:4] = [[-speed * s, c], [speed * c, s]]
        covariance[2:4, 2:4] += P[2, 2] * P[3, 3] * np.outer([-s, c], [-s, c])
    return Estimate(np.array([own[name] for name in names]), covariance + J @ P @ J.T)


_MAX_STEPS = 500
#: Of a sighting that a loss ignores.
_LEAST_WEIGHT = 1e-12
_WEIGHT_AT_REST = 1e-12


@dataclass(frozen=True)
class Filtered:
    """The states at the stamps, each after all sightings up to it."""

    problem: Problem
    estimates: dict[int, Estimate]

    def state_at(self, stamp_ns: int) -> Estimate:
        """At any stamp from the start on, predicted where nothing was seen."""
        last_ns = max(at for at in self.estimates if at <= stamp_ns)
        return moved(self.problem, self.estimates[last_ns], stamp_ns - last_ns)


def filtered(problem: Problem) -> Filtered:
    """The filter; sightings of one stamp count one after the other."""
    names, now_ns, estimate = problem.dynamics.names, problem.start_ns, problem.start
    estimates = {}
    for stamp_ns in problem.stamps_ns:
        estimate = moved(problem, estimate, stamp_ns - now_ns)
        for one in problem.sightings:
            if one.stamp_ns == stamp_ns:
                estimate = _with(estimate, one, names)
        estimates[stamp_ns], now_ns = estimate, stamp_ns
    return Filtered(problem, estimates)


def moved(problem: Problem, state: Estimate, ahead_ns: int) -> Estimate:
    """`state` after `ahead_ns`."""
    if not ahead_ns:
        return state
    flow = problem.dynamics.move(state.mean, ahead_ns / NS_PER_S)
    return Estimate(flow.mean, flow.F @ state.covariance @ flow.F.T + flow.Q)


def _with(prior: Estimate, one: Sighting, names: tuple[str, ...]) -> Estimate:
    """The state after a sighting, by tangents at `prior`, weighed by the loss of the residual that is left."""
    y, H, weight = one.residual(prior.mean, names), one.slope(prior.mean, names), 1.0
    for _ in range(_MAX_STEPS):
        K, P = conditioned(
            prior.covariance, H, np.eye(len(y)) / max(weight, _LEAST_WEIGHT)
        )
        step = K @ y
        last, weight = weight, one.weight(y - H @ step)
        if abs(weight - last) < _WEIGHT_AT_REST:
            return Estimate(prior.mean + step, P)
    raise ArithmeticError("the oracle's weight of a sighting does not converge")


#: A step of a state, in m, rad, m/s or rad/s, that is rounding.
_AT_REST = 1e-9


@dataclass(frozen=True)
class Solution:
    """States at all stamps, given everything."""

    problem: Problem
    means: FloatArray
    """Shape (N, n)."""
    covariance: FloatArray
    """Joint covariance, shape (N n, N n)."""

    def state_at(self, stamp_ns: int) -> Estimate:
        """At any stamp from the start on: at a node, predicted, or between two nodes, by tangents."""
        stamps = self.problem.stamps_ns
        place = int(np.searchsorted(stamps, stamp_ns, side="right")) - 1
        n = self.means.shape[1]
        here = slice(place * n, (place + 1) * n)
        mean, P = self.means[place], self.covariance[here, here]
        if place + 1 == len(stamps) or stamps[place] == stamp_ns:
            return moved(self.problem, Estimate(mean, P), stamp_ns - stamps[place])
        until = self.problem.dynamics.move(mean, (stamp_ns - stamps[place]) / NS_PER_S)
        after = self.problem.dynamics.move(
            until.mean, (stamps[place + 1] - stamp_ns) / NS_PER_S
        )
        return self._between(
            slice(place * n, (place + 2) * n), until, after, self.means[place + 1]
        )

    def _between(
        self, both: slice, until: Flow, after: Flow, right: FloatArray
    ) -> Estimate:
        """Condition N(until.mean, until.Q), given the left state, on the right one."""
        by_right, C = conditioned(until.Q, after.F, after.Q)
        by_left = until.F - by_right @ after.F @ until.F
        T = np.hstack([by_left, by_right])
        return Estimate(
            until.mean + by_right @ (right - after.mean),
            C + T @ self.covariance[both, both] @ T.T,
        )


def smoothed(problem: Problem) -> Solution:
    """Least squares over all states; where noise and robust weights follow the state, reweighted until nothing moves.

    Gauss-Newton on the normal equations' orthogonal factor, from the filter's states; a step that comes no closer is
    halved.
    """
    means = np.array(
        [estimate.mean for estimate in filtered(problem).estimates.values()]
    )
    last, share = np.inf, 1.0
    for _ in range(_MAX_STEPS):
        A, b = _rows(problem, means)
        Q, R = np.linalg.qr(A)
        step = np.asarray(linalg.solve_triangular(R, Q.T @ b)).reshape(means.shape)
        longest = float(np.abs(step).max())
        share = 1.0 if longest < 0.95 * last else 0.5
        means, last = means + share * step, longest
        if longest < _AT_REST:
            break
    else:
        raise ArithmeticError(
            f"the oracle's least squares do not converge: the last step is {last:g}"
        )
    A, _ = _rows(problem, means)
    return Solution(problem, means, _covariance(np.asarray(np.linalg.qr(A, mode="r"))))


def _covariance(R: FloatArray) -> FloatArray:
    """The inverse of R'R."""
    root = linalg.solve_triangular(R, np.eye(len(R)))
    return np.asarray(root @ root.T)


def _rows(problem: Problem, means: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Whitened equations A step = b at `means`: of the start, of the segments, of the sightings."""
    count, n = means.shape
    dynamics, place = (
        problem.dynamics,
        {stamp_ns: k for k, stamp_ns in enumerate(problem.stamps_ns)},
    )
    rows, rhs = [], []

    def add(blocks: Iterable[tuple[int, FloatArray]], b: FloatArray) -> None:
        A = np.zeros((len(b), count * n))
        for k, block in blocks:
            A[:, k * n : (k + 1) * n] = block
        rows.append(A)
        rhs.append(b)

    W = whitening(problem.start.covariance)
    add([(0, W)], W @ (problem.start.mean - means[0]))
    flow = dynamics.flow(means[:-1], problem.durations_s)
    for k in range(count - 1):
        W = whitening(flow.Q[k])
        add([(k, -W @ flow.F[k]), (k + 1, W)], W @ (flow.mean[k] - means[k + 1]))
    for one in problem.sightings:
        k = place[one.stamp_ns]
        y, H = (
            one.residual(means[k], dynamics.names),
            one.slope(means[k], dynamics.names),
        )
        root = np.sqrt(one.weight(y))
        add([(k, root * H)], root * y)
    return np.vstack(rows), np.concatenate(rhs)
