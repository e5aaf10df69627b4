from pathlib import Path

import numpy as np
import pytest
from support.scripts import load

from fgtrack.core.errors import CallError

script = load("bounds")


def test_the_script_writes_table_and_figure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    script.main(tmp_path / "out", runs=2, duration_s=3.3, seed=1, estimators="ekf-replay,drop")
    table = (tmp_path / "out/bounds.md").read_text()
    assert capsys.readouterr().out.startswith(table)
    rows = (tmp_path / "out/bounds.csv").read_text().splitlines()
    assert len(rows) == 1 + len(script.WORLDS) * len(script.DELAYS_S) * (len(script.BOUNDS) + 2)
    assert (tmp_path / "out/bounds.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("model", ["cv", "ctrv"])
def test_without_delay_what_has_arrived_is_all_and_later_it_lies_between(model: str) -> None:
    case = script.Case(script.WORLDS[model], 2, 3.3, np.random.default_rng(2))
    start, later = (script.mean_bounds(case, delay_s) for delay_s in (0.0, 0.2))
    assert start["in time"] == start["arrived"] == start["dropped"]
    assert later["in time"] == start["in time"] < later["arrived"] < later["dropped"]


def test_in_the_linear_model_the_posterior_bound_is_that_along_the_trajectories() -> None:
    case = script.Case(script.WORLDS["cv"], 2, 3.3, np.random.default_rng(2))
    found = script.mean_bounds(case, 0.1)
    assert found["posterior, arrived"] == pytest.approx(found["arrived"], rel=1e-12)


def test_every_estimator_sees_the_same_draws() -> None:
    case = script.Case(script.WORLDS["cv"], 2, 3.3, np.random.default_rng(2))
    makers = script.starts(case.world.motion, 0.0)
    errors = [script.squared_errors(case, makers[name], 0.0) for name in ("ekf-replay", "drop", "as-current", "rts")]
    np.testing.assert_allclose(errors, np.broadcast_to(errors[0], np.shape(errors)), rtol=1e-9)


def test_an_estimator_that_does_not_exist_is_a_bad_call(tmp_path: Path) -> None:
    with pytest.raises(CallError, match="kalman unknown"):
        script.main(tmp_path, estimators="drop,kalman")
