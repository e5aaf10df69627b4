"""What becomes of the ego's error when the detections of a batch are fused: each has its own, or all have one."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple, Protocol

import numpy as np
from scipy.linalg import block_diag

from fgtrack.core.linalg import congruence, mahalanobis_squared, psd_solve, symmetrise
from fgtrack.core.time import seconds
from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement, Start, StatesAt
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.ekf import joseph, linearised
from fgtrack.models.motion import MotionModel
from fgtrack.tracking.association import chi_square_quantile
from fgtrack.tracking.pose_error import placement
from fgtrack.tracking.preprocess import Candidate

_BELIEVED = 0.99
"""A detection whose NIS lies beyond this quantile may be no detection of its track: it says nothing to the others."""
_SINGULAR = 1e-10
"""A matrix of correlations with an eigenvalue below it is singular but for rounding."""


class EgoErrors(Protocol):
    """Decides what of a batch is fused, so that the error of the ego counts."""

    def measurements(
        self, stamp_ns: int, matched: Sequence[Candidate], rows: Sequence[int], states: StatesAt
    ) -> list[Measurement]:
        """What to fuse of the candidates `matched` with the tracks at `rows` of `states`; asked once for each batch."""

    def born(self, track_id: int, candidate: Candidate, prior: Start) -> None:
        """A candidate of the batch started a track."""

    def ended(self, track_id: int) -> None:
        """A track is no more."""


class IndependentErrors:
    """Every detection with the ego's error in its noise, as if each had one of its own."""

    def measurements(
        self, stamp_ns: int, matched: Sequence[Candidate], rows: Sequence[int], states: StatesAt
    ) -> list[Measurement]:
        """See `EgoErrors.measurements`."""
        return [candidate.measurement_at(states.means[row]) for candidate, row in zip(matched, rows, strict=True)]

    def born(self, track_id: int, candidate: Candidate, prior: Start) -> None:
        """See `EgoErrors.born`."""

    def ended(self, track_id: int) -> None:
        """See `EgoErrors.ended`."""


class _Seen(NamedTuple):
    """A matched candidate, linearised: y = H d + G e + N(0, R) with the error d of its track."""

    candidate: Candidate
    place: int
    """Of its track."""
    y: FloatArray
    H: FloatArray
    G: FloatArray
    R: FloatArray


class SharedErrors:
    """All detections of a batch have one error of the ego: it is estimated from them together with the tracks.

    The joint covariance of the errors d = (d_1, ..., d_m) of all tracks is kept, because what one scan leaves of the
    ego's error they have in common; without it the next scan would take that for fresh evidence. A batch is one linear
    problem, y = H d + G e + n, e ~ N(0, P_e). Of its posterior of d_i, what lies in the measured components is given to
    track i as one measurement of them, z' = h(x) + M D^-1 H m and R' = M D^-1 M - M with M = H P_i H', H m the
    correction of the joint problem there and D the covariance that it takes off M: fused, both give just this
    posterior. What the joint problem says besides of unmeasured entries is left to their correlation with the others.

    The covariance of each track itself is the estimator's; here only the correlations between them are kept.

    Parameters
    ----------
    motion
        The motion model of all tracks.
    """

    def __init__(self, motion: MotionModel) -> None:
        self._motion = motion
        self._stamp_ns = 0
        self._ids: list[int] = []
        self._means = np.empty((0, motion.dim))
        self._joint = np.empty((0, 0))
        self._with_pose = np.empty((0, 5))  # Cov(d, e) with the e of this batch

    def measurements(
        self, stamp_ns: int, matched: Sequence[Candidate], rows: Sequence[int], states: StatesAt
    ) -> list[Measurement]:
        """See `EgoErrors.measurements`; the NIS of each is that of what the batch as a whole says of its track.

        Where a covariance is not positive definite the batch is fused as `IndependentErrors` would, and the tracks
        count as independent of each other from there on.
        """
        if not self._ids and all(candidate.pose_error is None for candidate in matched):
            return [candidate.measurement for candidate in matched]
        try:
            self._move_to(stamp_ns)
            self._agree_with(states)
            self._with_pose = np.zeros((len(self._joint), 5))
            places = [self._ids.index(states.track_ids[row]) for row in rows]
            seen = [_seen(one, place, self._means[place]) for one, place in zip(matched, places, strict=True)]
            return self._fused(seen) if seen else []
        except np.linalg.LinAlgError:
            self._forget()
            return IndependentErrors().measurements(stamp_ns, matched, rows, states)

    def born(self, track_id: int, candidate: Candidate, prior: Start) -> None:
        """See `EgoErrors.born`; what the first state took from the detection, it took with the ego's error."""
        error, n = candidate.pose_error, self._motion.dim
        if error is None or candidate.position_covariance is None or candidate.position_m is None:
            return  # joins with its first match
        own = candidate.measurement
        names, pose = own.model.components, own.pose
        by_pose = np.zeros((n, 5))
        offset_m = candidate.position_m - np.array([pose.x_m, pose.y_m])
        by_pose[:2] = error.placement[:2] if names[:2] == ("x_m", "y_m") else placement(("x_m", "y_m"), offset_m)
        mean, P = initial_state(self._motion, prior)
        P[:2, :2] = candidate.position_covariance
        if "yaw_rad" in names and self._motion.state_names[2] == "yaw_rad":
            by_pose[2] = error.placement[names.index("yaw_rad")]
            P[2, 2] = own.R[names.index("yaw_rad"), names.index("yaw_rad")]
        common = congruence(by_pose, error.covariance)
        common[[0, 0, 1, 1, 2], [0, 1, 0, 1, 2]] = 0.0  # is in P already
        self._append(track_id, mean, P + common, -by_pose @ self._with_pose.T, -by_pose @ error.covariance)

    def ended(self, track_id: int) -> None:
        """See `EgoErrors.ended`."""
        if track_id in self._ids:
            place = self._ids.index(track_id)
            entries = np.arange(place * self._motion.dim, (place + 1) * self._motion.dim)
            del self._ids[place]
            self._means = np.delete(self._means, place, axis=0)
            self._joint = np.delete(np.delete(self._joint, entries, axis=0), entries, axis=1)
            self._with_pose = np.delete(self._with_pose, entries, axis=0)

    def _forget(self) -> None:
        """No track is known."""
        self._ids = []
        self._means, self._joint, self._with_pose = (np.empty((0, size)) for size in (self._motion.dim, 0, 5))

    def _append(self, track_id: int, mean: FloatArray, P: FloatArray, cross: FloatArray, with_pose: FloatArray) -> None:
        """A new track with covariance P (n, n), Cov(d, others) `cross` (n, all) and Cov(d, e) `with_pose` (n, 5)."""
        self._ids.append(track_id)
        self._means = np.vstack([self._means, mean])
        self._joint = np.block([[self._joint, cross.T], [cross, P]])
        self._with_pose = np.vstack([self._with_pose, with_pose])

    def _move_to(self, stamp_ns: int) -> None:
        """Predict all; an older batch than the newest meets the correlations as they are."""
        dt_s = seconds(stamp_ns - self._stamp_ns)
        if dt_s > 0.0:
            self._stamp_ns = stamp_ns
            if self._ids:
                F, Q = self._motion.jacobian(self._means, dt_s), self._motion.process_noise(self._means, dt_s)
                self._means = self._motion.predict(self._means, dt_s)
                self._joint = symmetrise(congruence(block_diag(*F), self._joint) + block_diag(*Q))

    def _agree_with(self, states: StatesAt) -> None:
        """Means and covariances of the tracks themselves are those of `states`; the correlations stay."""
        n, none = self._motion.dim, np.zeros((self._motion.dim, 5))
        for track_id, mean, P in zip(states.track_ids, states.means, states.covariances, strict=True):
            if track_id not in self._ids:
                self._append(track_id, mean, P, np.zeros((n, len(self._joint))), none)
        places = [self._ids.index(track_id) for track_id in states.track_ids]
        self._means[places] = states.means
        blocks = self._joint.reshape(len(self._ids), n, len(self._ids), n)[places, :, places]
        scales = np.tile(np.eye(n), (len(self._ids), 1, 1))
        scales[places] = np.linalg.solve(np.linalg.cholesky(blocks).mT, np.linalg.cholesky(states.covariances).mT).mT
        self._joint = symmetrise(congruence(block_diag(*scales), self._joint))

    def _fused(self, seen: Sequence[_Seen]) -> list[Measurement]:
        """The measurements of one batch; the correlations follow the gains that these have when they are fused."""
        n, J = self._motion.dim, self._joint
        ends = np.cumsum([0, *(len(one.y) for one in seen)]).tolist()
        parts = [slice(first, last) for first, last in pairwise(ends)]
        tracks = [slice(one.place * n, one.place * n + n) for one in seen]
        errors = [one.candidate.pose_error for one in seen]
        P_e = next((error.covariance for error in errors if error is not None), np.zeros((5, 5)))
        G, y = np.vstack([one.G for one in seen]), np.concatenate([one.y for one in seen])
        H = np.zeros((len(y), len(J)))
        for one, part, track in zip(seen, parts, tracks, strict=True):
            H[part, track] = one.H
        V = block_diag(*(one.R for one in seen)) + congruence(G, P_e)
        S = symmetrise(congruence(H, J) + V)
        believed = [_is_believed(one.y, S[part, part]) for one, part in zip(seen, parts, strict=True)]
        told = np.repeat(believed, np.diff(ends))
        gain_of_all = psd_solve(S[np.ix_(told, told)], H[told] @ J).T if told.any() else np.empty((len(J), 0))
        gain, found = np.zeros((len(J), len(y))), []
        for one, part, track, trusted in zip(seen, parts, tracks, believed, strict=True):
            own, P = one.candidate.measurement, J[track, track]
            M = congruence(one.H, P)
            joint = _equivalent(M, one.H @ gain_of_all[track], H[told] @ J[:, track] @ one.H.T) if trusted else None
            if joint is None:
                found.append(one.candidate.measurement_at(self._means[one.place]))
                gain[track, part] = psd_solve(S[part, part], one.H @ P).T
                continue
            weight, R = joint
            z = own.z - one.y + weight @ one.H @ gain_of_all[track] @ y[told]
            found.append(replace(own, z=z, R=R))
            gain[track, told] = P @ one.H.T @ psd_solve(M, one.H @ gain_of_all[track])
        self._joint = joseph(J, gain, H, V)
        if not np.isfinite(self._joint).all():
            raise np.linalg.LinAlgError("covariance of the tracks is not finite")
        self._means += (gain @ y).reshape(self._means.shape)
        self._with_pose = -gain @ G @ P_e
        return found


def _equivalent(M: FloatArray, gain: FloatArray, across: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """M D^-1 and R' = M D^-1 M - M of the measurement that takes D = `gain` `across` off M, both of shape (k, k).

    None where there is none: the batch says nothing of one of the measured components, or one of them follows from the
    others, as the bearing of a position, so that D cannot be told from a singular one.
    """
    D = symmetrise(gain @ across)
    std = np.sqrt(np.maximum(np.diag(D), 0.0))
    try:
        if not (std.all() and np.linalg.eigvalsh(D / np.outer(std, std))[0] > _SINGULAR):
            return None
        weight = psd_solve(D, M).T
        R = symmetrise(weight @ M - M)
        np.linalg.cholesky(R)
    except np.linalg.LinAlgError:
        return None
    return weight, R


def _seen(candidate: Candidate, place: int, mean: FloatArray) -> _Seen:
    own, error = candidate.measurement, candidate.pose_error
    y, H = linearised(own.z, mean, own.model, own.pose)
    if error is None:
        return _Seen(candidate, place, y, H, np.zeros((len(y), 5)), own.R)
    return _Seen(candidate, place, y, H, error.gain(own.model, own.pose, mean), error.R)


def _is_believed(y: FloatArray, S: FloatArray) -> bool:
    return bool(mahalanobis_squared(y, S) <= chi_square_quantile(_BELIEVED, len(y)))
