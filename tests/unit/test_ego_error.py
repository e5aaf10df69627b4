"""The ego's error, which all detections of a scan have in common."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.stats import chi2
from support.tracking import batch

from fgtrack.core.geometry import rotation
from fgtrack.core.linalg import mahalanobis_squared
from fgtrack.core.types import Detection, FloatArray
from fgtrack.estimation.base import Measurement, Start, StatesAt
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.ekf import correct_one
from fgtrack.models.motion import CTRV, CV, MotionModel
from fgtrack.models.road import OpenSpace
from fgtrack.models.sensors import SensorModel
from fgtrack.tracking.ego import EgoPose
from fgtrack.tracking.ego_error import EgoErrors, IndependentErrors, SharedErrors
from fgtrack.tracking.merge import NoMerge
from fgtrack.tracking.preprocess import Candidate, Preprocess

STD = {"x_m": 0.3, "y_m": 0.3, "speed_mps": 0.5}
PLACES = ((60.0, 5.0), (40.0, -30.0), (-20.0, 50.0), (70.0, 20.0))
EGO_COVARIANCE = np.diag([0.04, 0.09, 1e-4, 0.25, 0.0])


def scene(
    seed: int, count: int = 4, covariance: FloatArray | None = EGO_COVARIANCE, more: dict[str, float] | None = None
) -> tuple[list[Candidate], FloatArray, FloatArray]:
    """Candidates, and the means and covariances of their tracks, near to each other."""
    rng = np.random.default_rng(seed)
    ego = EgoPose(0.0, 0.0, 0.2, 20.0, 0.1, covariance)
    objects = [
        Detection(x_m=x, y_m=y, speed_mps=15.0, bearing_rad=np.arctan2(y, x) if more else None)
        for x, y in PLACES[:count]
    ]
    sensor = SensorModel(std={**STD, **(more or {})})
    found, _ = Preprocess(OpenSpace(), NoMerge(), CTRV(), (-1.74, 0.0))(batch(*objects), sensor, ego)
    roots = rng.normal(size=(count, 5, 5)) * 0.3
    covariances = roots @ roots.mT + 0.01 * np.eye(5)
    values = [(*(one.values[name] for name in STD), 0.1, 0.0) for one in found]
    means = np.array(values)[:, [0, 1, 3, 2, 4]]
    return found, means + 0.3 * rng.normal(size=means.shape), covariances


def fused(errors, candidates, means, covariances) -> list[Measurement]:
    states = StatesAt(tuple(range(len(means))), means, covariances)
    return errors.measurements(0, candidates, list(range(len(candidates))), states)


def independent(candidates, means, covariances) -> list[Measurement]:
    return fused(IndependentErrors(), candidates, means, covariances)


def shared(candidates, means, covariances) -> list[Measurement]:
    """With tracks that have been independent so far."""
    return fused(SharedErrors(CTRV()), candidates, means, covariances)


def updated(candidates, means, covariances) -> list[tuple[FloatArray, FloatArray]]:
    """Means and covariances of the tracks after measurements of their own."""
    found = []
    for measurement, x, P in zip(candidates, means, covariances, strict=True):
        H = measurement.model.jacobian(x)
        K = np.linalg.solve(H @ P @ H.T + measurement.R, H @ P).T
        found.append((x + K @ (measurement.z - H @ x), P - K @ H @ P))
    return found


@pytest.mark.parametrize("seed", range(5))
def test_shared_is_the_marginal_of_the_joint_posterior_of_all_tracks_and_the_error(seed: int) -> None:
    """One linear problem in (d_1, ..., d_m, e), solved at once."""
    candidates, means, covariances = scene(seed)
    count, size = len(candidates), 5 * len(candidates) + 5
    prior, H, R, y = np.zeros((size, size)), np.zeros((3 * count, size)), np.zeros((3 * count, 3 * count)), []
    for i, (candidate, x, P) in enumerate(zip(candidates, means, covariances, strict=True)):
        own, rows = candidate.measurement, slice(3 * i, 3 * i + 3)
        prior[5 * i : 5 * i + 5, 5 * i : 5 * i + 5] = P
        H[rows, 5 * i : 5 * i + 5] = own.model.jacobian(x)
        H[rows, -5:] = candidate.pose_error.gain(own.model, own.pose, x)
        R[rows, rows] = candidate.pose_error.R
        y += (own.z - own.model.predict(x)).tolist()
    prior[-5:, -5:] = candidates[0].pose_error.covariance
    K = np.linalg.solve(H @ prior @ H.T + R, H @ prior).T
    posterior, joint = prior - K @ H @ prior, K @ np.array(y)
    found = updated(shared(candidates, means, covariances), means, covariances)
    for i, (mean, covariance) in enumerate(found):
        mine = slice(5 * i, 5 * i + 5)
        np.testing.assert_allclose(mean - means[i], joint[mine], rtol=1e-9, atol=1e-10)
        np.testing.assert_allclose(covariance, posterior[mine, mine], rtol=1e-9, atol=1e-10)


def test_others_make_a_detection_surer_than_it_is_on_its_own() -> None:
    candidates, means, covariances = scene(1)
    alone = independent(candidates, means, covariances)
    together = shared(candidates, means, covariances)
    for one, other, candidate in zip(alone, together, candidates, strict=True):
        assert np.linalg.eigvalsh(one.R - other.R)[0] > -1e-12
        assert np.trace(other.R) < 0.9 * np.trace(one.R)
        assert np.linalg.eigvalsh(other.R - candidate.pose_error.R)[0] > -1e-12


@pytest.mark.parametrize(("count", "covariance"), [(1, EGO_COVARIANCE), (4, None)])
def test_a_detection_alone_and_an_exact_ego_have_nothing_to_share(count: int, covariance: FloatArray | None) -> None:
    candidates, means, covariances = scene(2, count, covariance)
    for one, other in zip(
        shared(candidates, means, covariances), independent(candidates, means, covariances), strict=True
    ):
        np.testing.assert_allclose(one.z, other.z, rtol=1e-12)
        np.testing.assert_allclose(one.R, other.R, rtol=1e-9, atol=1e-15)


def test_a_detection_that_its_track_does_not_explain_says_nothing_of_the_ego() -> None:
    candidates, means, covariances = scene(3)
    wrong = means.copy()
    wrong[0, :2] += 50.0
    of_others = shared(candidates, wrong, covariances)[1:]
    without = shared(candidates[1:], means[1:], covariances[1:])
    for one, other in zip(of_others, without, strict=True):
        np.testing.assert_allclose(one.z, other.z, rtol=1e-12)
        np.testing.assert_allclose(one.R, other.R, rtol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_a_component_that_follows_from_others_leaves_no_indefinite_covariance(seed: int) -> None:
    candidates, means, covariances = scene(seed, more={"bearing_rad": 0.02})
    for one, x, P in zip(shared(candidates, means, covariances), means, covariances, strict=True):
        assert np.linalg.eigvalsh(correct_one(x, P, one).covariance)[0] > 0.0
        assert np.linalg.eigvalsh(one.R)[0] > 1e-5


def test_where_a_covariance_is_none_every_detection_stands_for_itself() -> None:
    candidates, means, covariances = scene(3)
    broken = covariances.copy()
    broken[1] = -np.eye(5)
    for one, other in zip(shared(candidates, means, broken), independent(candidates, means, broken), strict=True):
        np.testing.assert_array_equal(one.R, other.R)


def test_a_track_that_ended_is_forgotten_and_one_that_did_not_exist_is_younger_than_the_batch() -> None:
    candidates, means, covariances = scene(4)
    errors = SharedErrors(CTRV())
    fused(errors, candidates, means, covariances)
    errors.ended(0)
    errors.ended(99)
    states = StatesAt((2, 3), means[2:], covariances[2:])  # an older batch, at which track 1 had not begun
    found = errors.measurements(-1, candidates[2:], [0, 1], states)
    assert [measurement.stamp_ns for measurement in found] == [candidates[2].measurement.stamp_ns] * 2


# --- scan after scan

CAR, STEP_NS, STEP_S = CV(velocity_density_m2ps3=1.0), 100_000_000, 0.1
LIDAR = SensorModel(std={"x_m": 0.3, "y_m": 0.1})


class Filters:
    """One Kalman filter for each object, fed through `errors`; all of them beside the joint one of objects and ego."""

    def __init__(self, errors, rng: np.random.Generator, count: int = 6) -> None:
        self.rng, self.errors, self.count, self.stamp_ns = rng, errors, count, 0
        angles = 2.0 * np.pi * np.arange(count) / count
        self.truth = np.column_stack([60.0 * np.cos(angles), 60.0 * np.sin(angles), np.zeros((count, 2))])
        self.x, self.P = np.zeros((count, 4)), np.zeros((count, 4, 4))
        noise = []
        for track_id, candidate in enumerate(self.scan()):
            own, std_mps = candidate.measurement, 2.0
            start = Start(position_m=own.z, position_covariance=own.R, speed_std_mps=std_mps, yaw_rad=None)
            self.x[track_id], self.P[track_id] = initial_state(CAR, start)
            errors.born(track_id, candidate, start)
            noise.append(candidate.pose_error)
        self.joint_x, self.joint_P = self.x.ravel().copy(), block_diag(*self.P)
        G = np.vstack([error.placement for error in noise])
        places = np.add.outer(4 * np.arange(count), [0, 1]).ravel()
        self.joint_P[np.ix_(places, places)] = G @ noise[0].covariance @ G.T + block_diag(*(e.R for e in noise))

    def scan(self) -> list[Candidate]:
        covariance = np.diag([0.01, 0.01, 1e-4, 0.0, 0.0])
        x_m, y_m, yaw_rad = (np.sqrt(np.diag(covariance)[:3]) * self.rng.standard_normal(3)).tolist()
        seen = []
        for place in self.truth[:, :2]:
            towards = np.arctan2(place[1], place[0])
            noise = rotation(towards) @ (np.array([0.3, 0.1]) * self.rng.standard_normal(2))
            seen.append(Detection(**dict(zip(("x_m", "y_m"), (place + noise).tolist(), strict=True))))
        ego = EgoPose(x_m, y_m, yaw_rad, 0.0, 0.0, covariance)
        preprocess = Preprocess(OpenSpace(), NoMerge(), CAR, (0.0, 0.0))
        return preprocess(replace(batch(*seen), stamp_ns=self.stamp_ns), LIDAR, ego)[0]

    def step(self) -> None:
        self.stamp_ns += STEP_NS
        F, Q = CAR.jacobian(self.truth, STEP_S), CAR.process_noise(self.truth, STEP_S)
        roots = np.linalg.cholesky(Q)
        self.truth = CAR.predict(self.truth, STEP_S) + (roots @ self.rng.standard_normal((self.count, 4, 1)))[..., 0]
        self.x, self.P = CAR.predict(self.x, STEP_S), F @ self.P @ F.mT + Q
        self.joint_x = block_diag(*F) @ self.joint_x
        self.joint_P = block_diag(*F) @ self.joint_P @ block_diag(*F).T + block_diag(*Q)
        candidates = self.scan()
        states = StatesAt(tuple(range(self.count)), self.x, self.P)
        order = list(range(self.count))
        fused = self.errors.measurements(self.stamp_ns, candidates, order, states)
        corrected = [correct_one(x, P, own) for x, P, own in zip(self.x, self.P, fused, strict=True)]
        self.x, self.P = np.array([c.mean for c in corrected]), np.array([c.covariance for c in corrected])
        H, G = np.kron(np.eye(self.count), np.eye(2, 4)), np.vstack([c.pose_error.placement for c in candidates])
        V = block_diag(*(c.pose_error.R for c in candidates)) + G @ candidates[0].pose_error.covariance @ G.T
        K = np.linalg.solve(H @ self.joint_P @ H.T + V, H @ self.joint_P).T
        z = np.concatenate([c.measurement.z for c in candidates])
        self.joint_x = self.joint_x + K @ (z - H @ self.joint_x)
        self.joint_P = self.joint_P - K @ H @ self.joint_P


def variances_over_joint(errors: EgoErrors) -> FloatArray:
    """Variances of the positions after 40 scans, by those of the joint filter, shape (6,)."""
    filters = Filters(errors, np.random.default_rng(4))
    for _ in range(40):
        filters.step()
    blocks = filters.joint_P.reshape(6, 4, 6, 4)[range(6), :2, range(6), :2]
    return np.trace(filters.P[:, :2, :2], axis1=1, axis2=2) / np.trace(blocks, axis1=1, axis2=2)


def test_over_many_scans_it_comes_nearer_to_the_joint_filter_of_all_tracks_and_never_below() -> None:
    """Without the correlations that one scan leaves, the next would be believed far too much: below 1."""
    together, alone = variances_over_joint(SharedErrors(CAR)), variances_over_joint(IndependentErrors())
    assert together.min() > 1.0
    assert together.max() < 1.22
    assert (together < alone - 0.05).all()


@pytest.mark.parametrize("make", [SharedErrors, lambda _: IndependentErrors()], ids=["shared", "independent"])
def test_over_many_scans_the_tracks_are_as_sure_as_they_should_be(make: Callable[[MotionModel], EgoErrors]) -> None:
    """Mean NEES of positions at the last of 20 scans; the six of a run have nearly one error, so 2 degrees count."""
    nees, runs = [], 25
    for seed in range(runs):
        filters = Filters(make(CAR), np.random.default_rng(seed))
        for _ in range(20):
            filters.step()
        error = filters.x[:, :2] - filters.truth[:, :2]
        nees.append(float(mahalanobis_squared(error, filters.P[:, :2, :2]).mean()))
    low, high = chi2(2 * runs).ppf([0.005, 0.995]) / runs
    assert low < np.mean(nees) < high
