"""Metrics that are computed in chunks of time equal those of the whole run; large columns stay only while in use."""

import gc
import math
from pathlib import Path

import numpy as np
import pytest
from evaluation_runs import Car, update, write_run
from evaluation_scenes import random_scenes

from fgtrack.core.types import Disposition
from fgtrack.evaluation.metrics import evaluate
from fgtrack.evaluation.scores.multi_object import multi_object_metrics
from fgtrack.runs import Columns, Run

NUM_TICKS = 60
#: Chunks of the evaluation: module and name of each size.
SIZES = (
    "near_pairs._BLOCK_TICKS",
    "truth._BLOCK_TICKS",
    "truth._BLOCK_ROWS",
    "matching._BLOCK_PAIRS",
    "scores.prediction._BLOCK_ROWS",
)


def in_chunks_of(size: int, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in SIZES:
        monkeypatch.setattr(f"fgtrack.evaluation.{name}", size)


def busy_run(path: Path) -> Run:
    """Three cars side by side, whose tracks end, exchange their cars and have errors like the distance of the cars."""
    rng = np.random.default_rng(3)
    cars = [Car(k, 100.0, 2.0 * k, 0.1, 20.0, 0.2) for k in range(3)]
    ids = np.arange(3)
    tracks, updates = [], {}
    for tick in range(NUM_TICKS):
        if tick % 11 == 10:
            ids = rng.permutation(ids)
        if tick % 17 == 16:
            ids = ids + rng.integers(0, 2, 3) * 10
        along_m, across_m = rng.normal(0.0, 1.0, (2, 3)).tolist()
        seen = np.flatnonzero(rng.random(3) > 0.1).tolist()
        tracks.append(
            [
                cars[k].track(
                    tick, int(ids[k]), along_m=along_m[k], across_m=across_m[k]
                )
                for k in seen
            ]
        )
        updates[tick] = [
            update(
                tick=tick,
                index=k,
                track_id=int(ids[k]),
                x_m=along_m[k],
                y_m=across_m[k],
                nis=1.0 + along_m[k] ** 2,
                disposition=Disposition.IN_SEQUENCE,
            )
            for k in seen
        ]
    truth = [row for car in cars for row in car.truth(range(NUM_TICKS + 300))]
    return write_run(path, tracks, truth=truth, updates=updates)


def test_metrics_in_chunks_of_five_ticks_equal_those_of_the_whole_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = busy_run(tmp_path / "run")
    whole = evaluate(run).as_dict()
    in_chunks_of(5, monkeypatch)
    chunked = evaluate(run).as_dict()
    assert whole["truth"]["overall"]["id_switches"] > 5
    assert whole["predictions"]["arc"]["1s"]["final_m"]["count"] > 10
    assert flat(chunked) == pytest.approx(flat(whole), rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("size", [1, 4])
@pytest.mark.parametrize("seed", range(4))
def test_pairs_stay_across_the_border_of_a_chunk(
    seed: int, size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenes = random_scenes(seed, side_m=8.0)[2]
    whole = multi_object_metrics(scenes, 5.0)
    in_chunks_of(size, monkeypatch)
    chunked = multi_object_metrics(scenes, 5.0)
    for name in ("gospa", "clear", "identity", "hota", "others"):
        assert flat(getattr(chunked, name)) == pytest.approx(
            flat(getattr(whole, name)), nan_ok=True
        )


def test_a_large_column_of_a_selection_is_kept_only_while_it_is_in_use(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("fgtrack.runs.columns.KEPT_BYTES", 100)
    table = Columns({"x_m": np.arange(1000.0), "tick": np.arange(1000)})
    large, small = table.where(np.arange(500)), table.where(np.arange(5))
    first = large["x_m"]
    assert large["x_m"] is first
    assert small["x_m"] is small["x_m"]
    del first
    gc.collect()
    assert list(large._columns) == []
    assert large["x_m"].tolist() == list(range(500))


def flat(values: object, name: str = "") -> dict[str, float]:
    """Return every number in nested mappings and lists by its path; minus infinity for None."""
    if isinstance(values, dict):
        parts = list(values.items())
    elif isinstance(values, list | tuple):
        parts = list(enumerate(values))
    elif values is None:
        return {name: -math.inf}
    else:
        return {name: float(values)} if isinstance(values, int | float) else {}
    return {
        key: number
        for part, value in parts
        for key, number in flat(value, f"{name}.{part}").items()
    }
