import io
import json
from collections.abc import Sequence
from pathlib import Path

import pytest
from evaluation_runs import ROUND, WEST, update, write_run
from rich.console import Console, RenderableType

from fgtrack.core.errors import CallError
from fgtrack.core.types import Disposition
from fgtrack.evaluation.labels import labelled
from fgtrack.evaluation.metrics import Metrics, evaluate
from fgtrack.evaluation.tables import (
    BACKWARD_FORWARD_NOTE,
    comparison_dict,
    comparison_tables,
    consistency_table,
    disposition_table,
    main_table,
    multi_object_table,
    residual_tables,
)
from fgtrack.io.run import Run

ESTIMATORS = ("ekf-backward-forward", "ekf-replay", "smoother")


def text_of(tables: Sequence[RenderableType], width: int = 120) -> str:
    console = Console(file=io.StringIO(), width=width)
    for table in tables:
        console.print(table)
    output = console.file
    assert isinstance(output, io.StringIO)
    return output.getvalue()


def a_run(folder: Path, estimator: str, *, truth: bool = True) -> Run:
    tracks = [[WEST.track(k, 1, along_m=0.3, across_m=0.4), ROUND.track(k, 2)] for k in range(4)]
    updates = {
        1: [
            update("lidar_cluster", tick=0, delay_ns=151_000_000, disposition=Disposition.BIRTH),
            update("lidar_cluster", delay_ns=151_000_000, index=1, nis=2.0, x_m=-0.5, y_m=0.25),
            update("radar_long_range", delay_ns=62_000_000, nis=3.0, x_m=1.0, y_m=2.0, speed_mps=-123.4),
        ]
    }
    rows = [*WEST.truth(range(4)), *ROUND.truth(range(4))] if truth else []
    return write_run(folder, tracks, truth=rows, updates=updates, meta={"estimator": estimator})


@pytest.fixture
def metrics(tmp_path: Path) -> dict[str, Metrics]:
    runs = [a_run(tmp_path / name, name) for name in ESTIMATORS]
    return {label: evaluate(run) for label, run in labelled(runs).items()}


def test_every_table_fits_a_terminal_of_120_columns(metrics: dict[str, Metrics]) -> None:
    tables = comparison_tables(metrics)
    wide = {f"race/{label}": one for label, one in metrics.items()}
    for shown in (tables, comparison_tables(wide)):
        lines = text_of(shown).splitlines()
        assert max(map(len, lines)) <= 120
        assert not any("…" in line for line in lines)
    assert len(tables) == 6
    for estimator in ESTIMATORS:
        assert f"race/{estimator} " in text_of([main_table(wide)])


def test_the_main_table_shows_errors_with_units(metrics: dict[str, Metrics]) -> None:
    text = text_of([main_table(metrics)])
    (row,) = [line for line in text.splitlines() if line.strip().startswith("smoother")]
    # position: 4 rows at 0.5 m, 4 at 0; along 0.3, across 0.4; tracked %, breaks/switches, false, precision
    expected = "0.354 0.212 0.283 0.000 0.000 100 0/0 0 1.00 2/2 1.00/1.00"
    assert row.split()[1:] == expected.split()
    for unit in ("[m]", "[rad]", "[m/s]", "[%]", "ms/tick"):
        assert unit in text


def test_the_multi_object_table_shows_gospa_scores_switches_and_the_time_to_confirm(tmp_path: Path) -> None:
    """WEST is 2.75 m off, with a late switch at tick 2; ROUND is missed; track 9 is false."""
    tracks = [[WEST.track(k, 1 if k < 2 else 2, along_m=2.75), WEST.track(k, 9, across_m=60.0)] for k in range(4)]
    updates = {
        0: [update(tick=-3, disposition=Disposition.BIRTH)],
        2: [update(tick=1, disposition=Disposition.OUT_OF_SEQUENCE, track_id=2)],
    }
    run = write_run(tmp_path / "run", tracks, truth=[*WEST.truth(range(4)), *ROUND.truth(range(4))], updates=updates)
    plain = write_run(tmp_path / "plain", tracks)
    metrics = {"run": evaluate(run), "plain": evaluate(plain)}
    text = text_of([multi_object_table(metrics)])
    rows = [line.split() for line in text.splitlines() if line.startswith((" run ", " plain "))]
    # GOSPA^2 = 2.75^2 + 12.5 + 12.5 at every tick; MOTA 1 - (4 + 4 + 1) / 8; IDF1 2 * 2 / (8 + 8)
    # a similarity of 0.725 passes 14 of 19 bounds: DetA 14/19 * 4/12, AssA 14/19 * 1/2, HOTA 14/19 sqrt(1/6)
    (_, *units), (_, *shown), (_, *dashes) = rows
    assert units == [*["[m]"] * 4, *["[%]"] * 5, "late", "[s]"]
    assert shown == ["5.71", "2.75", "3.54", "3.54", "-12.5", "25.0", "30.1", "24.6", "36.8", "1/1", "0.060"]
    assert dashes == ["-"] * 11


def test_the_consistency_table_shows_means_bands_and_whiteness(tmp_path: Path) -> None:
    flips = [update(tick=k, nis=5.0, x_m=(-1.0) ** k, y_m=0.0) for k in range(30)]
    tracks = [[WEST.track(k, 1, along_m=3.0)] for k in range(40)]
    updates = {k: [record, update("radar", tick=k, nis=1.0, speed_mps=2.0)] for k, record in enumerate(flips)}
    metrics = {"run": evaluate(write_run(tmp_path / "run", tracks, truth=WEST.truth(range(40)), updates=updates))}
    lines = text_of([consistency_table(metrics)]).splitlines()
    rows = [" ".join(line.split()) for line in lines]
    assert "run NEES position 40 9.00 2.00 1.43 to 2.67 - -" in rows
    assert "NEES state 40 9.00 4.00 3.17 to 4.92 - -" in rows
    assert "NIS lidar 30 5.00 2.00 1.35 to 2.78 -0.967 ± 0.352 100" in rows
    assert "NIS radar 30 1.00 1.00 0.560 to 1.57 0.967 ± 0.352 100" in rows


def test_without_truth_the_consistency_table_has_the_sensors(tmp_path: Path) -> None:
    metrics = {"a": evaluate(a_run(tmp_path / "without", "smoother", truth=False))}
    text = text_of([consistency_table(metrics)])
    assert "NEES position" not in text
    assert "NIS lidar_cluster" in text
    assert multi_object_table(metrics).row_count == 0


def test_a_residual_table_shows_mean_deviation_nis_and_delay(metrics: dict[str, Metrics]) -> None:
    lidar, radar = residual_tables(metrics)
    text = text_of([lidar])
    assert "Residuals of lidar_cluster" in text
    # WEST drives west: along is -x, across is -y
    assert "0.500 ± 0.000" in text
    assert "-0.250 ± 0.000" in text
    assert "151/151" in text
    assert "speed" not in text
    assert "-123 ± 0.000" in text_of([radar])


def test_the_disposition_table_sums_up_and_names_what_never_occurred(metrics: dict[str, Metrics]) -> None:
    text = text_of([disposition_table(metrics)])
    rows = [line.split() for line in text.splitlines() if "lidar_cluster" in line]
    assert [row[-3:] for row in rows] == [["1", "1", "2"]] * 3
    assert "none: out of sequence, beyond window, too old, gated" in text.replace("\n", " ")


def test_the_note_on_backward_forward_stands_where_it_is_shown_only(metrics: dict[str, Metrics]) -> None:
    tables = comparison_tables(metrics)
    assert all(BACKWARD_FORWARD_NOTE in text_of([table]) for table in tables)
    others = {label: one for label, one in metrics.items() if label != "ekf-backward-forward"}
    assert BACKWARD_FORWARD_NOTE not in text_of(comparison_tables(others))
    assert comparison_dict(metrics)["notes"] == [BACKWARD_FORWARD_NOTE]
    assert comparison_dict(others)["notes"] == []


def test_a_name_in_brackets_is_shown_as_it_is(tmp_path: Path) -> None:
    metrics = {"[bold]run": evaluate(a_run(tmp_path / "run", "smoother"))}
    assert text_of(comparison_tables(metrics)).count("[bold]run") == 6


def test_runs_without_truth_have_a_table_without_errors(tmp_path: Path) -> None:
    without = evaluate(a_run(tmp_path / "without", "smoother", truth=False))
    assert "RMSE" not in text_of([main_table({"a": without})])
    both = {"a": without, "b": evaluate(a_run(tmp_path / "with", "smoother"))}
    (row,) = [line for line in text_of([main_table(both)]).splitlines() if line.startswith(" a ")]
    assert row.split()[1:10] == ["-"] * 9


def test_a_run_without_detections_has_no_empty_tables(tmp_path: Path) -> None:
    assert len(comparison_tables({"a": evaluate(write_run(tmp_path / "run", [[]]))})) == 1


def test_the_dictionary_is_strict_json(metrics: dict[str, Metrics]) -> None:
    plain = comparison_dict(metrics)
    assert json.loads(json.dumps(plain, allow_nan=False)) == plain
    assert list(plain["runs"]) == list(ESTIMATORS)


def test_labels_are_as_long_as_they_must_be(tmp_path: Path) -> None:
    paths = [tmp_path / "dry" / "smoother", tmp_path / "wet" / "smoother"]
    runs = [write_run(path) for path in paths]
    assert list(labelled(runs)) == ["dry/smoother", "wet/smoother"]
    assert list(labelled(runs[:1])) == ["smoother"]


def test_a_label_names_the_estimator(tmp_path: Path) -> None:
    run = write_run(tmp_path / "first", meta={"estimator": "ekf-replay"})
    assert list(labelled([run])) == ["first (ekf-replay)"]


def test_the_same_run_twice_is_refused(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run")
    with pytest.raises(CallError, match="given twice"):
        labelled([run, run])
