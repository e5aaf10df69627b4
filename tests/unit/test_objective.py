"""Objective `map`: the smoother finds the minimum that SciPy finds, and the two objectives differ as they should."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy import optimize

from fgtrack.core.geometry import wrap_angles
from fgtrack.core.types import YAW, FloatArray
from fgtrack.estimation.factor_graph.smoother import FixedLagSmoother
from fgtrack.estimation.following_noise import log_determinant, segment_rows
from fgtrack.models.motion import CTRA, CTRV, MotionModel
from fgtrack.pipeline import verify_streams
from fgtrack.pipeline.oracle.posterior import most_probable
from fgtrack.pipeline.verify import one_estimator
from fgtrack.pipeline.verify_streams import Stream

LEFT = np.array([3.0, -2.0, 2.1, 9.0, -0.3, 1.5])


def smoothed(stream: Stream, name: str, objective: str, order: str = "random") -> FixedLagSmoother:
    subject = one_estimator(name)[name]
    estimator = replace(subject, options={**subject.options, "objective": objective}).start(stream)
    for place in stream.orders[order]:
        estimator.update(stream.measurements[place])
    assert isinstance(estimator, FixedLagSmoother)
    return estimator


def apart(stream: Stream, estimator: FixedLagSmoother, means: FloatArray, reach_s: float = 1e3) -> float:
    """Largest difference of the means at the nodes of the last `reach_s`, in standard deviations."""
    sigma = np.sqrt(np.diag(stream.solution.covariance)).reshape(means.shape)
    stamps_ns = stream.problem.stamps_ns
    places = [k for k, at in enumerate(stamps_ns) if at >= stream.newest_ns - 1e9 * reach_s]
    found = np.array([estimator.state_at(stamps_ns[k]).mean for k in places])
    off = found - means[places]
    off[:, YAW] = wrap_angles(off[:, YAW])
    return float((np.abs(off) / sigma[places]).max())


@pytest.mark.parametrize("motion", [CTRV(), CTRA()])
def test_half_the_squares_of_the_rows_have_the_gradient_of_the_negative_log_density(motion: MotionModel) -> None:
    n, dt_s = motion.dim, 0.4
    left = LEFT[:n]
    right = motion.predict(left, dt_s) + np.linspace(0.05, -0.03, n)

    def cost(both: FloatArray) -> float:
        Q = motion.process_noise(both[:n], dt_s)
        e = both[n:] - motion.predict(both[:n], dt_s)
        return float(0.5 * e @ np.linalg.solve(Q, e) + 0.5 * np.linalg.slogdet(Q)[1])

    level = log_determinant(motion, left, dt_s) - 3.0  # its value does not matter
    rows = segment_rows(motion, left, right, dt_s, level)
    gradient = np.concatenate([rows.by_left.T @ rows.value, rows.by_right.T @ rows.value])
    expected = optimize.approx_fprime(np.concatenate([left, right]), cost, 1e-7)
    np.testing.assert_allclose(gradient, expected, rtol=1e-4, atol=1e-3)
    assert rows.root @ rows.root.T == pytest.approx(motion.process_noise(left, dt_s))


def test_a_process_noise_that_vanishes_is_an_error_of_linear_algebra() -> None:
    with pytest.raises(np.linalg.LinAlgError, match="shrunk to nothing"):
        segment_rows(CTRV(), LEFT[:5], LEFT[:5], 0.1, level=1e6)
    with pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
        log_determinant(CTRV(speed_density_m2ps3=0.0), LEFT[:5], 0.1)


@pytest.mark.parametrize("name", ["smoother", "smoother-batch"])
@pytest.mark.parametrize("draw", [verify_streams.observed, verify_streams.accelerated])
def test_the_smoother_gives_the_most_probable_states(name: str, draw: Callable[[np.random.Generator], Stream]) -> None:
    stream = draw(np.random.default_rng(1))
    means = most_probable(stream.problem)
    assert apart(stream, smoothed(stream, name, "map"), means) < 1e-5
    assert apart(stream, smoothed(stream, name, "reweighted"), means) > 3e-3


def test_what_has_left_the_window_stays_linearised_where_it_was() -> None:
    stream = verify_streams.short(np.random.default_rng(1))
    means = most_probable(stream.problem)
    for name in ("smoother", "smoother-batch"):
        estimator = smoothed(stream, name, "map", "time")
        assert apart(stream, estimator, means, stream.lag_s) < 2e-2
        estimator.converge()
        assert apart(stream, estimator, means, stream.lag_s) < 2e-3


def test_a_linear_model_has_one_objective() -> None:
    stream = verify_streams.close(np.random.default_rng(1))
    both = [smoothed(stream, "smoother", objective).state_at(stream.newest_ns) for objective in ("map", "reweighted")]
    assert (both[0].mean == both[1].mean).all()
    assert (both[0].covariance == both[1].covariance).all()
