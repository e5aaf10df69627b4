"""Factors as rows of least squares are the linearisations of the same factors as functions."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from support.models import MOTIONS

from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement, Start, UpdateStatus
from fgtrack.estimation.factor_graph import FixedLagSmoother, SmootherBank, SmootherSettings, together
from fgtrack.estimation.factor_graph.backends.base import Change
from fgtrack.estimation.factor_graph.backends.incremental import IncrementalBackend
from fgtrack.estimation.factor_graph.rows import Factor, PriorOf, Segment, Term
from fgtrack.estimation.marginalised_past import Prior
from fgtrack.estimation.smoothing.terms import EquivalentMeasurement
from fgtrack.models.measurement import SensorPose, measurement_model
from fgtrack.models.motion import CTRV, MotionModel
from fgtrack.models.sensors import RobustLoss

MS = 1_000_000
MOTION = MOTIONS["ctrv"]
LEFT, RIGHT = np.array([3.0, -2.0, 0.4, 20.0, 0.3]), np.array([4.9, -1.1, 0.45, 20.5, 0.2])
POSE = SensorPose(-10.0, 5.0, 0.3, 4.0, 1.0)


def seen(*names: str, loss: RobustLoss | None = None) -> Measurement:
    model = measurement_model(names, MOTION)
    z = model.predict(LEFT, POSE) + 0.3
    return Measurement(0, model, z, 0.02 * (np.eye(len(names)) + 0.2), POSE, loss)


FACTORS: dict[str, Factor] = {
    "segment": Segment(MOTION, (1, 2), 0.1, (LEFT, RIGHT)),
    "prior": PriorOf(1, Prior(LEFT + 0.1, np.diag([1.0, 2.0, 0.1, 3.0, 0.2]) + 0.01)),
    "position": Term(1, seen("x_m", "y_m"), LEFT),
    "range, bearing": Term(1, seen("range_m", "bearing_rad"), LEFT),
    "position, outlier": Term(1, seen("x_m", "y_m", loss=RobustLoss("huber", 0.5)), LEFT),
    "equivalent": Term(1, EquivalentMeasurement(LEFT + 0.2, np.eye(2, 5), np.ones(2), np.eye(2)), LEFT),
}


@pytest.mark.parametrize("kind", FACTORS)
def test_the_rows_of_a_factor_are_its_linearisation(kind: str) -> None:
    factor = FACTORS[kind]
    rows = factor.rows()
    at = gtsam.Values()
    for key, x in zip(rows.keys, rows.at, strict=True):
        at.insert(key, x)
    A, b = factor.nonlinear().linearize(at).jacobian()
    found, offset = np.hstack(rows.A), rows.b  # the same up to a rotation of the rows
    np.testing.assert_allclose(found.T @ found, A.T @ A, rtol=1e-9, atol=1e-9 * np.abs(A.T @ A).max())
    np.testing.assert_allclose(found.T @ offset, A.T @ b, rtol=1e-8, atol=1e-9 * np.abs(A.T @ b).max())


@pytest.mark.parametrize("count", [3, 20])
def test_segments_linearised_together_are_those_linearised_alone(count: int) -> None:
    def segments() -> list[Segment]:
        rng = np.random.default_rng(0)
        at = [(LEFT + 0.1 * rng.standard_normal(5), RIGHT + 0.1 * rng.standard_normal(5)) for _ in range(count)]
        return [Segment(MOTION, (k, k + 1), 0.02 + 0.01 * k, pair) for k, pair in enumerate(at)]

    together_ones, alone = segments(), segments()
    Segment.linearise(together_ones)
    for one, other in zip(together_ones, alone, strict=True):
        found, expected = one.rows(), other.rows()
        assert (found.keys, found.at[0].tolist()) == (expected.keys, expected.at[0].tolist())
        for part, same in zip((*found.A, found.b), (*expected.A, expected.b), strict=True):
            np.testing.assert_allclose(part, same, rtol=1e-9, atol=1e-9 * np.abs(found.A[0]).max())


def test_a_factor_that_is_linearised_elsewhere_than_the_first_estimate_says_the_same() -> None:
    """The solver's variables stay relative to their first estimates; a factor may be relative to any state."""
    P, R, y = np.diag([1.0, 2.0, 0.1, 3.0, 0.2]), np.diag([0.5, 0.2]), np.array([0.4, -0.3])
    prior, H = Prior(LEFT, P), np.eye(2, 5)
    expected = LEFT + P @ H.T @ np.linalg.solve(H @ P @ H.T + R, y)
    for at in (LEFT, RIGHT):
        backend = IncrementalBackend()
        item = EquivalentMeasurement(LEFT, H, y, R)
        backend.update(Change({7: LEFT + 5.0}, {7: 0.0}, [PriorOf(7, prior), Term(7, item, at)], []))
        np.testing.assert_allclose(backend.means([7])[0], expected, atol=1e-12)


# --- smoothers together


def start(k: int) -> Start:
    return Start(position_m=(20.0 * k, 5.0 * k), yaw_rad=0.3 * k, yaw_std_rad=0.4, speed_mps=15.0)


def fleet(motion: MotionModel, count: int) -> list[FixedLagSmoother]:
    settings = SmootherSettings(lag_s=0.4, ring_s=0.3, lagged_s=())
    return [FixedLagSmoother(motion, start(k), settings) for k in range(count)]


def lists(count: int) -> list[list[Measurement]]:
    """Positions of all objects, every third list late, and some with another sensor or an outlier."""
    rng, found = np.random.default_rng(5), list[list[Measurement]]()
    stamps_ms = [50 * k - (120 if k % 3 == 0 else 0) - (700 if k == 25 else 0) for k in range(3, 40)]
    for number, ms in enumerate(stamps_ms):
        each = []
        for k in range(count):
            x_m, y_m = 20.0 * k + 0.015 * ms, 5.0 * k + 0.1 * rng.standard_normal()
            one = Measurement.of(ms * MS, x_m=x_m, y_m=y_m, std={"x_m": 0.3, "y_m": 0.3})
            if (number + k) % 5 == 0:
                std = {"x_m": 0.3, "y_m": 0.3, "yaw_rad": 0.3}
                one = Measurement.of(ms * MS, x_m=x_m, y_m=y_m, yaw_rad=0.1, std=std)
            if (number + k) % 7 == 0:
                one = replace(one, loss=RobustLoss("huber", 1.0))
            each.append(one)
        found.append(each)
    return found


@pytest.mark.parametrize("count", [2, 9])
def test_smoothers_together_are_those_alone(count: int) -> None:
    motion = CTRV()
    many, alone = fleet(motion, count), fleet(motion, count)
    statuses = set()
    for number, each in enumerate(lists(count)):
        expected = [one.update(item) for one, item in zip(alone, each, strict=True)]
        for found, same in zip(together.update(many, each), expected, strict=True):
            statuses.add(found.status)
            assert found.status is same.status
            if same.innovation is not None and found.innovation is not None:
                np.testing.assert_allclose(found.innovation, same.innovation, atol=1e-9)
                assert found.nis == pytest.approx(same.nis, rel=1e-7, abs=1e-9)
        oldest_ns, newest_ns = alone[0].window_ns
        for stamp_ns in (oldest_ns, max(newest_ns - 130 * MS, oldest_ns), newest_ns + number * MS):
            together.look_up(many, [stamp_ns] * count)
            for one, other in zip(many, alone, strict=True):
                state, same_state = one.state_at(stamp_ns), other.state_at(stamp_ns)
                std = np.sqrt(np.diag(same_state.covariance))
                assert np.abs((state.mean - same_state.mean) / std).max() < 1e-7
                assert np.abs((state.covariance - same_state.covariance) / np.outer(std, std)).max() < 1e-7
    assert {UpdateStatus.IN_SEQUENCE, UpdateStatus.OUT_OF_SEQUENCE, UpdateStatus.BEYOND_WINDOW} <= statuses


def broken(item: Measurement, what: str) -> Measurement:
    values: dict[str, FloatArray] = {"R": -np.eye(len(item.z)) * 9.0, "z": np.full(len(item.z), np.nan)}
    return replace(item, **{what: values[what]})


@pytest.mark.parametrize("what", ["R", "z"])
def test_of_several_tracks_the_one_that_cannot_be_updated_fails_alone(what: str) -> None:
    settings = SmootherSettings(lag_s=0.4, lagged_s=())
    (hit, spared) = (SmootherBank(CTRV(), settings) for _ in range(2))
    for bank in (hit, spared):
        for k in range(3):
            bank.birth(k, start(k))
    for number, each in enumerate(lists(3)[:6]):
        given = [broken(each[0], what), *each[1:]] if number == 3 else each
        ids = [1, 2] if number == 3 else [0, 1, 2]
        stamp_ns = each[0].stamp_ns
        found = [result.status for result in hit.update(stamp_ns, [0, 1, 2], given)]
        expected = [result.status for result in spared.update(stamp_ns, ids, [each[k] for k in ids])]
        assert found == ([UpdateStatus.FAILED, *expected] if number == 3 else expected)
    for bank in (hit, spared):
        bank.advance(400 * MS)
    for state, same in zip(hit.present(), spared.present(), strict=True):
        np.testing.assert_allclose(state.mean, same.mean, atol=1e-6)
