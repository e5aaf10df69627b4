"""The graph's factors against numeric derivatives and written-out losses."""

import math
from collections.abc import Callable
from itertools import product

import gtsam
import numpy as np
import pytest
from support.models import MOTIONS

from fgtrack.core.errors import CallError
from fgtrack.core.types import MEASURABLE, FloatArray
from fgtrack.estimation.base import Measurement
from fgtrack.estimation.smoothing.gtsam.factors import measurement_factor, motion_factor
from fgtrack.models.measurement import MeasurementModel, SensorPose, measurement_model
from fgtrack.models.motion import CTRV, MotionModel
from fgtrack.models.robust import penalty, weight, width
from fgtrack.models.sensors import RobustLoss

LEFT, RIGHT = 3, 7
POSE = SensorPose(2.0, -1.0, 0.3, 4.0, 1.0)
COMPONENTS = {
    "position": ("x_m", "y_m"),
    "position, yaw": ("x_m", "y_m", "yaw_rad"),
    "position, speed": ("x_m", "y_m", "speed_mps"),
    "range, bearing": ("range_m", "bearing_rad"),
    "range, bearing, Doppler": ("range_m", "bearing_rad", "range_rate_mps"),
    "bearing": ("bearing_rad",),
}
LOSSES = ("huber", "cauchy", "tukey", "geman_mcclure", "dcs")


def state(motion: MotionModel, seed: int) -> FloatArray:
    rng = np.random.default_rng(seed)
    kinematic = np.array([12.0, 7.0, 0.4, 20.0, 0.3, 1.5]) + 0.2 * rng.standard_normal(
        6
    )
    return motion.from_kinematic(kinematic, np.eye(6))[0]


def values(**states: FloatArray) -> gtsam.Values:
    found = gtsam.Values()
    for name, x in states.items():
        found.insert(LEFT if name == "left" else RIGHT, x)
    return found


def linear_parts(
    factor: gtsam.NonlinearFactor, at: gtsam.Values
) -> tuple[FloatArray, FloatArray]:
    """A and b of A dx = b, with the weight of a loss."""
    A, b = factor.linearize(at).jacobian()
    return A, b


def numeric_jacobian(
    function: Callable[[FloatArray], FloatArray], x: FloatArray
) -> FloatArray:
    """Central differences, with steps that suit metres, radians and metres per second alike."""
    columns = []
    for k in range(len(x)):
        step = 1e-5 * max(1.0, abs(x[k])) * (np.arange(len(x)) == k)
        columns.append((function(x + step) - function(x - step)) / (2.0 * step[k]))
    return np.stack(columns, axis=-1)


@pytest.mark.parametrize("dt_s", [1e-3, 0.05, 0.9, 3.0])
@pytest.mark.parametrize("kind", MOTIONS)
def test_a_motion_factor_is_the_whitened_gap_and_its_derivative_under_the_noise_of_the_linearisation_point(
    kind: str, dt_s: float
) -> None:
    """The derivative of the noise itself is left out on purpose, so L stays as it is at the linearisation point."""
    motion = MOTIONS[kind]
    left, at = state(motion, 0), state(motion, 9)
    right = motion.predict(left, dt_s) + 0.1 * np.random.default_rng(1).standard_normal(
        motion.dim
    )
    L = np.linalg.cholesky(motion.process_noise(at, dt_s))

    def residual(both: FloatArray) -> FloatArray:
        x_left, x_right = both[: motion.dim], both[motion.dim :]
        return np.linalg.solve(L, x_right - motion.predict(x_left, dt_s))

    A, b = linear_parts(
        motion_factor(motion, LEFT, RIGHT, dt_s, motion.process_noise(at, dt_s)),
        values(left=left, right=right),
    )
    both = np.concatenate([left, right])
    expected = numeric_jacobian(residual, both)
    np.testing.assert_allclose(
        A, expected, rtol=1e-6, atol=1e-7 * np.abs(expected).max()
    )
    np.testing.assert_allclose(
        b, -residual(both), rtol=1e-9, atol=1e-9 * np.abs(b).max()
    )


def measurement(
    kind: str, what: str, loss: RobustLoss | None, off: float = 1.0
) -> tuple[Measurement, FloatArray]:
    """A measurement of a state, and a state that is `off` away from it."""
    motion = MOTIONS[kind]
    model = measurement_model(COMPONENTS[what], motion)
    x, rng = state(motion, 4), np.random.default_rng(5)
    k = len(COMPONENTS[what])
    root = np.eye(k) + 0.3 * rng.standard_normal((k, k))
    R = 0.04 * root @ root.T
    z = model.predict(x, POSE) + off * np.linalg.cholesky(R) @ np.full(
        k, 1.0 / math.sqrt(k)
    )
    return Measurement(0, model, z, R, POSE, loss), x


def whitened(item: Measurement, x: FloatArray) -> FloatArray:
    L = np.linalg.cholesky(item.R)
    return np.linalg.solve(
        L, -item.model.residual(item.z, item.model.predict(x, item.pose))
    )


def loss_and_weight(kind: str, width: float, e: float) -> tuple[float, float]:
    """Loss of a whitened residual of length `e` and its weight, loss' / e, as the literature writes them."""
    c2, e2 = width * width, e * e
    if kind == "huber":
        return (0.5 * e2, 1.0) if e <= width else (width * (e - 0.5 * width), width / e)
    if kind == "cauchy":
        return 0.5 * c2 * math.log1p(e2 / c2), c2 / (c2 + e2)
    if kind == "tukey":
        inside = max(1.0 - e2 / c2, 0.0)
        return c2 / 6.0 * (1.0 - inside**3), inside**2
    if kind == "geman_mcclure":
        return 0.5 * c2 * e2 / (c2 + e2), (c2 / (c2 + e2)) ** 2
    # Dynamic covariance scaling leaves the square at e = width, so its phi is width^2 (Agarwal et al. 2013).
    if e2 <= c2:
        return 0.5 * e2, 1.0
    return 1.5 * c2 - 2.0 * c2 * c2 / (c2 + e2), (2.0 * c2 / (c2 + e2)) ** 2


@pytest.mark.parametrize("loss", [None, *LOSSES], ids=str)
@pytest.mark.parametrize(("kind", "what"), list(product(MOTIONS, COMPONENTS)))
def test_a_measurement_factor_is_the_whitened_weighted_residual(
    kind: str, what: str, loss: str | None
) -> None:
    for off in (0.4, 2.0, 5.0):
        item, x = measurement(
            kind, what, None if loss is None else RobustLoss(loss, 1.5), off
        )
        own = item.loss and width(item.loss, len(item.R))
        root_weight = (
            1.0
            if loss is None
            else math.sqrt(loss_and_weight(loss, own or 0.0, off)[1])
        )
        A, b = linear_parts(
            measurement_factor(item, LEFT, motion=MOTIONS[kind]), values(left=x)
        )
        expected = numeric_jacobian(lambda at, item=item: whitened(item, at), x)
        np.testing.assert_allclose(
            A, root_weight * expected, rtol=1e-6, atol=1e-7 * np.abs(expected).max()
        )
        np.testing.assert_allclose(
            b, -root_weight * whitened(item, x), rtol=1e-9, atol=1e-9
        )


@pytest.mark.parametrize(
    ("c", "off"),
    [(1.5, 0.3), (1.5, 1.4), (1.5, 1.6), (1.5, 8.0), (2.5, 2.4), (2.5, 2.6)],
)
@pytest.mark.parametrize("kind", LOSSES)
def test_a_robust_loss_is_its_formula(kind: str, c: float, off: float) -> None:
    item, x = measurement("ctrv", "position", RobustLoss(kind, c), off)
    factor = measurement_factor(item, LEFT)
    of_two = width(RobustLoss(kind, c), 2)
    assert factor.error(values(left=x)) == pytest.approx(
        loss_and_weight(kind, of_two, off)[0], rel=1e-9
    )
    loss, expected_weight = loss_and_weight(kind, c, off)
    assert penalty(RobustLoss(kind, c), off, 1) == pytest.approx(loss, rel=1e-12)
    assert weight(RobustLoss(kind, c), off, 1) == pytest.approx(
        expected_weight, rel=1e-12, abs=1e-12
    )
    step = 1e-6
    slope = (
        loss_and_weight(kind, c, off + step)[0]
        - loss_and_weight(kind, c, off - step)[0]
    ) / (2 * step)
    assert slope == pytest.approx(expected_weight * off, rel=1e-5, abs=1e-6)


@pytest.mark.parametrize(
    "loss", [None, RobustLoss("huber", 2.0)], ids=["gaussian", "huber"]
)
@pytest.mark.parametrize("turns", [-1, 0, 2])
def test_a_yaw_is_taken_on_the_branch_next_to_the_state(
    loss: RobustLoss | None, turns: int
) -> None:
    model = measurement_model(("yaw_rad",), CTRV())
    item = Measurement(
        0, model, np.array([-math.pi + 0.1]), np.array([[0.01]]), loss=loss
    )
    x = np.array([0.0, 0.0, math.pi - 0.05 + 2.0 * math.pi * turns, 10.0, 0.0])
    _, b = linear_parts(measurement_factor(item, LEFT), values(left=x))
    assert b == pytest.approx([1.5])


# Poses and clocks as variables

POSE_KEY, CLOCK_KEY = 11, 13
EVERY = {**COMPONENTS, "yaw": ("yaw_rad",), "all": MEASURABLE}


def tilted(what: str, motion: MotionModel) -> tuple[Measurement, FloatArray]:
    """A measurement half a standard deviation off a state, seen from `POSE`."""
    x = state(motion, 4)
    model = measurement_model(EVERY[what], motion)
    z = model.predict(x, POSE) + 0.1
    return Measurement(0, model, z, 0.04 * np.eye(len(z)), POSE), x


def numeric_columns(
    factor: gtsam.NonlinearFactor, at: gtsam.Values, key: int
) -> FloatArray:
    """Derivative of the whitened residual by the tangent vector of the variable at `key`, by central differences."""
    size, columns = at.zeroVectors().at(key).size, []
    for k in range(size):
        residuals = []
        for step in (1e-5, -1e-5):
            move = at.zeroVectors()
            move.update(key_vector(key, step * (np.arange(size) == k)))
            residuals.append(-linear_parts(factor, at.retract(move))[1])
        columns.append((residuals[0] - residuals[1]) / 2e-5)
    return np.stack(columns, axis=-1)


def key_vector(key: int, vector: FloatArray) -> gtsam.VectorValues:
    found = gtsam.VectorValues()
    found.insert(key, vector)
    return found


@pytest.mark.parametrize("role", ["sensor", "ego", "mount"])
@pytest.mark.parametrize("has_clock", [False, True])
@pytest.mark.parametrize("what", EVERY)
@pytest.mark.parametrize("kind", MOTIONS)
def test_the_derivatives_by_state_pose_and_clock_are_numeric_ones(
    kind: str, what: str, has_clock: bool, role: str
) -> None:
    motion = MOTIONS[kind]
    item, x = tilted(what, motion)
    known = {
        "sensor": {},
        "ego": {"mount": gtsam.Pose2(1.5, -0.4, 0.7)},
        "mount": {"ego": gtsam.Pose2(1.0, 0.5, -0.2)},
    }[role]
    at = gtsam.Values()
    at.insert(LEFT, x)
    at.insert(POSE_KEY, gtsam.Pose2(1.7, -0.6, 0.45))
    at.insert(CLOCK_KEY, 0.08)
    factor = measurement_factor(
        item,
        LEFT,
        motion=motion,
        ahead_s=0.02,
        pose_key=POSE_KEY,
        clock_key=CLOCK_KEY if has_clock else None,
        **known,
    )
    A, _ = linear_parts(factor, at)
    keys = [LEFT, POSE_KEY, CLOCK_KEY][: 3 if has_clock else 2]
    assert list(factor.keys()) == keys
    expected = np.hstack([numeric_columns(factor, at, key) for key in keys])
    np.testing.assert_allclose(A, expected, atol=2e-6 * np.abs(expected).max())


@pytest.mark.parametrize("what", EVERY)
@pytest.mark.parametrize("kind", MOTIONS)
def test_at_the_pose_of_the_measurement_the_factor_is_that_of_the_state_alone(
    kind: str, what: str
) -> None:
    motion = MOTIONS[kind]
    item, x = tilted(what, motion)
    at = values(left=x)
    at.insert(POSE_KEY, gtsam.Pose2(*POSE[:3]))
    at.insert(CLOCK_KEY, 0.0)
    plain = measurement_factor(item, LEFT)
    posed = measurement_factor(item, LEFT, pose_key=POSE_KEY, clock_key=CLOCK_KEY)
    n = motion.dim
    (A, b), (B, c) = linear_parts(plain, at), linear_parts(posed, at)
    np.testing.assert_allclose(B[:, :n], A, atol=1e-9)
    np.testing.assert_allclose(c, b, atol=1e-9)


def test_positions_seen_from_a_vehicle_give_the_mount_and_the_clock_of_the_sensor() -> (
    None
):
    """A car turns before a vehicle; the recording has a wrong mount and stamps that are 80 ms ahead."""
    motion, rng = CTRV(), np.random.default_rng(2)
    offset_s, truth = 0.08, gtsam.Pose2(2.0, 0.3, 0.15)
    wrong = gtsam.Pose2(1.6, 0.0, 0.0)
    graph, at = gtsam.NonlinearFactorGraph(), gtsam.Values()
    clock, mount = gtsam.symbol("c", 0), gtsam.symbol("m", 0)
    start = np.array([20.0, 3.0, 0.2, 15.0, 0.3])

    def vehicle(time_s: float) -> gtsam.Pose2:
        return gtsam.Pose2(12.0 * time_s, 0.0, 0.1)

    velocity = np.array([12.0, 0.0])
    previous = None
    for k in range(40):
        time_s, key = 0.1 * k, gtsam.symbol("x", k)
        x = motion.predict(start, time_s)
        seen = vehicle(time_s).compose(truth).transformTo(x[:2])
        seen = seen + 0.05 * rng.standard_normal(2)
        stamped_s = time_s + offset_s
        sensor = vehicle(stamped_s).compose(wrong)
        z = sensor.transformFrom(seen)
        pose = SensorPose(sensor.x(), sensor.y(), sensor.theta(), *velocity)
        item = Measurement(
            round(stamped_s * 1e9),
            measurement_model(("x_m", "y_m"), motion),
            z,
            0.05**2 * np.eye(2),
            pose,
        )
        # the state stands at the stamp; the graph finds that the object was seen earlier
        at.insert(key, motion.predict(start, stamped_s) + 0.2)
        graph.add(
            measurement_factor(
                item,
                key,
                pose_key=mount,
                ego=vehicle(stamped_s),
                clock_key=clock,
            )
        )
        exact = gtsam.noiseModel.Isotropic.Sigma(5, 0.05)
        if k % 10 == 0:  # another sensor that needs no calibration
            graph.add(
                gtsam.PriorFactorVector(key, motion.predict(start, stamped_s), exact)
            )
        if previous is not None:
            Q = motion.process_noise(x, 0.1)
            graph.add(motion_factor(motion, previous, key, 0.1, Q))
        previous = key
    at.insert(mount, wrong)
    at.insert(clock, 0.0)
    result = gtsam.LevenbergMarquardtOptimizer(graph, at).optimize()
    marginals = gtsam.Marginals(graph, result)
    error = truth.localCoordinates(result.atPose2(mount))
    sigma = np.sqrt(np.diag(marginals.marginalCovariance(mount)))
    assert (np.abs(error) < 3.0 * sigma).all()
    assert (sigma < [0.2, 0.2, 0.02]).all()
    clock_sigma = math.sqrt(marginals.marginalCovariance(clock)[0, 0])
    assert abs(result.atDouble(clock) - offset_s) < 3.0 * clock_sigma < 0.06


def test_a_factor_that_lacks_its_motion_or_pose_has_one_clear_line() -> None:
    item, _ = tilted("position", CTRV())
    with pytest.raises(CallError, match="ego and mount need a pose_key"):
        measurement_factor(item, LEFT, ego=gtsam.Pose2())
    with pytest.raises(CallError, match="give either ego or mount"):
        measurement_factor(
            item, LEFT, pose_key=POSE_KEY, ego=gtsam.Pose2(), mount=gtsam.Pose2()
        )
    names = (*CTRV.state_names, "length_m")
    other = Measurement(0, MeasurementModel(("x_m", "y_m"), names), item.z, item.R)
    with pytest.raises(CallError, match="has no shipped motion model, give motion"):
        measurement_factor(other, LEFT, clock_key=CLOCK_KEY)
