from pathlib import Path

import numpy as np
import pytest
from support.scripts import load

script = load("outliers")


def test_the_script_writes_tables_and_figure(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(script, "NUM_STEPS", 5)
    script.main(tmp_path / "out", runs=2, seed=1)
    table = (tmp_path / "out/outliers.md").read_text()
    assert capsys.readouterr().out.startswith(table)
    assert len(table.splitlines()) == 2 + len(script.VARIANTS)
    rows = (tmp_path / "out/outliers.csv").read_text().splitlines()
    assert len(rows) == 1 + 2 * len(script.VARIANTS) * len(script.SHARES) * len(script.LATEST_S)
    assert (tmp_path / "out/outliers.png").read_bytes().startswith(b"\x89PNG")


def test_every_variant_sees_the_same_detections_and_the_loss_makes_the_difference(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(script, "NUM_STEPS", 100)

    def mean_m(label: str, share: float) -> float:
        return float(np.mean([script.rmse_m(label, share, 0.1, 3, run) for run in range(3)]))

    assert mean_m("smoother, Gaussian", 0.2) == pytest.approx(mean_m("ekf-replay, Gaussian", 0.2), rel=0.03)
    assert mean_m("ekf-replay, Huber 1.5", 0.2) < 0.8 * mean_m("ekf-replay, Gaussian", 0.2)
    assert mean_m("ekf-replay, inflated R", 0.0) == mean_m("ekf-replay, Gaussian", 0.0)
