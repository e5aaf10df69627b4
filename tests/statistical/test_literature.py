"""Published examples of late measurements, see `experiments/literature`."""

import numpy as np
import pytest
from support.scripts import load

script = load("literature")
#: Methods that are exact for one late measurement at one lag in a linear model.
EXACT = ("ekf-replay", "ekf-rts", "rts", "zlz", "asd", "a1", "al1")


@pytest.mark.parametrize("name", EXACT)
@pytest.mark.parametrize("axes", [(0, 2), (4, 4)], ids=["x and y", "z"])
def test_on_the_page_of_matlab_all_exact_methods_are_the_joint_estimate(
    name: str, axes: tuple[int, int]
) -> None:
    example = script.matlab(np.random.default_rng(2021), axes)
    mean, covariance = script.last_state(name, example)
    exact_mean, exact_covariance = example.exact()
    np.testing.assert_allclose(mean, exact_mean, atol=1e-11)
    np.testing.assert_allclose(covariance, exact_covariance, rtol=1e-9, atol=1e-13)


@pytest.mark.parametrize(
    ("name", "least"), [("drop", 0.1), ("as-current", 0.3), ("c", 0.01)]
)
def test_other_methods_depart_from_it(name: str, least: float) -> None:
    example = script.matlab(np.random.default_rng(2021))
    assert script.deviation(name, example) > least


def test_stone_soups_late_sensor_is_filtered_in_the_order_of_its_stamps() -> None:
    example = script.stone_soup(np.random.default_rng(script.SOUP_SEED))
    assert script.deviation("ekf-replay", example) < 1e-9
    assert script.deviation("as-current", example) > 1.0
