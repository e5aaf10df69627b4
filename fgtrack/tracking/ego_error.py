"""What becomes of the ego's error when the detections of a batch are fused: each on its own, or it is shared."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from fgtrack.core.linalg import congruence, mahalanobis_squared, psd_solve, symmetrise
from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement
from fgtrack.estimation.ekf import linearised
from fgtrack.tracking.association import chi_square_quantile
from fgtrack.tracking.preprocess import Candidate

#: The measurements to fuse of the matched candidates of one batch, given the means (m, n) and covariances (m, n, n)
#: of their tracks at its stamp.
EgoErrors = Callable[[Sequence[Candidate], FloatArray, FloatArray], list[Measurement]]

_BELIEVED = 0.99
"""A detection whose NIS lies beyond this quantile may be no detection of its track: it says nothing of the ego."""


def independent(candidates: Sequence[Candidate], means: FloatArray, covariances: FloatArray) -> list[Measurement]:
    """Every detection with the ego's error in its noise, as if each had one of its own."""
    return [candidate.measurement_at(mean) for candidate, mean in zip(candidates, means, strict=True)]


def shared(candidates: Sequence[Candidate], means: FloatArray, covariances: FloatArray) -> list[Measurement]:
    """Every detection corrected for what the *other* ones of the batch say of the ego's error.

    The innovations are y_i = H_i d_i + G_i e + n_i with independent errors d_i of the tracks and the one error e of the
    pose, e ~ N(0, P_e). Then y_j, j != i, give e a posterior N(e_i, P_i), and z_i - G_i e_i with R_i + G_i P_i G_i' is,
    to first order, all that the batch says of track i. That tracks become correlated by it is neglected.
    """
    errors = [error for candidate in candidates if (error := candidate.pose_error) is not None]
    if len(errors) < max(len(candidates), 2):
        return independent(candidates, means, covariances)
    root = _root(errors[0].covariance)
    gains, scores, informations = [], [], []
    for candidate, error, mean, P in zip(candidates, errors, means, covariances, strict=True):
        own = candidate.measurement
        y, H = linearised(own.z, mean, own.model, own.pose)
        G = error.gain(own.model, own.pose, mean) @ root  # of u ~ N(0, I), e = root u
        S = congruence(H, P) + error.R
        weighted = psd_solve(S, np.column_stack((y, G)))
        believed = mahalanobis_squared(y, S + G @ G.T) <= chi_square_quantile(_BELIEVED, len(y))
        gains.append(G)
        scores.append(believed * (G.T @ weighted[:, 0]))
        informations.append(believed * (G.T @ weighted[:, 1:]))
    identity = np.eye(len(root))
    information = identity + np.sum(informations, axis=0) - np.array(informations)
    score = np.sum(scores, axis=0) - np.array(scores)
    found = []
    for candidate, error, G, A, b in zip(candidates, errors, gains, information, score, strict=True):
        u = psd_solve(A, np.column_stack((b, identity)))
        z, R = candidate.measurement.z - G @ u[:, 0], error.R + symmetrise(congruence(G, u[:, 1:]))
        found.append(replace(candidate.measurement, z=z, R=R))
    return found


def _root(covariance: FloatArray) -> FloatArray:
    """L with L L' = `covariance`, shape (n, n), which may be singular."""
    variances, axes = np.linalg.eigh(covariance)
    return np.asarray(axes * np.sqrt(np.maximum(variances, 0.0)))
