"""What the tables of a comparison say, and the forms that they take: the same numbers in each of them."""

import csv
import io
import json
import math
from collections.abc import Mapping
from dataclasses import replace
from itertools import groupby
from pathlib import Path

import numpy as np
import pytest
from evaluation_runs import ROUND, WEST, update, write_run
from rich.console import Console

from fgtrack.core.errors import CallError
from fgtrack.core.types import Disposition
from fgtrack.estimation.failures import Failures
from fgtrack.evaluation.compare import BACKWARD_FORWARD_NOTE, compare, comparison
from fgtrack.evaluation.metrics import evaluate
from fgtrack.evaluation.runs import JudgedRun, labelled
from fgtrack.evaluation.statistics import Distribution
from fgtrack.evaluation.tables import Column, Table, Tables, short
from fgtrack.io.run import Run

ESTIMATORS = ("ekf-backward-forward", "ekf-replay", "smoother")
SENSORS = ("lidar_cluster", "radar_long_range")

#: Every table of a comparison of runs with truth, and the column beside `run` that tells its rows apart.
TABLES = {
    "differences": "quantity",
    "tracking": None,
    "multi_object": None,
    "lag": "lag",
    "consistency": "of",
    **{f"residuals_{sensor}": None for sensor in SENSORS},
    "dispositions": "sensor",
    "failures": None,
    "residuals": None,
    "residuals_by": "of",
    "sensed": "sensor",
    "latency": None,
    "predictions": "predictor",
}


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
    smoothed = {3: [WEST.later(k, 1, along_m=0.1) for k in range(2)]} if estimator == "smoother" else {}
    meta = {"estimator": estimator, "failures": Failures().as_meta()["failures"]}
    return write_run(folder, tracks, truth=rows, updates=updates, smoothed=smoothed, meta=meta)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Run]:
    folder = tmp_path_factory.mktemp("runs")
    return {name: a_run(folder / name, name) for name in ESTIMATORS}


@pytest.fixture(scope="module")
def tables(runs: dict[str, Run]) -> Tables:
    return compare(*runs.values())


def rows_of(table: Table) -> list[str]:
    """Rows as they are shown."""
    return [" ".join(cells) for cells in zip(*(column.cells for column in table.shown), strict=True)]


def row_of(table: Table, row: int) -> dict[str, float]:
    return {name: column[row] for name, column in table.items() if name not in (*table.row_keys, "estimator")}


# --- forms


def test_the_tables_stand_in_their_order(tables: Tables) -> None:
    assert {name: (*table.row_keys, None)[1] for name, table in tables.items()} == TABLES
    assert all(table.num_rows >= len(ESTIMATORS) for table in tables.values())


@pytest.mark.parametrize("name", TABLES)
def test_csv_gives_the_numbers_back(tables: Tables, name: str) -> None:
    (*_,) = rows = list(csv.DictReader(io.StringIO(tables.to_csv(name))))
    for column, values in tables[name].items():
        read = [row[column] for row in rows]
        if values.dtype.kind == "U":
            assert read == values.tolist()
        else:
            np.testing.assert_array_equal([float(cell or math.nan) for cell in read], values)


def test_csv_of_all_tables_has_every_number_once(tables: Tables) -> None:
    rows = list(csv.DictReader(io.StringIO(tables.to_csv())))
    found = {(row["table"], row["run"], row["part"], row["quantity"]): row["value"] for row in rows}
    assert len(found) == len(rows) == sum(t.num_rows * (len(t) - len(t.row_keys)) for t in tables.values())
    rmse_m = tables["tracking"]["position_rmse_m"][2]
    assert float(found["tracking", "smoother", "", "position_rmse_m"]) == rmse_m
    assert found["dispositions", "smoother", "lidar_cluster", "birth"] == "1"


@pytest.mark.parametrize("name", TABLES)
def test_markdown_has_the_cells_that_are_shown(tables: Tables, name: str) -> None:
    lines = [line for line in tables.in_full().to_markdown(name).splitlines() if line.startswith("|")]
    head, rule, *rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert len(head) == len(rule) == len(tables[name].shown)
    shown = [list(cells) for cells in zip(*(column.cells for column in tables[name].shown), strict=True)]
    assert [row[1:] for row in rows] == [row[1:] for row in shown]
    assert [row[0] for row in rows if row[0]] == [name for name, _ in groupby(row[0] for row in shown)]


@pytest.mark.parametrize("name", TABLES)
def test_latex_has_a_cell_for_every_column(tables: Tables, name: str) -> None:
    lines = tables.in_full().to_latex(name).splitlines()
    rows = [line for line in lines if line.endswith(r" \\")]
    assert {row.count(" & ") + 1 for row in rows} == {len(tables[name].shown)}
    assert len(rows) == 1 + tables[name].num_rows
    shown = "".join(line for line in lines if not line.startswith("%"))
    assert "±" not in shown
    assert not any(char in shown.replace(f"\\{char}", "") for char in "%_#")


def test_what_means_something_in_latex_or_markdown_is_escaped() -> None:
    rows = ["50%_a&b|c", r"{x}^\~#$", "1 ± 2 <3"]
    table = Table("a_b", [Column("run", ("run",), lambda row: (row,), left=True)], rows)
    cells = table.to_latex().splitlines()[7:10]
    assert cells == [
        r"50\%\_a\&b|c \\",
        r"\{x\}\textasciicircum{}\textbackslash{}\textasciitilde{}\#\$ \\",
        r"1 $\pm$ 2 $<$3 \\",
    ]
    assert r"\caption{a\_b}" in table.to_latex()
    assert r"| 50%_a&b\|c |" in table.to_markdown().splitlines()


def test_names_can_be_neither_cells_links_nor_elements() -> None:
    rows = [r"a\|b", "<img src=x>", "[x](javascript:y)", "*z"]
    table = Table("<t>", [Column("run", ("run",), lambda row: (row,), left=True)], rows, notes=["<n>"])
    assert table.to_markdown().splitlines()[0] == r"### \<t>"
    assert table.to_markdown().splitlines()[4:] == [
        r"| a\\\|b |",
        r"| \<img src=x> |",
        r"| [x]\(javascript:y) |",
        "| *z |",
        "",
        r"- \<n>",
    ]
    assert [row[:3] for row in table.to_latex().splitlines()[9:11]] == ["{}[", "{}*"]


def test_a_column_has_several_numbers_in_a_cell_and_a_dash_for_none() -> None:
    rows: list[tuple[float, float] | None] = [(0.00123, 0.0156), None, (math.nan, 2.0)]
    table = Table("times", [Column("ms/\ntick", ("p50_s", "p99_s"), lambda row: row, "{}/{}", 1e3)], rows)
    (shown,) = table.shown
    assert shown.cells == ("1.23/15.6", "-", "-/2000")
    np.testing.assert_array_equal(table["p99_s"], [0.0156, math.nan, 2.0])
    assert table.to_csv() == "p50_s,p99_s\n0.00123,0.0156\n,\n,2.0\n"
    assert "| ms/tick |" in table.to_markdown()


def test_a_table_is_a_data_frame(tables: Tables) -> None:
    pandas = pytest.importorskip("pandas", reason="pandas is not installed")
    for table in tables.values():
        frame = pandas.DataFrame(table)
        assert frame.shape == (table.num_rows, len(table))
        numbers = [column for column in frame if column not in (*table.row_keys, "estimator", "standing")]
        assert all(frame[column].dtype.kind in "if" for column in numbers)


def test_tables_fit_a_terminal_of_120_columns(runs: dict[str, Run], tables: Tables) -> None:
    wide = compare([JudgedRun(f"race/{label}", run) for label, run in runs.items()])
    for shown in (str(tables), str(tables.in_full()), str(wide.in_full())):
        assert max(map(len, shown.splitlines())) <= 120
        assert "…" not in shown
    assert all(f"race/{estimator} " in str(wide["tracking"]) for estimator in ESTIMATORS)


def test_on_a_narrow_terminal_the_columns_that_do_not_fit_stand_below(tables: Tables) -> None:
    console = Console(width=80, file=io.StringIO(), color_system=None)
    with console.capture() as capture:
        console.print(tables["tracking"].in_full())
    first, second = capture.get().split("continued:\n")
    assert max(map(len, (first + second).splitlines())) <= 80
    assert "…" not in first + second
    for part in (first, second):
        assert all(part.count(f" {estimator} ") == 1 for estimator in ESTIMATORS)
    headings = [column.heading.split("\n")[0] for column in tables["tracking"].shown]
    assert [(first + second).count(heading) for heading in headings[2:5]] == [1, 1, 1]
    assert "continued" not in str(tables.in_full())


def test_few_tables_columns_and_rows_are_shown_unless_all_are_asked_for(tables: Tables) -> None:
    few, full = str(tables), str(tables.in_full())
    for detail in ("Multi-object metrics", "Consistency (", "Residuals of", "preci-", "speed [m/s]"):
        assert detail not in few
        assert detail in full
    assert "across" not in tables.to_markdown()
    assert "across" in tables.in_full().to_markdown()
    assert "across" in tables.to_csv() == tables.in_full().to_csv(), "files with all digits have everything"
    assert tables.to_dict() == tables.in_full().to_dict()
    assert (tables.has_more, tables.in_full().has_more) == (True, False)
    notes = str(tables["tracking"]).splitlines()
    assert not any(line.startswith("precision:") for line in notes), "the note of a column that is not shown"
    assert any(line.startswith("tracked:") for line in notes)


def test_few_dispositions_add_up(tables: Tables) -> None:
    table = tables["dispositions"]
    (_, rows) = str(table).split("─\n")
    for line, total in zip(rows.splitlines(), table["detections"].tolist(), strict=False):
        fused, late, merged, refused, shown = map(int, line.split()[-5:])
        assert late <= fused
        assert fused + merged + refused == shown == total


@pytest.mark.parametrize("width", [40, 60, 80, 100])
@pytest.mark.parametrize("label", ["{}", "a-long-name-of-a-campaign-of-2026/wet-and-cold/{}"])
def test_no_row_is_longer_than_the_terminal_and_every_name_is_whole(
    runs: dict[str, Run], width: int, label: str
) -> None:
    tables = compare([JudgedRun(label.format(name), run) for name, run in runs.items()])
    console = Console(width=width, file=io.StringIO(), color_system=None)
    for shown in (tables, tables.in_full()):
        with console.capture() as capture:
            console.print(shown)
        lines = capture.get().splitlines()
        assert max(map(len, lines)) <= width
        assert all(label.format(name) in "".join(lines) for name in runs)  # one longer than a line goes on in the next
        assert "…" not in capture.get()


def test_names_too_long_to_stand_beside_stand_above_their_rows() -> None:
    rows = [("a" * 28, "x", 1.0), ("a" * 28, "y", 2.0), ("b", "x", 3.0)]
    columns: list[Column[tuple[str, str, float]]] = [
        Column("run", ("run",), lambda row: row[:1], left=True),
        Column("of", ("of",), lambda row: row[1:2], left=True),
        Column("value", ("value",), lambda row: row[2:]),
    ]
    console = Console(width=30, file=io.StringIO(), color_system=None)
    with console.capture() as capture:
        console.print(Table("numbers", columns, rows, row_keys=("run", "of")))
    assert capture.get().splitlines()[2:] == [
        *(" run", "   of  value", "────────────"),
        *(" " + "a" * 28, "   x    1.00", "   y    2.00", " b", "   x    3.00"),
    ]


def test_a_number_and_its_unit_stay_on_one_line() -> None:
    tables = Tables({}, verdict=("b is worse by 0.14 m (0.1 to 0.2), which is 52 % of it.",))
    for width in range(12, 60):
        console = Console(width=width, file=io.StringIO(), color_system=None)
        with console.capture() as capture:
            console.print(tables)
        lines = capture.get().splitlines()
        assert max(map(len, lines)) <= width
        assert any("0.14 m" in line for line in lines)
        assert any("52 %" in line for line in lines)


def test_the_best_value_is_bold_in_every_form_that_knows_bold() -> None:
    rows = [("a", 1.0), ("b", 2.0)]
    columns: list[Column[tuple[str, float]]] = [
        Column("run", ("run",), lambda row: row[:1], left=True),
        Column("value", ("value",), lambda row: row[1:], bold=lambda row: row[1] < 2.0),
    ]
    table = Table("errors", columns, rows)
    assert "| a | **1.00** |\n| b | 2.00 |" in table.to_markdown()
    assert "a & \\textbf{1.00} \\\\\nb & 2.00" in table.to_latex()
    console = Console(width=80, file=io.StringIO(), force_terminal=True, color_system="standard")
    with console.capture() as capture:
        console.print(table)
    assert "\x1b[1m1.00" in capture.get()
    assert "\x1b[1m2.00" not in capture.get()


def test_the_verdict_stands_first_in_every_form(tables: Tables) -> None:
    assert tables.verdict
    for text in (str(tables), tables.to_markdown(), tables.to_latex()):
        assert text.lstrip("-% ").startswith(tables.verdict[0].split(" (")[0])
    assert tables.to_dict()["verdict"] == list(tables.verdict)
    assert tables.verdict[0] not in tables.to_markdown("tracking")


def test_what_is_printed_is_what_the_console_shows(tables: Tables) -> None:
    console = Console(width=120, file=io.StringIO(), color_system=None)
    with console.capture() as capture:
        console.print(tables)
    assert f"{tables}\n" == capture.get()
    assert str(tables["lag"]) in str(tables)
    assert str(tables["lag"].in_full()) in str(tables.in_full())
    assert tables._repr_html_().count("<table>") == len(tables._filled())
    assert repr(tables).splitlines()[0] == "Tables"
    assert set(repr(tables).splitlines()[-1].strip().split(", ")) <= set(TABLES)


def test_json_has_the_metrics_the_notes_and_the_tables(tables: Tables) -> None:
    plain = tables.to_dict()
    assert json.loads(json.dumps(plain, allow_nan=False)) == plain
    assert list(plain["runs"]) == list(ESTIMATORS)
    assert plain["notes"] == [BACKWARD_FORWARD_NOTE]
    assert plain["tables"]["lag"][0]["position_reduction"] is None
    assert plain["tables"]["residuals_lidar_cluster"][1]["delay_mean_s"] == pytest.approx(0.151)


def test_a_name_in_brackets_is_shown_as_it_is(runs: dict[str, Run]) -> None:
    tables = comparison({"[bold]run": evaluate(runs["smoother"])})
    assert str(tables.in_full()).count(" [bold]run ") == len(tables) - 1  # of one run there are no differences


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.9999, "1.00"),
        (9.996, "10.0"),
        (99.96, "100"),
        (12345.6, "12346"),
        (-0.0001, "0.000"),
        (math.nan, "-"),
        (7, "7"),
    ],
)
def test_numbers_have_three_significant_digits_and_no_more_than_three_decimals(value: float, text: str) -> None:
    assert short(value) == text


# --- what they say


def test_the_tracking_table_has_errors_continuity_and_times(tables: Tables) -> None:
    table = tables["tracking"]
    # position: 4 rows at 0.5 m, 4 at 0; along 0.3, across 0.4; tracked %, breaks/switches, false, precision
    assert rows_of(table)[2] == "smoother 0.354 0.212 0.283 0.000 0.000 100 0/0 0 1.00 2/2 1.00/1.00"
    assert row_of(table, 2) == pytest.approx(
        {
            "position_rmse_m": math.sqrt(0.125),
            "along_rmse_m": 0.3 / math.sqrt(2.0),
            "across_rmse_m": 0.4 / math.sqrt(2.0),
            **dict.fromkeys(("yaw_rmse_rad", "speed_rmse_mps", "breaks", "id_switches", "false_tracks"), 0.0),
            **dict.fromkeys(("tracked_share", "tracked_share_in_sight"), 1.0),
            "precision": 1.0,
            "num_tracks": 2,
            "num_confirmed": 2,
            **dict.fromkeys(("time_per_tick_p50_s", "time_per_tick_p99_s"), 0.001),
        },
        abs=1e-9,
    )
    units = [column.heading.split("\n")[-1] for column in table.shown]
    assert units[1:7] == ["[m]", "[m]", "[m]", "[rad]", "[m/s]", "[%]"]
    assert "RMSE" in table.title


def test_several_numbers_of_a_cell_stand_in_their_order(runs: dict[str, Run]) -> None:
    metrics = evaluate(runs["smoother"])
    assert metrics.truth is not None
    west = replace(metrics.truth.objects[7], breaks=3, id_switches=2, late_id_switches=1)
    truth = replace(metrics.truth, objects={7: west})
    times = Distribution(9, mean=0.004, p50=0.001, p90=0.002, p99=0.003)
    tables = comparison({"run": replace(metrics, truth=truth, num_tracks=5, time_per_tick_s=times)})
    assert rows_of(tables["tracking"])[0].split()[-5:] == ["3/2", "0", "1.00", "5/2", "1.00/3.00"]
    assert rows_of(tables["multi_object"])[0].split()[-2] == "2/1"


def test_the_multi_object_table_has_gospa_scores_switches_and_the_time_to_confirm(tmp_path: Path) -> None:
    """WEST is 2.75 m off, with a late switch at tick 2; ROUND is missed; track 9 is false."""
    tracks = [[WEST.track(k, 1 if k < 2 else 2, along_m=2.75), WEST.track(k, 9, across_m=60.0)] for k in range(4)]
    updates = {
        0: [update(tick=-3, disposition=Disposition.BIRTH)],
        2: [update(tick=1, disposition=Disposition.OUT_OF_SEQUENCE, track_id=2)],
    }
    run = write_run(tmp_path / "run", tracks, truth=[*WEST.truth(range(4)), *ROUND.truth(range(4))], updates=updates)
    table = comparison({"run": evaluate(run), "plain": evaluate(write_run(tmp_path / "plain", tracks))})["multi_object"]
    # GOSPA^2 = 2.75^2 + 12.5 + 12.5 at every tick; MOTA 1 - (4 + 4 + 1) / 8; IDF1 2 * 2 / (8 + 8)
    # a similarity of 0.725 passes 14 of 19 bounds: DetA 14/19 * 4/12, AssA 14/19 * 1/2, HOTA 14/19 sqrt(1/6)
    assert rows_of(table) == [
        "run 5.71 2.75 3.54 3.54 0.000 5.71 -12.5 25.0 30.1 24.6 36.8 1/1 0.060",
        f"plain{' -' * 13}",
    ]
    assert (table["mota"][0], table["assa"][0]) == pytest.approx((-0.125, 7 / 19))


def test_the_lag_table_says_what_waiting_brings(tables: Tables) -> None:
    table = tables["lag"]
    assert rows_of(table)[2:] == [
        "smoother 0 8 0.354 - - 0.000 - 0.000 - 0.125",
        "smoother window 2 0.100 80.0 - 0.000 - 0.000 - 0.010",  # too short for an interval
    ]
    assert table["lag"].tolist() == ["0", "0", "0", "window"]
    np.testing.assert_array_equal(table["lag_s"], [0.0, 0.0, 0.0, math.nan])


def test_of_many_lags_eight_are_shown_from_the_first_to_the_last(runs: dict[str, Run]) -> None:
    metrics = evaluate(runs["smoother"])
    present, final = metrics.lagged
    lags = tuple(replace(final, lag_s=k / 10) for k in range(1, 21))
    table = comparison({"smoother": replace(metrics, lagged=(present, *lags, final))})["lag"]
    assert table["lag"].tolist() == ["0", "0.1", "0.4", "0.6", "0.9", "1.2", "1.5", "1.7", "2", "window"]
    assert any("metrics.json has all" in note for note in table.notes)
    assert not any("metrics.json has all" in note for note in comparison({"smoother": metrics})["lag"].notes)


def test_the_consistency_table_has_means_bands_and_whiteness(tmp_path: Path) -> None:
    flips = [update(tick=k, nis=5.0, x_m=(-1.0) ** k, y_m=0.0) for k in range(30)]
    tracks = [[WEST.track(k, 1, along_m=3.0)] for k in range(40)]
    updates = {k: [record, update("radar", tick=k, nis=1.0, speed_mps=2.0)] for k, record in enumerate(flips)}
    run = write_run(tmp_path / "run", tracks, truth=WEST.truth(range(40)), updates=updates)
    assert rows_of(comparison({"run": evaluate(run)})["consistency"]) == [
        "run NEES position 40 9.00 2.00 1.43 to 2.67 - -",
        "run NEES state 40 9.00 4.00 3.17 to 4.92 - -",
        "run NIS lidar 30 5.00 2.00 1.35 to 2.78 -0.967 ± 0.352 100",
        "run NIS radar 30 1.00 1.00 0.560 to 1.57 0.967 ± 0.352 100",
    ]


def test_a_residual_table_has_mean_standard_deviation_nis_and_delay(tables: Tables) -> None:
    # WEST drives west: along is -x, across is -y
    lidar, radar = (tables[f"residuals_{sensor}"] for sensor in SENSORS)
    assert rows_of(lidar)[2] == "smoother 0.500 ± 0.000 -0.250 ± 0.000 2.00 2.00 151/151"
    assert rows_of(radar)[2] == "smoother -1.00 ± 0.000 -2.00 ± 0.000 -123 ± 0.000 3.00 3.00 62.0/62.0"
    assert lidar["x_mean_m"].tolist() == [-0.5] * 3  # not shown beside along and across, but there


def test_the_disposition_table_sums_up_and_names_what_never_occurred(tables: Tables) -> None:
    table = tables["dispositions"]
    assert rows_of(table)[-2:] == ["smoother lidar_cluster 1 1 2", "smoother radar_long_range 0 1 1"]
    assert table.notes[0].startswith("no detection was out of sequence or beyond window or too old or gated")
    assert sum(int(table[name.value].sum()) for name in Disposition) == table["detections"].sum() == 9


def test_the_note_on_backward_forward_stands_where_it_is_shown_only(runs: dict[str, Run], tables: Tables) -> None:
    assert [name for name, table in tables.items() if BACKWARD_FORWARD_NOTE in table.notes] == ["tracking"]
    assert str(tables.in_full()).count(BACKWARD_FORWARD_NOTE) == str(tables).count(BACKWARD_FORWARD_NOTE) == 1
    others = comparison({"smoother": evaluate(runs["smoother"])})
    assert BACKWARD_FORWARD_NOTE not in str(others)
    assert others.to_dict()["notes"] == []


def test_runs_without_truth_have_no_errors(tmp_path: Path, runs: dict[str, Run]) -> None:
    without = evaluate(a_run(tmp_path / "without", "smoother", truth=False))
    alone = comparison({"a": without})
    headings = [column.heading for column in alone["tracking"].shown]
    assert headings == ["run", "tracks all/\nconfirmed", "ms/tick\np50/p99"]
    assert np.isnan(alone["tracking"]["position_rmse_m"]).all()
    assert alone["consistency"]["of"].tolist() == [f"NIS {sensor}" for sensor in SENSORS]
    assert "Error against lag" not in str(alone)
    assert "Multi-object" not in str(alone)
    both = comparison({"a": without, "b": evaluate(runs["smoother"])})
    assert rows_of(both["tracking"])[0] == f"a{' -' * 9} 2/2 1.00/1.00"


def test_a_run_without_detections_shows_no_empty_tables(tmp_path: Path) -> None:
    tables = comparison({"a": evaluate(write_run(tmp_path / "run", [[]]))})
    assert tables["dispositions"].num_rows == tables["lag"].num_rows == 0
    for text in (str(tables), tables.to_markdown()):
        assert "Tracking" in text
        assert "Dispositions" not in text


# --- which runs


def contents(folder: Path) -> Mapping[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_runs_are_compared_from_folders_and_from_memory(tmp_path: Path) -> None:
    kept = replace(a_run(tmp_path / "elsewhere", "smoother"), path=None)
    a_run(tmp_path / "all" / "ekf-replay", "ekf-replay")
    before = contents(tmp_path)
    tables = compare(tmp_path / "all", kept, replace(kept))
    assert tables["tracking"]["run"].tolist() == ["ekf-replay", "smoother", "smoother #2"]
    assert contents(tmp_path) == before, "only the command writes metrics.json"
    assert str(compare(str(tmp_path / "all/ekf-replay"))) == str(compare([tmp_path / "all"]))


def test_what_is_no_run_is_refused(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(CallError, match="no run folder"):
            compare(path)
    with pytest.raises(CallError, match="no run is given"):
        compare()


def test_labels_are_as_long_as_they_must_be(tmp_path: Path) -> None:
    runs = [write_run(tmp_path / "dry" / "smoother"), write_run(tmp_path / "wet" / "smoother")]
    assert list(labelled(runs)) == ["dry/smoother", "wet/smoother"]
    assert list(labelled(runs[:1])) == ["smoother"]
    assert list(labelled([replace(runs[0], meta={"estimator": "ekf-replay"})])) == ["smoother (ekf-replay)"]


def test_the_same_run_twice_is_refused(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run")
    for same in (run, replace(run, path=None)):
        with pytest.raises(CallError, match="given twice"):
            labelled([same, same])
