"""Published states are sound."""

from collections.abc import Sequence

import numpy as np
import pytest

from fgtrack.core.types import FloatArray, TrackState
from fgtrack.estimation.failures import Failure
from fgtrack.estimation.filters.propagation import kinematic_states
from fgtrack.models.motion import CTRA, CTRV, CV, MotionModel
from fgtrack.tracking.guarded_bank import faults

MOTIONS = (CTRV(), CTRA(), CV())


def present(motion: MotionModel, count: int = 3) -> list[TrackState]:
    """Sound states."""
    rng = np.random.default_rng(1)
    means = rng.normal(size=(count, motion.dim)) * 10.0 + 5.0
    roots = rng.normal(size=(count, motion.dim, motion.dim))
    return kinematic_states(
        motion, 0, means, roots @ roots.mT + 0.1 * np.eye(motion.dim)
    )


def spoilt(
    states: Sequence[TrackState], place: int, mean: FloatArray, covariance: FloatArray
) -> list[TrackState]:
    return [
        TrackState(0, mean, covariance) if k == place else state
        for k, state in enumerate(states)
    ]


@pytest.mark.parametrize("motion", MOTIONS, ids=lambda motion: type(motion).__name__)
def test_states_of_every_motion_model_are_sound(motion: MotionModel) -> None:
    assert faults(present(motion)) == faults([]) == {}


@pytest.mark.parametrize(
    ("mean", "variance", "fault"),
    [
        (np.nan, 1.0, Failure.NOT_FINITE),
        (-np.inf, 1.0, Failure.NOT_FINITE),
        (1.0, np.nan, Failure.NOT_FINITE),
        (1.0, np.inf, Failure.NOT_FINITE),
        (1.1e9, 1.0, Failure.NOT_FINITE),
        (-1e300, 1.0, Failure.NOT_FINITE),
        (1.0, -1e-12, Failure.NOT_DEFINITE),
        (1.0, 1e-9, Failure.NOT_DEFINITE),
        (0.9e9, 1e6, None),
    ],
)
@pytest.mark.parametrize("motion", MOTIONS, ids=lambda motion: type(motion).__name__)
def test_what_is_wrong_with_a_state_is_told_of_that_state_alone(
    motion: MotionModel, mean: float, variance: float, fault: Failure | None
) -> None:
    states = present(motion)
    x, P = states[1].mean.copy(), states[1].covariance.copy()
    x[0], P[0, 0] = mean, variance
    P[0, 1] = P[1, 0] = 1e-3
    assert faults(spoilt(states, 1, x, P)) == ({} if fault is None else {1: fault})


def test_a_covariance_may_be_singular_up_to_rounding_whatever_its_units() -> None:
    states = present(CTRV())
    for size in (1e-12, 1.0, 1e12):
        P = np.diag([size, size, 1.0, 1.0, 0.0])
        for correlation, sound in ((1.0, True), (1.0 + 1e-7, False)):
            P[0, 1] = P[1, 0] = correlation * size
            found = faults(spoilt(states, 0, states[0].mean, P))
            assert found == ({} if sound else {0: Failure.NOT_DEFINITE})
