"""How large errors are beside what their covariance says."""

import numpy as np

from fgtrack.core.types import FloatArray
from fgtrack.io.run import Table

#: Components of a state in the order of the covariance columns; a part of them is always a leading one.
_COMPONENTS = ("x", "y", "yaw", "speed", "yaw_rate")


def normalised_squares(states: Table, errors: FloatArray) -> FloatArray:
    """Normalised error squared e' P^-1 e of the leading components of `states`, shape (n,).

    `errors` are those of x, y, yaw, speed, yaw rate or a leading part of them, shape (n, k). A consistent estimator
    has a mean of k. NaN where the covariance of these components is not positive definite or an error is NaN.
    """
    names = _COMPONENTS[: errors.shape[1]]
    e = list(errors.T)
    P = [[states[f"p_{a}_{b}"] for b in names[i:]] for i, a in enumerate(names)]
    total = np.zeros(len(states))
    # One component after the other is taken out of all rows at once: what is left of the others is their error and
    # covariance given this one (Schur complement), so the squares add up.
    while P:
        (variance, *covariances), *P = P
        variance = np.where(variance > 0.0, variance, np.nan)
        first, *e = e
        total += first**2 / variance
        gains = [covariance / variance for covariance in covariances]
        e = [error - gain * first for error, gain in zip(e, gains, strict=True)]
        P = [[entry - gains[i] * c for entry, c in zip(row, covariances[i:], strict=True)] for i, row in enumerate(P)]
    return total
