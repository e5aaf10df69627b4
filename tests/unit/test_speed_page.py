"""The tables of docs/speed.md: how they are made of rounds, and that they are not older than the code."""

import re
import subprocess
import sys
from datetime import date, timedelta

import pytest
from support.scripts import EXPERIMENTS, ROOT

sys.path.insert(0, str(EXPERIMENTS))
from bench_report import BANDED, REPLAY, Results, Row, tables
from bench_tracker import Cell, Measured

TIMED = ("core", "estimation", "io", "models", "pipeline", "tracking")


def test_a_quantile_is_of_the_least_time_of_every_tick() -> None:
    ticks_ms = [1.0] * 98 + [2.0, 2.0]
    busy, late = [9.0, *ticks_ms[1:]], [*ticks_ms[:-3], 8.0, 2.0, 2.0]
    cell = Cell(REPLAY, "smoother", 50)
    row = Row.of(
        cell, [Measured(1.0, each, 5000, 50.0) for each in (busy, late)], [30.0, 20.0]
    )
    assert (row.median_ms, row.p50_ms, row.p99_ms, row.ratios) == (
        1.0,
        1.0,
        2.0,
        [30.0, 20.0],
    )
    results = Results([row])
    assert (results.p99(REPLAY, 50).verdict, results.ratio(REPLAY, 50).cell()) == (
        "yes",
        "25 (20 to 30)",
    )
    assert (
        "(target 25)"
        in Results([Row.of(cell, [Measured(1.0, busy, 5000, 50.0)], [24.0])])
        .ratio(REPLAY, 50)
        .cell()
    )


def test_a_tracker_that_lost_cars_has_no_times_in_the_table() -> None:
    row = Row.of(Cell(BANDED, "smoother", 300), [Measured(1.0, [1.0], 300, 299.0)], [])
    text = tables(Results([row], yardsticks_us=[1.0]))
    assert "smoother-banded, 300 objects: only 299 tracks" in text
    assert f"| {BANDED} | 300 |" not in text
    assert Results([row]).others()[1].verdict == "not measured"


def test_the_page_is_at_most_a_month_older_than_the_code_that_it_times() -> None:
    page = (ROOT / "docs/speed.md").read_text(encoding="utf-8")
    measured = re.search(r"commit \S+, (\d{4}-\d\d-\d\d)", page)
    assert measured is not None
    folders = [f"fgtrack/{name}" for name in TIMED]
    log = subprocess.run(
        ["git", "log", "-1", "--format=%cs", "--", *folders],
        cwd=ROOT,
        text=True,
        capture_output=True,
        check=False,
    )
    if not log.stdout.strip():
        pytest.skip("not a checkout")
    changed = date.fromisoformat(log.stdout.strip())
    assert changed <= date.fromisoformat(measured[1]) + timedelta(days=31), (
        "run `make bench PAGE=docs/speed.md`"
    )
