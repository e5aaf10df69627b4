"""Process noise that leaves out a direction, as CTRV without noise of the position: estimators agree all the same."""

import numpy as np
import pytest

from fgtrack.core.linalg import inverse_root, noise_root, regular
from fgtrack.core.types import TrackState
from fgtrack.estimation.base import Measurement, Start
from fgtrack.estimation.registry import estimator
from fgtrack.models.motion import CTRV
from fgtrack.testing.references import difference

STEP_NS = 50_000_000
DENSITIES = CTRV().density_names()


def present(name: str, motion: CTRV, speed_mps: float, order: np.ndarray) -> TrackState:
    """The last of 14 states of an object, from its positions in an order of arrival."""
    start = Start(
        position_m=(6.0, 3.0),
        position_std_m=2.0,
        yaw_rad=0.3,
        yaw_std_rad=0.3,
        speed_mps=speed_mps,
    )
    tracked, rng = estimator(name, motion, start, lag_s=2.0), np.random.default_rng(1)
    places = [
        (6.0, 3.0)
        + 0.05 * k * speed_mps * np.array([0.96, 0.3])
        + rng.normal(0.0, 0.3, 2)
        for k in range(1, 15)
    ]
    for k in order.tolist():
        x_m, y_m = places[k].tolist()
        measurement = Measurement.of(
            (k + 1) * STEP_NS, x_m=x_m, y_m=y_m, std={"x_m": 0.3, "y_m": 0.3}
        )
        assert tracked.update(measurement).innovation is not None
    tracked.bank.converge()
    return tracked.state_at(14 * STEP_NS)


@pytest.mark.parametrize("speed_mps", [0.0, 10.0])
@pytest.mark.parametrize(
    "without", [(name,) for name in DENSITIES] + [DENSITIES], ids=[*DENSITIES, "all"]
)
def test_smoothers_agree_without_noise_of_some_component(
    without: tuple[str, ...], speed_mps: float
) -> None:
    others = {"resting_yaw_rad2ps": 0.0} if without == DENSITIES else {}
    motion, rng = (
        CTRV(**dict.fromkeys(without, 0.0), **others),
        np.random.default_rng(2),
    )
    expected = present("smoother-banded", motion, speed_mps, np.arange(14))
    # without any noise the states are bound to a curve, along which the steps of gtsam's optimiser are tiny
    names = (
        ("smoother", "smoother-banded")
        if without == DENSITIES
        else ("smoother", "smoother-banded", "smoother-batch")
    )
    for name in names:
        found = present(name, motion, speed_mps, rng.permutation(14))
        assert max(difference(found, expected, motion)) < 1e-5, name


def test_noise_that_is_regular_is_taken_as_it_is() -> None:
    Q = CTRV().process_noise(np.array([0.0, 0.0, 0.3, 5.0, 0.1]), 0.1)
    np.testing.assert_array_equal(noise_root(Q), inverse_root(Q))
    np.testing.assert_allclose(
        regular(np.diag([4.0, 0.0])), np.diag([4.0 + 4e-12, 1e-18]), rtol=1e-15
    )
    with pytest.raises(np.linalg.LinAlgError):
        noise_root(np.array([[1.0, 2.0], [2.0, 1.0]]))
