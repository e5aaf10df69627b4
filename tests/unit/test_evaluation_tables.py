"""Tables of a comparison: their numbers, and the forms that they take."""

import csv
import io
import json
import math
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from unit.evaluation_runs import ROUND, WEST, update, write_run

from fgtrack.core.errors import CallError
from fgtrack.core.types import Disposition
from fgtrack.evaluation.metrics import Metrics, evaluate
from fgtrack.evaluation.runs import EvaluatedRun, labelled
from fgtrack.evaluation.scores.statistics import Distribution
from fgtrack.evaluation.tables import Column, Table, Tables, short, two_digits
from fgtrack.evaluation.tables.compare import compare
from fgtrack.runs import Run

ESTIMATORS = ("ekf-backward-forward", "ekf-replay", "smoother")
SENSORS = ("lidar_cluster", "radar_long_range")

#: Every table of a comparison of runs with truth, and what identifies its rows.
TABLES = {
    "differences": ("run", "quantity"),
    "tracking": ("run",),
    "multi_object": ("run",),
    "lag": ("run", "lag"),
    "consistency": ("run", "of"),
    **{f"residuals_{sensor}": ("run",) for sensor in SENSORS},
    "dispositions": ("run", "sensor"),
    "revisions": ("run",),
    "decisions": ("run",),
}


def a_run(folder: Path, estimator: str, *, truth: bool = True) -> Run:
    tracks = [
        [WEST.track(k, 1, along_m=0.3, across_m=0.4), ROUND.track(k, 2)]
        for k in range(4)
    ]
    updates = {
        1: [
            update(
                "lidar_cluster",
                tick=0,
                delay_ns=151_000_000,
                disposition=Disposition.BIRTH,
            ),
            update(
                "lidar_cluster",
                delay_ns=151_000_000,
                index=1,
                nis=2.0,
                x_m=-0.5,
                y_m=0.25,
            ),
            update(
                "radar_long_range",
                delay_ns=62_000_000,
                nis=3.0,
                x_m=1.0,
                y_m=2.0,
                speed_mps=-123.4,
            ),
        ]
    }
    rows = [*WEST.truth(range(4)), *ROUND.truth(range(4))] if truth else []
    smoothed = (
        {3: [WEST.later(k, 1, along_m=0.1) for k in range(2)]}
        if estimator == "smoother"
        else {}
    )
    return write_run(
        folder,
        tracks,
        truth=rows,
        updates=updates,
        smoothed=smoothed,
        meta={"estimator": estimator},
    )


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Run]:
    folder = tmp_path_factory.mktemp("runs")
    return {name: a_run(folder / name, name) for name in ESTIMATORS}


@pytest.fixture(scope="module")
def tables(runs: dict[str, Run]) -> Tables:
    return compare(*runs.values())


def rows_of(tables: Tables, name: str) -> list[str]:
    """Rows as they are shown in full."""
    table = tables.tables[name].in_full()
    return [
        " ".join(column.cell(record) for column in table.shown)
        for record in table.records
    ]


def evaluated(label: str, run: Run, metrics: Metrics) -> EvaluatedRun:
    """A run with these metrics."""
    one = EvaluatedRun(label, run)
    one.__dict__["metrics"] = metrics
    return one


def printed(shown: Tables | Table, width: int) -> str:
    console = Console(width=width, file=io.StringIO(), color_system=None)
    with console.capture() as capture:
        console.print(shown)
    return capture.get()


# --- forms


def test_a_table_is_a_data_frame_and_csv_and_json_give_its_numbers(
    tables: Tables,
) -> None:
    assert {name: tuple(table.keys) for name, table in tables.tables.items()} == TABLES
    values = {}
    for name, table in tables.tables.items():
        frame = tables[name]
        numbers = [
            column
            for column in frame
            if column not in (*table.keys, "estimator", "standing")
        ]
        assert all(frame[column].dtype.kind in "if" for column in numbers)
        # These runs lack the values of detections, so there are no decisions to judge.
        assert len(frame) >= len(ESTIMATORS) or name == "decisions"
        read = list(csv.DictReader(io.StringIO(table.to_csv())))
        for column in numbers:
            np.testing.assert_array_equal(
                [float(row[column] or math.nan) for row in read], frame[column]
            )
        for row in frame.to_dict("records"):
            part = row[table.keys[1]] if len(table.keys) > 1 else ""
            values |= {
                (name, row["run"], part, key): row[key]
                for key in frame
                if key not in table.keys
            }
    rows = list(csv.DictReader(io.StringIO(tables.to_csv())))
    found = {
        (row["table"], row["run"], row["part"], row["quantity"]): row["value"]
        for row in rows
    }
    assert len(rows) == len(found)
    assert found.keys() == values.keys()
    assert (
        float(found["tracking", "smoother", "", "position_rmse_m"])
        == tables["tracking"]["position_rmse_m"][2]
    )
    plain = tables.to_dict()
    assert json.loads(json.dumps(plain, allow_nan=False)) == plain
    assert list(plain["runs"]) == list(ESTIMATORS)
    assert plain["tables"]["lag"][0]["position_reduction"] is None
    assert plain["verdict"] == list(tables.verdict)


@pytest.mark.parametrize("name", TABLES)
def test_markdown_and_latex_have_a_cell_for_every_column(
    tables: Tables, name: str
) -> None:
    table = tables.tables[name].in_full()
    lines = [line for line in table.to_markdown().splitlines() if line.startswith("|")]
    if not table.records:  # runs without detections have no decisions
        assert name == "decisions"
        assert len(lines) == 2
        return
    head, _, *rows = [
        [cell.strip() for cell in line.strip("|").split("|")] for line in lines
    ]
    assert len(head) == len(table.shown)
    shown = [
        [column.cell(record) for column in table.shown] for record in table.records
    ]
    assert [row[1:] for row in rows] == [row[1:] for row in shown]
    assert [row[0] for row in rows if row[0]] == list(
        dict.fromkeys(row[0] for row in shown)
    )
    lines = table.to_latex().splitlines()
    assert {line.count(" & ") + 1 for line in lines if line.endswith(r" \\")} == {
        len(head)
    }
    text = "".join(line for line in lines if not line.startswith("%"))
    assert "±" not in text
    assert not any(char in text.replace(f"\\{char}", "") for char in "%_#")


def test_special_characters_are_escaped_and_names_are_neither_cells_links_nor_elements() -> (
    None
):
    names = [
        "50%_a&b|c",
        r"{x}^\~#$",
        "1 ± 2 <3",
        r"a\|b",
        "<img src=x>",
        "[x](javascript:y)",
        "[bold]q",
    ]
    table = Table(
        "<a_b>",
        [{"run": name} for name in names],
        [Column("run", left=True)],
        notes=["<n>"],
    )
    latex = table.to_latex().splitlines()
    assert latex[7:10] == [
        r"50\%\_a\&b|c \\",
        r"\{x\}\textasciicircum{}\textbackslash{}\textasciitilde{}\#\$ \\",
        r"1 $\pm$ 2 $<$3 \\",
    ]
    assert table.to_markdown().splitlines()[0] == r"### \<a_b>"
    assert table.to_markdown().splitlines()[4:] == [
        r"| 50%_a&b\|c |",
        r"| {x}^\\~#$ |",
        r"| 1 ± 2 \<3 |",
        r"| a\\\|b |",
        r"| \<img src=x> |",
        r"| [x]\(javascript:y) |",
        "| [bold]q |",
        "",
        r"- \<n>",
    ]
    html = table.to_html()
    assert "<img" not in html
    assert "&lt;img src=x&gt;" in html
    assert " [bold]q" in str(table)


def test_a_column_has_several_numbers_in_a_cell_and_a_dash_for_none() -> None:
    records = [
        {"p50_s": 0.00123, "p99_s": 0.0156},
        {},
        {"p50_s": math.nan, "p99_s": 2.0},
    ]
    table = Table("times", records, [Column("ms/\ntick", "p50_s p99_s", "{}/{}", 1e3)])
    assert table.rows() == [["1.23/15.6"], ["-"], ["-/2000"]]
    np.testing.assert_array_equal(table.data["p99_s"], [0.0156, math.nan, 2.0])
    assert table.to_csv() == "p50_s,p99_s\n0.00123,0.0156\n,\n,2.0\n"
    assert "| ms/tick |" in table.to_markdown()


def test_few_tables_columns_and_rows_are_shown_unless_all_are_asked_for(
    tables: Tables,
) -> None:
    few, full = str(tables), str(tables.in_full())
    for detail in (
        "Multi-object metrics",
        "Consistency (",
        "Residuals of",
        "preci-",
        "speed [m/s]",
    ):
        assert detail not in few
        assert detail in full
    assert "tracked:" in few
    assert "across" not in tables.to_markdown()
    assert "across" in tables.in_full().to_markdown()
    assert "across" in tables.to_csv() == tables.in_full().to_csv(), (
        "files with all digits have everything"
    )
    assert tables.to_dict() == tables.in_full().to_dict()
    assert list(tables[["lag", "consistency"]].tables) == ["lag", "consistency"]
    assert "Consistency (" in str(tables[["consistency"]])
    assert str(tables.tables["lag"]) in few


@pytest.mark.parametrize("width", [40, 80, 120])
@pytest.mark.parametrize(
    "label", ["{}", "a-long-name-of-a-campaign-of-2026/wet-and-cold/{}"]
)
def test_no_row_is_longer_than_the_terminal_and_every_name_is_whole(
    runs: dict[str, Run], width: int, label: str
) -> None:
    tables = compare({label.format(name): run for name, run in runs.items()})
    for shown in (tables, tables.in_full()):
        lines = printed(shown, width).splitlines()
        assert max(map(len, lines)) <= width
        names = (
            re.sub(r"\s", "", "".join(lines)) if width == 40 else "".join(lines)
        )  # a long name is broken
        assert all(label.format(name).split("/")[-1] in names for name in runs)
        assert not any("…" in line for line in lines)
    assert printed(tables, 120) == f"{tables}\n"


def test_columns_that_do_not_fit_stand_below() -> None:
    numbers = {f"{k}": float(k) for k in range(4)}
    wide = Table(
        "t",
        [{"run": "a", **numbers}],
        [Column("run", left=True), *(Column(k) for k in numbers)],
    )
    assert printed(wide, 24).splitlines()[2:] == [
        *(
            " run      0     1     2",
            "───────────────────────",
            " a    0.000  1.00  2.00",
            "continued:",
        ),
        *(" run     3", "──────────", " a    3.00"),
    ]


def test_the_best_value_is_bold_in_every_form_that_has_bold() -> None:
    value = Column("value", bold=lambda record: record["value"] < 2.0)
    table = Table(
        "errors",
        [{"run": "a", "value": 1.0}, {"run": "b", "value": 2.0}],
        [Column("run", left=True), value],
    )
    assert "| a | **1.00** |\n| b | 2.00 |" in table.to_markdown()
    assert "a & \\textbf{1.00} \\\\\nb & 2.00" in table.to_latex()
    assert "<b>1.00</b>" in table.to_html()
    console = Console(
        width=80, file=io.StringIO(), force_terminal=True, color_system="standard"
    )
    with console.capture() as capture:
        console.print(table)
    assert "\x1b[1m1.00" in capture.get()
    assert "\x1b[1m2.00" not in capture.get()


def test_the_verdict_stands_first_in_every_form(tables: Tables) -> None:
    for text in (str(tables), tables.to_markdown(), tables.to_latex()):
        assert text.lstrip("-% ").startswith(tables.verdict[0].split(" (")[0])


@pytest.mark.parametrize(
    ("value", "three", "two"),
    [
        (0.9999, "1.00", "1.0"),
        (9.996, "10.0", "10"),
        (99.96, "100", "100"),
        (12345.6, "12346", "12346"),
        (-0.0001, "0.000", "-0.00010"),
        (-0.000001, "0.000", "0"),
        (math.nan, "-", "-"),
        (7, "7", "7"),
    ],
)
def test_numbers_have_three_or_two_significant_digits_and_few_decimals(
    value: float, three: str, two: str
) -> None:
    assert (short(value), two_digits(value)) == (three, two)


# --- contents


def test_the_tracking_table_has_errors_continuity_and_times(
    tables: Tables, runs: dict[str, Run]
) -> None:
    # position: 4 rows at 0.5 m, 4 at 0; along 0.3, across 0.4; tracked %, breaks/switches, false, precision
    assert (
        rows_of(tables, "tracking")[2]
        == "smoother 0.354 0.212 0.283 0.000 0.000 0.125 100 0/0 0 1.00 2/2 1.00/1.00"
    )
    row = tables["tracking"].loc[2]
    assert row["position_rmse_m"] == pytest.approx(math.sqrt(0.125))
    assert (row["tracked_share"], row["num_tracks"], row["time_per_tick_p50_s"]) == (
        1.0,
        2,
        0.001,
    )
    headings = [
        column.heading.split("\n")[-1] for column in tables.tables["tracking"].columns
    ]
    assert headings[1:8] == ["[m]", "[m]", "[m]", "[rad]", "[m/s]", "pos.", "[%]"]
    metrics = evaluate(runs["smoother"])
    assert metrics.truth is not None
    west = replace(metrics.truth.objects[7], breaks=3, id_switches=2)
    changed = replace(metrics, truth=replace(metrics.truth, overall=west), num_tracks=5)
    times = Distribution(9, mean=0.004, p50=0.001, p90=0.002, p99=0.003)
    other = compare(
        evaluated("run", runs["smoother"], replace(changed, time_per_tick_s=times))
    )
    assert rows_of(other, "tracking")[0].split()[-5:] == [
        "3/2",
        "0",
        "1.00",
        "5/2",
        "1.00/3.00",
    ]


def test_the_multi_object_table_has_gospa_scores_switches_and_the_time_to_confirm(
    tmp_path: Path,
) -> None:
    """WEST is 2.75 m off, with a late switch at tick 2; ROUND is missed; track 9 is false."""
    tracks = [
        [
            WEST.track(k, 1 if k < 2 else 2, along_m=2.75),
            WEST.track(k, 9, across_m=60.0),
        ]
        for k in range(4)
    ]
    updates = {
        0: [update(tick=-3, disposition=Disposition.BIRTH)],
        2: [update(tick=1, disposition=Disposition.OUT_OF_SEQUENCE, track_id=2)],
    }
    run = write_run(
        tmp_path / "run",
        tracks,
        truth=[*WEST.truth(range(4)), *ROUND.truth(range(4))],
        updates=updates,
    )
    tables = compare({"run": run, "plain": write_run(tmp_path / "plain", tracks)})
    # GOSPA^2 = 2.75^2 + 12.5 + 12.5 at every tick; MOTA 1 - (4 + 4 + 1) / 8; IDF1 2 * 2 / (8 + 8)
    # OSPA^2 = (2.75^2 + 25) / 2; T-GOSPA^2 adds one switch of 1 m^2 in 4 ticks to GOSPA^2
    # a similarity of 0.725 passes 14 of 19 bounds: DetA 14/19 * 4/12, AssA 14/19 * 1/2, HOTA 14/19 sqrt(1/6)
    assert rows_of(tables, "multi_object") == [
        "run 5.71 2.75 3.54 3.54 0.000 5.71 -12.5 25.0 30.1 24.6 36.8 1 0.060 4.04 4.04 "
        "5.73 7.56 12.5 12.5 0.250 1.00"
    ]
    table = tables["multi_object"]
    assert (table["mota"][0], table["assa"][0]) == pytest.approx((-0.125, 7 / 19))


def test_the_lag_table_shows_the_gain_of_waiting(tables: Tables) -> None:
    assert rows_of(tables, "lag")[2:] == [
        "smoother 0 8 0.354 - 0.000 0.000 0.125",
        "smoother window 2 0.100 80.0 0.000 0.000 0.010",  # too short for an interval
    ]
    assert tables["lag"]["lag"].tolist() == ["0", "0", "0", "window"]
    np.testing.assert_array_equal(tables["lag"]["lag_s"], [0.0, 0.0, 0.0, math.nan])


def test_the_consistency_table_has_means_bands_and_whiteness(tmp_path: Path) -> None:
    flips = [update(tick=k, nis=5.0, x_m=(-1.0) ** k, y_m=0.0) for k in range(30)]
    tracks = [[WEST.track(k, 1, along_m=3.0)] for k in range(40)]
    updates = {
        k: [record, update("radar", tick=k, nis=1.0, speed_mps=2.0)]
        for k, record in enumerate(flips)
    }
    run = write_run(
        tmp_path / "run", tracks, truth=WEST.truth(range(40)), updates=updates
    )
    assert rows_of(compare({"run": run}), "consistency") == [
        "run NEES position 40 9.00 2.00 1.43 to 2.67 -",
        "run NIS lidar 30 5.00 2.00 1.35 to 2.78 -0.967 ± 0.352",
        "run NIS radar 30 1.00 1.00 0.560 to 1.57 0.967 ± 0.352",
    ]


def test_residuals_have_moments_nis_and_delay_and_dispositions_add_up(
    tables: Tables,
) -> None:
    # WEST drives west: along is -x, across is -y
    lidar, radar = (f"residuals_{sensor}" for sensor in SENSORS)
    assert (
        rows_of(tables, lidar)[2]
        == "smoother 0.500 ± 0.000 -0.250 ± 0.000 2.00 2.00 151/151"
    )
    assert (
        rows_of(tables, radar)[2]
        == "smoother -1.00 ± 0.000 -2.00 ± 0.000 -123 ± 0.000 3.00 3.00 62.0/62.0"
    )
    assert (
        tables[lidar]["x_mean_m"].tolist() == [-0.5] * 3
    )  # not shown beside along and across, but there
    table = tables["dispositions"]
    assert rows_of(tables, "dispositions")[-2:] == [
        "smoother lidar_cluster 2 0 0 0 1 1 2",
        "smoother radar_long_range 1 0 0 0 0 1 1",
    ]
    assert tables.tables["dispositions"].notes[0].startswith("fused:")
    assert (
        sum(int(table[name.value].sum()) for name in Disposition)
        == table["detections"].sum()
        == 9
    )
    assert (
        table["fused"] + table["merged"] + table["refused"] == table["detections"]
    ).all()


def test_runs_without_truth_or_detections_have_no_errors_and_no_empty_tables(
    tmp_path: Path, runs: dict[str, Run]
) -> None:
    without = a_run(tmp_path / "without", "smoother", truth=False)
    alone = compare({"a": without})
    headings = [column.heading for column in alone.tables["tracking"].shown]
    assert headings == ["run", "tracks all/\nconfirmed", "ms/tick\np50/p99"]
    assert "position_rmse_m" not in alone["tracking"]
    assert alone["consistency"]["of"].tolist() == [
        f"NIS {sensor}" for sensor in SENSORS
    ]
    assert not any(text in str(alone) for text in ("Error against lag", "Multi-object"))
    assert (
        rows_of(compare({"a": without, "b": runs["smoother"]}), "tracking")[0]
        == f"a{' -' * 10} 2/2 1.00/1.00"
    )
    empty = compare(write_run(tmp_path / "run", [[]]))
    assert "Tracking" in str(empty)
    assert "Dispositions" not in str(empty)


# --- runs


def contents(folder: Path) -> Mapping[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_runs_are_compared_from_folders_from_memory_and_under_labels(
    tmp_path: Path,
) -> None:
    kept = replace(a_run(tmp_path / "elsewhere", "smoother"), path=None)
    a_run(tmp_path / "all" / "ekf-replay", "ekf-replay")
    before = contents(tmp_path)
    tables = compare(tmp_path / "all", kept, replace(kept))
    assert tables["tracking"]["run"].tolist() == [
        "ekf-replay",
        "smoother",
        "smoother #2",
    ]
    assert contents(tmp_path) == before, "only the command writes metrics.json"
    assert str(compare(str(tmp_path / "all/ekf-replay"))) == str(
        compare([tmp_path / "all"])
    )
    assert compare({"mine": kept, "theirs": tmp_path / "all"})["tracking"][
        "run"
    ].tolist() == ["mine", "theirs"]


def test_what_is_not_a_run_and_the_same_run_twice_are_refused(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(CallError, match="not a run folder"):
            compare(path)
    with pytest.raises(CallError, match="no run is given"):
        compare()
    run = write_run(tmp_path / "run")
    for same in (run, replace(run, path=None)):
        with pytest.raises(CallError, match="given twice"):
            labelled([same, same])


def test_labels_are_as_long_as_they_must_be(tmp_path: Path) -> None:
    runs = [
        write_run(tmp_path / "dry" / "smoother"),
        write_run(tmp_path / "wet" / "smoother"),
    ]
    assert list(labelled(runs)) == ["dry/smoother", "wet/smoother"]
    assert list(labelled(runs[:1])) == ["smoother"]
    assert list(labelled([replace(runs[0], meta={"estimator": "ekf-replay"})])) == [
        "smoother (ekf-replay)"
    ]


def test_tables_are_a_mapping_of_names_to_frames() -> None:
    table = Table("lag", [{"run": "a", "error_m": 0.5}], [Column("run")])
    tables = Tables({"lag": table})
    assert "lag" in tables
    assert "tracking" not in tables
    assert list(tables) == ["lag"]
    assert len(tables) == 1
    assert [frame["error_m"].tolist() for frame in tables.values()] == [[0.5]]
    assert tables.get("tracking") is None
