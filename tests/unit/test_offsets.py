"""Clock offsets of sensors from tracks whose association is known."""

from collections.abc import Callable

import numpy as np
import pytest
from support.shiftable import MOTION, START_NS, Circle, Eye, World, in_ego, polar, shuffled

from fgtrack.core.geometry import rotation
from fgtrack.core.time import nanoseconds
from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement
from fgtrack.estimation.factor_graph.clock_calibration import offsets
from fgtrack.estimation.factor_graph.clock_calibration.offsets import OffsetSettings, OffsetSolution, solve_offsets
from fgtrack.estimation.factor_graph.clock_calibration.time_shift import Nodes, ShiftableMeasurement, pair_term, rates

Making = Callable[[FloatArray, Circle, float], Callable[[int], Measurement]]

TRUE_S = 0.04
TWO = {"a": Eye(), "b": Eye(TRUE_S, phase_s=0.03)}
STILL = (30.0, -40.0, 1.2, 0.0, 0.0)
X = np.array([30.0, -40.0, 1.2, 25.0, 0.1])


def solution(world: World, seed: int = 0, settings: OffsetSettings | None = None) -> OffsetSolution:
    """Of all sensors but the first one."""
    rng = np.random.default_rng(seed)
    free = [name for name in world.eyes if name != "a"]
    return solve_offsets(MOTION, [world.measurements(rng)], dict.fromkeys(free, 0.0), settings or OffsetSettings())


def std_s(found: OffsetSolution) -> float:
    return float(np.sqrt(found.covariance[0, 0]))


def exact_nodes() -> Nodes:
    """Nodes of an object that moves exactly as the model says."""
    stamps_ns = range(START_NS, START_NS + nanoseconds(1.0), nanoseconds(0.1))
    return Nodes(stamps_ns, np.array([MOTION.predict(X, 0.1 * k) for k in range(len(stamps_ns))]))


def test_the_rate_of_a_position_is_the_velocity_in_the_turning_ego_frame() -> None:
    ego, after_s = Circle(20.0, 0.2), 0.43
    z = np.array([12.0, -7.0])
    time_ns = START_NS + nanoseconds(after_s)
    found = rates(MOTION, exact_nodes(), ShiftableMeasurement("b", time_ns, in_ego(z, ego, 0.2)), time_ns)
    x = MOTION.predict(X, after_s)
    pose = ego(time_ns)
    quarter = rotation(pose.yaw_rad + np.pi / 2.0)
    frame = np.array([pose.vx_mps, pose.vy_mps]) + 0.2 * quarter @ z
    expected = x[3] * np.array([np.cos(x[2]), np.sin(x[2])]) - frame
    np.testing.assert_allclose(found.y, expected, atol=1e-4)
    np.testing.assert_allclose(found.velocity_mps, expected, atol=1e-4)


@pytest.mark.parametrize("make", [in_ego, polar])
def test_the_rate_is_how_a_reading_changes_when_its_time_does(make: Making) -> None:
    time_ns, step_ns = START_NS + nanoseconds(0.43), nanoseconds(0.02)
    item = ShiftableMeasurement("b", time_ns, make(np.array([31.0, -38.0]), Circle(20.0), 0.2))
    nodes = exact_nodes()
    change = pair_term(MOTION, nodes, item, time_ns + step_ns).y - pair_term(MOTION, nodes, item, time_ns - step_ns).y
    np.testing.assert_allclose(rates(MOTION, nodes, item, time_ns).y, change / 0.04, rtol=5e-3)


@pytest.mark.parametrize("make", [in_ego, polar])
def test_a_reading_moves_with_the_nodes_around_it_as_it_says(make: Making) -> None:
    time_ns = START_NS + nanoseconds(0.43)
    item = ShiftableMeasurement("b", time_ns, make(np.array([31.0, -38.0]), Circle(20.0), 0.2))
    nodes = exact_nodes()
    found = pair_term(MOTION, nodes, item, time_ns)
    assert found.place == 4
    for place, claimed in ((4, found.left), (5, found.right)):
        for j in range(5):
            ahead, behind = (_error(nodes, place, sign * 1e-5 * np.eye(5)[j], item, time_ns) for sign in (1, -1))
            np.testing.assert_allclose((ahead - behind) / 2e-5, claimed[:, j], rtol=0.02, atol=2e-3)


def _error(nodes: Nodes, place: int, change: FloatArray, item: ShiftableMeasurement, time_ns: int) -> FloatArray:
    means = nodes.means.copy()
    means[place] += change
    return pair_term(MOTION, Nodes(nodes.stamps_ns, means), item, time_ns).y


def test_the_slope_is_that_of_the_loss() -> None:
    items = World({"a": Eye(), "b": Eye(TRUE_S, phase_s=0.03, outliers=0.2)}, duration_s=2.0).measurements(
        np.random.default_rng(0)
    )
    path = offsets._Path(MOTION, items, offsets._first_nodes(MOTION, items, {"b": 0.0}, OffsetSettings()), 3.0)

    def loss(offset_s: float) -> float:
        found = np.array([path.pair_term(item, {"b": offset_s}).distance for item in items])
        return float(np.where(found < 3.0, found**2 / 2.0, 3.0 * found - 4.5).sum())

    expected = (loss(0.001) - loss(-0.001)) / 0.002
    assert path.slopes({"b": 0.0})["b"] == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("second", [Eye(TRUE_S, phase_s=0.03), Eye(TRUE_S, phase_s=0.03, polar=True)])
@pytest.mark.parametrize("seed", [1, 2])
def test_an_offset_is_estimated_from_a_driving_ego(seed: int, second: Eye) -> None:
    found = solution(World({"a": Eye(), "b": second}, Circle(20.0)), seed)
    assert found.converged.all()
    error_s = abs(found.offsets_s[0] - TRUE_S)
    assert error_s < 0.003
    assert error_s < 3.0 * std_s(found)
    assert std_s(found) < 0.003
    assert found.residuals["b"] == pytest.approx(1.0, abs=0.2)
    assert 15.0 < found.speeds_mps["b"] < 30.0


def test_each_of_three_sensors_has_its_own_offset() -> None:
    found = solution(World({**TWO, "c": Eye(-0.02, phase_s=0.07)}, duration_s=3.0))
    assert found.sensors == ("b", "c")
    np.testing.assert_allclose(found.offsets_s, [TRUE_S, -0.02], atol=3.0 * std_s(found))
    assert 0.2 < found.covariance[0, 1] / found.covariance[0, 0] < 0.8  # both lean on the same reference


def test_the_order_of_measurements_and_the_first_guess_do_not_matter() -> None:
    rng = np.random.default_rng(3)
    items = World(TWO, duration_s=3.0).measurements(rng)
    tight = OffsetSettings(tolerance_s=1e-6, max_rounds=6)
    one = solve_offsets(MOTION, [items], {"b": 0.0}, tight)
    other = solve_offsets(MOTION, [shuffled(rng, items)], {"b": 0.1}, tight)
    assert abs(one.offsets_s[0] - other.offsets_s[0]) < 0.1 * std_s(one)
    assert std_s(one) == pytest.approx(std_s(other), rel=0.05)


def test_outliers_cost_little_with_a_robust_loss_and_much_without() -> None:
    world = World({"a": Eye(outliers=0.1), "b": Eye(TRUE_S, phase_s=0.03, outliers=0.1)}, duration_s=4.0)
    robust, gaussian = solution(world), solution(world, settings=OffsetSettings(huber_width=None))
    assert abs(robust.offsets_s[0] - TRUE_S) < 3.0 * std_s(robust)
    assert abs(gaussian.offsets_s[0] - TRUE_S) > 3.0 * std_s(gaussian)


def test_nothing_is_known_where_ego_and_object_stand() -> None:
    found = solution(World(TWO, start=STILL, frozen=True, duration_s=3.0))
    assert std_s(found) > 0.05


def test_an_object_that_stands_is_enough_where_the_ego_drives() -> None:
    found = solution(World(TWO, Circle(20.0), start=STILL, frozen=True, duration_s=3.0))
    assert found.converged.all()
    assert abs(found.offsets_s[0] - TRUE_S) < 3.0 * std_s(found) < 0.01


def test_one_sensor_alone_tells_nothing_of_its_clock() -> None:
    found = solution(World({"b": Eye(TRUE_S)}, Circle(20.0)))
    assert std_s(found) == pytest.approx(0.5, rel=1e-3)
    assert abs(found.offsets_s[0]) < 1e-3


def test_a_track_seen_at_a_single_time_is_refused() -> None:
    item = World(TWO).measurements(np.random.default_rng(0))[0]
    with pytest.raises(np.linalg.LinAlgError):
        solve_offsets(MOTION, [[item, item]], {"b": 0.0}, OffsetSettings())


@pytest.mark.parametrize(
    ("name", "value"),
    [("prior_std_s", 0.0), ("node_s", -1.0), ("tolerance_s", float("nan")), ("huber_width", 0.0), ("max_rounds", 0)],
)
def test_settings_out_of_range_are_named(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"^{name}: "):
        OffsetSettings(**{name: value})  # type: ignore[arg-type]  # one of several types
