"""The slow check: Levenberg-Marquardt on the whole window at every update, with factors that call the models."""

from collections.abc import Callable, Mapping
from typing import ClassVar

import gtsam
import numpy as np
from gtsam.noiseModel import mEstimator
from scipy.linalg.lapack import dtrtri

from fgtrack.core.linalg import identity, inverse_root, noise_root
from fgtrack.core.time import seconds
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.smoothing.bank import SmootherBank
from fgtrack.estimation.smoothing.gtsam.incremental import IncrementalSolver
from fgtrack.estimation.smoothing.terms import MeasurementFactor, linearised, whitened
from fgtrack.models.motion import MotionModel
from fgtrack.models.robust import width

_Loss = (
    mEstimator.Huber
    | mEstimator.Cauchy
    | mEstimator.Tukey
    | mEstimator.GemanMcClure
    | mEstimator.DCS
)
_LOSSES: Mapping[str, Callable[[float], _Loss]] = {
    "huber": mEstimator.Huber.Create,
    "cauchy": mEstimator.Cauchy.Create,
    "tukey": mEstimator.Tukey.Create,
    "geman_mcclure": mEstimator.GemanMcClure.Create,
    "dcs": lambda width: mEstimator.DCS.Create(
        width * width
    ),  # gtsam's is in squared standard deviations
}


class BatchSolver(IncrementalSolver):
    """Windows that Levenberg-Marquardt solves from their last estimates; a prior replaces what leaves them.
    Process noise stays that of the linearisation point; all else is relinearised at every step.
    """

    is_damped: ClassVar[bool] = True

    def optimise(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values
    ) -> gtsam.Values:
        """Return the values near `values` with the least error."""
        params = gtsam.LevenbergMarquardtParams()
        params.setLinearSolverType("MULTIFRONTAL_QR")
        params.setRelativeErrorTol(1e-12)
        params.setAbsoluteErrorTol(1e-12)
        return gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()

    def _update(self, tracks: IntArray, starts: IntArray) -> None:
        nodes, n = self.nodes, self.motion.dim
        for track in tracks.tolist():
            graph, values, numbers = (
                gtsam.NonlinearFactorGraph(),
                gtsam.Values(),
                nodes.window(track).tolist(),
            )
            _, last = self._graphs.get(track, (None, values))
            prior = nodes.predicted[numbers[0]]
            noise = gtsam.noiseModel.Gaussian.Covariance(prior[:, :n])
            graph.add(
                gtsam.PriorFactorVector(
                    numbers[0], nodes.origin[numbers[0]] + prior[:, n], noise
                )
            )
            spans_ns = np.diff(nodes.window_stamps_ns(track)).tolist()
            for left, right, dt_ns in zip(numbers, numbers[1:], spans_ns, strict=False):
                graph.add(
                    motion_factor(
                        self.motion, left, right, seconds(dt_ns), nodes.Q[left]
                    )
                )
            for number in numbers:
                values.insert(
                    number,
                    last.atVector(number)
                    if last.exists(number)
                    else nodes.origin[number],
                )
                for factor in nodes.factors(number):
                    graph.add(
                        measurement_factor(
                            number, factor, nodes.origin[number], self.motion
                        )
                    )
            values = self.optimise(graph, values)
            self._graphs[track] = graph, values
            for number in numbers:
                nodes.step[number] = values.atVector(number) - nodes.origin[number]

    def _covariance(self, track: int, *numbers: int) -> FloatArray:
        """See `IncrementalSolver._covariance`; from one dense QR of the whole linearised window."""
        graph, values = self._graphs[track]
        ordering, n = gtsam.Ordering(), self.motion.dim
        for number in (*sorted(set(values.keys()).difference(numbers)), *numbers):
            ordering.push_back(number)
        A, _ = graph.linearize(values).jacobian(ordering)
        R, size = np.asarray(np.linalg.qr(A, mode="r")), n * len(numbers)
        root = dtrtri(R[-size:, -size:])[0]
        return np.asarray(root @ root.T)


def motion_factor(
    motion: MotionModel, left: int, right: int, dt_s: float, Q: FloatArray
) -> gtsam.NonlinearFactor:
    """Return the factor of the motion from the state at key `left` to that at `right`, with noise Q (n, n)."""

    def error(
        this: gtsam.CustomFactor,
        values: gtsam.Values,
        jacobians: list[FloatArray] | None,
    ) -> FloatArray:
        mean, F, _ = motion.transition(values.atVector(left), dt_s)
        if jacobians is not None:
            jacobians[0], jacobians[1] = -F, identity(motion.dim)
        return np.subtract(values.atVector(right), mean)

    return gtsam.CustomFactor(_gaussian(noise_root(Q)), [left, right], error)


def measurement_factor(
    key: int, factor: MeasurementFactor, origin: FloatArray, motion: MotionModel
) -> gtsam.NonlinearFactor:
    """Return the factor of `factor` on the state at `key`; a linear one takes angles on the branch next to `origin`.
    Raises `numpy.linalg.LinAlgError` for a covariance that is not positive definite.
    """
    measurement = factor[0]
    if not measurement.is_nonlinear:
        rows, at = whitened(factor, origin, motion), gtsam.Values()
        at.insert(key, origin)
        linear = gtsam.JacobianFactor(
            key, rows[:, :-1], rows[:, -1], gtsam.noiseModel.Unit.Create(len(rows))
        )
        return gtsam.LinearContainerFactor(linear, at)

    def error(
        this: gtsam.CustomFactor,
        values: gtsam.Values,
        jacobians: list[FloatArray] | None,
    ) -> FloatArray:
        y, H = linearised(factor, values.atVector(key), motion)
        if jacobians is not None:
            jacobians[0] = H
        return -y

    noise, loss = _gaussian(inverse_root(measurement.R)), measurement.loss
    if loss is not None:
        noise = gtsam.noiseModel.Robust.Create(
            _LOSSES[loss.kind](width(loss, len(measurement.R))), noise
        )
    return gtsam.CustomFactor(noise, [key], error)


def _gaussian(root: FloatArray) -> gtsam.noiseModel.Base:
    return gtsam.noiseModel.Gaussian.SqrtInformation(root, smart=False)


class BatchBank(SmootherBank):
    """Fixed-lag smoother, a factor graph that Levenberg-Marquardt solves at every update: slow, for checks."""

    make_solver = BatchSolver
    tolerance = 1e-6  # it compares errors at absolute positions: eps W of 50 m instead of the standard deviation, 0.5 m
    rounding = 100.0
