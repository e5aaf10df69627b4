from collections.abc import Callable, Sequence

import numpy as np
import pytest

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.base import Measurement, Start
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.filters.replay import ReplayEkf
from fgtrack.evaluation.bounds import (
    Bounds,
    ScheduledMeasurement,
    _step,
    bounds,
    bounds_along,
)
from fgtrack.models.measurement import measurement_model
from fgtrack.models.motion import CTRV, CV, MotionModel

START_NS = 1_790_000_000 * NS_PER_S
PRIOR = Start(
    stamp_ns=START_NS,
    position_covariance=0.5 * np.eye(2),
    yaw_rad=0.3,
    yaw_std_rad=0.2,
    speed_mps=20.0,
    speed_std_mps=2.0,
    yaw_rate_std_radps=0.2,
)


def planned(motion: MotionModel, seed: int = 0) -> list[ScheduledMeasurement]:
    """Positions at 10 Hz 350 ms late, and others in between that come at once; jitter makes some overtake."""
    rng = np.random.default_rng(seed)
    model = measurement_model(("x_m", "y_m"), motion)
    found = []
    for k in range(1, 20):
        late_ns = int(rng.uniform(0.3, 0.4) * NS_PER_S)
        stamp_ns = START_NS + k * 100_000_000
        found.append(
            ScheduledMeasurement(stamp_ns, stamp_ns + late_ns, model, 0.04 * np.eye(2))
        )
        found.append(
            ScheduledMeasurement(
                stamp_ns + 40_000_000, stamp_ns + 45_000_000, model, 2.0 * np.eye(2)
            )
        )
    return found


def straight(motion: MotionModel, x: FloatArray, trajectories: int = 1):
    def truth(stamps_ns: IntArray) -> FloatArray:
        states = motion.predict(x, (stamps_ns - START_NS) / NS_PER_S)
        return np.broadcast_to(states, (trajectories, *states.shape))

    return truth


def replayed(
    motion: MotionModel, items: Sequence[ScheduledMeasurement], now_ns: int
) -> FloatArray:
    """Covariance of the exact filter, given `items` with any values."""
    estimator = ReplayEkf(motion, PRIOR, 100.0)
    for item in items:
        estimator.update(Measurement(item.stamp_ns, item.model, np.zeros(2), item.R))
    return estimator.state_at(now_ns).covariance


NOW_NS = [START_NS + k * 130_000_000 for k in range(1, 15)]


def test_in_a_linear_model_the_bounds_are_the_covariances_of_the_exact_filter() -> None:
    motion = CV(5.0)
    items = planned(motion)
    x, P = initial_state(motion, PRIOR)
    found = bounds(motion, START_NS, P, items, straight(motion, x), NOW_NS)
    for i, now_ns in enumerate(NOW_NS):
        sensed = [item for item in items if item.stamp_ns <= now_ns]
        arrived = [item for item in items if item.receipt_ns <= now_ns]
        newest_ns = 0
        kept = []
        for item in sorted(arrived, key=lambda item: item.receipt_ns):
            if item.stamp_ns >= newest_ns:
                kept.append(item)
            newest_ns = max(newest_ns, item.stamp_ns)
        for covariance, expected in zip(
            (found.in_time[i], found.arrived[i], found.dropped[i]),
            (sensed, arrived, kept),
            strict=True,
        ):
            np.testing.assert_allclose(
                covariance, replayed(motion, expected, now_ns), rtol=1e-9, atol=1e-12
            )


@pytest.mark.parametrize("motion", [CV(5.0), CTRV()])
def test_what_has_arrived_lies_between_all_and_what_came_in_time(
    motion: MotionModel,
) -> None:
    x, P = initial_state(motion, PRIOR)
    found = bounds(
        motion,
        START_NS,
        P,
        planned(motion),
        straight(motion, x, trajectories=3),
        NOW_NS,
    )
    for smaller, larger in (
        (found.in_time, found.arrived),
        (found.arrived, found.dropped),
    ):
        least = np.linalg.eigvalsh(larger - smaller).min(axis=-1)
        assert (least > -1e-9).all()
    assert np.trace(found.dropped[-1] - found.arrived[-1]) > 1e-3


def test_the_bounds_along_trajectories_are_the_mean_of_those_of_each() -> None:
    motion = CTRV()
    x, P = initial_state(motion, PRIOR)
    starts = (
        x + np.random.default_rng(1).standard_normal((3, 5)) @ np.linalg.cholesky(P).T
    )

    def truth(stamps_ns: IntArray) -> FloatArray:
        return motion.predict(starts[:, None], (stamps_ns - START_NS) / NS_PER_S)

    found = bounds_along(motion, START_NS, P, planned(motion), truth, NOW_NS)
    each = [
        bounds(motion, START_NS, P, planned(motion), straight(motion, start), NOW_NS)
        for start in starts
    ]
    for mean, single in zip(found, zip(*each, strict=True), strict=True):
        np.testing.assert_allclose(mean, np.mean(single, axis=0), rtol=1e-12)


@pytest.mark.parametrize("function", [bounds, bounds_along])
def test_a_measurement_before_the_start_is_refused(
    function: Callable[..., Bounds],
) -> None:
    motion = CV(5.0)
    x, P = initial_state(motion, PRIOR)
    early = ScheduledMeasurement(
        START_NS - 1, START_NS, measurement_model(("x_m", "y_m"), motion), np.eye(2)
    )
    with pytest.raises(ValueError, match="start_ns"):
        function(motion, START_NS, P, [early], straight(motion, x), NOW_NS)


def test_noise_that_depends_on_the_state_tells_of_it() -> None:
    """Its part of the information is the curvature of the divergence between the noises of neighbouring states."""
    motion, dt_s, h = CTRV(), 0.2, 1e-3
    x = np.array([0.0, 0.0, 0.7, 8.0, 0.3])

    def divergence(shift: FloatArray) -> float:
        """Kullback-Leibler divergence of N(0, Q(x)) from N(0, Q(x + shift))."""
        Q, other = motion.process_noise(x, dt_s), motion.process_noise(x + shift, dt_s)
        ratio = np.linalg.solve(other, Q)
        return 0.5 * float(np.trace(ratio) - len(x) - np.linalg.slogdet(ratio)[1])

    J = np.empty((5, 5))
    for i, a in enumerate(h * np.eye(5)):
        for j, b in enumerate(h * np.eye(5)):
            corners = (
                divergence(a + b)
                - divergence(a - b)
                - divergence(b - a)
                + divergence(-a - b)
            )
            J[i, j] = corners / (4.0 * h * h)
    F, weight = motion.jacobian(x, dt_s), np.linalg.inv(motion.process_noise(x, dt_s))
    D11, D12, D22 = _step(motion, x[None], dt_s)
    np.testing.assert_allclose(
        D11 - F.T @ weight @ F, J, rtol=1e-3, atol=1e-3 * J.max()
    )
    np.testing.assert_allclose(D22, weight, rtol=1e-9)
    np.testing.assert_allclose(D12, -F.T @ weight, rtol=1e-9)
    assert J[2, 2] > 1.0  # the heading shows in the direction of the noise
