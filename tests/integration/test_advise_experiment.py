from pathlib import Path

import pytest
from support.scripts import load

script = load("advise")


def test_following_the_advice_on_a_wrong_clock_lowers_the_error(tmp_path: Path) -> None:
    case = next(one for one in script.CASES if one.wrong == "lidar_cluster")
    _, _, found = script.simulated(case, 1, 25.0, tmp_path)
    key, _, value = found.changes.partition("=")
    assert (key, float(value)) == ("sensors.lidar_cluster.clock_offset_s", pytest.approx(0.08, abs=0.01))
    assert found.rmse_followed_m < found.rmse_m
    assert not list(tmp_path.iterdir())
