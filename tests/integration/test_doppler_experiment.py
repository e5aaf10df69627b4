from pathlib import Path

import numpy as np
import pytest
from support.scripts import load

script = load("doppler")


def test_the_script_writes_tables_and_figure(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(script, "DURATION_S", 1.3)
    monkeypatch.setattr(script, "NAMES", ("ekf-replay", "smoother"))
    script.main(tmp_path / "out", runs=2, seed=1)
    tables = (tmp_path / "out/doppler.md").read_text()
    assert capsys.readouterr().out.startswith(tables)
    assert len(tables.splitlines()) == 2 + 3 * 2 + 1 + 2 + 2 * 2
    assert len((tmp_path / "out/doppler.csv").read_text().splitlines()) == 1 + 2 * 5 * 2
    assert (tmp_path / "out/doppler.png").read_bytes().startswith(b"\x89PNG")


def test_two_intersections_cure_the_wrong_side() -> None:
    """Of the first runs, one start leaves two on the wrong side of the sensors for good."""
    rmse_m = {
        how: script.rmse_m(np.array([script.errors_m("ranging", "ekf-replay", how, 0, run) for run in range(5)]))
        for how in script.STARTS["ranging"]
    }
    assert (rmse_m["one start"] > 10.0).sum() == 2
    assert rmse_m["two intersections"].max() < 1.0
