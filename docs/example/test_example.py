"""The promises of the example."""

import pytest
from fgtrack_example.acceleration import Acceleration
from fgtrack_example.bank import DropBank
from fgtrack_example.dogleg import DoglegBank
from fgtrack_example.refilter import Refilter

from fgtrack.testing import check_estimator, check_motion_model, estimator_checks

CHECKS = estimator_checks(Refilter, num_streams=5)


@pytest.mark.parametrize("promise", CHECKS)
def test_refilter(promise):
    CHECKS[promise]()


@pytest.mark.parametrize("estimator", [DropBank, DoglegBank])
def test_the_other_estimators(estimator):
    check_estimator(estimator, num_streams=2)


def test_the_motion_model():
    check_motion_model(Acceleration())
