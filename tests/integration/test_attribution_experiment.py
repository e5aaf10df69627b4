from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.scripts import load

script = load("attribution")
noise = load("fitted_noise")


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> dict[str, object]:
    """One world of each kind of start, short."""
    worlds = {
        name: replace(world, duration_s=1.5, judged_from_s=0.5)
        for name, world in script.WORLDS.items()
        if name.startswith(("outliers", "near"))
    }
    monkeypatch.setattr(script, "WORLDS", worlds)
    return worlds


def test_the_script_writes_a_row_for_every_contestant_and_step(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], short: dict[str, object]
) -> None:
    script.main(tmp_path, runs=2)
    errors, steps = ((tmp_path / f"{name}.md").read_text() for name in ("errors", "steps"))
    printed = capsys.readouterr().out
    assert errors in printed
    assert steps in printed
    assert len(errors.splitlines()) == 2 + len(short) * len(script.CONTESTANTS)
    assert len(steps.splitlines()) == 2 + len(script.STEPS) + 1
    assert all(len(line.split(" | ")) == 1 + len(short) for line in steps.splitlines())
    assert len((tmp_path / "scores.csv").read_text().splitlines()) == 1 + 2 * len(short) * len(script.CONTESTANTS)


def test_every_contestant_gets_the_same_measurements_and_the_same_start(short: dict[str, object]) -> None:
    world = script.WORLDS[next(iter(short))]
    one, other = (script.scene(world, np.random.default_rng(3)) for _ in range(2))
    assert [m.z.tolist() for _, m in one.received] == [m.z.tolist() for _, m in other.received]
    receipts = [receipt for receipt, _ in one.received]
    assert receipts == sorted(receipts)
    assert any(a.stamp_ns > b.stamp_ns for (_, a), (_, b) in zip(one.received, one.received[1:], strict=False))
    twice = script.Contestant("ekf-replay", options={"initiation": "one-point"})
    assert script.score(twice, one) == script.score(script.CONTESTANTS["EKF"], one)


def test_in_a_world_without_outliers_a_loss_of_great_width_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    world = replace(script.WORLDS["race: LiDAR and RADAR, late"], duration_s=1.5, judged_from_s=0.5)
    run = script.scene(world, np.random.default_rng(4))
    wide = script.Contestant("ekf-replay", script.RobustLoss("huber", 1e3))
    plain = script.Contestant("ekf-replay")
    assert script.score(wide, run).rmse_m == pytest.approx(script.score(plain, run).rmse_m, rel=1e-9)


def test_the_change_is_the_geometric_mean_of_the_ratios() -> None:
    found = script.change([2.0, 8.0, 4.0], [1.0, 2.0, 4.0])
    assert found.mean == pytest.approx(100.0)
    assert found.low < found.mean < found.high


def test_both_noises_are_replayed_with_every_estimator(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    noise.main(tmp_path, configs="smoother,tuned", seeds=2, duration_s=2.0)
    table = (tmp_path / "table.md").read_text()
    assert table in capsys.readouterr().out
    rows = [line.split(" | ") for line in table.splitlines()[2:]]
    assert [row[0].removeprefix("| ") for row in rows] == ["smoother"] * 3 + ["tuned"] * 3
    assert [row[1] for row in rows[:3]] == list(noise.ESTIMATORS)
    assert len((tmp_path / "runs.csv").read_text().splitlines()) == 1 + 2 * 3 * 2
