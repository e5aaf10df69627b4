import json
import sys
from pathlib import Path

import numpy as np
import pytest
from support.scripts import EXPERIMENTS

sys.path.insert(0, str(EXPERIMENTS))
import bench_estimators
import bench_memory
import bench_report
import bench_speed
import bench_streaming
import bench_tracker

from fgtrack.core.types import DetectionList, TruthState

CHECKOUT = EXPERIMENTS.parent
SMALL = {"rounds": 1, "duration_s": 1.6}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out: Path = tmp_path_factory.mktemp("speed")
    (out / "page.md").write_text("# Speed\n<!-- begin speed -->\nold\n<!-- end speed -->\nMore.\n")
    options = {"figure": out / "again.png", "page": out / "page.md"}
    bench_speed.main(out, objects="1,2", against=CHECKOUT, **options, **SMALL)
    return out


def test_the_table_has_a_row_for_every_cell_and_every_promise(folder: Path) -> None:
    found = json.loads((folder / "speed.json").read_text())
    assert [(row["cell"]["label"], row["cell"]["count"]) for row in found["ticks"]] == [
        *((label, 1) for label in bench_report.MAIN),
        (bench_report.BANDED, 2),
    ]
    assert all(0.0 < row["median_ms"] <= row["p99_ms"] <= row["largest_ms"] * 1.001 for row in found["ticks"])
    text = (folder / "speed.md").read_text()
    assert all(bar["what"] in text for bar in found["bars"])
    assert [bar["verdict"] for bar in found["bars"]].count("not measured") == 8 + 1
    assert [one["count"] for one in found["against"]] == [1]
    assert found["machine"]["python"] in text


def test_stone_soup_stands_beside_the_estimators_of_one_object(folder: Path) -> None:
    found = json.loads((folder / "speed.json").read_text())
    names = [one["name"] for one in found["per_detection"]]
    assert {"smoother", "smoother-banded", "ekf-replay", "ekf-backward-forward"} < set(names)
    assert sum("Stone Soup" in name for name in names) == 2
    assert found["stone_soup_us"] > 0.0
    assert max(one["error_m"] for one in found["per_detection"]) < 5.0


def test_the_tables_replace_those_of_the_page(folder: Path) -> None:
    page, text = (folder / "page.md").read_text(), (folder / "speed.md").read_text()
    assert page == f"# Speed\n<!-- begin speed -->\n\n{text}\n<!-- end speed -->\nMore.\n"
    (folder / "other.md").write_text("# Speed\n")
    with pytest.raises(ValueError, match="has no marks"):
        bench_report.put_into(folder / "other.md", "speed", text)


def test_the_figure_is_drawn_twice(folder: Path) -> None:
    pictures = [(folder / name).read_bytes() for name in ("speed.png", "again.png")]
    assert all(picture.startswith(b"\x89PNG") for picture in pictures)


def test_without_stone_soup_it_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench_speed.importlib.util, "find_spec", lambda name: None)
    results = bench_report.Results()
    bench_speed.measure_single(results, ["ekf-replay"], 1, 0.5, cpu=True)
    assert "pip install fgtrack[bench]" in bench_report.tables(results)
    assert [one["name"] for one in results.per_detection] == ["ekf-replay"]


def test_the_full_run_takes_every_estimator_number_lag_and_delay_once() -> None:
    cells = bench_speed.full_cells(bench_report.ALL_OBJECTS, 8.0)
    assert len(set(cells)) == len(cells)
    assert {one.count for one in cells} == set(bench_report.ALL_OBJECTS)
    assert {one.lag_s for one in cells} == {0.5, 1.0, 3.0}
    assert {one.delay_s for one in cells} == {None, 0.0, 0.06, 0.15, 0.4}
    assert {one.label for one in cells} == {*bench_speed.ESTIMATORS, bench_report.PAPER}


@pytest.mark.parametrize("delay_s", [0.0, 0.4])
def test_every_detection_counts_however_late(delay_s: float) -> None:
    found = bench_tracker.measure(bench_tracker.Cell("x", "smoother", 2, "ekf-replay", delay_s=delay_s, duration_s=2.0))
    assert found.tracks == 2


def test_two_hundred_objects_are_all_tracked() -> None:
    found = bench_tracker.measure(bench_tracker.Cell("x", "smoother", 200, "smoother-banded", duration_s=1.0))
    assert found.tracks >= 200


def test_missing_tracks_are_no_measurement() -> None:
    one = bench_tracker.Measured(1.0, [1.0], 1.0, 1.0, tracks=9.0, memory_mb=0.0)
    row = bench_report.Row.of(bench_tracker.Cell("x", "smoother", 10), [one])
    assert row.lost_tracks
    assert np.isnan(row.published_ratio)
    assert not bench_report.Row.of(bench_tracker.Cell("x", "smoother", 9), [one]).lost_tracks


def test_an_older_checkout_that_cannot_be_measured_spoils_nothing_else(tmp_path: Path) -> None:
    (tmp_path / "fgtrack").mkdir()
    (tmp_path / "fgtrack/__init__.py").write_text("raise SystemExit(3)")
    results = bench_report.Results()
    bench_speed.measure_against(results, tmp_path, [bench_speed.cell("smoother", 1)], rounds=1)
    assert not results.against
    assert "cannot be measured, its benchmark exits 3" in bench_report.tables(results)


@pytest.mark.parametrize(
    ("measured", "at_most", "verdict"), [(2.0, False, "yes"), (2.0, True, "NO"), (1.0, True, "yes")]
)
def test_a_promise_holds_or_not(measured: float, at_most: bool, verdict: str) -> None:
    assert bench_report.Bar("x", measured, 1.5, at_most).verdict == verdict


def test_the_floor_has_the_rows_behind_a_late_detection_and_a_whole_window() -> None:
    assert bench_estimators.num_applied(bench_estimators.stream(1.0))[5:15] == [1, 3] * 5
    found = bench_speed.measure_floor([1])
    assert [one["rows"] for one in found] == [3, 40]
    assert all(one["lapack_us"] > 0.0 and one["gtsam_us"] > 0.0 for one in found)


def test_the_streaming_table_has_both_streams_and_every_method(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "page.md"
    page.write_text("<!-- begin streaming -->\n<!-- end streaming -->\n")
    bench_streaming.main(
        tmp_path, duration_s=2.5, objects=3, rounds=2, methods="ekf-replay,ekf-backward-forward", page=page
    )
    text = (tmp_path / "streaming.md").read_text()
    assert capsys.readouterr().out == text
    assert text in page.read_text()
    for title in ("the demo", "3 objects"):
        rows = text[text.index(f"| {title} |") :].splitlines()[2:4]
        assert [row.split("|")[1].strip() for row in rows] == ["ekf-replay", "ekf-backward-forward"]
        asked_m, ready_m = ([float(row.split("|")[k].split()[0]) for row in rows] for k in (2, 3))
        assert max(asked_m) < 2.0
        assert asked_m != ready_m


def test_a_drive_of_many_laps_is_one_recording() -> None:
    messages = list(bench_memory.laps(1, 60.0))
    receipts_ns = [message.receipt_ns for message in messages]
    assert receipts_ns == sorted(receipts_ns)
    lists = [message for message in messages if isinstance(message, DetectionList) and message.sensor == "radar"]
    periods_ns = set(np.diff(sorted(message.stamp_ns for message in lists)).tolist())
    assert periods_ns == {50_000_000}  # also where a lap ends
    truth = [m for m in messages if isinstance(m, TruthState) and m.object_id == 0]
    steps_m = np.hypot(*np.diff([(m.x_m, m.y_m) for m in truth], axis=0).T)
    assert steps_m.max() < 1.1 * np.median(steps_m)


def test_the_memory_table_follows_one_run_over_its_laps(tmp_path: Path) -> None:
    bench_memory.main(tmp_path, duration_s=4.0, objects=1, estimator="ekf-replay", parts=4)
    text = (tmp_path / "memory.md").read_text()
    rows = [line.split("|") for line in text.splitlines() if line.startswith("| ")][1:]
    assert [float(row[1]) for row in rows] == pytest.approx([1 / 60, 2 / 60, 3 / 60, 4 / 60], abs=2e-3)
    assert all(float(row[2]) > 10.0 and int(row[4]) == 1 for row in rows)
    assert [path.name for path in tmp_path.iterdir()] == ["memory.md"]
