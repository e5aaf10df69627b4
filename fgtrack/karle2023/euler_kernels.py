"""Compiled Euler steps of CTRV (Karle et al. 2023, eq. 10)."""

import math

from fgtrack.core.compiled import (
    add_product_transposed,
    check,
    copy,
    njit,
    product,
    scratch,
)
from fgtrack.core.types import FloatArray, IntArray


@njit(
    "void(float64[:, ::1], float64[:, :, ::1], int64[::1], float64, float64[::1], b1, float64)"
)
def propagate(
    mean: FloatArray,
    P: FloatArray,
    steps: IntArray,
    dt_s: float,
    density: FloatArray,
    accelerates: bool,
    yaw_limit_rad: float,
) -> None:
    """Overwrite means (m, n) and covariances (m, n, n) with their predictions: P' = F P F' + Q dt.

    Each object moves by its own number of `steps` (m,). `density`, shape (n,), is the
    diagonal of Q. Its first two entries are along and across the heading. If
    `accelerates`, the acceleration drives the speed but is absent from F. The yaw is
    clipped to `yaw_limit_rad` from above.
    """
    m, n = mean.shape
    check(n >= (6 if accelerates else 5) and len(density) >= n and len(steps) >= m)
    check(len(P) >= m and P.shape[1] == n and P.shape[2] == n)
    F = scratch(n, n)
    FP = scratch(n, n)
    predicted = scratch(n, n)
    for j in range(n):
        for k in range(n):
            F[j, k] = 1.0 if j == k else 0.0
    F[2, 4] = dt_s
    along, across = density[0] * dt_s, density[1] * dt_s
    for i in range(m):
        x = mean[i]
        for _ in range(steps[i]):
            c, s, way = math.cos(x[2]), math.sin(x[2]), x[3] * dt_s
            F[0, 2], F[0, 3], F[1, 2], F[1, 3] = -way * s, c * dt_s, way * c, s * dt_s
            product(F, P[i], FP)
            for j in range(n):
                for k in range(n):
                    predicted[j, k] = density[j] * dt_s if j == k else 0.0
            predicted[0, 0] = along * c * c + across * s * s
            predicted[1, 1] = along * s * s + across * c * c
            predicted[0, 1] = predicted[1, 0] = (along - across) * c * s
            add_product_transposed(FP, F, predicted)
            copy(predicted, P[i])
            x[0] += way * c
            x[1] += way * s
            x[2] = min(x[2] + x[4] * dt_s, yaw_limit_rad)
            if accelerates:
                x[3] += x[5] * dt_s
