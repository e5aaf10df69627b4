"""The measurement models of the shipped components, compiled: values h, Jacobians H, residuals; and robust losses.

Components have numbers, their indices in `COMPONENTS`. A sensor pose is x, y, yaw, vx and vy, shape (5,), see
`fgtrack.models.measurement.SensorPose`. A state begins with x, y, yaw, speed, or with x, y, vx, vy.
"""

import math

import numpy as np

from fgtrack.core.compiled import MATRIX, check, inlined, njit, shared, wrapped
from fgtrack.core.types import YAW_RATE, FloatArray, IntArray
from fgtrack.models.measurement import COMPONENTS, MIN_RANGE_M, SLOW_MPS
from fgtrack.models.motion import MIN_SPEED_MPS
from fgtrack.models.robust import KINDS, LEAST_WEIGHT

YAW, SPEED, RANGE, BEARING, RANGE_RATE, CURVATURE = (
    COMPONENTS.index(name)
    for name in (
        "yaw_rad",
        "speed_mps",
        "range_m",
        "bearing_rad",
        "range_rate_mps",
        "curvature_radpm",
    )
)
NUM_COMPONENTS, POSE_SIZE = len(COMPONENTS), 5
GAUSSIAN, HUBER, CAUCHY, TUKEY, GEMAN_MCCLURE, DCS = range(len(KINDS))
STACK = "Tuple((int64[::1], float64[::1], int64, float64[:, ::1], float64[:, :, ::1]))"
Stack = tuple[IntArray, FloatArray, int, FloatArray, FloatArray]
"""m measurements of one sensor: codes of the components (k,), sensor pose with the width of the robust loss (6,), kind
of the loss, values z (m, k), and covariances R (m, k, k)."""


@inlined
def check_stack(stack: Stack, m: int, k: int, n: int) -> None:
    """Raise `IndexError` unless a stack has m measurements of k components that a state of n entries has."""
    components, view, _, z, R = stack
    check_components(components, n)
    check(k > 0 and len(components) == k and len(view) > POSE_SIZE)
    check(len(z) >= m and len(R) >= m and z.shape[1] == k)
    check(R.shape[1] == k and R.shape[2] == k)


@inlined
def check_components(codes: IntArray, n: int) -> None:
    """Raise `IndexError` unless `codes` are codes of components that a state of n entries has."""
    check(n >= 4)
    for code in codes:
        check(0 <= code < NUM_COMPONENTS and (code != CURVATURE or n > YAW_RATE))


@shared(f"void(int64[::1], b1, float64[::1], float64[::1], float64[::1], {MATRIX})")
def observe(
    codes: IntArray,
    is_cartesian: bool,
    x: FloatArray,
    pose: FloatArray,
    h: FloatArray,
    H: FloatArray,
) -> None:
    """Write the components h (k,) of the state x (n,) seen from `pose` (5,), and their Jacobian H (k, n).

    Below `MIN_RANGE_M` the gradient of a bearing is the gradient at `MIN_RANGE_M`. Below `MIN_SPEED_MPS` the gradient
    of the yaw of a Cartesian state is the gradient at `MIN_SPEED_MPS`. A curvature is the yaw rate over the speed v,
    times v^2 / (v^2 + v0^2) with v0 = `SLOW_MPS`. This factor falls to 0 at rest.
    """
    k, n = len(codes), len(x)
    if codes[k - 1] > SPEED:  # components are in ascending order
        east, north = x[0] - pose[0], x[1] - pose[1]
        distance = math.hypot(east, north)
        c, s = 1.0, 0.0
        if distance > 0.0:
            c, s = east / distance, north / distance
        across = max(distance, MIN_RANGE_M)
    for a in range(k):
        code = codes[a]
        for j in range(n):
            H[a, j] = 0.0
        if code < YAW or (code <= SPEED and not is_cartesian):
            h[a], H[a, code] = x[code], 1.0
        elif code <= SPEED:
            vx, vy = x[2], x[3]
            speed = math.hypot(vx, vy)
            along, left = 1.0, 0.0
            if speed > 0.0:
                along, left = vx / speed, vy / speed
            if code == SPEED:
                h[a], H[a, 2], H[a, 3] = speed, along, left
            else:
                slowest = max(speed, MIN_SPEED_MPS)
                h[a] = math.atan2(vy, vx)
                H[a, 2], H[a, 3] = -left / slowest, along / slowest
        elif code == RANGE:
            h[a], H[a, 0], H[a, 1] = distance, c, s
        elif code == BEARING:
            h[a] = math.atan2(north, east) - pose[2]
            H[a, 0], H[a, 1] = -s / across, c / across
        elif code == RANGE_RATE:
            vx, vy = x[2], x[3]
            H[a, 2], H[a, 3] = c, s
            if not is_cartesian:
                cos, sin = math.cos(x[2]), math.sin(x[2])
                vx, vy = x[3] * cos, x[3] * sin
                H[a, 2], H[a, 3] = s * vx - c * vy, c * cos + s * sin
            vx, vy = vx - pose[3], vy - pose[4]
            sideways = (c * vy - s * vx) / across
            h[a] = c * vx + s * vy
            H[a, 0], H[a, 1] = -s * sideways, c * sideways
        else:
            speed, turn = x[3], x[YAW_RATE]
            least = 1.0 / (speed * speed + SLOW_MPS * SLOW_MPS)
            share = speed * least
            h[a] = turn * share
            H[a, YAW_RATE] = share
            H[a, 3] = turn * (least - 2.0 * share * share)


@inlined
def subtract(
    codes: IntArray, z: FloatArray, h: FloatArray, residual: FloatArray
) -> None:
    """Write z - h (k,) with angles in (-pi, pi]; `residual` may be `z` or `h`."""
    for a in range(len(codes)):
        residual[a] = z[a] - h[a]
        if codes[a] == YAW or codes[a] == BEARING:
            residual[a] = wrapped(residual[a])


@njit(
    "void(int64[::1], b1, float64[:, ::1], float64[::1], float64[:, ::1], float64[:, :, ::1])"
)
def observations(
    codes: IntArray,
    is_cartesian: bool,
    x: FloatArray,
    pose: FloatArray,
    h: FloatArray,
    H: FloatArray,
) -> None:
    """Write the components h (m, k) of states x (m, n) seen from `pose` (5,), and their Jacobians H (m, k, n)."""
    (m, n), k = x.shape, len(codes)
    check(k > 0 and len(pose) >= POSE_SIZE)
    check_components(codes, n)
    check(h.shape == (m, k) and H.shape == (m, k, n))
    for i in range(m):
        observe(codes, is_cartesian, x[i], pose, h[i], H[i])


@njit("void(int64[::1], float64[:, ::1])")
def wrap(codes: IntArray, residuals: FloatArray) -> None:
    """Move the angles among `residuals` (m, k) into (-pi, pi]."""
    check(residuals.shape[1] == len(codes))
    for i in range(len(residuals)):
        for a in range(len(codes)):
            if codes[a] == YAW or codes[a] == BEARING:
                residuals[i, a] = wrapped(residuals[i, a])


@inlined
def penalty_and_weight(kind: int, width: float, d: float) -> tuple[float, float]:
    """Return the loss rho(d) of a whitened residual of length d, and the weight rho'(d) / d of at least `LEAST_WEIGHT`.

    Dynamic covariance scaling, `DCS`, is that of Agarwal et al. 2013.
    """
    if kind == GAUSSIAN:
        return 0.5 * d * d, 1.0
    if not d < np.inf:
        return np.inf, LEAST_WEIGHT
    share = width * width / (width * width + d * d)
    ratio = d / width
    if kind == CAUCHY:
        rho, w = 0.5 * width * width * math.log1p(ratio * ratio), share
    elif kind == GEMAN_MCCLURE:
        rho, w = 0.5 * d * d * share, share * share
    elif kind == TUKEY:
        left = max(1.0 - ratio * ratio, 0.0)
        rho, w = width * width / 6.0 * (1.0 - left * left * left), left * left
    elif d <= width:
        rho, w = 0.5 * d * d, 1.0
    elif kind == HUBER:
        rho, w = width * (d - 0.5 * width), width / d
    else:
        rho, w = width * width * (1.5 - 2.0 * share), 4.0 * share * share
    return rho, max(w, LEAST_WEIGHT)


@njit("UniTuple(float64, 2)(int64, float64, float64)")
def loss_at(kind: int, width: float, d: float) -> tuple[float, float]:
    """See `penalty_and_weight`."""
    return penalty_and_weight(kind, width, d)
