"""The ego's error, which all detections of a scan have in common."""

import numpy as np
import pytest
from support.tracking import batch

from fgtrack.core.types import Detection, FloatArray
from fgtrack.models.motion import CTRV
from fgtrack.models.road import OpenSpace
from fgtrack.models.sensors import SensorModel
from fgtrack.tracking.ego import EgoPose
from fgtrack.tracking.ego_error import independent, shared
from fgtrack.tracking.preprocess import Candidate, NoMerge, Preprocess

STD = {"x_m": 0.3, "y_m": 0.3, "speed_mps": 0.5}
PLACES = ((60.0, 5.0), (40.0, -30.0), (-20.0, 50.0), (70.0, 20.0))
EGO_COVARIANCE = np.diag([0.04, 0.09, 1e-4, 0.25, 0.0])


def scene(
    seed: int, count: int = 4, covariance: FloatArray | None = EGO_COVARIANCE
) -> tuple[list[Candidate], FloatArray, FloatArray]:
    """Candidates, and the means and covariances of their tracks, near to each other."""
    rng = np.random.default_rng(seed)
    ego = EgoPose(0.0, 0.0, 0.2, 20.0, 0.1, covariance)
    objects = [Detection(x_m=x, y_m=y, speed_mps=15.0) for x, y in PLACES[:count]]
    found, _ = Preprocess(OpenSpace(), NoMerge(), CTRV(), (-1.74, 0.0))(batch(*objects), SensorModel(std=STD), ego)
    roots = rng.normal(size=(count, 5, 5)) * 0.3
    covariances = roots @ roots.mT + 0.01 * np.eye(5)
    means = np.array([[*candidate.values.values(), 0.1, 0.0] for candidate in found])[:, [0, 1, 3, 2, 4]]
    return found, means + 0.3 * rng.normal(size=means.shape), covariances


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
        np.testing.assert_array_equal(one.z, other.z)
        np.testing.assert_array_equal(one.R, other.R)


def test_a_detection_that_its_track_does_not_explain_says_nothing_of_the_ego() -> None:
    candidates, means, covariances = scene(3)
    wrong = means.copy()
    wrong[0, :2] += 50.0
    of_others = shared(candidates, wrong, covariances)[1:]
    without = shared(candidates[1:], means[1:], covariances[1:])
    for one, other in zip(of_others, without, strict=True):
        np.testing.assert_allclose(one.z, other.z, rtol=1e-12)
        np.testing.assert_allclose(one.R, other.R, rtol=1e-9)
