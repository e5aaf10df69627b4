from pathlib import Path

import numpy as np
import pytest
from support.scripts import load

script = load("births")


def test_the_script_writes_table_and_figure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    script.main(tmp_path / "out", objects=3, seed=1)
    table = (tmp_path / "out/births.md").read_text()
    assert capsys.readouterr().out.startswith(table)
    assert len(table.splitlines()) == 2 + len(script.ESTIMATORS)
    assert len((tmp_path / "out/births.csv").read_text().splitlines()) == 1 + 3 * len(script.ESTIMATORS)
    assert (tmp_path / "out/births.png").read_bytes().startswith(b"\x89PNG")


def test_the_same_start_makes_the_filter_as_good_as_the_smoother() -> None:
    """Ten objects say it already: 0.2 s after birth the start counts, and smoothing does not."""
    labels = ("smoother, regression", "ekf-replay, regression", "ekf-replay, one-point")
    rmse = [
        np.sqrt(np.mean([script.errors(label, np.random.default_rng([3, i]))[3, 1] ** 2 for i in range(10)]))
        for label in labels
    ]
    assert rmse[1] == pytest.approx(rmse[0], rel=0.1)
    assert rmse[2] > 3.0 * rmse[1]


def test_a_quantile_has_an_interval_around_it() -> None:
    found = script.quantile(np.arange(100.0), 0.5, np.random.default_rng(0))
    assert found.mean == 50.0
    assert 35.0 < found.low < 45.0 < 55.0 < found.high < 65.0
