"""The copy of a window: its graph in gtsam, measurements withdrawn, and measurements that are fused twice."""

import pickle
import re
from dataclasses import replace

import gtsam
import numpy as np
import pytest

import fgtrack
from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement, UpdateStatus
from fgtrack.estimation.registry import ESTIMATORS, estimator, estimator_bank
from fgtrack.estimation.repeated import FusedOnce
from fgtrack.estimation.smoothing.window import Window
from fgtrack.models.motion import CT, CTRA, CTRV, CV, MotionModel
from fgtrack.models.sensors import RobustLoss
from fgtrack.testing.references import difference
from fgtrack.testing.streams import MS, START, US, measured

SMOOTHERS = ("smoother", "smoother-batch", "smoother-banded")
MOTIONS = (CTRV(), CT(), CV(), CTRA())
POSITION = ("x_m", "y_m")
RANGE_BEARING = ("range_m", "bearing_rad")
#: Milliseconds after the start, in the order of arrival: 345 splits a segment.
ARRIVALS = (50, 100, 200, 300, 400, 500, 650, 800, 900, 1000, 1100, 345)


def stream(
    motion: MotionModel,
    names: tuple[str, ...] = POSITION,
    loss: RobustLoss | None = None,
) -> list[Measurement]:
    """Measurements in the order of their arrival; with a loss two of them are outliers."""
    rng = np.random.default_rng(3)
    found = []
    for ms in ARRIVALS:
        one = measured(rng, motion, ms * MS, names)
        off = 4.0 * np.sqrt(np.diag(one.R)) if loss and ms in (345, 800) else 0.0
        found.append(replace(one, z=one.z + off, loss=loss))
    return found


def fused(
    name: str, motion: MotionModel, measurements: list[Measurement], lag_s: float = 0.8
) -> FusedOnce:
    one = estimator(name, motion, START, lag_s=lag_s)
    assert isinstance(one, FusedOnce)
    for measurement in measurements:
        assert one.update(measurement).innovation is not None
    return one


def optimised(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, tolerance: float = 1e-14
) -> gtsam.Values:
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(tolerance)
    parameters.setAbsoluteErrorTol(tolerance)
    parameters.setMaxIterations(200)
    return gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()


def in_deviations(states: FloatArray, window: Window) -> float:
    """Largest difference of states (m, n) to those of a window, in standard deviations."""
    variances = np.diagonal(window.covariances, axis1=1, axis2=2)
    return float((np.abs(states - window.states) / np.sqrt(variances)).max())


@pytest.mark.parametrize(
    ("names", "loss"),
    [
        (POSITION, None),
        (RANGE_BEARING, None),
        ((*POSITION, "yaw_rad"), RobustLoss("huber", 1.5)),
        (RANGE_BEARING, RobustLoss("cauchy", 1.5)),
    ],
    ids=["position", "range, bearing", "yaw, huber", "range, bearing, cauchy"],
)
@pytest.mark.parametrize("motion", MOTIONS, ids=lambda each: type(each).__name__)
@pytest.mark.parametrize("name", SMOOTHERS)
def test_the_optimum_of_the_graph_is_the_converged_smoother(
    name: str,
    motion: MotionModel,
    names: tuple[str, ...],
    loss: RobustLoss | None,
) -> None:
    """From the values of the graph with the defaults of gtsam, and from other values with small tolerances."""
    one = fused(name, motion, stream(motion, names, loss))
    window = one.window()
    graph, values, key = window.to_gtsam(prefix="a")
    near = optimised(graph, values, tolerance=1e-5)
    far = gtsam.Values()
    for stamp_ns, state in zip(window.stamps_ns, window.states, strict=True):
        far.insert(key[stamp_ns], state + 1e-3)
    one.bank.converge()
    converged = one.window()
    for result in (near, optimised(graph, far)):
        found = np.array([result.atVector(key[each]) for each in window.stamps_ns])
        assert in_deviations(found, converged) < 1e-6
        assert window.compare(result).largest < 1e-6
        assert window.compare(result, "a").largest < 1e-6


def test_a_window_is_a_copy_of_the_states_between_its_ends() -> None:
    one = fused("smoother-banded", CTRV(), stream(CTRV()), lag_s=0.5)
    window = one.window()
    kept = pickle.loads(pickle.dumps(window))
    ages_ms = [(each - START.stamp_ns) // MS for each in window.stamps_ns]
    assert ages_ms == [500, 650, 800, 900, 1000, 1100]
    assert len(window.measurements) == 6
    assert repr(window) == "<Window of 6 states over 0.600 s: CTRV, 6 measurements>"
    assert window.indices == (0, 1, 2, 3, 4, 5)
    for row, stamp_ns in enumerate(window.stamps_ns):
        state = one.state_at(stamp_ns)
        np.testing.assert_allclose(window.states[row], state.mean, atol=1e-12)
        np.testing.assert_allclose(window.covariances[row], state.covariance)
    one.update(measured(np.random.default_rng(1), CTRV(), 1200 * MS))
    assert one.window().stamps_ns != window.stamps_ns
    np.testing.assert_array_equal(window.states, kept.states)
    np.testing.assert_array_equal(window.prior.covariance, kept.prior.covariance)
    assert kept.compare(kept.to_gtsam()[1]).largest == 0.0


def test_the_comparison_names_the_state_that_differs_most() -> None:
    window = fused("smoother-banded", CV(), stream(CV())).window()
    _, values, key = window.to_gtsam()
    row = window.stamps_ns.index(START.stamp_ns + 650 * MS)
    deviation = np.sqrt(window.covariances[row, 3, 3])
    moved = window.states[row] + np.array([0.0, 0.0, 0.0, 2.0 * deviation])
    values.update(key[window.stamps_ns[row]], moved)
    found = window.compare(values)
    assert found.largest == pytest.approx(2.0)
    after_s = (window.stamps_ns[row] - window.stamps_ns[0]) / 1e9
    assert f"2 (vy_mps, {after_s:.3f} s after the oldest state)" in str(found)


def test_measurements_of_almost_one_stamp_share_a_state_and_its_key() -> None:
    one = fused("smoother-banded", CTRV(), stream(CTRV())[:4])
    late = measured(np.random.default_rng(9), CTRV(), 200 * MS + US // 2)
    one.update(late)
    window = one.window()
    graph, values, key = window.to_gtsam()
    assert len(window.stamps_ns) == len(window.measurements) == 5
    assert key[late.stamp_ns] == key[START.stamp_ns + 200 * MS]
    assert window.compare(optimised(graph, values)).largest < 1e-6


def test_two_windows_stand_in_one_graph_under_their_prefixes() -> None:
    first, second = (
        fused("smoother-banded", CV(), stream(CV())[:num]).window() for num in (4, 6)
    )
    graph, values, _ = first.to_gtsam("a")
    more, others, _ = second.to_gtsam("b")
    graph.push_back(more)
    values.insert(others)
    result = optimised(graph, values)
    assert first.compare(result, "a").largest < 1e-6
    assert second.compare(result).largest < 1e-6  # only `b` has so many states
    with pytest.raises(fgtrack.CallError, match="under a, b, give the prefix"):
        first.compare(result)
    with pytest.raises(fgtrack.CallError, match="lacks 7 states with the prefix 'a'"):
        second.compare(result, "a")
    shorter = gtsam.Values()
    for index in range(len(first.stamps_ns)):
        shorter.insert(gtsam.symbol("a", index), np.zeros(2))
    with pytest.raises(fgtrack.CallError, match="under no prefix, give the prefix"):
        first.compare(shorter)
    with pytest.raises(fgtrack.CallError, match="prefix: must be one letter, is 'ab'"):
        first.to_gtsam("ab")


# Withdrawn


@pytest.mark.parametrize("ms", [1100, 345, 800, 500, 100], ids=str)
@pytest.mark.parametrize("name", SMOOTHERS)
def test_a_withdrawn_measurement_leaves_no_trace(name: str, ms: int) -> None:
    """Of the newest state, of a split, inside, on the oldest state of the window, and behind the window."""
    motion = CV()
    measurements = stream(motion)
    wrong = measurements[ARRIVALS.index(ms)]
    one = fused(name, motion, measurements, lag_s=0.6)
    without = [each for each in measurements if each is not wrong]
    never = fused(name, motion, without, lag_s=0.6)
    never.advance(one.bank.present_ns)
    newest_ns = START.stamp_ns + 1100 * MS
    assert max(difference(one.state_at(newest_ns), never.state_at(newest_ns))) > 1e-3
    one.withdraw(wrong)
    tolerance = 1e-6 if name == "smoother-batch" else 1e-9
    for at_ms in (500, 650, 777, 900, 1100, 1200):
        stamp_ns = START.stamp_ns + at_ms * MS
        assert (
            max(difference(one.state_at(stamp_ns), never.state_at(stamp_ns)))
            < tolerance
        )
    late = measured(np.random.default_rng(4), motion, 700 * MS)
    assert one.update(late).status is never.update(late).status
    assert (
        max(difference(one.state_at(newest_ns), never.state_at(newest_ns))) < tolerance
    )
    stamps_ns = one.window().stamps_ns
    if ms == 500:  # the oldest state holds the prior and stays, without a measurement
        assert stamps_ns[0] == wrong.stamp_ns
        assert 0 not in one.window().indices
    else:
        assert stamps_ns == never.window().stamps_ns


@pytest.mark.parametrize("name", SMOOTHERS)
def test_a_nonlinear_window_converges_without_the_withdrawn_measurement(
    name: str,
) -> None:
    measurements = stream(CTRV(), RANGE_BEARING)
    one = fused(name, CTRV(), measurements, lag_s=2.0)
    never = fused(name, CTRV(), measurements[:-1], lag_s=2.0)
    one.withdraw(measurements[-1])
    for each in (one, never):
        each.bank.converge()
    assert one.window().stamps_ns == never.window().stamps_ns
    assert in_deviations(one.window().states, never.window()) < 1e-6


def test_one_of_two_measurements_of_a_state_is_withdrawn_alone() -> None:
    motion = CV()
    measurements = stream(motion)
    other = measured(np.random.default_rng(4), motion, 650 * MS)
    one = fused("smoother", motion, [*measurements, other])
    never = fused("smoother", motion, measurements)
    one.withdraw(other)
    assert one.window().stamps_ns == never.window().stamps_ns
    assert in_deviations(one.window().states, never.window()) < 1e-9


def test_what_cannot_be_withdrawn_has_a_clear_reason() -> None:
    measurements = stream(CV())
    one = fused("smoother-banded", CV(), measurements[:1])
    one.advance(START.stamp_ns + 5000 * MS)
    with pytest.raises(fgtrack.CallError, match="has left the window, which begins at"):
        one.withdraw(measurements[0])
    one = fused("smoother-banded", CV(), measurements[:3])
    with pytest.raises(fgtrack.CallError, match="was not fused"):
        one.withdraw(measurements[3])
    one.withdraw(measurements[1])
    with pytest.raises(fgtrack.CallError, match="was withdrawn before"):
        one.withdraw(measurements[1])
    on_grid = estimator("ekf-backward-forward", CTRV(), START)
    assert isinstance(on_grid, FusedOnce)
    for call in (on_grid.window, lambda: on_grid.withdraw(measurements[0])):
        with pytest.raises(fgtrack.CallError, match="keeps no window, take a smoother"):
            call()


# Fused twice


@pytest.mark.parametrize("name", [*SMOOTHERS, "ekf-replay", "ukf-replay"])
def test_an_identical_measurement_is_fused_once(name: str) -> None:
    measurements = stream(CV())
    one = estimator(name, CV(), START)
    for measurement in measurements:
        one.update(measurement)
    before = one.state_at(measurements[-2].stamp_ns)
    for measurement in (measurements[-2], measurements[3]):
        again = replace(measurement, z=measurement.z.copy())
        result = one.update(again)
        assert result.status is UpdateStatus.DUPLICATE
        assert result.innovation is None
    after = one.state_at(measurements[-2].stamp_ns)
    np.testing.assert_array_equal(after.mean, before.mean)
    np.testing.assert_array_equal(after.covariance, before.covariance)
    other = replace(measurements[3], z=measurements[3].z + 1e-3)
    assert one.update(other).status is UpdateStatus.OUT_OF_SEQUENCE


@pytest.mark.parametrize("name", [*SMOOTHERS, "ekf-replay", "imm-replay", "asd"])
def test_a_tracker_fuses_equal_values_of_two_sensors(name: str) -> None:
    measurements = stream(CV())
    bank = estimator_bank(name, CV(), 1.0, {})
    bank.advance(START.stamp_ns)
    bank.birth(0, START)
    bank.advance(measurements[0].stamp_ns)
    for _ in range(2):
        (result,) = bank.update(measurements[0].stamp_ns, [0], [measurements[0]])
        assert result.status is UpdateStatus.IN_SEQUENCE


# Names


@pytest.mark.parametrize("name", sorted(ESTIMATORS))
def test_the_repr_of_an_estimator_names_it_its_motion_and_its_window(name: str) -> None:
    one = estimator(name, CTRV(), START)
    text = repr(one)
    assert f"of one object: CTRV, window {START.stamp_ns}" in text
    assert text.startswith(f"<{name if hasattr(one, 'bank') else ''}")


@pytest.mark.parametrize("name", sorted(ESTIMATORS))
def test_a_time_that_is_no_stamp_has_one_clear_line(name: str) -> None:
    one = estimator(name, CTRV(), START)
    for call in (one.state_at, one.advance):
        for wrong in (0.05e9, 2**70, -(2**70), True, "5"):
            with pytest.raises(fgtrack.CallError) as caught:
                call(wrong)
            line = str(caught.value)
            assert re.fullmatch(
                r"(stamp_ns|now_ns): must be an integer .*, is .*", line
            )


# In a tracker


def test_a_tracker_gives_the_window_of_each_track() -> None:
    messages = list(fgtrack.simulate("single_opponent", seed=1, duration_s=2.0))
    trackers = {
        name: fgtrack.Tracker("smoother", estimator=name, map="oval")
        for name in ("smoother", "ekf-replay")
    }
    for tracker in trackers.values():
        for message in messages:
            if not isinstance(message, fgtrack.TruthState):
                tracker.receive(message)
                report = tracker.tick(message.receipt_ns)
    smoother, replaying = trackers.values()
    track = report.tracks[0]
    window = smoother.window(track.track_id)
    assert len(window.stamps_ns) == len(set(window.stamps_ns)) > 10
    stamp_ns = window.stamps_ns[5]
    state = smoother.state_at(track.track_id, stamp_ns)
    np.testing.assert_allclose(window.states[5, :2], [state.x_m, state.y_m])
    seen_from = {each.pose for each in window.measurements}
    assert len(seen_from) > 10  # by a sensor that moves
    graph, values, _ = window.to_gtsam()
    assert window.compare(optimised(graph, values)).largest < 1e-6
    with pytest.raises(fgtrack.CallError, match="track 99 does not exist"):
        smoother.window(99)
    with pytest.raises(fgtrack.CallError, match="track_id: must be an integer"):
        smoother.window(1.5)
    with pytest.raises(fgtrack.CallError, match="keeps no window, take a smoother"):
        replaying.window(track.track_id)
