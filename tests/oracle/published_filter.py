"""The filter of the published tracker, from BEHAVIOUR.md sections 1, 7 and 13: naive and literal, yaw 0 along +y."""

import math

import numpy as np
from published_lane import Array

DT = 0.01
P_INIT = np.diag([0.01, 0.01, 0.3, 4.0, 0.3, 1.0])
Q0 = np.diag(np.square([0.2, 0.2, 0.3, 1.0, 0.5, 3.0])) * DT**2


def wrap(angle: float) -> float:
    """One step only (section 1)."""
    if angle <= -math.pi:
        return angle + 2 * math.pi
    if angle > math.pi:
        return angle - 2 * math.pi
    return angle


def rot(yaw: float) -> Array:
    """Local to global (section 1)."""
    return np.array([[-math.sin(yaw), -math.cos(yaw)], [math.cos(yaw), -math.sin(yaw)]])


def rotated(matrix: Array, yaw: float) -> Array:
    """`matrix` with its upper left block turned by `yaw`."""
    turned, turn = matrix.copy(), rot(yaw)
    turned[:2, :2] = turn @ matrix[:2, :2] @ turn.T
    return turned


def predict(state: Array, P: Array) -> tuple[Array, Array]:
    """One step of DT (section 7)."""
    x, y, yaw, v, r, a = (float(value) for value in state)
    s, c = math.sin(yaw), math.cos(yaw)
    F = np.eye(6)
    F[0, 2], F[0, 3] = -v * DT * c, -DT * s
    F[1, 2], F[1, 3] = -v * DT * s, DT * c
    F[2, 4] = DT
    predicted = np.array(
        [x - v * DT * s, y + v * DT * c, min(yaw + r * DT, math.pi), v + a * DT, r, a]
    )
    return predicted, (F @ P) @ F.T + rotated(Q0, yaw)


def line_of_sight(offset: Array) -> float:
    """Bearing of `offset` (section 13)."""
    distance = math.hypot(*offset)
    if distance == 0.0:
        return math.pi / 2
    bearing = math.acos(min(max(offset[1] / distance, -1.0), 1.0))
    return wrap(-bearing if offset[0] > 0 else bearing)


def correct(
    x: Array, P: Array, z: Array, std: tuple[float, ...], ego_xy: Array
) -> tuple[Array, Array]:
    """Measurement update (section 13)."""
    R = rotated(np.diag(np.square(std)), line_of_sight(x[:2] - ego_xy))
    H = np.eye(len(std), 6)
    y = z - H @ x
    y[2] = wrap(wrap(z[2]) - x[2])
    S = H @ (P @ H.T) + R
    K = (P @ H.T) @ np.linalg.inv(S)
    posterior = x + K @ y
    posterior[2] = wrap(posterior[2])
    return posterior, (np.eye(6) - K @ H) @ P
