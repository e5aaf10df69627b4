"""Memory over a drive of two hours, replayed into a run folder as `fgtrack replay` does.

    python experiments/bench_memory.py                     # minutes
    python experiments/bench_memory.py --duration-s 300    # a short run

Cars drive lap after lap on the built-in oval with the paper's sensors and delays. The recording is written lap by lap;
recording and run are removed at the end.
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
from bench_report import plural, progress, short_machine, table
from bench_tracker import SPEED_MPS, scenario, yardstick_us

from fgtrack import (
    Config,
    Message,
    TickReport,
    nanoseconds,
    open_input,
    simulate,
    write_recording,
)
from fgtrack.models.oval import make_oval
from fgtrack.models.path import Path as Track
from fgtrack.pipeline.replay import replay

_MB = 1 << 20
LAPS_START_NS = 1_700_000_000_000_000_000


def laps(objects: int, duration_s: float) -> Iterator[Message]:
    """Messages of a drive of whole laps, at least `duration_s` long, in order of receipt."""
    lap_s, speed_mps = whole_laps()
    one_lap = scenario(objects, lap_s, speed_mps=speed_mps)

    def lap(number: int, begun_ns: int) -> Iterable[Message]:
        return list(simulate(replace(one_lap, start_ns=begun_ns), seed=number))

    return joined(lap, lap_s, int(np.ceil(duration_s / lap_s)))


def whole_laps() -> tuple[float, float]:
    """Time of a lap of the oval in whole seconds, so that every lap begins with the same scans, and the speed then."""
    length_m = Track.through(make_oval().table[:, :2]).length_m
    lap_s = float(round(length_m / SPEED_MPS))
    return lap_s, length_m / lap_s


def joined(
    lap: Callable[[int, int], Iterable[Message]], lap_s: float, count: int
) -> Iterator[Message]:
    """Messages of `count` laps in order of receipt; `lap(number, begun_ns)` makes one when the one before has ended.
    A message stamped at the end of a lap is left to the next one.
    """
    waiting: list[Message] = []
    for number in range(count):
        begun_ns = LAPS_START_NS + number * nanoseconds(lap_s)
        ended_ns = begun_ns + nanoseconds(lap_s)
        waiting += [
            message for message in lap(number, begun_ns) if message.stamp_ns < ended_ns
        ]
        waiting.sort(key=lambda message: message.receipt_ns)
        ready = sum(message.receipt_ns < ended_ns for message in waiting)
        yield from waiting[:ready]
        waiting = waiting[ready:]
    yield from waiting


def memory_mb() -> float:
    """Memory that the process holds; its peak where the system does not report more."""
    file = Path("/proc/self/statm")
    if file.exists():
        return int(file.read_text().split()[1]) * resource.getpagesize() / _MB
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (
        _MB if sys.platform == "darwin" else 1024
    )


def main(
    out: Annotated[
        Path,
        typer.Option(
            "-o", help="Folder for the recording and the run while they last."
        ),
    ] = Path("out/speed"),
    duration_s: float = 7200.0,
    objects: int = 2,
    estimator: str = "smoother-banded",
    parts: Annotated[int, typer.Option(help="Rows of the table.")] = 12,
) -> None:
    """Replay, print memory over the time of the recording."""
    out.mkdir(parents=True, exist_ok=True)
    config = Config.from_yaml("smoother").replace(
        {"map.track": "oval", "map.pit": "oval"}, estimator=estimator
    )
    rows: list[
        tuple[float, float, float, int]
    ] = []  # recording in min, memory in MB, computed in s, tracks

    def look(report: TickReport) -> None:
        passed_s = (report.now_ns - LAPS_START_NS) / 1e9
        if passed_s >= duration_s * (len(rows) + 1) / parts:
            rows.append(
                (
                    passed_s / 60.0,
                    memory_mb(),
                    time.perf_counter() - began_s,
                    len(report.tracks),
                )
            )

    with tempfile.TemporaryDirectory(dir=out) as folder:
        drive = Path(folder) / "drive.jsonl.gz"
        progress("write the recording")
        write_recording(drive, laps(objects, duration_s))
        progress("replay it")
        began_s = time.perf_counter()
        replay(
            open_input(drive, config.input).messages,
            config,
            {estimator: Path(folder) / "run"},
            on_tick=look,
        )
    print(short_machine([yardstick_us()]), end="\n\n")
    header = ["recording [min]", "memory [MB]", "computed for [s]", "tracks"]
    print(
        table(
            header,
            [
                (f"{past_min:.3g}", f"{mb:.1f}", f"{s:.0f}", str(n))
                for past_min, mb, s, n in rows
            ],
        )
    )
    print(
        f"\n{estimator}, {plural(objects)}: the memory grew by {rows[-1][1] - rows[0][1]:.1f} MB after the first row."
    )


if __name__ == "__main__":
    typer.run(main)
