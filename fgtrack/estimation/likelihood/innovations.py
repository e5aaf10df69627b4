"""The log-likelihood of innovations at many vectors of parameters at once, linearised about one trajectory.

Along a given trajectory motion and measurements are linear, so all that depends on the parameters is the noise. The
trajectory is that of the filter itself (`filtered`), so each linearisation depends on earlier measurements only; the
score then has mean zero at the true parameters where the model is right, as that of the filter has (Schweppe 1965,
"Evaluation of likelihood functions for Gaussian signals", IEEE Transactions on Information Theory 11(1)).
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from fgtrack.core.time import seconds
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.filters.ekf import joseph, kalman_gain, propagated
from fgtrack.estimation.likelihood.contaminated import update
from fgtrack.estimation.likelihood.noise import NoiseSpace
from fgtrack.estimation.likelihood.reference import Step
from fgtrack.estimation.likelihood.series import Series


class Evaluation(NamedTuple):
    """N innovations at b vectors of parameters, padded with components 0 of variance 1."""

    log_likelihoods: FloatArray
    """Log densities, shape (b, N)."""
    y: FloatArray
    """Shape (b, N, d)."""
    S: FloatArray
    """Covariances where the errors are nominal, shape (b, N, d, d)."""


class Innovations:
    """Linearised series, side by side: step k of each of t series, padded where a series is shorter."""

    def __init__(
        self,
        space: NoiseSpace,
        values: FloatArray,
        series: Sequence[Series],
        steps: Sequence[Sequence[Step]],
        counts: Callable[[Series, int], bool],
    ) -> None:
        """`steps`: those of `filtered` along each of the `series` at `values`, shape (p,).

        `counts`: True if observation k of a series has a part in the likelihood; every one moves the state.
        """
        self._space = space
        motion = space.motion_model(values)
        self._start = np.array([initial_state(motion, one.start)[1] for one in series])
        shape = max(map(len, steps)), len(series)
        d = max(len(step.y) for track in steps for step in track)
        a = max(len(step.assumed[0]) for track in steps for step in track)
        n, columns = motion.dim, {name: column for column, name in enumerate(space.names)}
        none = len(columns)  # a last column of zeros
        self.counted: BoolArray = np.zeros(shape, dtype=np.bool_)
        """True for steps that have a part in the likelihood, shape (k, t)."""
        self.since_start_s = np.zeros(shape)
        """Time of each step since the first state, shape (k, t)."""
        self._since_s = np.full(shape, np.nan)
        self._about, self._offset = np.zeros((*shape, n)), np.zeros((*shape, n))
        self._predicted, self._after = np.zeros((*shape, n)), np.zeros((*shape, n))
        self._y, self._H = np.zeros((*shape, d)), np.zeros((*shape, d, n))
        self._axes, self._own = np.zeros((*shape, d, d)), np.zeros((*shape, d, d))
        self._foreign = np.broadcast_to(np.eye(d), (*shape, d, d)).copy()
        self._std: IntArray = np.full((*shape, d), none)
        self._odds: IntArray = np.full(shape, none)
        self._padding = np.full(shape, d)
        self._assumed = np.zeros((*shape, a)), np.zeros((*shape, a, n)), np.zeros((*shape, a, a))
        self._assumed[2][:] = np.eye(a)
        for t, (track, one) in enumerate(zip(steps, series, strict=True)):
            for k, step in enumerate(track):
                self.counted[k, t] = counts(one, k)
                self.since_start_s[k, t] = seconds(step.observation.measurement.stamp_ns - one.start.stamp_ns)
                self._set(k, t, step, columns)
        self._there = np.isfinite(self._since_s)
        self._since_s = np.where(self._there, self._since_s, 0.0)
        self._F = motion.jacobian(self._about, self._since_s)
        self._parts = space.noise_parts(self._about, self._since_s)
        self._has_assumed: list[bool] = np.any(self._assumed[1], axis=(1, 2, 3)).tolist()

    def _set(self, k: int, t: int, step: Step, columns: Mapping[tuple[str, str], int]) -> None:
        """Set step k of series t; `columns` are those of the parameters."""
        observation, size = step.observation, len(step.y)
        sensor, names = observation.sensor, observation.measurement.model.components
        self._since_s[k, t] = step.since_s
        self._about[k, t], self._offset[k, t] = step.about, step.before - step.about
        self._predicted[k, t], self._after[k, t] = step.predicted, step.after
        self._y[k, t, :size], self._H[k, t, :size] = step.y, step.H
        self._foreign[k, t, :size, :size] = observation.foreign
        if observation.tuned:
            self._axes[k, t, :size, :size] = observation.axes
            self._std[k, t, :size] = [columns[sensor, names[i]] for i in observation.measured]
        self._own[k, t, :size, :size] = observation.own
        self._odds[k, t] = columns[sensor, ""]
        self._padding[k, t] -= size
        y, H, R = step.assumed
        self._assumed[0][k, t, : len(y)], self._assumed[1][k, t, : len(y)] = y, H
        self._assumed[2][k, t, : len(y), : len(y)] = R

    def evaluate(self, values: FloatArray) -> Evaluation:
        """Return the N innovations that count, at each row of `values`, (b, p)."""
        num_steps, num_series = self._there.shape
        b, n = len(values), self._about.shape[-1]
        extended = np.concatenate([values, np.zeros((b, 1))], axis=1)
        d = self._y.shape[-1]
        log_likelihoods = np.empty((num_steps, b, num_series))
        ys, Ss = np.empty((num_steps, b, num_series, d)), np.empty((num_steps, b, num_series, d, d))
        x = np.zeros((b, num_series, n))
        P = np.broadcast_to(self._start, (b, *self._start.shape))
        size = max(1, int(1e6 / (b * num_series * n * n)))
        for k in range(num_steps):
            j = k % size
            if j == 0:  # as many steps at once as fit into the cache
                block = slice(k, k + size)
                F, drift, Q = self._transitions(values, block)
                rooted = self._axes[block] * extended[:, self._std[block]][..., None, :]
                R = rooted @ rooted.mT + self._own[block]
                odds = extended[:, self._odds[block]]
            x = (F[:, j] @ x[..., None])[..., 0] + drift[:, j]
            P = propagated(F[:, j], P, Q[:, j])
            H = self._H[k]
            y = self._y[k] - (H @ x[..., None])[..., 0]
            one = update(P, H, y, R[:, j], self._foreign[k], odds[:, j])
            x, P = x + one.step, one.covariance
            log_likelihoods[k], ys[k], Ss[k] = one.log_likelihood, y, one.S
            if self._has_assumed[k]:
                y, H, R_assumed = (array[k] for array in self._assumed)
                K, _ = kalman_gain(P, np.broadcast_to(H, (b, *H.shape)), R_assumed)
                x = x + (K @ (y - (H @ x[..., None])[..., 0])[..., None])[..., 0]
                P = joseph(P, K, H, R_assumed)
            x = x + (self._predicted[k] - self._after[k])
        log_likelihoods += 0.5 * math.log(math.tau) * self._padding[:, None]
        return Evaluation(*(array.swapaxes(0, 1)[:, self.counted] for array in (log_likelihoods, ys, Ss)))

    def _transitions(self, values: FloatArray, block: slice) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return F, the change of the prediction against that of the reference, and Q of a block of steps, by row.

        White noise changes Q alone: then the first two have one row for all.
        """
        if self._parts is not None:
            rest, parts = self._parts
            weights = np.square(values[:, : len(parts)])
            Q = rest[block] + np.tensordot(weights, parts[:, block], axes=1)
            return self._F[None, block], np.zeros((1, *self._about[block].shape)), Q
        x, dt_s, there = self._about[block], self._since_s[block], self._there[block]
        models = [self._space.motion_model(row) for row in values]
        moved = np.array([model.predict(x, dt_s) for model in models])
        F = np.array([model.jacobian(x, dt_s) for model in models])
        Q = np.array([model.process_noise(x, dt_s) for model in models])
        moved = moved + (F @ self._offset[block][..., None])[..., 0]
        return F, np.where(there[..., None], moved - self._predicted[block], 0.0), Q
