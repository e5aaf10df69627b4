"""Every experiment runs in a short form, and its tables have a row for each case and numbers in them."""

import csv
import sys
from pathlib import Path
from typing import Any

import pytest
from support.messages import shared
from support.scripts import EXPERIMENTS, load

from fgtrack.config.reading import read_config

for folder in ("any_order", "real_data"):
    sys.path.insert(0, str(EXPERIMENTS / folder))

pytestmark = pytest.mark.slow

#: Script, options of a short run, what else makes it short, and the rows of its table; a name for the rest.
SHORT: dict[str, tuple[dict[str, Any], dict[str, Any], str, int]] = {
    "any_order": (
        {"seeds": 1, "methods": "decided once;revised"},
        {"DENSE_DELAYS_S": {"in order": {"lidar": 0.0, "radar": 0.0}}},
        "runs.csv",
        2,
    ),
    "association": ({"runs": 2, "duration_s": 2.0}, {}, "judged.csv", 0),
    "association/crossings": (
        {"runs": 2, "duration_s": 2.5, "jobs": 1},
        {},
        "crossings.csv",
        2 * 5,
    ),
    "births": ({"objects": 3}, {}, "births.csv", 0),
    "bounds": (
        {"runs": 2, "duration_s": 3.3, "estimators": "ekf-replay,drop"},
        {},
        "bounds.csv",
        0,
    ),
    "calls": ({"estimators": "ekf-replay,smoother"}, {}, "calls.csv", 2),
    "commits": (
        {"other": EXPERIMENTS.parent, "estimators": "ekf-replay", "objects": "1"}
        | {"rounds": 1, "duration_s": 2.0},
        {},
        "commits.csv",
        1,
    ),
    "doppler": (
        {"runs": 2},
        {"DURATION_S": 1.3, "NAMES": ("ekf-replay", "smoother-banded")},
        "doppler.csv",
        2 * 2 * 2,
    ),
    "ego_uncertainty": (
        {"runs": 2, "duration_s": 2.5},
        {"COUNTS": (2,)},
        "ego_uncertainty.csv",
        0,
    ),
    "ladder": ({"runs": 2, "lags": "1,4"}, {}, "ladder.csv", 0),
    "lag": ({"runs": 4}, {}, "lag.csv", 0),
    "leaderboard": (
        {"runs": 2},
        {"SCENARIOS": ("late-by-1", "late-by-10"), "OTHERS": ()},
        "leaderboard.csv",
        5,
    ),
    "outliers": ({"runs": 2}, {"NUM_STEPS": 5}, "outliers.csv", 0),
    "rivals": (
        {"seeds": 1, "duration_s": 4.0, "scenes": "default, fitted noise"},
        {},
        "runs.csv",
        0,
    ),
    "survival": ({"duration_s": 3.0}, {}, "survival.csv", 0),
    "bearing_only": (
        {"runs": 2, "share": 0.2, "cases": "ekf-replay;smoother-banded"},
        {},
        "bearing_only.csv",
        0,
    ),
    "bearing_only/cameras": ({"runs": 2, "duration_s": 1.5}, {}, "cameras.csv", 3 * 2),
}


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("name", SHORT)
def test_a_short_run_writes_its_table_and_prints_it(
    name: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    options, constants, written, count = SHORT[name]
    script = load(*name.split("/"))
    for constant, value in constants.items():
        monkeypatch.setattr(script, constant, value)
    script.main(tmp_path, **options)
    rows = table(tmp_path / written)
    assert len(rows) == count or (count == 0 and len(rows) > 1)
    assert all(value for row in rows for value in list(row.values())[:1])
    assert capsys.readouterr().out.strip()
    for picture in tmp_path.glob("*.png"):
        assert picture.read_bytes().startswith(b"\x89PNG")


SHORT_COMPARISON = """
format: fgtrack-sweep/1
scenario: default
config: tuned
duration_s: 3.0
seeds: [1, 2]
estimators: [drop, ekf-backward-forward, rewind-forget, ekf-replay, ekf-rts, smoother-banded]
set: {map.track: oval, map.pit: oval, options.ekf-replay.lagged_s: 0.3}
vary:
  delays:
    label: [late, none]
    scenario.sensors.lidar_cluster.delay: [{kind: constant, delay_s: 0.2}, {kind: none}]
"""


def test_the_comparison_has_a_row_for_each_estimator_and_state(tmp_path: Path) -> None:
    comparison = load("ledger", "comparison")
    sweep = tmp_path / "short.yaml"
    sweep.write_text(SHORT_COMPARISON, encoding="utf-8")
    comparison.main(tmp_path / "out", seeds=2, sweep=str(sweep))
    text = (tmp_path / "out/comparison.md").read_text(encoding="utf-8")
    assert text.startswith("2 seeds\n")
    rows = [line.split(" | ") for line in text.splitlines() if line.startswith("| ")]
    errors = {
        (row[0].strip("| "), row[1], row[2]): float(row[3].split()[0])
        for row in rows[1:]
    }
    assert len(errors) == len(comparison.ROWS)
    replay_m = errors["late", "`ekf-replay`", "now"]
    assert errors["none", "`ekf-replay`", "now"] < replay_m
    assert errors["late", "`drop`", "now"] > replay_m
    smoothed_m = errors["late", "`smoother-banded`", "0.3 s ago"]
    assert smoothed_m < errors["late", "`ekf-replay`", "0.3 s ago"]


def test_published_examples_have_a_row_for_each_method(tmp_path: Path) -> None:
    literature = load("literature")
    literature.main(tmp_path, runs=2)
    rows = (tmp_path / "table.md").read_text(encoding="utf-8").splitlines()
    assert [row.split("`")[1] for row in rows[2:]] == list(literature.METHODS)
    columns = {len(row.split(" | ")) for row in (rows[0], *rows[2:])}
    assert columns == {1 + 2 * len(literature.EXAMPLES)}


# --- recordings of other people


def test_on_real_recordings_tracks_are_better_than_their_raw_detections(
    tmp_path: Path,
) -> None:
    load("real_data").main(
        shared("data/autoferry"),
        out=tmp_path,
        estimators="ekf-replay",
        scenarios="scenario4",
    )
    first, *averages = table(tmp_path / "autoferry_scores.csv")
    assert float(first["mota"]) > float(first["mota_raw"]) + 20.0
    assert [row["recording"] for row in averages] == ["median", "mean"]


def test_the_shipped_numbers_are_those_of_the_rules_and_a_scenario_is_judged_without_its_own(
    tmp_path: Path,
) -> None:
    held_out = load("real_data", "held_out")
    held_out.main(
        shared("data/autoferry"),
        tmp_path,
        estimators="ekf-replay",
        judge="scenario2",
        delays_s="0.5",
    )
    without, everything = table(tmp_path / "rules.csv")
    assert (without.pop("held_out"), everything.pop("held_out")) == (
        "scenario2",
        "none",
    )
    assert without != everything
    shipped = held_out.numbers(read_config("autoferry"))
    assert {key: float(value) for key, value in everything.items()} == pytest.approx(
        shipped
    )
    for name in ("scores.csv", "0.5_s_scores.csv"):
        assert float(table(tmp_path / name)[0]["mota"]) > 40.0


def test_the_score_of_one_drive_follows_from_another(tmp_path: Path) -> None:
    load("real_data", "leave_one_out").main(
        kitti=shared("data/kitti"),
        out=tmp_path,
        sequences="0006,0010",
        estimator="ekf-replay",
    )
    rows = table(tmp_path / "leave_one_out.csv")
    assert [row["sequence"] for row in rows] == ["0006", "0010"]
    for row in rows:
        assert 3.0 < float(row["even"]) < 6.0
        assert 0.8 < float(row["visible_share"]) <= float(row["detection_probability"])
        assert (
            float(row["mota"])
            > max(float(row["mota_raw_2"]), float(row["mota_raw_3"])) - 1.0
        )


def test_forgotten_positions_cost_backward_forward_more(tmp_path: Path) -> None:
    late = load("real_data", "delayed")
    late.main(
        kitti=shared("data/kitti"),
        out=tmp_path,
        sequences="0006",
        arrangements="halves",
    )
    rows = [
        row
        for row in table(tmp_path / "costs.csv")
        if row["quantity"] == "position_rmse_m"
    ]
    assert [row["estimator"] for row in rows] == list(late.ESTIMATORS)
    *others, forgets = (float(row["cost_m"].split()[0]) for row in rows)
    assert all(0.0 < other < forgets for other in others)


def test_a_vessel_is_missed_for_longer_unless_visibility_is_estimated(
    tmp_path: Path,
) -> None:
    load("real_data", "parts").main(
        autoferry=shared("data/autoferry"), out=tmp_path, scenarios="scenario4"
    )
    shipped, without, *others = table(tmp_path / "parts.csv")
    assert float(without["mota_difference"].split()[0]) < -5.0
    assert (
        float(shipped["mota"])
        > max(float(row["mota"]) for row in (without, *others)) - 3.0
    )


def test_a_late_camera_costs_most_where_prompt_positions_are_forgotten(
    tmp_path: Path,
) -> None:
    late = load("real_data", "late_sensors")
    late.main(
        kitti=shared("data/kitti"),
        out=tmp_path,
        recordings="0006",
        late="rrc_car",
        delays_s="0.3",
    )
    forgets, rewinds, *others, drop = table(tmp_path / "late_sensors.csv")
    assert [row["estimator"] for row in (forgets, rewinds, *others, drop)] == list(
        dict.fromkeys(sum(late.GROUPS, ()))
    )
    for row in (*others, drop):
        assert float(row["rmse_m"]) < float(forgets["rmse_m"])
        assert float(row["less_backward_forward_m"].split(" to ")[1].rstrip(")")) < 0.0
