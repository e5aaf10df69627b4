"""Whether a long recording needs more memory than a short one: a drive of two hours, replayed into a run folder.

    python experiments/bench_memory.py                     # minutes
    python experiments/bench_memory.py --duration-s 300    # to see that it works

Cars drive lap after lap on the built-in oval, seen by the paper's sensors with their delays. The recording is written
lap by lap, then read and replayed as `fgtrack replay` does; recording and run are removed at the end. The memory of the
process is read as the run goes.
"""

import resource
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from bench_report import plural, progress, put_into, short_machine
from bench_tracker import SPEED_MPS, scenario, yardstick_us

from fgtrack.core.time import nanoseconds
from fgtrack.core.types import Message, TickReport
from fgtrack.io.recording import write_recording
from fgtrack.io.source import open_input
from fgtrack.models.oval import make_oval
from fgtrack.models.path import Path as Track
from fgtrack.pipeline.replay import replay
from fgtrack.pipeline.shipped import read_config
from fgtrack.sim.simulate import simulate

_MB = 1 << 20
LAPS_START_NS = 1_700_000_000_000_000_000


def laps(objects: int, duration_s: float) -> Iterator[Message]:
    """Messages of a drive of whole laps, at least `duration_s` long, in order of receipt."""
    lap_s, speed_mps = whole_laps()
    one_lap = scenario(objects, lap_s, speed_mps=speed_mps)

    def lap(number: int, begun_ns: int) -> Iterable[Message]:
        return simulate(replace(one_lap, start_ns=begun_ns), np.random.default_rng(number))

    return joined(lap, lap_s, int(np.ceil(duration_s / lap_s)))


def whole_laps() -> tuple[float, float]:
    """Time of a lap of the oval in whole seconds, so that every lap begins with the same scans, and the speed then."""
    length_m = Track.through(make_oval().table[:, :2]).length_m
    lap_s = float(round(length_m / SPEED_MPS))
    return lap_s, length_m / lap_s


def joined(lap: Callable[[int, int], Iterable[Message]], lap_s: float, count: int) -> Iterator[Message]:
    """Messages of `count` laps in order of receipt, made lap by lap; `lap` is given the number and the begin in ns.

    What a lap says of its very end is left out: the next one begins with it.
    """
    waiting: list[Message] = []
    for number in range(count):
        begun_ns = LAPS_START_NS + number * nanoseconds(lap_s)
        ended_ns = begun_ns + nanoseconds(lap_s)
        waiting += [message for message in lap(number, begun_ns) if message.stamp_ns < ended_ns]
        waiting.sort(key=lambda message: message.receipt_ns)
        ready = sum(message.receipt_ns < ended_ns for message in waiting)
        yield from waiting[:ready]
        waiting = waiting[ready:]
    yield from waiting


def memory_mb() -> float:
    """What the process holds now; where the system does not say, the most that it has held so far."""
    file = Path("/proc/self/statm")
    if file.exists():
        return int(file.read_text().split()[1]) * resource.getpagesize() / _MB
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (_MB if sys.platform == "darwin" else 1024)


def main(
    out: Annotated[Path, typer.Option("-o", help="Folder for memory.md, and for the run while it lasts.")] = Path(
        "out/speed"
    ),
    duration_s: Annotated[float, typer.Option(help="Of the recording.")] = 7200.0,
    recording: Annotated[
        str, typer.Option(help="Its name, which says the format: a folder is a rosbag2.")
    ] = "drive.jsonl.gz",
    objects: int = 2,
    estimator: str = "smoother-banded",
    parts: Annotated[int, typer.Option(help="Rows of the table.")] = 12,
    page: Annotated[Path | None, typer.Option(help="Put the table into this page, between its marks.")] = None,
) -> None:
    """Replay, print memory and speed over the time of the recording, write memory.md."""
    out.mkdir(parents=True, exist_ok=True)
    config = read_config("smoother", track_map="oval", pit_map="oval", estimator=estimator)
    rows: list[tuple[float, float, float, int]] = []  # recording in s, memory in MB, computed in s, tracks

    def look(report: TickReport) -> None:
        passed_s = (report.now_ns - LAPS_START_NS) / 1e9
        if len(rows) < parts and passed_s >= duration_s * (len(rows) + 1) / parts:
            rows.append((passed_s, memory_mb(), time.perf_counter() - began, len(report.tracks)))

    with tempfile.TemporaryDirectory(dir=out) as folder:
        drive, run = Path(folder) / recording, Path(folder) / "run"
        progress("write the recording")
        write_recording(drive, laps(objects, duration_s))
        progress("replay it")
        began = time.perf_counter()
        replay(open_input(drive, config.input).messages, config, {estimator: run}, on_tick=look)
        sizes_mb = [sum(file.stat().st_size for file in path.rglob("*")) / _MB for path in (run, Path(folder))]
    lines = [
        short_machine([yardstick_us()]),
        "",
        "| recording [min] | memory [MB] | computed for [s] | tracks |",
        "|---|---|---|---|",
        *(f"| {s / 60.0:.3g} | {mb:.1f} | {spent_s:.0f} | {count} |" for s, mb, spent_s, count in rows),
        "",
        f"{estimator}, {plural(objects)}, {rows[-1][0] / 3600.0:.2g} h, "
        f"{sizes_mb[1] - sizes_mb[0]:.0f} MB of recording, {sizes_mb[0]:.0f} MB of run folder: "
        f"from the first row to the last the memory grew by {rows[-1][1] - rows[0][1]:.1f} MB.",
    ]
    text = "\n".join(lines) + "\n"
    (out / "memory.md").write_text(text, encoding="utf-8")
    if page is not None:
        put_into(page, "memory", text)
    print(text, end="")


if __name__ == "__main__":
    typer.run(main)
