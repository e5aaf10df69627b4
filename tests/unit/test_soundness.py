"""Which states can be published, and when a track has diverged."""

from collections.abc import Sequence

import numpy as np
import pytest

from fgtrack.core.types import FloatArray, TrackState
from fgtrack.estimation.base import Measurement, UpdateResult, UpdateStatus
from fgtrack.estimation.failures import Failure
from fgtrack.estimation.present import PresentStates
from fgtrack.models.motion import CTRA, CTRV, CV, MotionModel
from fgtrack.tracking.guarded_bank import Divergence, faults

MOTIONS = (CTRV(), CTRA(), CV())


def present(motion: MotionModel, count: int = 3) -> PresentStates:
    """Sound states."""
    rng = np.random.default_rng(1)
    means = rng.normal(size=(count, motion.dim)) * 10.0 + 5.0
    roots = rng.normal(size=(count, motion.dim, motion.dim))
    return PresentStates(motion, 0, means, roots @ roots.mT + 0.1 * np.eye(motion.dim))


def spoilt(states: Sequence[TrackState], place: int, mean: FloatArray, covariance: FloatArray) -> list[TrackState]:
    return [TrackState(0, mean, covariance) if k == place else state for k, state in enumerate(states)]


@pytest.mark.parametrize("motion", MOTIONS, ids=lambda motion: type(motion).__name__)
def test_states_of_every_motion_model_are_sound_as_arrays_and_one_by_one(motion: MotionModel) -> None:
    states = present(motion)
    assert faults(states) == faults(list(states)) == faults([]) == {}


@pytest.mark.parametrize(
    ("mean", "variance", "fault"),
    [
        (np.nan, 1.0, Failure.NOT_FINITE),
        (-np.inf, 1.0, Failure.NOT_FINITE),
        (1.0, np.nan, Failure.NOT_FINITE),
        (1.0, np.inf, Failure.NOT_FINITE),
        (1.1e9, 1.0, Failure.OUT_OF_BOUNDS),
        (-1e300, 1.0, Failure.OUT_OF_BOUNDS),
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


def outcomes(divergence: Divergence, nis: Sequence[float | None], track_id: int = 0, **measured: float) -> list[int]:
    """How many tracks diverge at each of these updates of a track."""
    z = Measurement.of(0, std=dict.fromkeys(measured, 1.0), **measured)
    results = [UpdateResult(UpdateStatus.IN_SEQUENCE, None if one is None else z.z, one) for one in nis]
    return [divergence.count([track_id], [z], [one]) for one in results]


def test_a_track_diverges_at_the_eighth_surprise_in_a_row_and_again_only_after_a_fit() -> None:
    position = {"x_m": 0.0, "y_m": 0.0}
    surprise, fit = 18.5, 18.3  # 99.99 % of chi-square with two degrees of freedom: 18.42
    assert outcomes(Divergence(), [surprise] * 20, **position) == [0] * 7 + [1] + [0] * 12
    assert outcomes(Divergence(), [fit] * 20, **position) == [0] * 20
    assert sum(outcomes(Divergence(), [*[surprise] * 7, fit] * 5, **position)) == 0
    assert sum(outcomes(Divergence(), [*[surprise] * 9, fit] * 5, **position)) == 5
    assert sum(outcomes(Divergence(), [surprise, None] * 8, **position)) == 1  # what is not fused says nothing
    assert sum(outcomes(Divergence(), [np.nan] * 8, **position)) == 1
    assert sum(outcomes(Divergence(), [surprise] * 8, bearing_rad=0.0)) == 1
    assert sum(outcomes(Divergence(), [surprise] * 8, **position, speed_mps=0.0)) == 0


def test_tracks_diverge_by_themselves_and_begin_anew_with_nothing_against_them() -> None:
    divergence = Divergence()
    for _ in range(7):
        assert outcomes(divergence, [30.0], 0, x_m=0.0, y_m=0.0) == outcomes(divergence, [30.0], 1, x_m=0.0) == [0]
    divergence.forget(0)
    assert outcomes(divergence, [30.0], 0, x_m=0.0, y_m=0.0) == [0]
    assert outcomes(divergence, [30.0], 1, x_m=0.0) == [1]


@pytest.mark.slow
@pytest.mark.parametrize(("size", "times"), [(1.0, range(1)), (3.0, range(20, 60))])
def test_chance_makes_no_track_diverge_and_errors_three_times_too_large_some_once_in_5000(
    size: float, times: range
) -> None:
    nis = size**2 * np.random.default_rng(3).chisquare(2, 200_000)
    assert sum(outcomes(Divergence(), nis.tolist(), x_m=0.0, y_m=0.0)) in times


@pytest.mark.parametrize("kind", [complex, object, str, bool])
def test_states_are_real_numbers(kind: type) -> None:
    states = present(CTRV())
    for x, P in ((states[0].mean.astype(kind), states[0].covariance), (states[0].mean, np.eye(5).astype(kind))):
        with pytest.raises(TypeError, match="real numbers"):
            faults([TrackState(0, x, P)])
    assert faults([TrackState(0, states[0].mean.astype(np.float32), np.eye(5, dtype=int))]) == {}
