import inspect
import re
import sys
from pathlib import Path

import pytest
from support.scripts import EXPERIMENTS

sys.path.insert(0, str(EXPERIMENTS))
import contest


def test_a_lever_arm_costs_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    rows = [line.split("|")[2:5] for line in contest.lever_arm(1, 8.0).splitlines()[2:]]
    (near_m, *_), (far_m, nees, nis) = ([float(cell.split()[0]) for cell in row] for row in rows)
    assert far_m == pytest.approx(near_m, rel=0.1)
    assert nees < 5.0
    assert 2.5 < nis < 3.5


def test_innovations_are_judged_by_estimator_and_sensor() -> None:
    rows = contest.whiteness(1, 4.0).splitlines()[2:]
    assert [row.split("|")[1].strip() for row in rows[::2]] == ["smoother", "ekf-replay", "ekf-backward-forward"]
    assert all(row.split("|")[4].strip() in ("0 of 1", "1 of 1") for row in rows)


@pytest.mark.parametrize("script", contest.SCRIPTS)
def test_every_script_takes_the_options_of_a_quick_run(script: str) -> None:
    source = (EXPERIMENTS / script).read_text()
    main = source[source.index("def main(") :]
    for option in contest.SCRIPTS[script][1][::2]:
        assert re.search(rf"\b{option.removeprefix('--').replace('-', '_')}: ", main), option


def test_what_a_script_prints_is_kept_and_a_failure_ends_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert "jobs" in inspect.signature(contest.main).parameters
    monkeypatch.setattr(contest, "HERE", tmp_path)
    (tmp_path / "good.py").write_text("print('a table')")
    (tmp_path / "bad.py").write_text("raise SystemExit(3)")
    assert contest.printed("good.py", tmp_path / "out", 1, ()) == "a table\n"
    with pytest.raises(contest.subprocess.CalledProcessError):
        contest.printed("bad.py", tmp_path / "out", 1, ())
