"""How fast fgtrack is: whole ticks beside the published implementation, detections beside Stone Soup, and the floor.

    make bench        # some 5 minutes: what is promised, as ratios measured in this run
    make bench-full   # every estimator, number of objects, lag and delay, memory
    python experiments/bench_speed.py --against CHECKOUT    # gtsam's smoother beside that of an older checkout, too
    python experiments/bench_speed.py --page docs/speed.md --figure docs/speed.png    # as the page has it

Cells are measured in turn, round after round, each with a yardstick of its own, so that a machine which becomes slower
slows all of them. A table row is the median over the rounds. How to read it: docs/speed.md.
"""

import importlib.util
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from statistics import median
from typing import Annotated, Any

import bench_estimators as single
import numpy as np
import typer
from bench_report import (
    ALL_OBJECTS,
    BANDED,
    MAIN,
    PAPER,
    SMOOTHER,
    Results,
    Row,
    draw,
    finite,
    progress,
    put_into,
    tables,
)
from bench_tracker import PUBLISHED_MS_PER_US, Cell, Measured, measure, traffic

from fgtrack.estimation.registry import ESTIMATORS

LAGS_S = (0.5, 1.0, 3.0)
DELAYS_S = (0.0, 0.06, 0.15, 0.4)
_MANY, _SHORT_S = 50, 4.0  # from so many objects on the traffic is shorter, or the slow ones take minutes
_MOST = {SMOOTHER: 100}  # objects; more would take minutes and say nothing new
_WORKER = Path(__file__).with_name("bench_tracker.py")


def cell(label: str, count: int, **settings: Any) -> Cell:
    """The cell of a row; traffic of many objects is shorter."""
    if label == PAPER:
        return Cell(label, "karle2023", count, **settings)
    return Cell(label, "smoother", count, label, **settings)


def quick_cells(objects: Iterable[int], duration_s: float) -> list[Cell]:
    """What the promises need."""
    cells = [cell(label, n) for label in MAIN for n in (1, 10, 50)]
    cells += [cell(BANDED, 50, lag_s=3.0), *(cell(BANDED, n) for n in ALL_OBJECTS)]
    return _fitted(cells, objects, duration_s)


def full_cells(objects: Iterable[int], duration_s: float) -> list[Cell]:
    """Over the number of objects, the lag, the delay, and every estimator."""
    cells = [cell(label, n) for label in MAIN for n in ALL_OBJECTS if n <= _MOST.get(label, n)]
    cells += [cell(label, n, lag_s=lag_s) for label in (BANDED, SMOOTHER) for n in (10, 50) for lag_s in LAGS_S]
    cells += [cell(label, 10, delay_s=delay_s) for label in MAIN for delay_s in DELAYS_S]
    cells += [cell(name, 10, duration_s=_SHORT_S) for name in ESTIMATORS if name not in MAIN]
    return _fitted(cells, objects, duration_s)


def _fitted(cells: Iterable[Cell], objects: Iterable[int], duration_s: float) -> list[Cell]:
    """The distinct ones of `cells` with one of the numbers of `objects`, traffic of at most `duration_s`."""
    wanted, found = set(objects), []
    for one in cells:
        # A long window needs time to fill.
        short_s = _SHORT_S + one.lag_s if one.count > _MANY or (one.label, one.count) == (SMOOTHER, _MANY) else 8.0
        found.append(replace(one, duration_s=min(one.duration_s, short_s, duration_s)))
    return [one for one in dict.fromkeys(found) if one.count in wanted]


def measure_ticks(cells: Sequence[Cell], rounds: int) -> list[Row]:
    """All cells in turn, round after round."""
    ticks = {}
    for one in cells:
        ticks.setdefault((one.count, one.duration_s, one.delay_s), None)
    found: dict[Cell, list[Measured]] = {one: [] for one in cells}
    for number in range(rounds):
        for one in cells:
            key = (one.count, one.duration_s, one.delay_s)
            ticks[key] = ticks[key] or traffic(*key)
            progress(f"round {number + 1} of {rounds}: {one.label}, {one.count} objects, {one.lag_s:g} s lag")
            found[one].append(measure(one, ticks[key]))
    return [Row.of(one, measured) for one, measured in found.items()]


def measure_apart(one: Cell, checkout: Path | None = None) -> Measured:
    """A cell in a process of its own, of the code in `checkout`."""
    root = Path(__file__).parents[1] if checkout is None else checkout.resolve()
    command = [sys.executable, str(_WORKER), json.dumps(asdict(one))]
    environment = {**os.environ, "PYTHONPATH": str(root)}
    out = subprocess.run(command, check=True, text=True, stdout=subprocess.PIPE, env=environment).stdout
    return Measured(**json.loads(out))


def measure_against(results: Results, checkout: Path, cells: Sequence[Cell], rounds: int) -> None:
    """gtsam's smoother of this code and of `checkout`, in turn, each in a process of its own."""
    for one in cells:
        pairs = []
        try:
            for number in range(rounds):
                progress(f"round {number + 1} of {rounds}: {SMOOTHER}, {one.count} objects, beside {checkout}")
                order = [None, checkout] if number % 2 == 0 else [checkout, None]
                pairs.append({path: measure_apart(one, path) for path in order})
        except subprocess.CalledProcessError as error:
            results.missing.append(f"{checkout}: cannot be measured, its benchmark exits {error.returncode}")
            return
        now_ms, then_ms = ([pair[path].median_ms for pair in pairs] for path in (None, checkout))
        ratios = [then / now for now, then in zip(now_ms, then_ms, strict=True)]
        results.against.append(
            {
                "count": one.count,
                "now_ms": median(now_ms),
                "then_ms": median(then_ms),
                "ratio": median(ratios),
                "lowest": min(ratios),
                "highest": max(ratios),
            }
        )


def is_compared(one: Cell) -> bool:
    """Whether a cell is measured beside an older checkout."""
    return one.label == SMOOTHER and one.count in PUBLISHED_MS_PER_US and (one.lag_s, one.delay_s) == (1.0, None)


def measure_single(results: Results, names: Iterable[str], rounds: int, duration_s: float, cpu: bool) -> None:
    """Every estimator of one object and Stone Soup, per detection, in turn."""
    measurements, clock = single.stream(duration_s), time.thread_time_ns if cpu else time.perf_counter_ns
    passes: dict[str, list[single.PerDetection]] = {}
    reason = "" if importlib.util.find_spec("stonesoup") else "Stone Soup is not installed: pip install fgtrack[bench]"
    for number in range(rounds):
        progress(f"round {number + 1} of {rounds}: per detection")
        for name in names:
            found = single.run_estimator(name, measurements, duration_s, clock)
            passes.setdefault(name, []).append(found)
        if not reason:
            soup = {"Stone Soup, EKF, in order of stamps": 0.0, "Stone Soup, EKF and smoother over 1 s": 1.0}
            for name, window_s in soup.items():
                if window_s == 0.0 or number == 0:  # the smoother takes a hundred times as long
                    passes.setdefault(name, []).append(single.run_stone_soup(measurements, window_s, clock))
                if window_s == 0.0:
                    means = [float(np.mean(one.times_us)) for one in passes[name]]
                    results.stone_soup_us = median(means)
    results.missing += [reason] if reason else []
    for name, every in passes.items():
        results.per_detection.append(
            {
                "name": name,
                "median_us": median(one.median_us() for one in every),
                "in_sequence_us": median(one.median_us(False) if one.late else one.median_us() for one in every),
                "late_us": median(one.median_us(True) if one.late else float("nan") for one in every),
                "p99_us": median(one.p99_us for one in every),
                "mean_us": median(float(np.mean(one.times_us)) for one in every),
                "error_m": float(np.hypot(*(every[0].position_m - single.truth_m(duration_s)))),
            }
        )


def measure_floor(objects: Iterable[int]) -> list[dict[str, float]]:
    """Bare LAPACK and gtsam calls: the rows behind a late detection, and a whole window of 1 s."""
    progress("floor")
    behind = round(np.mean(single.num_applied(single.stream(6.0)))) + 1
    counts = sorted({1, 10, 50} & set(objects)) or [1]
    return [
        {"count": n, "rows": rows, "lapack_us": single.lapack_us(n, rows), "gtsam_us": single.gtsam_us(n, rows)}
        for n in counts
        for rows in (behind, 40)
    ]


def numbers(text: str) -> list[int]:
    """Numbers with commas between them."""
    return [int(part) for part in text.split(",")]


def main(
    out: Annotated[Path, typer.Option("-o", help="Folder for speed.md, speed.json and speed.png.")] = Path("out/speed"),
    full: Annotated[bool, typer.Option(help="Every estimator, number of objects, lag and delay; memory.")] = False,
    against: Annotated[Path | None, typer.Option(help="Checkout of an older commit, to compare with.")] = None,
    rounds: Annotated[int, typer.Option(min=1, help="Passes over every cell.")] = 3,
    duration_s: Annotated[float, typer.Option(help="Longest traffic.")] = 8.0,
    objects: Annotated[str, typer.Option(help="Numbers of objects, with commas.")] = ",".join(map(str, ALL_OBJECTS)),
    cpu: Annotated[bool, typer.Option(help="Processor time of ticks, for a busy machine.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print speed.json instead of the tables.")] = False,
    figure: Annotated[Path | None, typer.Option(help="Write the figure there, too.")] = None,
    page: Annotated[Path | None, typer.Option(help="Put the tables into this page, between its marks.")] = None,
) -> None:
    """Measure, print the tables, write speed.md, speed.json and speed.png."""
    out.mkdir(parents=True, exist_ok=True)
    wanted, results = numbers(objects), Results()
    cells = (full_cells if full else quick_cells)(wanted, duration_s)
    cells = [replace(one, cpu=cpu) for one in cells]
    results.rows = measure_ticks(cells, rounds)
    results.missing += [f"{r.cell.label}, {r.cell.count} objects: lost tracks" for r in results.rows if r.lost_tracks]
    save(results, out)  # so that what is measured stays, whatever happens to the rest
    names = list(ESTIMATORS) if full else [name for name in ESTIMATORS if name in MAIN]
    measure_single(results, names, rounds, min(6.0, duration_s), cpu)
    results.floors = measure_floor(wanted)
    save(results, out)
    if full:
        results.rows = with_memory(results.rows)
    if against is not None:
        measure_against(results, against, [one for one in cells if is_compared(one)], rounds)
    save(results, out)
    if figure is not None:
        draw(results, figure)
    text = tables(results)
    if page is not None:
        put_into(page, "speed", text)
    print((out / "speed.json").read_text(encoding="utf-8") if as_json else text, end="")


def save(results: Results, out: Path) -> None:
    """Write speed.md, speed.json and speed.png."""
    (out / "speed.md").write_text(tables(results), encoding="utf-8")
    (out / "speed.json").write_text(json.dumps(finite(results.as_dict()), indent=2) + "\n", encoding="utf-8")
    draw(results, out / "speed.png")


def with_memory(rows: Sequence[Row]) -> list[Row]:
    """The rows with the memory of a process of their own, where the delays are the paper's."""
    found = []
    for row in rows:
        memory_mb = float("nan")
        if row.cell.delay_s is None and row.cell.count in PUBLISHED_MS_PER_US:
            progress(f"memory: {row.cell.label}, {row.cell.count} objects")
            memory_mb = measure_apart(replace(row.cell, duration_s=min(row.cell.duration_s, _SHORT_S))).memory_mb
        found.append(replace(row, memory_mb=memory_mb))
    return found


if __name__ == "__main__":
    typer.run(main)
