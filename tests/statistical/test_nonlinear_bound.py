"""In a nonlinear model nobody is better than the posterior bound, and those along the trajectories are reached."""

from dataclasses import dataclass

import numpy as np
import pytest

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.base import Estimator, Measurement, Start
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.filters.replay import ReplayEkf
from fgtrack.estimation.registry import estimator
from fgtrack.evaluation.bounds import Bounds, ScheduledMeasurement, bounds, bounds_along
from fgtrack.models.measurement import measurement_model
from fgtrack.models.motion import CTRV, MotionModel
from fgtrack.sim.vehicles import draw_states

STEP_NS = 50_000_000
START_NS = 1_790_000_000 * NS_PER_S
PRIOR = Start(
    stamp_ns=START_NS,
    position_std_m=0.3,
    yaw_rad=0.4,
    yaw_std_rad=0.1,
    speed_mps=30.0,
    speed_std_mps=2.0,
    yaw_rate_radps=0.05,
    yaw_rate_std_radps=0.02,
)
NUM_STEPS = 50
NUM_RUNS = 40
NOWS_NS = [START_NS + k * STEP_NS + STEP_NS // 2 for k in (30, 40, 50)]
NAMES = ("ekf-replay", "smoother")


def make(name: str, motion: MotionModel) -> Estimator:
    if name == "ekf-replay":
        return ReplayEkf(motion, PRIOR, 1.0)
    return estimator("smoother", motion, PRIOR, lag_s=1.0)


def late_positions(
    motion: MotionModel, start_ns: int, num_steps: int
) -> list[ScheduledMeasurement]:
    """Good positions 151 ms late at every other step, bad ones 62 ms late in between, in order of receipt."""
    position = measurement_model(("x_m", "y_m"), motion)
    found = []
    for k in range(1, num_steps + 1):
        stamp_ns = start_ns + k * STEP_NS
        late_ns, std_m = (151_000_000, 0.3) if k % 2 else (62_000_000, 1.0)
        found.append(
            ScheduledMeasurement(
                stamp_ns, stamp_ns + late_ns, position, std_m**2 * np.eye(2)
            )
        )
    return sorted(found, key=lambda item: item.receipt_ns)


@dataclass(frozen=True)
class Trial:
    errors: dict[str, FloatArray]  # by estimator, shape (runs, nows, 5)
    posterior: Bounds
    along: Bounds


def tried(motion: MotionModel) -> Trial:
    rng = np.random.default_rng(3)
    items = late_positions(motion, START_NS, NUM_STEPS)
    stamps_ns = np.unique([START_NS, *(item.stamp_ns for item in items), *NOWS_NS])
    x0, P0 = initial_state(motion, PRIOR)
    states = [x0 + rng.standard_normal((NUM_RUNS, 5)) @ np.linalg.cholesky(P0).T]
    for dt_s in (np.diff(stamps_ns) / NS_PER_S).tolist():
        states.append(draw_states(motion, states[-1], dt_s, rng))
    chain = np.stack(states, axis=1)

    def truth(wanted_ns: IntArray) -> FloatArray:
        return chain[:, np.searchsorted(stamps_ns, wanted_ns)]

    z = truth(np.array([item.stamp_ns for item in items]))[..., :2]
    z = z + np.sqrt([item.R[0, 0] for item in items])[:, None] * rng.standard_normal(
        z.shape
    )
    errors = {
        name: np.array([errors_of(name, motion, items, values) for values in z])
        for name in NAMES
    }
    true_now = truth(np.array(NOWS_NS))
    about = motion, START_NS, P0, items, truth, NOWS_NS
    return Trial(
        {name: wrapped(found - true_now) for name, found in errors.items()},
        bounds(*about),
        bounds_along(*about),
    )


def errors_of(
    name: str, motion: MotionModel, items: list[ScheduledMeasurement], z: FloatArray
) -> list[FloatArray]:
    """States at NOWS_NS, from what has arrived by then."""
    estimator, place, found = make(name, motion), 0, []
    for now_ns in NOWS_NS:
        while place < len(items) and items[place].receipt_ns <= now_ns:
            item = items[place]
            estimator.update(Measurement(item.stamp_ns, item.model, z[place], item.R))
            place += 1
        estimator.advance(now_ns)
        found.append(estimator.state_at(now_ns).mean)
    return found


def wrapped(errors: FloatArray) -> FloatArray:
    errors[..., 2] = (errors[..., 2] + np.pi) % (2.0 * np.pi) - np.pi
    return errors


@pytest.fixture(scope="module")
def paper() -> Trial:
    return tried(CTRV())


def position_ratio(
    trial: Trial, name: str, covariances: FloatArray
) -> tuple[float, float]:
    """Mean squared error of the position over its bound, averaged over the times, and the standard error."""
    squared = np.sum(trial.errors[name][..., :2] ** 2, axis=-1)
    ratio = np.mean(
        squared / np.trace(covariances[:, :2, :2], axis1=1, axis2=2), axis=1
    )
    return float(ratio.mean()), float(ratio.std(ddof=1) / np.sqrt(NUM_RUNS))


@pytest.mark.parametrize("name", NAMES)
def test_the_mean_of_the_bounds_along_the_trajectories_is_reached(
    paper: Trial, name: str
) -> None:
    ratio, error = position_ratio(paper, name, paper.along.arrived)
    assert abs(ratio - 1.0) < 3.0 * error
    assert error < 0.12


@pytest.mark.parametrize("name", NAMES)
def test_no_estimator_is_better_than_the_posterior_bound(
    paper: Trial, name: str
) -> None:
    """The trace of B^-1 E[e e'] is at least n, with the bound B and the errors e of all n entries."""
    for covariance, errors in zip(
        paper.posterior.arrived, np.moveaxis(paper.errors[name], 1, 0), strict=True
    ):
        weighed = np.vecdot(errors, np.linalg.solve(covariance, errors.T).T)
        assert weighed.mean() > 5.0 - 3.0 * weighed.std(ddof=1) / np.sqrt(NUM_RUNS)


def test_the_posterior_bound_is_far_off_where_it_matters_much(paper: Trial) -> None:
    posterior_m2, along_m2 = (
        np.trace(one.arrived[-1][:2, :2]) for one in (paper.posterior, paper.along)
    )
    assert posterior_m2 < 0.5 * along_m2


def test_who_takes_all_in_time_would_be_below_the_bound_of_what_has_arrived(
    paper: Trial,
) -> None:
    in_time_m2, arrived_m2, dropped_m2 = (
        np.trace(one[-1][:2, :2]) for one in paper.along
    )
    assert in_time_m2 < 0.8 * arrived_m2 < 0.8 * 0.8 * dropped_m2
