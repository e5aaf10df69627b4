"""The parts of a window on their own: chain, past, and the state between two nodes."""

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.models import MODELS, MOTIONS

from fgtrack.core.time import seconds
from fgtrack.core.types import FloatArray, TrackState
from fgtrack.estimation.base import Measurement, Start
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.factor_graph.chain import Chain, Node
from fgtrack.estimation.interpolation import between
from fgtrack.estimation.marginalised_past import MarginalisedPast, Prior
from fgtrack.models.measurement import measurement_model
from fgtrack.models.motion import CV, MotionModel
from fgtrack.models.sensors import RobustLoss
from fgtrack.testing.references import dense_joint, difference

MS, US = 1_000_000, 1_000
START_NS = 1_790_000_000_000_000_000


# --- chain


def chain(*stamps_ns: int) -> Chain:
    made = Chain(Node(stamps_ns[0], 100, np.zeros(2)))
    for stamp_ns in stamps_ns[1:]:
        made.insert(stamp_ns, np.zeros(2))
    return made


def test_a_chain_keeps_its_nodes_in_the_order_of_their_stamps() -> None:
    made = chain(10, 50, 30, 40, 20)
    assert [node.stamp_ns for node in made.nodes] == [10, 20, 30, 40, 50]
    assert [node.key for node in made.nodes] == [100, 104, 102, 103, 101]
    assert (made.oldest.stamp_ns, made.newest.stamp_ns) == (10, 50)


def test_the_place_of_a_stamp_is_that_of_the_newest_node_at_or_before_it() -> None:
    made = chain(10, 30)
    assert [made.place(stamp_ns) for stamp_ns in (9, 10, 29, 30, 31)] == [-1, 0, 0, 1, 1]


def test_a_stamp_up_to_a_microsecond_away_from_a_node_is_near_the_nearest_one() -> None:
    made = chain(10_000, 10_000 + 1_500, 50_000)
    assert made.near(50_000) is made.nodes[2]
    assert [made.near(stamp_ns) for stamp_ns in (8_999, 12_501, 48_999, 51_001)] == [None] * 4
    assert [made.near(stamp_ns) for stamp_ns in (9_000, 10_749)] == [made.nodes[0]] * 2
    assert [made.near(stamp_ns) for stamp_ns in (10_751, 12_500)] == [made.nodes[1]] * 2


def test_the_origins_of_a_chain_are_those_of_its_nodes_whatever_becomes_of_them() -> None:
    rng = np.random.default_rng(0)
    made = chain(0)
    for number in range(1, 400):
        made.insert(1000 * number - int(rng.integers(4)) * 1500 + number, rng.normal(size=2))
        if number % 3 == 0:
            made.move(int(rng.integers(len(made.nodes))), rng.normal(size=2))
        if number % 7 == 0:
            made.remove({made.newest.key})
        if len(made.nodes) > 12:
            made.drop(int(rng.integers(3)))
        np.testing.assert_array_equal(made.origins, [node.origin for node in made.nodes])
        assert made.keys == [node.key for node in made.nodes]
    assert len(made.nodes) > 5


def test_a_segment_that_is_split_stays_with_its_left_neighbour() -> None:
    made = chain(10, 30)
    made.oldest.slot = 7
    node = made.insert(20, np.ones(2))
    assert made.oldest.slot == 7
    assert node.slot is None
    assert made.nodes[1] is node


def test_what_was_inserted_can_be_taken_back_and_its_key_is_not_used_again() -> None:
    made = chain(10, 30)
    key = made.insert(20, np.zeros(2)).key
    made.remove({key})
    assert [node.stamp_ns for node in made.nodes] == [10, 30]
    assert made.insert(20, np.zeros(2)).key == key + 1
    made.drop(2)
    assert [node.stamp_ns for node in made.nodes] == [30]


# --- past


def prior(motion: MotionModel) -> Prior:
    start = Start(
        stamp_ns=START_NS,
        position_m=(3.0, -2.0),
        position_covariance=np.eye(2) * 0.5,
        yaw_rad=0.4,
        yaw_std_rad=0.3,
        speed_mps=20.0,
        speed_std_mps=3.0,
        yaw_rate_radps=0.1,
        yaw_rate_std_radps=0.3,
    )
    return Prior(*initial_state(motion, start))


def birth_prior() -> Start:
    return Start(
        stamp_ns=START_NS,
        position_m=(3.0, -2.0),
        position_covariance=np.eye(2) * 0.5,
        yaw_rad=0.4,
        yaw_std_rad=0.3,
        speed_mps=20.0,
        speed_std_mps=3.0,
        yaw_rate_radps=0.1,
        yaw_rate_std_radps=0.3,
    )


def position(offset_ns: int, x_m: float, y_m: float, loss: RobustLoss | None = None) -> Measurement:
    model = measurement_model(("x_m", "y_m"), CV())
    return Measurement(START_NS + offset_ns, model, np.array([x_m, y_m]), 0.09 * np.eye(2), loss=loss)


def passed(offsets_ns: tuple[int, ...], measured: dict[int, Measurement]) -> MarginalisedPast:
    """A past whose nodes left at some guess of their means, the last of `offsets_ns` being the oldest that is left."""
    past = MarginalisedPast(CV(), START_NS, prior(CV()))
    guesses = [np.array([3.0 + 18.0 * o / 1e9, -2.0 + 8.0 * o / 1e9, 17.0, 9.0]) for o in offsets_ns]
    for k in range(len(offsets_ns) - 1):
        items = [measured[offsets_ns[k]]] if offsets_ns[k] in measured else []
        past.pass_node(items, guesses[k], START_NS + offsets_ns[k + 1], guesses[k + 1])
    return past


def fused(past: MarginalisedPast, measurements: list[Measurement]) -> tuple[FloatArray, FloatArray]:
    """The oldest node's state after `measurements` behind it, one after the other."""
    mean, P = past.prior.mean, past.prior.covariance
    for item in measurements:
        seen = past.fuse(item)
        S = seen.H @ P @ seen.H.T + seen.R
        K = np.linalg.solve(S, seen.H @ P).T
        mean, P = mean + K @ (seen.y - seen.H @ (mean - seen.origin)), P - K @ S @ K.T
    return mean, P


@pytest.mark.parametrize("order", list(permutations(range(4))), ids=str)
@pytest.mark.parametrize("gap_ns", [1, 100, 1 * US, 10 * US, 1 * MS, 50 * MS])
def test_detections_close_together_behind_the_window_are_exact_in_any_order(
    order: tuple[int, ...], gap_ns: int
) -> None:
    """A velocity between two positions 1 us apart magnifies their rounding a million times; nothing else does."""
    at_node = position(300 * MS, 8.6, 0.6)
    offsets = (500 * MS, 500 * MS + gap_ns, 500 * MS + 2 * gap_ns, 700 * MS - gap_ns)
    late = [position(offset, 12.4 + 0.3 * k, 2.0 - 0.4 * k) for k, offset in enumerate(offsets)]
    past = passed((0, 300 * MS, 700 * MS), {300 * MS: at_node})
    mean, P = fused(past, [late[k] for k in order])
    stamps_ns = [START_NS + 700 * MS, START_NS, *(item.stamp_ns for item in late), START_NS + 420 * MS]
    joint = dense_joint(CV(), birth_prior(), [at_node, *late], stamps_ns)
    found = {stamps_ns[0]: TrackState(stamps_ns[0], mean, P)}
    for stamp_ns in stamps_ns[1:]:
        found[stamp_ns] = TrackState(stamp_ns, *past.state_at(stamp_ns, mean, P))
    for stamp_ns, state in found.items():
        assert max(difference(state, joint[stamp_ns])) < (1e-8 if gap_ns < 10 * US else 1e-9)


def test_the_ring_forgets_what_is_not_needed_any_more() -> None:
    past = passed((0, 100 * MS, 200 * MS, 300 * MS), {})
    assert past.start_ns == START_NS
    past.forget_before(START_NS + 150 * MS)
    assert past.start_ns == START_NS + 100 * MS
    past.forget_before(START_NS + 200 * MS)
    assert past.start_ns == START_NS + 200 * MS
    past.forget_before(START_NS + 5000 * MS)
    assert past.start_ns == START_NS + 200 * MS


def test_a_copy_knows_nothing_of_what_the_other_fuses() -> None:
    past = passed((0, 100 * MS, 200 * MS), {})
    at = past.prior.mean, past.prior.covariance
    before = past.state_at(START_NS + 50 * MS, *at)
    past.copy().fuse(position(40 * MS, 9.0, 9.0))
    after = past.state_at(START_NS + 50 * MS, *at)
    np.testing.assert_array_equal(before[0], after[0])
    np.testing.assert_array_equal(before[1], after[1])


@pytest.mark.parametrize("kind", ["cauchy", "tukey"])
def test_an_outlier_weighs_as_little_behind_the_window_as_its_loss_says(kind: str) -> None:
    """Both when its node leaves, and when it comes too late for it."""
    plain = passed((0, 300 * MS, 700 * MS), {})
    outlier = position(300 * MS, 58.0, 0.6, RobustLoss(kind, 2.0))
    left = passed((0, 300 * MS, 700 * MS), {300 * MS: outlier})
    mean, _ = fused(passed((0, 300 * MS, 700 * MS), {}), [outlier])
    deviation = np.sqrt(np.diag(plain.prior.covariance))
    assert np.abs((left.prior.mean - plain.prior.mean) / deviation).max() < 0.1
    assert np.abs((mean - plain.prior.mean) / deviation).max() < 0.1


# --- the state between two nodes


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

    found = between(kind, left, right, until_s, after_s)
    scale = np.abs(gain).max()
    np.testing.assert_allclose(np.hstack([found.Lambda, found.Psi]), gain, atol=1e-6 * scale)
    np.testing.assert_allclose(found.Sigma, M - gain @ cross.T, atol=1e-7 * np.abs(M).max())
    moved = gain @ np.concatenate([np.zeros(n), right - kind.predict(middle, after_s)])
    np.testing.assert_allclose(found.mean, middle + moved, atol=1e-6 * max(1.0, np.abs(moved).max()))


@pytest.mark.parametrize("kind", MODELS, ids=MOTIONS)
def test_at_its_ends_the_state_between_two_nodes_is_theirs(kind: MotionModel) -> None:
    left = np.array([12.0, 7.0, 0.4, 20.0, 0.3, 1.5])[: kind.dim]
    right = kind.predict(left, 0.3) + 0.1
    at_left, at_right = (between(kind, left, right, *times) for times in ((0.0, 0.3), (0.3, 0.0)))
    np.testing.assert_allclose(at_left.mean, left, atol=1e-9)
    np.testing.assert_allclose(at_left.Lambda, np.eye(kind.dim), atol=1e-9)
    np.testing.assert_allclose(at_right.mean, right, atol=1e-9)
    np.testing.assert_allclose(at_right.Psi, np.eye(kind.dim), atol=1e-9)
    for end in (at_left, at_right):
        np.testing.assert_allclose(end.Sigma, 0.0, atol=1e-12)
