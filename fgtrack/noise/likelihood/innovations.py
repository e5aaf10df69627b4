"""Log-likelihood of innovations for many parameter vectors at once, linearised about one trajectory.

Along a fixed trajectory only the noise depends on the parameters. The filter itself
makes the trajectory (`filtered`). So each linearisation depends on earlier measurements
only, and the score has mean zero at the true parameters.

Source: Schweppe 1965, "Evaluation of likelihood functions for Gaussian signals", IEEE
Transactions on Information Theory 11(1).
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.filters.ekf import correct, propagated
from fgtrack.noise.likelihood.contaminated import update
from fgtrack.noise.likelihood.reference import FilteredObservation, filtered
from fgtrack.noise.likelihood.series import NoiseSpace, Series


class Evaluation(NamedTuple):
    """N innovations for b parameter vectors, padded with components of value 0 and variance 1."""

    log_likelihoods: FloatArray
    """Log densities of the innovations, shape (b, N)."""
    y: FloatArray
    """Innovations, shape (b, N, d)."""
    S: FloatArray
    """Covariances of the innovations for nominal errors, shape (b, N, d, d)."""


class Innovations:
    """Filter steps of t series, linearised at `values`, shape (p,), in arrays.

    Arrays have the shape (k, t, ...): step k of each series, padded at the end of
    shorter series.
    """

    def __init__(
        self, space: NoiseSpace, values: FloatArray, series: Sequence[Series]
    ) -> None:
        self._space = space
        steps = [filtered(item, space, values) for item in series]
        motion = space.motion_model(values)
        self._start = np.array(
            [initial_state(motion, item.start)[1] for item in series]
        )
        n = motion.dim
        columns = {name: column for column, name in enumerate(space.names)}
        d = max(len(step.y) for track in steps for step in track)
        a = max(len(step.assumed[0]) for track in steps for step in track)

        def padded(
            value: Callable[[FilteredObservation], ArrayLike],
            *size: int,
            fill: ArrayLike = 0.0,
        ) -> FloatArray:
            """Array (k, t, *size) of a value of each step, filled with `fill` beyond the end of a series."""
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
        """Mask of the steps that contribute to the likelihood, shape (k, t)."""
        self.since_start_s = np.zeros(since_s.shape)
        """Time from the first state to each step, shape (k, t)."""
        for t, item in enumerate(series):
            stamps_ns = np.array(
                [each.measurement.stamp_ns for each in item.observations]
            )
            self.counted[: len(stamps_ns), t] = item.counted
            self.since_start_s[: len(stamps_ns), t] = (
                stamps_ns - item.start.stamp_ns
            ) / NS_PER_S
        self._since_s = np.nan_to_num(since_s)
        self._about = padded(lambda step: step.about, n)
        self._offset = padded(lambda step: step.before - step.about, n)
        self._predicted = padded(lambda step: step.predicted, n)
        self._after = padded(lambda step: step.after, n)
        self._y = padded(lambda step: step.y, d)
        self._H = padded(lambda step: step.H, d, n)
        self._axes = padded(
            lambda step: step.observation.axes * step.observation.tuned, d, d
        )
        self._own = padded(lambda step: step.observation.own, d, d)
        self._foreign = padded(
            lambda step: step.observation.other_errors, d, d, fill=np.eye(d)
        )
        none = len(columns)  # index of an additional column of zeros
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
        """Return the N counted innovations for each parameter vector in `values` (b, p)."""
        num_steps, num_series = self._there.shape
        b, n = len(values), self._about.shape[-1]
        extended = np.concatenate([values, np.zeros((b, 1))], axis=1)
        d = self._y.shape[-1]
        log_likelihoods = np.empty((num_steps, b, num_series))
        ys = np.empty((num_steps, b, num_series, d))
        Ss = np.empty((num_steps, b, num_series, d, d))
        x = np.zeros((b, num_series, n))
        P = np.broadcast_to(self._start, (b, *self._start.shape))
        size = max(1, int(1e6 / (b * num_series * n * n)))
        for k in range(num_steps):
            j = k % size
            if j == 0:  # compute a block of steps that fits into the processor's cache
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
            log_likelihoods[k] = item.log_likelihood
            ys[k] = y
            Ss[k] = item.S
            if self._has_assumed[k]:
                y, H, R_assumed = (array[k] for array in self._assumed)
                x, P = _corrected(x, P, y - (H @ x[..., None])[..., 0], H, R_assumed)
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
        """Return F (..., n, n), drift (..., n) and Q (..., n, n) of a `block` of steps, for each parameter vector in
        `values`.

        The drift is the prediction minus the reference prediction. If only Q depends on the parameters, F and drift
        have a first axis of length 1, and the drift is 0.
        """
        if self._parts is not None:
            rest, parts = self._parts
            weights = np.square(values[:, : len(parts)])
            Q = rest[block] + np.tensordot(weights, parts[:, block], axes=1)
            return self._F[None, block], np.zeros((1, *self._about[block].shape)), Q
        x = self._about[block]
        dt_s = self._since_s[block]
        there = self._there[block]
        models = [self._space.motion_model(row) for row in values]
        moved = np.array([model.predict(x, dt_s) for model in models])
        F = np.array([model.jacobian(x, dt_s) for model in models])
        Q = np.array([model.process_noise(x, dt_s) for model in models])
        moved = moved + (F @ self._offset[block][..., None])[..., 0]
        return F, np.where(there[..., None], moved - self._predicted[block], 0.0), Q


def _corrected(
    x: FloatArray, P: FloatArray, y: FloatArray, H: FloatArray, R: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return means (b, t, n) and covariances (b, t, n, n) after innovations y (b, t, a).

    H (t, a, n) and R (t, a, a) are the same for all b parameter vectors.
    """
    b, (a, n) = len(x), H.shape[-2:]
    result = correct(
        x.reshape(-1, n),
        P.reshape(-1, n, n),
        y.reshape(-1, a),
        np.tile(H, (b, 1, 1)),
        np.tile(R, (b, 1, 1)),
    )
    return result.mean.reshape(x.shape), result.covariance.reshape(P.shape)
