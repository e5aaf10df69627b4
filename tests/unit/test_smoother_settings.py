"""What the smoother's settings refuse, and in which words."""

import numpy as np
import pytest

from fgtrack.estimation.smoothing.settings import SmootherSettings
from fgtrack.models.motion import CTRV, CV


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"lag_s": -1.0}, "lag_s: must be finite and not negative"),
        ({"ring_s": float("inf")}, "ring_s: must be finite and not negative"),
        ({"max_iterations": 0}, "max_iterations: must lie between 1 and 100"),
        (
            {"relinearise": {"yaw_rad": -0.1}},
            r"relinearise\.yaw_rad: must be finite and not negative",
        ),
        (
            {"lag_s": 0.2, "lagged_s": (0.3,)},
            "lagged_s: must lie between 0 and lag_s = 0.2",
        ),
        ({"lagged_s": (0.1, 0.3, 0.1)}, "lagged_s: names a lag twice"),
    ],
)
def test_settings_that_make_no_sense_are_refused(wrong: dict, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        SmootherSettings(**wrong)


def test_thresholds_stand_in_the_order_of_the_state() -> None:
    settings = SmootherSettings(relinearise={"speed_mps": 2.0, "x_m": 0.3})
    straight, curved = (
        settings.thresholds(CTRV(), nonlinear) for nonlinear in (False, True)
    )
    np.testing.assert_array_equal(straight[[0, 3]], [0.3, 2.0])
    assert (straight[[1, 2, 4]] > 1e6).all()
    np.testing.assert_array_equal(curved[:4], [0.3, 0.05, straight[2], 2.0])


def test_where_all_is_linear_nothing_is_relinearised() -> None:
    settings = SmootherSettings(relinearise={"x_m": 0.3})
    assert (settings.thresholds(CV(), nonlinear=False) > 1e6).all()
    np.testing.assert_array_equal(
        settings.thresholds(CV(), nonlinear=True), [0.3, 0.05, 0.2, 0.2]
    )
