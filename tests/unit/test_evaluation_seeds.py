"""Estimators of a sweep against each other, over the seeds."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd
import pytest

from fgtrack.evaluation.intervals import paired
from fgtrack.evaluation.tables.seeds import (
    SWEEP_FILE,
    SeedComparison,
    SweepTable,
    difference_table,
    read_sweep,
    seed_comparisons,
    summary_table,
)

RMSE = "truth.overall.errors.position_m.rmse"
SEEDS = 6


def rows_of(
    values: dict[str, Sequence[float | None]], metric: str = RMSE, **cells: str
) -> list[dict[str, str]]:
    """Rows of sweep.csv at one point: the metric of each estimator and seed."""
    return [
        {
            **cells,
            "seed": str(seed),
            "estimator": name,
            metric: "" if value is None else repr(float(value)),
        }
        for name, of in values.items()
        for seed, value in enumerate(of)
    ]


def noisy(seed: int, mean: float) -> list[float]:
    return list(np.random.default_rng(seed).normal(mean, 0.01, SEEDS))


def sweep_of(rows: list[dict[str, str]]) -> SweepTable:
    """The table, read from a file."""
    with TemporaryDirectory() as folder:
        pd.DataFrame(rows).to_csv(Path(folder) / SWEEP_FILE, index=False)
        return read_sweep(folder)


def only(rows: list[dict[str, str]]) -> SeedComparison:
    (found,) = seed_comparisons(sweep_of(rows))
    return found


def test_differences_are_paired_by_seed_and_the_standing_follows_from_the_interval() -> (
    None
):
    common = np.random.default_rng(1).normal(0.5, 0.2, SEEDS)
    small = np.random.default_rng(2).normal(0.0, 0.001, SEEDS)
    values = {
        "worse": list(common + 0.02 + small),
        "good": list(common),
        "same": list(common + small - small.mean()),
    }
    found = only(rows_of(values))
    assert {entry.name: entry.standing for entry in found.entries} == {
        "good": "unresolved",
        "same": "unresolved",
        "worse": "worse",
    }
    last = found.entries[-1]
    assert last.worse_by == paired(values["worse"], values[found.entries[0].name])
    assert last.value == pytest.approx(np.mean(values["worse"]))
    assert [
        entry.standing
        for entry in only(rows_of({k: values[k] for k in ("worse", "good")})).entries
    ] == [
        "best",
        "worse",
    ]


def test_of_shares_more_is_better_and_of_the_nees_the_expected_value() -> None:
    share = only(
        rows_of({"a": noisy(1, 0.7), "b": noisy(2, 0.9)}, "truth.overall.tracked_share")
    )
    assert [entry.name for entry in share.entries] == ["b", "a"]
    assert share.entries[1].worse_by is not None
    assert share.entries[1].worse_by.mean == pytest.approx(0.2, abs=0.02)
    nees = only(
        rows_of(
            {"a": noisy(1, 1.0), "b": noisy(2, 2.4)}, "consistency.position_nees.mean"
        )
    )
    assert [entry.name for entry in nees.entries] == ["b", "a"]
    rows = rows_of(
        {"a": noisy(1, 3.0), "b": noisy(2, 4.1)}, "consistency.nis.radar.mean"
    )
    nis = only([{**row, "consistency.nis.radar.dof": "4.0"} for row in rows])
    assert [entry.name for entry in nis.entries] == ["b", "a"]
    assert nis.entries[0].value == pytest.approx(4.1, abs=0.02), (
        "the mean is that of the metric, not of the distance"
    )


def test_only_seeds_that_all_estimators_have_count() -> None:
    found = only(rows_of({"a": [None, 1.0, 1.1, 1.2], "b": [0.1, 2.0, 2.1, 2.2]}))
    assert found.seeds == 3
    assert [entry.value for entry in found.entries] == pytest.approx([1.1, 2.1])


def test_one_estimator_no_common_seed_or_an_unknown_metric_make_no_contest() -> None:
    for values, metric in (
        ({"a": [1.0, 2.0]}, RMSE),
        ({"a": [1.0, None], "b": [None, 1.0]}, RMSE),
        ({"a": [1.0, 2.0], "b": [1.0, 2.0]}, "num_tracks"),
    ):
        assert seed_comparisons(sweep_of(rows_of(values, metric))) == []


def test_every_point_is_a_contest_and_csv_gives_the_numbers_back() -> None:
    rows = [
        row
        for delay in ("0.1", "0.2")
        for row in rows_of(
            {"a": noisy(1, 0.4), "b": noisy(2, 0.5 + float(delay))}, delay_s=delay
        )
    ]
    found = seed_comparisons(sweep_of(rows))
    read = list(
        csv.DictReader(io.StringIO(difference_table(found, ("delay_s",)).to_csv()))
    )
    assert [
        (row["delay_s"], row["estimator"], row["standing"], row["seeds"])
        for row in read
    ] == [
        *(("0.1", "a", "best", "6"), ("0.1", "b", "worse", "6")),
        *(("0.2", "a", "best", "6"), ("0.2", "b", "worse", "6")),
    ]
    worse_by = found[1].entries[1].worse_by
    assert worse_by is not None
    assert (float(read[3]["worse_by"]), float(read[3]["low"])) == (
        worse_by.mean,
        worse_by.low,
    )
    assert read[0]["worse_by"] == ""


def test_few_points_are_shown_in_full_under_the_labels_of_their_axes() -> None:
    cells = {
        "late": "much",
        "sensors.radar.delay": '{"kind": "constant"}',
        "association.gate_m": "5.0",
    }
    rows = rows_of({"a": noisy(1, 0.4), "b": noisy(2, 0.5)}, **cells)
    table = difference_table(seed_comparisons(sweep_of(rows)), tuple(cells))
    assert [row[0] for row in table.rows()] == ["much, 5.0", ""]
    assert table.columns[0].heading == "late,\nassociation gate [m]"
    assert table.data["standing"].tolist() == ["best", "worse"]
    assert max(map(len, str(table).splitlines())) <= 100


def test_a_summary_has_mean_and_standard_error_of_each_point_and_estimator() -> None:
    values = {"a": [0.4, 0.5, 0.6, 0.5], "b": [0.9, 1.0, 1.1, 1.0]}
    cells = {"late": "much", "delay": '{"kind": "none"}'}
    rows = [
        row | {"truth.false_tracks": "3"}
        for row in rows_of({k: values[k] for k in values}, **cells)
    ]
    rows += [
        row | {"truth.false_tracks": ""}
        for row in rows_of({"a": [0.7]}, **{**cells, "late": "little"})
    ]
    shown = summary_table(sweep_of(rows))
    table = shown.data
    assert table[RMSE].tolist() == pytest.approx([0.5, 1.0, 0.7])
    assert table[f"{RMSE}.standard_error"][:2].tolist() == pytest.approx(
        [np.std(values["a"], ddof=1) / 2] * 2
    )
    assert np.isnan(table[f"{RMSE}.standard_error"][2]), "of one seed nothing is known"
    assert (table["late"].tolist(), table["seeds"].tolist()) == (
        ["much", "much", "little"],
        [4, 4, 1],
    )
    text = str(shown)
    assert "0.500 ± 0.130" in text, (
        "3.18 standard errors of 0.041, by Student's t of 3 degrees of freedom"
    )
    assert "0.500 ± 0.130" in shown.to_latex().replace("$\\pm$", "±")
    assert "false tracks" not in text
    assert "false tracks" in str(shown.in_full())
    assert next(csv.DictReader(io.StringIO(shown.to_csv())))["delay"] == cells["delay"]
