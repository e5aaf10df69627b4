"""What a smoother promises of its window, its relinearisation and its outputs."""

import copy
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.linalg import solve_triangular

from fgtrack.core.linalg import inverse_root
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.base import Measurement, SensorPose, Start, UpdateStatus
from fgtrack.estimation.object_bank import SingleObject
from fgtrack.estimation.smoothing.bank import SmootherBank
from fgtrack.estimation.smoothing.gtsam.batch import BatchBank
from fgtrack.estimation.smoothing.gtsam.incremental import (
    IncrementalBank,
    IncrementalSolver,
)
from fgtrack.estimation.smoothing.node_arrays import NUM_ROWS
from fgtrack.estimation.smoothing.nodes import Nodes
from fgtrack.models.motion import CTRV, CV, MotionModel, Transition

MS = 1_000_000
STD = {"x_m": 0.3, "y_m": 0.3}


def at(ms: int, x_m: float, y_m: float = 0.0) -> Measurement:
    return Measurement.of(ms * MS, x_m=x_m, y_m=y_m, std=STD)


def one_of(
    motion: MotionModel,
    start: Start,
    make: type[SmootherBank] = SmootherBank,
    **options: Any,
) -> SingleObject:
    return SingleObject(motion, make(motion, **{"lag_s": 1.0, **options}), start)


def largest_step_to_convergence(smoother: SingleObject, ms: int) -> float:
    """How far the state at `ms` is from that of convergence, in standard deviations."""
    found = smoother.state_at(ms * MS)
    assert isinstance(smoother.bank, SmootherBank)
    smoother.bank.converge()
    return float(
        (
            np.abs(found.mean - smoother.state_at(ms * MS).mean)
            / np.sqrt(np.diag(found.covariance))
        ).max()
    )


@pytest.mark.parametrize("make", [SmootherBank, IncrementalBank, BatchBank])
def test_the_process_noise_follows_the_states_that_move(
    make: type[SmootherBank],
) -> None:
    """The speed starts far off, and with it the noise across the direction of travel."""
    names, start = (
        CTRV().state_names,
        Start(yaw_rad=0.4, yaw_std_rad=0.5, speed_mps=5.0, speed_std_mps=50.0),
    )
    apart = {}
    for threshold in (1e-7, 1e9):
        thresholds = dict.fromkeys(names, threshold)
        smoother = one_of(
            CTRV(), start, make, lag_s=9.0, relinearise=thresholds, max_iterations=50
        )
        for k in range(1, 6):
            smoother.update(at(500 * k, 15.0 * k, 0.8 * k * k))
        apart[threshold] = largest_step_to_convergence(smoother, 2500)
    assert apart[1e-7] < 1e-5
    assert apart[1e9] > 5e-3


def test_a_sensor_that_is_not_linear_brings_the_thresholds_of_the_position() -> None:
    """Bearings from the side, of an object that starts far from where it is."""
    pose, start = (
        SensorPose(0.0, -20.0),
        Start(position_m=(8.0, 6.0), position_std_m=10.0, speed_std_mps=1.0),
    )
    smoother = one_of(CV(), start, lag_s=9.0)
    smoother.update(at(100, 7.0, 6.0))
    for k in range(2, 8):
        std = {"range_m": 0.2, "bearing_rad": 0.02}
        smoother.update(
            Measurement.of(
                100 * k * MS, range_m=20.0, bearing_rad=np.pi / 2, std=std, pose=pose
            )
        )
    assert largest_step_to_convergence(smoother, 700) < 0.1


class Counted(IncrementalSolver):
    num_steps = num_updates = 0

    def _solve(self, *windows: IntArray, is_partial: bool = False) -> None:
        Counted.num_steps += not is_partial
        super()._solve(*windows, is_partial=is_partial)

    def _eliminate(self, *windows: IntArray) -> None:
        Counted.num_updates += 1
        super()._eliminate(*windows)


class CountedBank(IncrementalBank):
    make_solver = Counted


def test_further_iterations_are_taken_only_while_a_state_moves() -> None:
    smoother = one_of(CV(), Start(), CountedBank, max_iterations=5)
    Counted.num_steps = 0
    smoother.update(at(100, 3.0))
    assert Counted.num_steps == 1
    exact = dict.fromkeys(CTRV().state_names, 1e-9)
    smoother = one_of(
        CTRV(),
        Start(yaw_rad=0.5, speed_mps=20.0),
        CountedBank,
        max_iterations=5,
        relinearise=exact,
    )
    Counted.num_steps = Counted.num_updates = 0
    smoother.update(at(100, 3.0))
    assert Counted.num_steps == 5
    assert Counted.num_updates == 2  # gtsam solves before the iterations and after them


def dense_solution(nodes: Nodes, track: int) -> tuple[FloatArray, FloatArray]:
    """Return steps (m, n) and joint covariance (m n, m n) of a window, by one QR of its whole linearised problem."""
    numbers = nodes.window(track).tolist()
    n, m, rows = nodes.points.shape[1], len(numbers), list[FloatArray]()

    def add(index: int, A: FloatArray, b: FloatArray) -> None:
        row = np.zeros((len(b), m * n + 1))
        row[:, index * n : index * n + A.shape[1]], row[:, -1] = A, b
        rows.append(row)

    prior = nodes.predicted[numbers[0]]
    W = inverse_root(prior[:, :-1])
    add(0, W, W @ prior[:, -1])
    for index, number in enumerate(numbers):
        own = nodes.rows[number, : nodes.labels[number, NUM_ROWS]]
        add(index, own[:, :-1], own[:, -1])
    for index, (left, right) in enumerate(pairwise(numbers)):
        W = inverse_root(nodes.Q[left])
        e = nodes.origin[right] - nodes.ahead[left]
        add(index, np.hstack([W @ nodes.F[left], -W]), W @ e)
    R = np.linalg.qr(np.concatenate(rows), mode="r")
    root = solve_triangular(R[:-1, :-1], np.eye(m * n))
    return (root @ R[:-1, -1]).reshape(m, n), root @ root.T


@pytest.mark.parametrize("motion", [CV(), CTRV()])
def test_the_states_of_a_window_are_those_of_one_dense_least_squares_problem(
    motion: MotionModel,
) -> None:
    """With detections ahead, late, on a node and older than the window; of states and of neighbours."""
    start, rng = Start(yaw_rad=0.4, speed_mps=12.0), np.random.default_rng(1)
    smoother = one_of(motion, start, IncrementalBank, lag_s=0.6, ring_s=1.0)
    assert isinstance(smoother.bank, IncrementalBank)
    solver = smoother.bank.solver
    n, compared = motion.dim, 0
    first_ms = (100, 300, 200, 200, 510, 500, 400, 700, 900, 150, 650, 1100, 1010)
    for ms in (*first_ms, *range(1200, 1700, 60), 1390, 1180, 1450):
        x_m, y_m = rng.normal([0.011 * ms, 0.004 * ms], 0.3)
        smoother.update(Measurement.of(ms * MS, x_m=x_m, y_m=y_m, std=STD))
        nodes, stamps_ns = solver.nodes, solver.nodes.window_stamps_ns(0)
        steps, covariance = dense_solution(nodes, 0)
        stds = np.sqrt(np.diag(covariance)).reshape(-1, n)
        numbers = nodes.window(0)
        assert (np.abs(nodes.step[numbers] - steps) / stds).max() < 1e-9
        solver.states_at(np.zeros(len(stamps_ns), dtype=np.int64), stamps_ns)
        for index, (left, right) in enumerate(pairwise(numbers.tolist())):
            A, P = nodes.backs[left, :n, :n], nodes.P[right]
            joint = np.block([[nodes.P[left], A @ P], [P @ A.T, P]])
            both = slice(index * n, (index + 2) * n)
            assert_same_covariance(joint, covariance[both, both])
            compared += 1
    assert compared > 150


def assert_same_covariance(found: FloatArray, expected: FloatArray) -> None:
    """Entries differ by less than 1e-9 standard deviations of both components."""
    stds = np.sqrt(np.diag(expected))
    assert (np.abs(found - expected) / np.outer(stds, stds)).max() < 1e-9


def test_an_object_that_is_never_seen_again_has_no_graph() -> None:
    """So 10^5 detections of clutter in one list are 10^5 states."""
    start = Start(yaw_rad=0.5, speed_mps=20.0)
    Counted.num_updates = 0
    states = [one_of(CTRV(), start, CountedBank).state_at(k * MS) for k in (0, 100)]
    assert Counted.num_updates == 0
    smoother = one_of(CTRV(), start, IncrementalBank)
    smoother.update(
        Measurement.of(200 * MS, x_m=4.0, y_m=0.0, std={"x_m": 1e7, "y_m": 1e7})
    )
    for state, seen in zip(
        states, [smoother.state_at(state.stamp_ns) for state in states], strict=True
    ):
        np.testing.assert_allclose(state.mean, seen.mean, atol=1e-9)
        np.testing.assert_allclose(
            state.covariance, seen.covariance, rtol=1e-6, atol=1e-9
        )


def test_the_window_is_as_long_as_it_says() -> None:
    smoother = one_of(CV(), Start(), lag_s=0.3, late="drop")
    for k in range(1, 11):
        smoother.update(at(100 * k, 1.0 * k))
    assert smoother.window_ns == (700 * MS, 1000 * MS)
    assert smoother.update(at(699, 7.0)).status is UpdateStatus.TOO_OLD
    assert smoother.update(at(700, 7.1)).status is UpdateStatus.OUT_OF_SEQUENCE
    smoother.advance(1100 * MS)
    smoother.advance(900 * MS)
    assert smoother.window_ns[0] == 800 * MS
    assert smoother.update(at(1000, 10.1)).status is UpdateStatus.IN_SEQUENCE


@pytest.mark.parametrize("make", [SmootherBank, IncrementalBank])
def test_what_lies_behind_the_ring_is_forgotten(make: type[SmootherBank]) -> None:
    """And what does not is kept, in arrays that do not grow with the drive."""
    smoother = one_of(CV(), Start(), make, lag_s=0.3, ring_s=0.2)
    for k in range(1, 301):
        smoother.update(at(100 * k, 1.0 * k))
    assert smoother.window_ns == (29_500 * MS, 30_000 * MS)
    assert smoother.bank.solver.nodes.stamps_ns.shape[1] == 64
    before = smoother.state_at(30_000 * MS)
    assert smoother.update(at(29_500, 295.4)).status is UpdateStatus.BEYOND_WINDOW
    assert 0.0 < smoother.state_at(30_000 * MS).mean[0] - before.mean[0] < 0.1
    assert smoother.state_at(30_000 * MS).covariance[0, 0] < before.covariance[0, 0]
    assert smoother.update(at(29_499, 295.0)).status is UpdateStatus.TOO_OLD


@pytest.mark.parametrize(
    ("final", "left", "rest"), [(True, [1], [2, 3, 4, 5]), (False, [], [])]
)
def test_a_bank_reports_lagged_states_and_final_ones_once(
    final: bool, left: list[int], rest: list[int]
) -> None:
    bank = SmootherBank(CV(), 0.25, ring_s=0.5, lagged_s=(0.2,), final=final)
    bank.advance(100 * MS)
    bank.birth(7, Start(stamp_ns=100 * MS))
    assert bank.smoothed() == []  # 0.2 s ago there was no track
    for k in range(2, 6):
        bank.advance(100 * k * MS)
        bank.update(100 * k * MS, [7], [at(100 * k, 1.0 * k)])
    assert bank.window_start_ns == -250 * MS
    reports = bank.smoothed()
    [lagged] = [report for report in reports if report.lag_s is not None]
    assert (lagged.track_id, lagged.state.stamp_ns, lagged.lag_s) == (7, 300 * MS, 0.2)
    assert [report.state.stamp_ns for report in reports if report.lag_s is None] == [
        100 * k * MS for k in left
    ]
    bank.remove(7)
    assert [report.state.stamp_ns for report in bank.smoothed()] == [
        100 * k * MS for k in rest
    ]
    assert bank.smoothed() == []


class OwnTransition(CTRV):
    """CTRV as a model that is not compiled."""

    def transition(self, x: FloatArray, dt_s: float | FloatArray) -> Transition:
        return super().transition(x, dt_s)


def test_a_motion_model_in_numpy_gives_what_the_same_one_compiled_gives() -> None:
    """With detections ahead, late, on a node and beyond the window, and at stamps between nodes."""
    start = Start(yaw_rad=0.4, yaw_std_rad=0.5, speed_mps=12.0)
    compiled, numpy = (
        one_of(model, start, lag_s=0.3, ring_s=1.0)
        for model in (CTRV(), OwnTransition())
    )
    for k, ms in enumerate((100, 300, 200, 200, 500, 400, 700, 150, 650)):
        for each in (compiled, numpy):
            each.update(at(ms, 0.012 * ms, 0.2 * (k % 3)))
    for ms in (150, 450, 700, 900):
        states = [each.state_at(ms * MS) for each in (compiled, numpy)]
        np.testing.assert_allclose(
            states[1].mean, states[0].mean, rtol=1e-12, atol=1e-12
        )
        np.testing.assert_allclose(
            states[1].covariance, states[0].covariance, rtol=1e-10, atol=1e-14
        )


@pytest.mark.parametrize("make", [SmootherBank, IncrementalBank, BatchBank])
def test_noise_that_is_no_covariance_fails_updates_and_leaves_the_states(
    make: type[SmootherBank],
) -> None:
    class Faulty(CV):
        sign = 1.0

        def process_noise(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
            return type(self).sign * super().process_noise(x, dt_s)

        def transition(self, x: FloatArray, dt_s: float | FloatArray) -> Transition:
            return MotionModel.transition(self, x, dt_s)

    estimator = SingleObject(Faulty(), make(Faulty(), lag_s=1.0), Start())
    for k in range(1, 10):
        Faulty.sign = 1.0 if k < 4 else -1e3
        stamp_ns = k * 100_000_000
        status = estimator.update(
            Measurement.of(stamp_ns, x_m=float(k), y_m=0.0, std=0.3)
        ).status
        assert status is (UpdateStatus.IN_SEQUENCE if k < 4 else UpdateStatus.FAILED)
        assert 0.0 < estimator.state_at(stamp_ns).covariance[0, 0] < np.inf


def test_a_copy_converges_as_its_original() -> None:
    estimator = SingleObject(
        CTRV(), SmootherBank(CTRV(), lag_s=1.0), Start(yaw_rad=0.0, speed_mps=10.0)
    )
    for k in range(1, 6):
        estimator.update(
            Measurement.of(k * 100_000_000, x_m=float(k), y_m=0.3 * k * k, std=0.1)
        )
    clone = copy.deepcopy(estimator)
    for each in (estimator, clone):
        each.bank.converge()
    for k in (1, 3, 5):
        np.testing.assert_array_equal(
            clone.state_at(k * 100_000_000).mean,
            estimator.state_at(k * 100_000_000).mean,
        )
