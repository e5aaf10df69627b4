"""Parts and tables of a sweep."""

import math
from pathlib import Path

import pytest

from fgtrack.core.errors import CallError, DataError
from fgtrack.pipeline.sweep import Sweep
from fgtrack.pipeline.sweep_plan import Job, Plan, Recipe
from fgtrack.pipeline.sweep_store import Cell, PartStore, Scalar, write_tables

RECIPE = Recipe(None, None, {}, {}, 0, ("a", "b"))
PLAN = Plan(
    columns=("rate_hz", "delay"),
    jobs=(
        Job((5.0, {"kind": "none"}), 0, "k0", RECIPE),
        Job((5.0, None), 1, "k1", RECIPE),
        Job((-1, "x,y"), 0, "", None, "rate_hz=-1: must be positive"),
    ),
    estimators=("a", "b"),
    metrics=(),
)


def cell(name: str, error: str | None = None, **values: float | None) -> Cell:
    return Cell(name, {} if error else values, {} if error else {"replay_s": 0.25}, error)


DONE = {
    "k1": [cell("a", x=1 / 3, n=2), cell("b", error="it, broke")],
    "k0": [cell("a", x=0.1), cell("b", y=1e-300, x=None)],
}


def lines(path: Path) -> list[str]:
    return path.read_text().splitlines()


def test_tables_are_in_the_order_of_the_grid_with_all_digits(tmp_path: Path) -> None:
    result = write_tables(tmp_path, PLAN, DONE)
    assert lines(tmp_path / "sweep.csv") == [
        "rate_hz,delay,seed,estimator,x,y,n",
        '5.0,"{""kind"":""none""}",0,a,0.1,,',
        '5.0,"{""kind"":""none""}",0,b,,1e-300,',
        "5.0,,1,a,0.3333333333333333,,2",
    ]
    assert lines(tmp_path / "timing.csv")[1] == '5.0,"{""kind"":""none""}",0,a,0.25'
    assert lines(tmp_path / "errors.csv") == [
        "rate_hz,delay,seed,estimator,error",
        '5.0,,1,b,"it, broke"',
        '-1,"x,y",0,a,rate_hz=-1: must be positive',
        '-1,"x,y",0,b,rate_hz=-1: must be positive',
    ]
    assert (result.num_cells, result.num_good, result.num_bad) == (6, 3, 3)
    assert result.first_error == "it, broke"


def test_jobs_that_are_not_finished_have_no_row(tmp_path: Path) -> None:
    result = write_tables(tmp_path, PLAN, {"k0": DONE["k0"]})
    assert len(lines(tmp_path / "sweep.csv")) == 3
    assert (result.num_good, result.num_bad) == (2, 2)


def test_metrics_are_chosen_by_name_or_pattern_and_unknown_ones_reported(tmp_path: Path) -> None:
    plan = Plan(PLAN.columns, PLAN.jobs, PLAN.estimators, ("n", "[xz]", "n*", "missing", "m.*"))
    result = write_tables(tmp_path, plan, DONE)
    assert lines(tmp_path / "sweep.csv")[0] == "rate_hz,delay,seed,estimator,n,x"
    assert result.unknown_metrics == ("missing", "m.*")


def test_a_part_gives_back_its_cells_to_the_last_bit(tmp_path: Path) -> None:
    store = PartStore(tmp_path)
    cells = (cell("a", x=0.1 + 0.2, n=3, y=None), cell("b", error="no"))
    store.write("key", cells)
    assert PartStore(tmp_path).read("key") == cells
    assert store.keys() == {"key"}
    assert store.read("other") is None


def test_a_half_written_part_is_none(tmp_path: Path) -> None:
    store = PartStore(tmp_path)
    (tmp_path / "parts/key.json.part").write_text('{"format": "fgtrack-sw')
    assert store.keys() == frozenset()
    assert store.read("key") is None


@pytest.mark.parametrize(
    "text",
    [
        '{"format": "fgtrack-sw',
        "[]",
        '{"format": "x"}',
        '{"format": "fgtrack-sweep-part/1", "cells": [{}]}',
        '{"format": "fgtrack-sweep-part/1", "cells": 7}',
        *(
            f'{{"format": "fgtrack-sweep-part/1", "cells": [{{"estimator": "a", "values": {values}, "times": {{}}}}]}}'
            for values in ("[1]", '"x"', '{"x": [1]}', "null")
        ),
        "[" * 100_000,
    ],
)
def test_a_damaged_part_is_reported(tmp_path: Path, text: str) -> None:
    store = PartStore(tmp_path)
    (tmp_path / "parts/key.json").write_text(text)
    with pytest.raises(DataError, match=r"key\.json: .*, delete it"):
        store.read("key")


@pytest.mark.parametrize(
    "values",
    [
        *("{}", '{"x": 1e999}', '{"x": -Infinity}', f'{{"x": {10**400}}}', '{"x": ""}', '{"x": "a\\u001b[31m"}'),
        *('{"x": "a\\u0000"}', '{"": 1}', '{"seed": 1}', '{"estimator": "a"}', '{"error": "a"}', '{"a\\nb": 1}'),
    ],
)
def test_a_part_with_what_no_sweep_writes_is_done_again(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, values: str
) -> None:
    store = PartStore(tmp_path)
    cells = ", ".join(f'{{"estimator": "{name}", "values": {values}, "times": {{"s": 1}}}}' for name in "ab")
    (tmp_path / "parts/k0.json").write_text(f'{{"format": "fgtrack-sweep-part/1", "cells": [{cells}]}}')
    assert store.read("k0") is None
    assert "k0.json: " in caplog.text
    assert "its job is done again" in caplog.text
    assert [job.key for job in Sweep.open(PLAN, tmp_path).todo] == ["k0", "k1"]


def test_a_part_may_hold_all_that_a_sweep_writes(tmp_path: Path) -> None:
    values: dict[str, Scalar] = {"window": "window", "on": True, "none": None, "nan": math.nan, "n": 2**62, "x": -1e300}
    PartStore(tmp_path).write("k0", [Cell(name, values, {"s": 0.5}) for name in "ab"])
    assert list(Sweep.open(PLAN, tmp_path).done) == ["k0"]


def test_results_whose_parts_are_gone_are_replaced_with_overwrite_only(tmp_path: Path) -> None:
    PartStore(tmp_path).write("k0", DONE["k0"])
    write_tables(tmp_path, PLAN, DONE)
    (tmp_path / "parts/k0.json").unlink()
    with pytest.raises(CallError, match=r"sweep\.csv: already exists"):
        PartStore(tmp_path)
    PartStore(tmp_path, overwrite=True)
    write_tables(tmp_path, PLAN, {})
    PartStore(tmp_path)  # without a row there is nothing to lose


def test_links_in_the_folder_of_a_sweep_are_neither_followed_nor_replaced(tmp_path: Path) -> None:
    PartStore(tmp_path).write("k0", DONE["k0"])
    write_tables(tmp_path, PLAN, DONE)
    (tmp_path / "timing.csv").rename(tmp_path / "mine.csv")
    (tmp_path / "timing.csv").symlink_to("mine.csv")
    with pytest.raises(CallError, match=r"timing\.csv: exists and is not a file"):
        PartStore(tmp_path)
    assert (tmp_path / "timing.csv").is_symlink()
    (tmp_path / "timing.csv").unlink()
    (tmp_path / "parts").rename(tmp_path / "real")
    (tmp_path / "parts").symlink_to("real")
    with pytest.raises(CallError, match="parts: is a link"):
        PartStore(tmp_path)


def test_a_file_is_no_folder(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(CallError, match=r"file.*: cannot be written .*, choose another"):
        PartStore(tmp_path / "file")


def test_a_part_without_all_its_cells_is_not_done(tmp_path: Path) -> None:
    store = PartStore(tmp_path)
    for key, cells in {"k0": [cell("a", x=1.0)], "k1": [cell("a", x=1.0), cell("a", x=1.0)]}.items():
        store.write(key, cells)
    sweep = Sweep.open(PLAN, tmp_path)
    assert sweep.done == {}
    assert [job.key for job in sweep.todo] == ["k0", "k1"]
    store.write("k1", [cell("b", x=1.0), cell("a", x=1.0)])
    assert list(Sweep.open(PLAN, tmp_path).done) == ["k1"]
