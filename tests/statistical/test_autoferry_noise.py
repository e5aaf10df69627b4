"""The shipped noise for Autoferry, on the recordings that it is for."""

from typing import NamedTuple

import numpy as np
import pytest
from support.messages import shared

import fgtrack
from fgtrack.evaluation.metrics import evaluate

SCENARIOS = range(2, 7)
EXPECTED = 2.0


class Judged(NamedTuple):
    off_by: list[float]
    """How far NEES and the NIS of both sensors are from what is expected."""
    gospa_m: float


def judged(number: int, config: str) -> Judged:
    metrics = evaluate(fgtrack.replay(shared(f"data/autoferry/scenario{number}"), config))
    consistency = metrics.consistency
    found = consistency.position_nees, consistency.nis["lidar"], consistency.nis["radar"]
    assert metrics.multi_object is not None
    return Judged([abs(one.mean - EXPECTED) for one in found], metrics.as_dict()["multi_object"]["gospa"]["rms_m"])


@pytest.mark.slow
def test_the_shipped_noise_is_more_consistent_than_the_configured_one_and_no_less_accurate():
    before = [judged(number, "autoferry") for number in SCENARIOS]
    after = [judged(number, "autoferry_tuned") for number in SCENARIOS]
    assert np.all(np.array([one.off_by for one in after]) < np.array([one.off_by for one in before]))
    assert np.mean([one.gospa_m for one in after]) <= np.mean([one.gospa_m for one in before])
