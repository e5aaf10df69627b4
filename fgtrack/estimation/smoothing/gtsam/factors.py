"""Factors of gtsam that call the models: motion, and measurements with a sensor pose or a clock offset as variables."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import gtsam
import numpy as np
from gtsam.noiseModel import mEstimator

from fgtrack.core.errors import CallError
from fgtrack.core.linalg import identity, inverse_root, noise_root
from fgtrack.core.types import YAW, FloatArray
from fgtrack.estimation.base import Measurement
from fgtrack.estimation.smoothing.terms import linearised
from fgtrack.models.motion import CARTESIAN, CT, CTRA, CTRV, CV, MotionModel
from fgtrack.models.robust import width

_Loss = (
    mEstimator.Huber
    | mEstimator.Cauchy
    | mEstimator.Tukey
    | mEstimator.GemanMcClure
    | mEstimator.DCS
)
_LOSSES: Mapping[str, Callable[[float], _Loss]] = {
    "huber": mEstimator.Huber.Create,
    "cauchy": mEstimator.Cauchy.Create,
    "tukey": mEstimator.Tukey.Create,
    "geman_mcclure": mEstimator.GemanMcClure.Create,
    "dcs": lambda width: mEstimator.DCS.Create(
        width * width
    ),  # gtsam counts in squared standard deviations
}
_SHIPPED = (CTRV, CTRA, CT, CV)
#: Half of the interval over which motion is differentiated by time.
_RATE_STEP_S = 1e-4
#: Derivative of a rotation by its angle, times the inverse rotation.
_QUARTER_TURN = np.array([[0.0, -1.0], [1.0, 0.0]])


def motion_factor(
    motion: MotionModel, left: int, right: int, dt_s: float, noise: FloatArray
) -> gtsam.NonlinearFactor:
    """Return the factor of the motion from the state at key `left` to the state at key `right`.

    Parameters
    ----------
    motion
        Motion model. Both variables are vectors in its state, shape (n,).
    left, right
        Keys of the states; the right one is `dt_s` later.
    dt_s
        Time between them.
    noise
        Covariance of the accumulated process noise, shape (n, n): `motion.process_noise(x, dt_s)`.
    """

    def error(
        this: gtsam.CustomFactor,
        values: gtsam.Values,
        jacobians: list[FloatArray] | None,
    ) -> FloatArray:
        mean, F, _ = motion.transition(values.atVector(left), dt_s)
        if jacobians is not None:
            jacobians[0], jacobians[1] = -F, identity(motion.dim)
        return np.subtract(values.atVector(right), mean)

    return gtsam.CustomFactor(_gaussian(noise_root(noise)), [left, right], error)


def measurement_factor(
    measurement: Measurement,
    key: int,
    *,
    motion: MotionModel | None = None,
    ahead_s: float = 0.0,
    pose_key: int | None = None,
    ego: gtsam.Pose2 | None = None,
    mount: gtsam.Pose2 | None = None,
    clock_key: int | None = None,
) -> gtsam.NonlinearFactor:
    """Return the factor of a measurement on the state at `key`, with its robust loss.

    The sensor pose is the pose of the measurement, or a variable. With a variable, a measured position or yaw is first
    expressed relative to the pose of the measurement. The factor compares it with the object relative to the variable.

    Parameters
    ----------
    measurement
        Measurement of the object, at its own stamp and seen from its own pose.
    key
        Key of the state, a vector of shape (n,).
    motion
        Motion model of the state. It may be left out for the state of `CTRV`, `CTRA`, `CT` or `CV`; their default
        parameters then move the state in time.
    ahead_s
        Time from the state to the stamp of the measurement. The process noise over it is neglected.
    pose_key
        Key of a `gtsam.Pose2`: the sensor in the map; with `ego` the mount of the sensor on the vehicle; with `mount`
        the pose of the vehicle in the map. The velocity of the sensor stays that of the measurement.
    ego, mount
        Known part of the sensor pose, see `pose_key`.
    clock_key
        Key of a scalar: the clock offset of the sensor in seconds. The measurement belongs to its stamp minus the
        offset, as with the setting `clock_offset_s`. Object and sensor pose move over this time, without process noise.

    Raises `CallError` for a state without a motion model and for a pose that is given twice, and
    `numpy.linalg.LinAlgError` for a covariance that is not positive definite.
    """
    if (ego is not None or mount is not None) and pose_key is None:
        raise CallError("measurement_factor: ego and mount need a pose_key")
    if ego is not None and mount is not None:
        raise CallError("measurement_factor: give either ego or mount, not both")
    if motion is None and (clock_key is not None or ahead_s != 0.0):
        motion = _shipped(measurement)
    if motion is not None:
        measurement = measurement.seen_by(motion)
    noise = _noise(measurement)
    if pose_key is None and clock_key is None:
        return _state_factor(measurement, key, motion, ahead_s, noise)
    view = _View(measurement, motion, ahead_s)
    keys = [each for each in (key, pose_key, clock_key) if each is not None]

    def error(
        this: gtsam.CustomFactor,
        values: gtsam.Values,
        jacobians: list[FloatArray] | None,
    ) -> FloatArray:
        sensor, by_variable = None, None
        if pose_key is not None:
            sensor, by_variable = _sensor(values.atPose2(pose_key), ego, mount)
        offset_s = 0.0 if clock_key is None else values.atDouble(clock_key)
        y, H, by_sensor, by_offset = view.linearised(
            values.atVector(key), sensor, offset_s
        )
        if jacobians is not None:
            jacobians[0] = H
            if by_variable is not None:
                jacobians[1] = by_sensor @ by_variable
            if clock_key is not None:
                jacobians[-1] = by_offset[:, None]
        return -y

    return gtsam.CustomFactor(noise, keys, error)


def _state_factor(
    measurement: Measurement,
    key: int,
    motion: MotionModel | None,
    ahead_s: float,
    noise: gtsam.noiseModel.Base,
) -> gtsam.NonlinearFactor:
    """Return the factor of a measurement on its state alone."""
    if measurement.model.linear and not ahead_s:
        return _linear_factor(measurement, key, noise)

    def error(
        this: gtsam.CustomFactor,
        values: gtsam.Values,
        jacobians: list[FloatArray] | None,
    ) -> FloatArray:
        x = values.atVector(key)
        if motion is None:
            y, H = measurement.model.linearised(measurement.z, x, measurement.pose)
        else:
            y, H = linearised((measurement, ahead_s), x, motion)
        if jacobians is not None:
            jacobians[0] = H
        return -y

    return gtsam.CustomFactor(noise, [key], error)


def _linear_factor(
    measurement: Measurement, key: int, noise: gtsam.noiseModel.Base
) -> gtsam.NonlinearFactor:
    """Return the factor of a measurement of entries of the state: its callback is short, because it is called often."""
    model, z = measurement.model, measurement.z

    def error(
        this: gtsam.CustomFactor,
        values: gtsam.Values,
        jacobians: list[FloatArray] | None,
    ) -> FloatArray:
        x = values.atVector(key)
        H = model.selection(len(x))
        if jacobians is not None:
            jacobians[0] = H
        if model.angular:
            return -model.residual(z, H @ x)
        return np.subtract(H @ x, z)

    return gtsam.CustomFactor(noise, [key], error)


def _noise(measurement: Measurement) -> gtsam.noiseModel.Base:
    """Return the noise model of a measurement, with its robust loss."""
    noise, loss = _gaussian(inverse_root(measurement.R)), measurement.loss
    if loss is None:
        return noise
    robust = _LOSSES[loss.kind](width(loss, len(measurement.R)))
    return gtsam.noiseModel.Robust.Create(robust, noise)


class _Innovation(NamedTuple):
    """Innovation of a measurement, and the derivatives of the predicted measurement."""

    y: FloatArray
    """Measured minus predicted values, shape (k,)."""
    by_state: FloatArray
    """Derivative by the state, shape (k, n)."""
    by_sensor: FloatArray
    """Derivative by x, y and yaw of the sensor in the map, shape (k, 3)."""
    by_offset: FloatArray
    """Derivative by the clock offset, shape (k,)."""


@dataclass(frozen=True)
class _View:
    """A measurement as a function of the state, the sensor pose and the clock offset.

    `ahead_s` is the time from the state to the stamp of the measurement. Without `motion` the state does not move.
    """

    measurement: Measurement
    motion: MotionModel | None
    ahead_s: float

    def linearised(
        self, x: FloatArray, sensor: FloatArray | None, offset_s: float
    ) -> _Innovation:
        """Return the innovation at the state `x` (n,), the `sensor` pose (3,) in the map and the clock offset.

        The object is moved to the time of the measurement, and then rigidly so that the `sensor` pose becomes the pose
        of the measurement. All models then apply as they are.
        """
        model, z, pose = (
            self.measurement.model,
            self.measurement.z,
            self.measurement.pose,
        )
        at, F, rate = self._moved(x, self.ahead_s - offset_s)
        if sensor is None:
            sensor = np.array(pose[:3])
        velocity = np.array(pose[3:])
        placed = sensor.copy()
        placed[:2] -= offset_s * velocity
        turn_rad = pose.yaw_rad - placed[2]
        c, s = np.cos(turn_rad), np.sin(turn_rad)
        turn = np.array([[c, -s], [s, c]])
        seen, own_velocity = at.copy(), turn @ velocity
        offset_m = turn @ (at[:2] - placed[:2])
        seen[:2] = offset_m + pose[:2]
        turns, by_pose = np.eye(len(x)), np.zeros((len(x), 3))
        turns[:2, :2] = turn
        by_pose[:2, :2], by_pose[:2, 2] = -turn, -_QUARTER_TURN @ offset_m
        if model.state_names[:4] == CARTESIAN:
            seen[2:4], turns[2:4, 2:4] = turn @ at[2:4], turn
            by_pose[2:4, 2] = -_QUARTER_TURN @ seen[2:4]
        else:
            seen[YAW] += turn_rad
            by_pose[YAW, 2] = -1.0
        own_pose = pose._replace(vx_mps=own_velocity[0], vy_mps=own_velocity[1])
        y, H = model.linearised(z, seen, own_pose)
        by_sensor = H @ by_pose
        by_velocity = model.pose_jacobian(seen, own_pose)[:, 3:]
        by_sensor[:, 2] -= by_velocity @ _QUARTER_TURN @ own_velocity
        by_offset = -H @ turns @ rate - by_sensor[:, :2] @ velocity
        return _Innovation(y, H @ turns @ F, by_sensor, by_offset)

    def _moved(
        self, x: FloatArray, dt_s: float
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the state after `dt_s`, its derivative by `x`, shape (n, n), and its derivative by time, (n,)."""
        if self.motion is None:
            return x, identity(len(x)), np.zeros(len(x))
        after = self.motion.predict(x, dt_s + _RATE_STEP_S)
        before = self.motion.predict(x, dt_s - _RATE_STEP_S)
        rate = (after - before) / (2.0 * _RATE_STEP_S)
        return self.motion.predict(x, dt_s), self.motion.jacobian(x, dt_s), rate


def _sensor(
    variable: gtsam.Pose2, ego: gtsam.Pose2 | None, mount: gtsam.Pose2 | None
) -> tuple[FloatArray, FloatArray]:
    """Return the sensor pose in the map as (x, y, yaw), and its derivative, shape (3, 3).

    The pose is ego * variable * mount. `variable` is the unknown part. `ego` and `mount` are known parts; None leaves a
    part out. The derivative is by the tangent vector of gtsam, in the axes of the variable.
    """
    left = variable if ego is None else ego.compose(variable)
    sensor = left if mount is None else left.compose(mount)
    derivative = np.eye(3)
    derivative[:2, :2] = left.rotation().matrix()
    if mount is not None:
        arm_m = np.array([mount.x(), mount.y()])
        derivative[:2, 2] = derivative[:2, :2] @ _QUARTER_TURN @ arm_m
    return np.array([sensor.x(), sensor.y(), sensor.theta()]), derivative


def _shipped(measurement: Measurement) -> MotionModel:
    """Return the shipped motion model, with default parameters, of the state that is measured.

    Raises `CallError` if there is no such model.
    """
    names = measurement.model.state_names
    for model in _SHIPPED:
        if model.state_names == names:
            return model()
    raise CallError(
        f"measurement_factor: the state {', '.join(names)} has no shipped motion model, give motion"
    )


def _gaussian(root: FloatArray) -> gtsam.noiseModel.Base:
    return gtsam.noiseModel.Gaussian.SqrtInformation(root, smart=False)
