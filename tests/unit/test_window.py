"""A window behind its oldest node and between its nodes."""

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.models import MODELS, MOTIONS

from fgtrack.core.time import seconds
from fgtrack.estimation.base import Measurement, Start, UpdateStatus
from fgtrack.estimation.object_bank import SingleObject
from fgtrack.estimation.rts import between
from fgtrack.estimation.smoothing.bank import SmootherBank
from fgtrack.estimation.smoothing.gtsam.incremental import IncrementalBank
from fgtrack.models.measurement import measurement_model
from fgtrack.models.motion import CV, MotionModel
from fgtrack.models.sensors import RobustLoss
from fgtrack.testing.references import dense_joint, difference

MS, US = 1_000_000, 1_000
START_NS = 1_790_000_000_000_000_000
START = Start(
    stamp_ns=START_NS,
    position_m=(3.0, -2.0),
    position_covariance=np.eye(2) * 0.5,
    yaw_rad=0.4,
    yaw_std_rad=0.3,
    speed_mps=20.0,
    speed_std_mps=3.0,
)


def position(
    offset_ns: int, x_m: float, y_m: float, loss: RobustLoss | None = None
) -> Measurement:
    model = measurement_model(("x_m", "y_m"), CV())
    return Measurement(
        START_NS + offset_ns, model, np.array([x_m, y_m]), 0.09 * np.eye(2), loss=loss
    )


def smoother(make: type[SmootherBank], *measurements: Measurement) -> SingleObject:
    one = SingleObject(CV(), make(CV(), 0.1, ring_s=9.0, final=True), START)
    for measurement in measurements:
        one.update(measurement)
    return one


@pytest.mark.parametrize("make", [SmootherBank, IncrementalBank])
@pytest.mark.parametrize("gap_ns", [1 * US, 50 * MS])
def test_detections_close_together_behind_the_window_are_exact_in_any_order(
    gap_ns: int, make: type[SmootherBank]
) -> None:
    """A velocity between two positions 1 us apart magnifies their rounding a million times; nothing else does."""
    inside = [
        position(ms * MS, 3.0 + 0.018 * ms, -2.0 + 0.008 * ms)
        for ms in (300, 700, 1200)
    ]
    offsets = (500 * MS, 500 * MS + gap_ns, 500 * MS + 2 * gap_ns, 700 * MS - gap_ns)
    late = [
        position(offset, 12.4 + 0.3 * k, 2.0 - 0.4 * k)
        for k, offset in enumerate(offsets)
    ]
    stamps_ns = [
        START_NS + 1200 * MS,
        START_NS,
        *(item.stamp_ns for item in late),
        START_NS + 420 * MS,
    ]
    joint = dense_joint(CV(), START, [*inside, *late], stamps_ns)
    for order in list(permutations(late))[::5]:
        one = smoother(make, *inside)
        for measurement in order:
            assert one.update(measurement).status is UpdateStatus.BEYOND_WINDOW
        for stamp_ns in stamps_ns:
            found = difference(one.state_at(stamp_ns), joint[stamp_ns])
            assert max(found) < (1e-8 if gap_ns < 10 * US else 1e-9)


@pytest.mark.parametrize("kind", ["cauchy", "tukey"])
def test_an_outlier_weighs_as_little_behind_the_window_as_its_loss_says(
    kind: str,
) -> None:
    """Both when its node leaves, and when it comes too late for it."""
    outlier = position(300 * MS, 58.0, 0.6, RobustLoss(kind, 2.0))
    newest = position(700 * MS, 15.6, 3.6)
    plain, left, late = (
        smoother(SmootherBank, *each)
        for each in ([newest], [outlier, newest], [newest, outlier])
    )
    expected = plain.state_at(START_NS + 700 * MS)
    for one in (left, late):
        off = one.state_at(START_NS + 700 * MS).mean - expected.mean
        assert np.abs(off / np.sqrt(np.diag(expected.covariance))).max() < 0.1


@pytest.mark.parametrize("offset_ns", [-US, US, 1])
@pytest.mark.parametrize("make", [SmootherBank, IncrementalBank])
def test_a_stamp_up_to_a_microsecond_from_a_node_shares_it(
    offset_ns: int, make: type[SmootherBank]
) -> None:
    near, apart = (
        position(300 * MS + offset_ns, 8.5, 0.5),
        position(300 * MS + 3 * offset_ns, 8.5, 0.5),
    )
    for last, num in ((near, 2), (apart, 3 if abs(offset_ns) == US else 2)):
        one = smoother(make, position(300 * MS, 8.4, 0.4), near, last)
        one.bank.remove(0)
        assert len(one.bank.smoothed()) == num


@settings(deadline=None, max_examples=30)
@given(
    kind=st.sampled_from(MODELS),
    until_ns=st.integers(50 * MS, 800 * MS),
    after_ns=st.integers(50 * MS, 800 * MS),
    seed=st.integers(0, 2**31),
)
def test_the_state_between_two_nodes_is_the_conditional_of_the_joint(
    kind: MotionModel, until_ns: int, after_ns: int, seed: int
) -> None:
    """Of x_l + N, moved and moved on: condition the joint of the three states on the outer two by textbook."""
    rng, n = np.random.default_rng(seed), kind.dim
    left = np.array([12.0, 7.0, 0.4, 20.0, 0.3, 1.5])[:n]
    until_s, after_s = seconds(until_ns), seconds(after_ns)
    middle = kind.predict(left, until_s)
    F1, Q1 = kind.jacobian(left, until_s), kind.process_noise(left, until_s)
    F2, Q2 = kind.jacobian(middle, after_s), kind.process_noise(middle, after_s)
    P = np.diag(rng.uniform(0.1, 1.0, n))
    M = F1 @ P @ F1.T + Q1
    outer = np.block([[P, P @ F1.T @ F2.T], [F2 @ F1 @ P, F2 @ M @ F2.T + Q2]])
    cross = np.hstack([F1 @ P, M @ F2.T])
    gain = np.linalg.solve(outer, cross.T).T
    right = kind.predict(middle, after_s) + 0.1 * rng.standard_normal(n)

    mean, Lambda, Psi, Sigma = between(kind, left, right, until_s, after_s)
    scale = np.abs(gain).max()
    np.testing.assert_allclose(np.hstack([Lambda, Psi]), gain, atol=1e-6 * scale)
    np.testing.assert_allclose(Sigma, M - gain @ cross.T, atol=1e-7 * np.abs(M).max())
    moved = gain @ np.concatenate([np.zeros(n), right - kind.predict(middle, after_s)])
    np.testing.assert_allclose(
        mean, middle + moved, atol=1e-6 * max(1.0, np.abs(moved).max())
    )


@pytest.mark.parametrize("kind", MODELS, ids=MOTIONS)
def test_at_its_ends_the_state_between_two_nodes_is_theirs(kind: MotionModel) -> None:
    left = np.array([12.0, 7.0, 0.4, 20.0, 0.3, 1.5])[: kind.dim]
    right = kind.predict(left, 0.3) + 0.1
    at_left, at_right = (
        between(kind, left, right, *times) for times in ((0.0, 0.3), (0.3, 0.0))
    )
    np.testing.assert_allclose(at_left[0], left, atol=1e-9)
    np.testing.assert_allclose(at_left[1], np.eye(kind.dim), atol=1e-9)
    np.testing.assert_allclose(at_right[0], right, atol=1e-9)
    np.testing.assert_allclose(at_right[2], np.eye(kind.dim), atol=1e-9)
    for _, _, _, Sigma in (at_left, at_right):
        np.testing.assert_allclose(Sigma, 0.0, atol=1e-12)
