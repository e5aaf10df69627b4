from pathlib import Path

import numpy as np
import pytest
from support.scripts import load

script = load("objective")


def test_the_script_writes_rows_and_both_tables(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(script, "CASES", [("agile", (5.0, 2.0)), ("paper", (65.0, 20.0))])
    script.main(tmp_path / "out", runs=2, jobs=1, seed=1)
    tables = (tmp_path / "out/objective.md").read_text()
    assert capsys.readouterr().out.startswith(tables)
    assert tables.count("agile, 5 m/s, 2 Hz") == tables.count("paper, 65 m/s, 20 Hz") == 2
    rows = (tmp_path / "out/objective.csv").read_text().splitlines()
    assert len(rows) == 3
    assert rows[0].startswith("noise,speed_mps,rate_hz,runs,gap_median_sd")


def test_both_objectives_see_the_same_track_and_differ_where_the_noise_follows_the_speed() -> None:
    slow, fast = (script.track("agile", 5.0, 2.0, 3), script.track("fitted", 65.0, 20.0, 3))
    for both, least, most in ((slow, 0.03, 2.0), (fast, 0.0, 0.03)):
        gap = np.abs(both["map"].means - both["reweighted"].means) / both["map"].sigma
        assert least < gap.max() < most
        assert both["map"].squared_m2.shape == (script.NUM_STAMPS,)


def test_the_interval_is_that_of_the_mean() -> None:
    values = np.random.default_rng(0).normal(2.0, 3.0, 900)
    mean, half = script.interval(values)
    assert mean == pytest.approx(2.0, abs=0.3)
    assert half == pytest.approx(1.96 * 3.0 / 30.0, rel=0.1)
