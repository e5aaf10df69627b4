from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.scripts import load

from fgtrack.core.types import EgoState
from fgtrack.sim.simulate import simulate

script = load("ego_uncertainty")


def test_the_script_writes_a_table(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch) -> None:
    monkeypatch.setattr(script, "COUNTS", (2,))
    script.main(tmp_path / "out", runs=2, duration_s=2.5, estimator="ekf-replay", jobs=1)
    table = (tmp_path / "out/ego_uncertainty.csv").read_text()
    assert capsys.readouterr().out == table
    assert len(table.splitlines()) == 1 + len(script.TIMES_S) * (len(script.MODES) + 1)


@pytest.mark.parametrize(("time_s", "correlation"), [(0.0, 0.0), (0.5, np.exp(-0.01 / 0.5))])
def test_the_ego_errs_as_much_and_for_as_long_as_it_should(time_s: float, correlation: float) -> None:
    drive = replace(script.scenario(0, 60.0), truth_rate_hz=0.1)
    exact = [m for m in simulate(drive, np.random.default_rng(0)) if isinstance(m, EgoState)]
    found = list(script.erring(exact, time_s, np.random.default_rng(1)))
    error = np.array([a.yaw_rad - b.yaw_rad for a, b in zip(found, exact, strict=True)])
    assert error.std() == pytest.approx(script.YAW_STD_RAD, rel=0.35 if time_s else 0.05)
    assert np.corrcoef(error[1:], error[:-1])[0, 1] == pytest.approx(correlation, abs=0.05)
    assert np.sqrt(np.reshape(found[0].covariance, (5, 5))[2, 2]) == pytest.approx(script.YAW_STD_RAD)
