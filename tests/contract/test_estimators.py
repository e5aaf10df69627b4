"""Every registered estimator keeps the contract of `fgtrack.testing`."""

from typing import Any

import pytest

from fgtrack.estimation.registry import ESTIMATORS, Claims
from fgtrack.testing import check_estimator

#: Estimators whose options change what they promise nothing of.
VARIANTS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("smoother", {"late": "drop"}),
    ("smoother", {"ring_s": 0.4}),
    ("smoother", {"max_iterations": 3}),
    ("smoother-banded", {"late": "drop"}),
    ("smoother-banded", {"ring_s": 0.4}),
    ("smoother-banded", {"max_iterations": 3}),
    ("delayed-horizon", {"horizon_s": 0.2}),
    ("ekf-backward-forward", {"frequency_hz": 1000.0}),
)


@pytest.mark.parametrize("name", list(ESTIMATORS))
def test_every_estimator_keeps_the_contract(name: str) -> None:
    check_estimator(name, num_streams=3)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "options"), VARIANTS, ids=str)
def test_so_it_does_with_other_options(name: str, options: dict[str, Any]) -> None:
    check_estimator(name, seed=1, num_streams=5, **options)


@pytest.mark.slow
@pytest.mark.parametrize("name", list(ESTIMATORS))
def test_estimators_keep_it_on_more_streams(name: str) -> None:
    if not Claims.of(ESTIMATORS.load(name)).is_exact:
        check_estimator(name, num_streams=6)
        return
    check_estimator(name, seed=2, num_streams=100 if name == "smoother-batch" else 500)
