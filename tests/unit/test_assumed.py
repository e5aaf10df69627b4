"""What is fused without having been measured, as a heading from the map, is no innovation."""

import numpy as np
import pytest

from fgtrack.core.errors import CallError
from fgtrack.core.linalg import mahalanobis_squared
from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement, Start, UpdateStatus
from fgtrack.estimation.ekf import correct, correct_one
from fgtrack.estimation.registry import ESTIMATORS, estimator
from fgtrack.models.motion import CTRV, CV

MS = 1_000_000
START = Start(position_m=(0.0, 0.0), yaw_rad=0.1, yaw_std_rad=0.3, speed_mps=20.0, speed_std_mps=2.0)


def measurement(stamp_ns: int, assumed: tuple[str, ...] = ("yaw_rad",), yaw_rad: float = 0.6) -> Measurement:
    at_m = 20.0 * stamp_ns / 1e9
    std = {"x_m": 0.3, "y_m": 0.3, "yaw_rad": 0.2}
    return Measurement.of(stamp_ns, x_m=at_m + 0.4, y_m=-0.5, yaw_rad=yaw_rad, std=std, assumed=assumed)


def prior() -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(5)
    root = rng.normal(size=(5, 5))
    return np.array([0.3, 0.2, 0.1, 20.0, 0.0]), root @ root.T + np.eye(5)


def test_the_nis_is_that_of_the_marginal_distribution_of_what_was_measured() -> None:
    x, P = prior()
    known, with_yaw = measurement(0), measurement(0, assumed=())
    by_hand = float(mahalanobis_squared(known.z[:2] - x[:2], P[:2, :2] + known.R[:2, :2]))
    one, other = correct_one(x, P, known), correct_one(x, P, with_yaw)
    assert one.nis == pytest.approx(by_hand, rel=1e-12)
    assert other.nis > one.nis + 0.01
    np.testing.assert_array_equal(one.mean, other.mean)
    np.testing.assert_array_equal(one.covariance, other.covariance)
    stack = correct(x[None], P[None], known.z[None], known.R[None], known.model, known.pose, measured=known.measured)
    assert stack.nis == pytest.approx([by_hand], rel=1e-12)


@pytest.mark.parametrize("name", ESTIMATORS)
@pytest.mark.parametrize("late", [False, True])
def test_every_estimator_fuses_what_is_assumed_and_leaves_it_out_of_the_nis(name: str, late: bool) -> None:
    stamps_ns = [20 * MS, 60 * MS, 40 * MS] if late else [20 * MS, 40 * MS]
    results, states = [], []
    for assumed in ((), ("yaw_rad",)):
        one = estimator(name, CTRV(), START)
        results.append([one.update(measurement(stamp_ns, assumed)) for stamp_ns in stamps_ns][-1])
        states.append(one.state_at(80 * MS))
    with_yaw, without = results
    np.testing.assert_array_equal(states[0].mean, states[1].mean)
    np.testing.assert_array_equal(states[0].covariance, states[1].covariance)
    assert without.status is with_yaw.status
    if without.status in (UpdateStatus.IN_SEQUENCE, UpdateStatus.OUT_OF_SEQUENCE) and without.nis is not None:
        assert with_yaw.nis is not None
        assert without.nis < with_yaw.nis - 1e-3


@pytest.mark.parametrize("name", ["smoother", "ekf-replay", "ekf-backward-forward", "al1", "zlz"])
def test_the_assumed_value_itself_does_not_move_the_first_nis(name: str) -> None:
    nis = [estimator(name, CTRV(), START).update(measurement(20 * MS, yaw_rad=yaw)).nis for yaw in (0.1, 0.9)]
    assert nis[0] == pytest.approx(nis[1], rel=1e-12)


@pytest.mark.parametrize("assumed", [("speed_mps",), ("x_m", "y_m", "yaw_rad")])
def test_what_is_assumed_must_be_a_part_of_what_is_given(assumed: tuple[str, ...]) -> None:
    with pytest.raises(CallError, match="assumed must name some of them"):
        measurement(0, assumed)


def test_it_stays_assumed_for_another_motion_model() -> None:
    seen = measurement(0).seen_by(CV())
    assert seen.model is not measurement(0).model
    assert seen.measured == [0, 1]
    assert measurement(0, ()).measured is None
