"""The ladder of out-of-sequence methods against what an earlier implementation gave.

The scenario, and what of it had to be found out, is told in `experiments/ladder/ladder.py`.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2
from support.scripts import load

SEED = 1
ROUNDING_M, ROUNDING_ANEES = 0.001, 0.01  # of a difference of two entries of the reference
CONSISTENT = ("ekf-replay", "rts", "zlz", "asd", "drop", "delayed-horizon", "reorder-buffer", "rewind-forget")

script = load("ladder")


@pytest.fixture(scope="module", params=[24, pytest.param(400, marks=pytest.mark.slow)], ids=lambda runs: f"{runs} runs")
def ladder(request: pytest.FixtureRequest) -> dict[int, dict[str, Any]]:
    """Samples by lag and method."""
    return {lag: script.measured(lag, request.param, SEED) for lag in script.REFERENCE_LAGS}


@pytest.mark.parametrize("lag", script.REFERENCE_LAGS)
@pytest.mark.parametrize("name", script.REFERENCE)
def test_error_and_consistency_are_those_of_the_reference(ladder, name: str, lag: int) -> None:
    rmse, anees = script.deviations(name, lag, ladder[lag][name])
    assert abs(rmse) < 3.0
    assert abs(anees) < 3.0


@pytest.mark.parametrize("lag", script.REFERENCE_LAGS)
@pytest.mark.parametrize("name", [name for name in script.REFERENCE if name != "ekf-replay"])
def test_so_is_the_distance_to_the_replay_in_which_the_common_noise_cancels(ladder, name: str, lag: int) -> None:
    found, replay = ladder[lag][name], ladder[lag]["ekf-replay"]
    place = script.REFERENCE_LAGS.index(lag)
    (rmse_m, anees), (replay_m, replay_anees) = script.REFERENCE[name][place], script.REFERENCE["ekf-replay"][place]
    part = np.sqrt(1.0 / len(found.nees) + 1.0 / script.REFERENCE_RUNS)
    error_m = part * np.std(found.squared_m2 - replay.squared_m2) / (found.rmse_m + replay.rmse_m)
    error = part * np.std(found.nees - replay.nees)
    assert abs(found.rmse_m - replay.rmse_m - (rmse_m - replay_m)) < 3.0 * error_m + ROUNDING_M
    assert abs(found.anees - replay.anees - (anees - replay_anees)) < 3.0 * error + ROUNDING_ANEES


@pytest.mark.parametrize("lag", script.REFERENCE_LAGS)
@pytest.mark.parametrize("name", CONSISTENT)
def test_a_consistent_method_is_as_sure_as_it_should_be(ladder, name: str, lag: int) -> None:
    nees = ladder[lag][name].nees
    low, high = chi2.ppf([0.0005, 0.9995], 2 * len(nees))
    assert low < nees.sum() < high


@pytest.mark.parametrize("lag", script.REFERENCE_LAGS)
def test_what_the_methods_fuse_is_counted(ladder, lag: int) -> None:
    refused = {name for name, samples in ladder[lag].items() if samples.fused_share < 1.0}
    assert refused == ({"drop", "a1"} if lag == 10 else {"drop"})


def test_the_script_writes_table_and_figure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    script.main(tmp_path / "out", runs=2, seed=SEED, lags="1,4")
    table = (tmp_path / "out/ladder.md").read_text()
    assert capsys.readouterr().out == table
    assert len(table.splitlines()) == 2 + len(script.METHODS)
    rows = (tmp_path / "out/ladder.csv").read_text().splitlines()
    assert len(rows) == 1 + 2 * len(script.METHODS)
    assert (tmp_path / "out/ladder.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("lags", ["", "0", "1,x", "41"])
def test_a_lag_that_does_not_exist_is_a_bad_call(tmp_path: Path, lags: str) -> None:
    with pytest.raises(script.CallError, match="whole numbers from 1 to 40"):
        script.main(tmp_path, lags=lags)
