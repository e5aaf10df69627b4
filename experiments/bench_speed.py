"""How fast fgtrack is: whole ticks beside the published implementation, reading, and a whole replay.

    make bench                                # some 5 minutes: the requirements
    make bench-full                           # also every estimator, more numbers of objects, lags, delays
    make bench AGAINST='COMMAND' PAGE=docs/speed.md

COMMAND passes the messages of a stream, its last argument, to the callbacks of the published node, with ROS replaced by
stubs. Its last line is JSON with `receive_and_handling`: median, 99 % quantile and mean in ms of the ticks with
detections. Without AGAINST the yardstick stands for it, `np.dot(F, P).dot(F.T) + Q` on 6 x 6 arrays. Everything is
measured in turns, round after round. How to read the tables: docs/speed.md.
"""

import json
import resource
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache
from pathlib import Path
from statistics import median
from typing import Annotated, Any

import bench_banks
import typer
from bench_report import (
    BANDED,
    COSTED,
    LARGEST_MS,
    LARGEST_REPLAY_S,
    MAIN,
    PAPER,
    PUBLISHED_MS_PER_US,
    REPLAY,
    REVISED,
    SMOOTHER,
    Results,
    Row,
    draw,
    finite,
    page_tables,
    progress,
    put_into,
    tables,
)
from bench_tracker import Cell, Measured, measure, scene, traffic

from fgtrack import list_estimators, open_input, write_recording

ALL_OBJECTS = (1, 2, 5, 10, 20, 50, 100, 200, 300, 1000)
LAGS_S = (0.5, 1.0, 3.0)
DELAYS_S = (0.0, 0.06, 0.15, 0.4)
_MANY, _SHORT_S = (
    50,
    4.0,
)  # with more objects the traffic is shorter, or the slow ones take minutes
_MOST = {SMOOTHER: 100, REVISED: 100}  # objects


def cell(label: str, count: int, **settings: Any) -> Cell:
    """Return the cell of a row."""
    if label == PAPER:
        return Cell(label, "karle2023", count, **settings)
    if label == REVISED:
        return Cell(label, "smoother", count, REPLAY, revises=True, **settings)
    return Cell(label, "smoother", count, label, **settings)


def quick_cells() -> list[Cell]:
    """Return what the requirements need."""
    cells = [cell(label, n) for n in PUBLISHED_MS_PER_US for label in MAIN]
    return [
        *cells,
        *(cell(*each) for each in LARGEST_MS),
        *(cell(REPLAY, n) for n in COSTED),
    ]


def full_cells() -> list[Cell]:
    """Return cells over the number of objects, the lag, the delay, and every estimator."""
    cells = [
        cell(label, n)
        for n in ALL_OBJECTS
        for label in MAIN
        if n <= _MOST.get(label, n)
    ]
    cells += [
        cell(label, n, lag_s=lag_s)
        for label in (BANDED, SMOOTHER)
        for n in (10, 50)
        for lag_s in LAGS_S
    ]
    cells += [
        cell(label, 10, delay_s=delay_s) for label in MAIN for delay_s in DELAYS_S
    ]
    return cells + [
        cell(name, 10, duration_s=_SHORT_S)
        for name in list_estimators()
        if name not in MAIN
    ]


def shortened(cells: Iterable[Cell], duration_s: float) -> list[Cell]:
    """Return the distinct `cells`, with traffic of at most `duration_s`; a long window needs time to fill."""
    short = [
        replace(
            one,
            duration_s=min(
                one.duration_s,
                _SHORT_S + one.lag_s
                if one.count > _MANY or (one.label, one.count) == (SMOOTHER, _MANY)
                else 8.0,
                duration_s,
            ),
        )
        for one in cells
    ]
    return list(dict.fromkeys(short))


def measure_round(
    results: Results,
    passes: dict[Cell, list[Measured]],
    streams: dict[int, Path],
    command: str,
) -> None:
    """Measure all cells once, each number of objects beside the published implementation on its stream."""
    yardsticks_us: dict[int, list[float]] = {}
    for count in sorted({one.count for one in passes}):
        if command and count in streams:
            progress(f"published implementation, {count} objects")
            results.published_ms.setdefault(count, []).append(
                run_published(command, streams[count])
            )
        for one in [each for each in passes if each.count == count]:
            progress(f"{one.label}, {count} objects, {one.lag_s:g} s lag")
            passes[one].append(
                measure(one, _traffic(count, one.duration_s, one.delay_s))
            )
            yardsticks_us.setdefault(count, []).append(passes[one][-1].yardstick_us)
    for count, times_us in yardsticks_us.items():
        results.yardsticks_us += times_us
        if not command and count in PUBLISHED_MS_PER_US:
            ms = PUBLISHED_MS_PER_US[count] * median(times_us)
            results.published_ms.setdefault(count, []).append(ms)


_traffic = cache(traffic)


def run_published(command: str, stream: Path) -> float:
    """Return the median tick of the published implementation in ms."""
    run = subprocess.run(
        [*shlex.split(command), str(stream)],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    return float(
        json.loads(run.stdout.strip().splitlines()[-1])["receive_and_handling"][0]
    )


def measure_reading(
    results: Results, recordings: Sequence[Path], duration_s: float
) -> None:
    """Read recordings once; processor time counts."""
    for recording in recordings:
        progress(f"reading {recording.name}")
        began_s = time.process_time()
        for _ in open_input(recording).messages():
            pass
        name = "a stream" if recording.suffix == ".jsonl" else "a bag"
        results.reading.setdefault(name, []).append(
            duration_s / (time.process_time() - began_s)
        )


def measure_replay(results: Results, demo: Path, folder: Path) -> None:
    """Replay the demo's recording once by the command, with each of the estimators that have a limit."""
    for name in LARGEST_REPLAY_S:
        progress(f"fgtrack replay, {name}")
        before_s = _children_s()
        _fgtrack(
            "replay",
            demo,
            "-c",
            "tuned",
            "-e",
            name,
            "-o",
            folder / "run",
            "--overwrite",
        )
        results.replay_s.setdefault(name, []).append(_children_s() - before_s)


def measure_banks(results: Results) -> None:
    """Measure lists of 50 objects once, with several kinds of measurements, in the estimators alone."""
    times_ms = bench_banks.measured(1, progress)
    for estimator in bench_banks.ESTIMATORS:
        for kind in bench_banks.KINDS:
            results.over_position.setdefault(f"{estimator}, {kind.label}", []).extend(
                bench_banks.ratios(times_ms, estimator, kind)
            )


def _fgtrack(*arguments: object) -> None:
    subprocess.run(
        [sys.executable, "-m", "fgtrack", *map(str, arguments)],
        check=True,
        stdout=subprocess.DEVNULL,
    )


def _children_s() -> float:
    """Return the processor time of all commands so far, of user and system."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def main(
    out: Annotated[
        Path, typer.Option("-o", help="Folder for speed.md, speed.json and speed.png.")
    ] = Path("out/speed"),
    full: Annotated[
        bool, typer.Option(help="Every estimator, number of objects, lag and delay.")
    ] = False,
    published: Annotated[
        str,
        typer.Option(
            help="Command that runs the published implementation on a stream."
        ),
    ] = "",
    rounds: Annotated[int, typer.Option(min=1, help="Passes over every cell.")] = 3,
    duration_s: Annotated[
        float, typer.Option(help="Longest traffic and replay.")
    ] = 60.0,
    objects: Annotated[
        str, typer.Option(help="Numbers of objects, with commas.")
    ] = ",".join(map(str, ALL_OBJECTS)),
    page: Annotated[
        Path | None, typer.Option(help="Put answer, tables and figure into this page.")
    ] = None,
) -> None:
    """Measure, print the tables, write speed.md, speed.json and speed.png."""
    out.mkdir(parents=True, exist_ok=True)
    counts = {int(text) for text in objects.split(",")}
    cells = shortened(full_cells() if full else quick_cells(), duration_s)
    passes: dict[Cell, list[Measured]] = {
        one: [] for one in cells if one.count in counts
    }
    results = Results(is_run=bool(published))
    with suppress(ImportError):
        from bench_stone_soup import per_detection_us

        results.stone_soup_us = per_detection_us()
    with tempfile.TemporaryDirectory(dir=out) as name:
        folder = Path(name).resolve()
        streams, recordings, demo = (
            {},
            [folder / "drive.jsonl", folder / "drive"],
            folder / "demo",
        )
        short_s = min(duration_s, 8.0)
        if published:
            for count in counts & set(PUBLISHED_MS_PER_US):
                streams[count] = folder / f"{count}.jsonl"
                write_recording(streams[count], scene(count, short_s))
        for recording in recordings:
            write_recording(recording, scene(10, short_s))
        _fgtrack(
            "simulate", "default", "--seed", 1, "--duration", duration_s, "-o", demo
        )
        for number in range(rounds):
            progress(f"round {number + 1} of {rounds}")
            measure_round(results, passes, streams, published)
            measure_reading(results, recordings, short_s)
            measure_replay(results, demo, folder)
            measure_banks(results)
    results.rows = [
        Row.of(
            one,
            found,
            results.published_ms.get(one.count, [])
            if one.label in MAIN and one.delay_s is None
            else [],
        )
        for one, found in passes.items()
    ]
    text = tables(results)
    (out / "speed.md").write_text(text, encoding="utf-8")
    (out / "speed.json").write_text(
        json.dumps(finite(results.as_dict()), indent=2) + "\n", encoding="utf-8"
    )
    draw(results, out / "speed.png")
    if page is not None:
        put_into(page, "speed", page_tables(results))
        draw(results, page.with_suffix(".png"))
    print(text, end="")


if __name__ == "__main__":
    typer.run(main)
