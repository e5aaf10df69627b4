"""Tests of measurements made from named values, and of estimators that are given them."""

import numpy as np
import pytest
from support.models import MODELS

from fgtrack.core.errors import CallError
from fgtrack.core.types import TrackState
from fgtrack.estimation.base import Estimator, Measurement, Start
from fgtrack.estimation.filters.replay import ReplayEkf
from fgtrack.estimation.oosm.asd import AccumulatedStateDensity
from fgtrack.estimation.oosm.buffers import ReorderBuffer
from fgtrack.estimation.oosm.crossing import Al1
from fgtrack.estimation.registry import estimator
from fgtrack.models.measurement import SensorPose, measurement_model
from fgtrack.models.sensors import RobustLoss

STD = {"x_m": 0.3, "y_m": 0.4}


def test_values_are_ordered_as_the_model_orders_them() -> None:
    pose, loss = SensorPose(1.0, 2.0), RobustLoss("huber", 3.0)
    found = Measurement.of(
        5,
        speed_mps=7.0,
        x_m=1.0,
        std={"x_m": 0.3, "speed_mps": 0.1},
        pose=pose,
        loss=loss,
    )
    assert (found.stamp_ns, found.pose, found.loss) == (5, pose, loss)
    assert found.model.components == ("x_m", "speed_mps")
    assert found.z.tolist() == [1.0, 7.0]
    assert found.R.tolist() == np.diag([0.3**2, 0.1**2]).tolist()
    R = [[2.0, 0.5], [0.5, 1.0]]
    assert Measurement.of(5, y_m=1.0, x_m=2.0, covariance=np.array(R)).R.tolist() == R
    assert (
        Measurement.of(5, y_m=1.0, x_m=2.0, std=0.5).R.tolist()
        == (0.25 * np.eye(2)).tolist()
    )


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"std": {}}, "of nothing: give one or more of x_m"),
        ({"x": 1.0, "std": {"x": 1.0}}, "of x: give one or more of x_m"),
        ({"x_m": 1.0, "y_m": 2.0}, "either std or covariance"),
        (
            {"x_m": 1.0, "y_m": 2.0, "std": STD, "covariance": np.eye(2)},
            "either std or covariance",
        ),
        (
            {"x_m": 1.0, "y_m": 2.0, "std": {"x_m": 0.3}},
            "std must name these components, names x_m",
        ),
        ({"x_m": 1.0, "std": STD}, "std must name these components, names x_m, y_m"),
        (
            {"x_m": 1.0, "yaw_rad": 2.0, "std": 0.3},
            "std: must be a mapping of x_m, yaw_rad to numbers, or one number",
        ),
        (
            {"x_m": 1.0, "std": "0.3"},
            "std: must be a mapping of x_m to numbers, or one number .*, is '0.3'",
        ),
        (
            {"x_m": "1", "y_m": 2.0, "std": STD},
            "of x_m: must be a number, finite and at most 1e9, is '1'",
        ),
        ({"x_m": 1.0, "std": {"x_m": 1e300}}, "of x_m: must be a number"),
        ({"x_m": 1.0, "std": {"x_m": 0.0}}, "symmetric, positive definite"),
        ({"x_m": 1.0, "covariance": np.eye(2)}, r"of shape \(1, 1\)"),
        (
            {"x_m": 1.0, "covariance": np.array([[np.inf]])},
            "symmetric, positive definite",
        ),
        (
            {"x_m": 1.0, "y_m": 1.0, "covariance": np.array([[1.0, 0.3], [0.0, 1.0]])},
            "symmetric",
        ),
    ],
)
def test_what_makes_no_sense_is_one_line(given: dict, message: str) -> None:
    with pytest.raises(CallError, match=message) as raised:
        Measurement.of(0, **given)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("motion", MODELS, ids=lambda motion: type(motion).__name__)
def test_every_kind_of_estimator_sees_it_in_its_own_state(motion) -> None:
    start = Start(yaw_rad=0.5, speed_mps=20.0)
    values = {"x_m": 1.5, "y_m": 0.8, "yaw_rad": 0.5, "speed_mps": 21.0}
    std = {"x_m": 0.3, "y_m": 0.3, "yaw_rad": 0.1, "speed_mps": 1.0}
    stamp_ns = 100_000_000
    own = measurement_model(tuple(values), motion)
    named = Measurement.of(stamp_ns, std=std, **values)
    bound = Measurement(
        stamp_ns,
        own,
        np.array(list(values.values())),
        np.diag(np.square(list(std.values()))),
    )

    def smoother(motion, start: Start, lag_s: float) -> Estimator:
        return estimator("smoother-banded", motion, start, lag_s=lag_s)

    for make in (ReplayEkf, AccumulatedStateDensity, Al1, ReorderBuffer, smoother):
        found, expected = make(motion, start, 1.0), make(motion, start, 1.0)
        found.update(named)
        expected.update(bound)
        state = found.state_at(stamp_ns)
        assert isinstance(state, TrackState)
        assert state.mean.tolist() == expected.state_at(stamp_ns).mean.tolist()
