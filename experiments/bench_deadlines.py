"""Deadlines of an hour at 50 Hz with 20 cars, by the processor time of the tracker, as fast as it goes.

    python experiments/bench_deadlines.py                        # an hour of driving
    python experiments/bench_deadlines.py --duration-s 60        # a short run

A tick is due every 20 ms. It begins when it is due, or when the tick before has ended, and it lasts as long as the
processor works on it: receiving, ticking, and the tracks of 0.1 s ago. It misses its deadline if it ends after the next
tick is due. Other programs of the machine take nothing of this time. Another process makes the messages, as in a
vehicle. So the collector of garbage looks through the objects of the tracker only. Exits 1 where a deadline is missed,
where memory grows in the second half by more than 1 %, or where a detection is not accounted for.
"""

import gc
import json
import multiprocessing
import time
from collections.abc import Iterator
from dataclasses import asdict
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Annotated

import typer
from bench_live import Part, spread
from bench_memory import LAPS_START_NS, laps, memory_mb
from bench_report import plural, progress, short_machine, table
from bench_tracker import NODE_HZ, yardstick_us

import fgtrack
from fgtrack import DetectionList, TruthState, nanoseconds
from fgtrack.pipeline.clock import Tick, clock_ticks

_BEHIND_NS = 100_000_000
_MOST_GROWTH = 0.01
#: Seconds of ticks that are sent at once.
_SENT_S = 1.0
HEADER = (
    "until [min]",
    "memory [MB]",
    "tick p50 / p99 / worst [ms]",
    "deadlines missed",
    "tracks",
)


def send_ticks(connection: Connection, objects: int, duration_s: float) -> None:
    """Send the ticks of a drive in groups of `_SENT_S`, and in the end an empty group."""
    messages = (
        message
        for message in laps(objects, duration_s)
        if not isinstance(message, TruthState)
    )
    group = list[Tick]()
    for tick in clock_ticks(messages, NODE_HZ):
        if tick.now_ns - LAPS_START_NS > nanoseconds(duration_s):
            break
        group.append(tick)
        if len(group) >= _SENT_S * NODE_HZ:
            connection.send(group)
            group = []
    connection.send(group)
    if group:
        connection.send([])


def received_ticks(objects: int, duration_s: float) -> Iterator[Tick]:
    """Ticks of a drive that another process makes."""
    context = multiprocessing.get_context("spawn")
    receiving, sending = context.Pipe(duplex=False)
    vehicle = context.Process(
        target=send_ticks, args=(sending, objects, duration_s), daemon=True
    )
    vehicle.start()
    sending.close()
    while group := receiving.recv():
        yield from group
    vehicle.join()


def cpu_ns(tracker: fgtrack.Tracker, tick: Tick) -> int:
    """Make a tick, and return the processor time that it took."""
    before_ns = time.thread_time_ns()
    for message in tick.messages:
        tracker.receive(message)
    tracker.tick(tick.now_ns)
    tracker.tracks_at(tick.now_ns - _BEHIND_NS)
    return time.thread_time_ns() - before_ns


def drive(
    tracker: fgtrack.Tracker, objects: int, duration_s: float, num_parts: int
) -> tuple[list[Part], int]:
    """Track a drive. Return the measurements of its parts, and the number of detections that were sent."""
    parts, times_ms, missed, sent, free_ns = list[Part](), list[float](), 0, 0, 0
    period_ns, end_ns = nanoseconds(1.0 / NODE_HZ), nanoseconds(duration_s)
    for tick in received_ticks(objects, duration_s):
        passed_ns = tick.now_ns - LAPS_START_NS
        sent += sum(
            len(message.objects)
            for message in tick.messages
            if isinstance(message, DetectionList)
        )
        took_ns = cpu_ns(tracker, tick)
        free_ns = max(free_ns, tick.now_ns) + took_ns
        missed += free_ns > tick.now_ns + period_ns
        times_ms.append(took_ns / 1e6)
        if passed_ns >= end_ns / num_parts * (len(parts) + 1) - period_ns:
            times = spread(times_ms)
            num_tracks = len(tracker.tracks_at(tick.now_ns))
            part = Part(
                passed_ns / 1e9,
                memory_mb(),
                len(times_ms),
                times,
                times,
                missed,
                0,
                num_tracks,
            )
            parts.append(part)
            progress(" ".join(row(part)))
            times_ms, missed = [], 0
    return parts, sent


def row(part: Part) -> tuple[str, ...]:
    """Return the row of the table."""
    minutes, memory, _, times, missed, _, tracks = part.row()
    return minutes, memory, times, missed, tracks


def growth(parts: list[Part]) -> float:
    """Return the growth of the memory in the second half, a share."""
    half_mb = [part.memory_mb for part in parts[max(len(parts) // 2 - 1, 0) :]]
    return max(half_mb) / half_mb[0] - 1.0


def main(
    out: Annotated[
        Path, typer.Option("-o", help="Folder for deadlines.md and deadlines.json.")
    ] = Path("out/deadlines"),
    duration_s: Annotated[float, typer.Option(help="Of the drive.")] = 3600.0,
    objects: int = 20,
    estimator: str = "smoother",
    parts: Annotated[int, typer.Option(help="Rows of the table.")] = 12,
) -> None:
    """Drive, track, print the table; write deadlines.md and deadlines.json."""
    out.mkdir(parents=True, exist_ok=True)
    machine = short_machine([yardstick_us()])
    tracker = fgtrack.Tracker(
        "smoother",
        map="oval",
        pit_map="oval",
        estimator=estimator,
        set={"clock.node_hz": NODE_HZ},
    )
    gc.collect()
    gc.freeze()  # as docs/live.md advises
    measured, sent = drive(tracker, objects, duration_s, parts)
    counted = sum(sum(counts.values()) for counts in tracker.counts.values())
    missed = sum(part.missed for part in measured)
    lines = [
        machine,
        "",
        table(HEADER, [row(part) for part in measured]),
        "",
        f"{estimator}, {plural(objects)}, {NODE_HZ:g} Hz, {measured[-1].until_s / 3600.0:.2g} h: {missed} deadlines "
        f"missed, memory grew by {100.0 * growth(measured):.2f} % in the second half. {sent} detections were sent, "
        f"{counted} ended in a disposition; failures: {sum(tracker.failures.values())}.",
    ]
    text = "\n".join(lines) + "\n"
    (out / "deadlines.md").write_text(text, encoding="utf-8")
    (out / "deadlines.json").write_text(
        json.dumps([asdict(part) for part in measured], indent=1) + "\n",
        encoding="utf-8",
    )
    print(text, end="")
    if missed or growth(measured) > _MOST_GROWTH or counted != sent:
        raise SystemExit(1)


if __name__ == "__main__":
    typer.run(main)
