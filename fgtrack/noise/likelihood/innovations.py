"""The log-likelihood of innovations at many vectors of parameters at once, linearised about one trajectory.

Along a trajectory all that depends on the parameters is the noise. It is that of the filter itself (`filtered`), so
each linearisation depends on earlier measurements only, and the score has mean zero at the true parameters (Schweppe
1965, "Evaluation of likelihood functions for Gaussian signals", IEEE Transactions on Information Theory 11(1)).
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.filters.ekf import joseph, kalman_gain, propagated
from fgtrack.noise.likelihood.contaminated import update
from fgtrack.noise.likelihood.reference import Step, filtered
from fgtrack.noise.likelihood.series import NoiseSpace, Series


class Evaluation(NamedTuple):
    """N innovations at b vectors of parameters, padded with components 0 of variance 1."""

    log_likelihoods: FloatArray
    """Log densities, shape (b, N)."""
    y: FloatArray
    """Shape (b, N, d)."""
    S: FloatArray
    """Covariances where the errors are nominal, shape (b, N, d, d)."""


class Innovations:
    """Series linearised at `values`, shape (p,), side by side: step k of each of t series, padded at the end."""

    def __init__(
        self, space: NoiseSpace, values: FloatArray, series: Sequence[Series]
    ) -> None:
        self._space = space
        steps = [filtered(item, space, values) for item in series]
        motion = space.motion_model(values)
        self._start = np.array(
            [initial_state(motion, item.start)[1] for item in series]
        )
        n, columns = (
            motion.dim,
            {name: column for column, name in enumerate(space.names)},
        )
        d = max(len(step.y) for track in steps for step in track)
        a = max(len(step.assumed[0]) for track in steps for step in track)

        def padded(
            value: Callable[[Step], ArrayLike], *size: int, fill: ArrayLike = 0.0
        ) -> FloatArray:
            """A value of each step, shape (k, t, *size)."""
            array = np.full((max(map(len, steps)), len(steps), *size), fill)
            for t, track in enumerate(steps):
                for k, step in enumerate(track):
                    entry = np.asarray(value(step))
                    index: tuple[int | slice, ...] = (k, t, *map(slice, entry.shape))
                    array[index] = entry
            return array

        since_s = padded(lambda step: step.since_s, fill=math.nan)
        self._there = np.isfinite(since_s)
        self.counted: BoolArray = np.zeros(since_s.shape, dtype=np.bool_)
        """True for steps that have a part in the likelihood, shape (k, t)."""
        self.since_start_s = np.zeros(since_s.shape)
        """Time of each step since the first state, shape (k, t)."""
        for t, item in enumerate(series):
            stamps_ns = np.array(
                [each.measurement.stamp_ns for each in item.observations]
            )
            self.counted[: len(stamps_ns), t] = item.counted
            self.since_start_s[: len(stamps_ns), t] = (
                stamps_ns - item.start.stamp_ns
            ) / NS_PER_S
        self._since_s = np.nan_to_num(since_s)
        self._about, self._offset = (
            padded(lambda step: step.about, n),
            padded(lambda step: step.before - step.about, n),
        )
        self._predicted, self._after = (
            padded(lambda step: step.predicted, n),
            padded(lambda step: step.after, n),
        )
        self._y, self._H = (
            padded(lambda step: step.y, d),
            padded(lambda step: step.H, d, n),
        )
        self._axes = padded(
            lambda step: step.observation.axes * step.observation.tuned, d, d
        )
        self._own = padded(lambda step: step.observation.own, d, d)
        self._foreign = padded(
            lambda step: step.observation.foreign, d, d, fill=np.eye(d)
        )
        none = len(columns)  # a last column of zeros
        self._std: IntArray = padded(
            lambda step: [columns[name] for name in step.observation.parameters],
            d,
            fill=none,
        ).astype(np.int64)
        odds = padded(lambda step: columns[step.observation.sensor, ""], fill=none)
        self._odds: IntArray = odds.astype(np.int64)
        self._padding = d - padded(lambda step: len(step.y))
        self._assumed = (
            padded(lambda step: step.assumed[0], a),
            padded(lambda step: step.assumed[1], a, n),
            padded(lambda step: step.assumed[2], a, a, fill=np.eye(a)),
        )
        self._F = motion.jacobian(self._about, self._since_s)
        self._parts = space.noise_parts(self._about, self._since_s)
        self._has_assumed: list[bool] = np.any(
            self._assumed[1], axis=(1, 2, 3)
        ).tolist()

    def evaluate(self, values: FloatArray) -> Evaluation:
        """Return the N innovations that count, at each row of `values`, (b, p)."""
        num_steps, num_series = self._there.shape
        b, n = len(values), self._about.shape[-1]
        extended = np.concatenate([values, np.zeros((b, 1))], axis=1)
        d = self._y.shape[-1]
        log_likelihoods = np.empty((num_steps, b, num_series))
        ys, Ss = (
            np.empty((num_steps, b, num_series, d)),
            np.empty((num_steps, b, num_series, d, d)),
        )
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
            item = update(P, H, y, R[:, j], self._foreign[k], odds[:, j])
            x, P = x + item.step, item.covariance
            log_likelihoods[k], ys[k], Ss[k] = item.log_likelihood, y, item.S
            if self._has_assumed[k]:
                y, H, R_assumed = (array[k] for array in self._assumed)
                K, _ = kalman_gain(P, np.broadcast_to(H, (b, *H.shape)), R_assumed)
                x = x + (K @ (y - (H @ x[..., None])[..., 0])[..., None])[..., 0]
                P = joseph(P, K, H, R_assumed)
            x = x + (self._predicted[k] - self._after[k])
        log_likelihoods += 0.5 * math.log(math.tau) * self._padding[:, None]
        return Evaluation(
            *(
                array.swapaxes(0, 1)[:, self.counted]
                for array in (log_likelihoods, ys, Ss)
            )
        )

    def _transitions(
        self, values: FloatArray, block: slice
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return F, the change of the prediction against that of the reference, and Q of a block of steps, by row."""
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
