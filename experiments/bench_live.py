"""An hour in a running system: ticks at 50 Hz by the clock of the machine.

    python experiments/bench_live.py                     # an hour
    python experiments/bench_live.py --duration-s 60     # a short run

One process is the vehicle: cars drive lap after lap on the built-in oval with the paper's sensors, and every message is
sent when it is due. The other one is the tracker: a thread receives, the main thread ticks. Every detection sent must
end in one disposition.
"""

import json
import multiprocessing
import queue
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from bench_memory import LAPS_START_NS, laps, memory_mb
from bench_report import plural, progress, short_machine, table
from bench_tracker import yardstick_us

import fgtrack
from fgtrack import nanoseconds

Sent = fgtrack.EgoState | fgtrack.DetectionList

_BEGIN_S = 1.0  # until the first message


def sleep_until(due_ns: int) -> None:
    """Sleep until a time of the system's clock."""
    left_ns = due_ns - time.time_ns()
    if left_ns > 0:
        time.sleep(left_ns / 1e9)


def made_ahead(objects: int, duration_s: float) -> Iterator[Sent]:
    """Messages of `laps` up to a receipt, made by a thread before they are due."""
    made: queue.Queue[Sent | None] = queue.Queue(10_000)

    def make() -> None:
        for message in laps(objects, duration_s):
            if not isinstance(message, fgtrack.TruthState):
                made.put(message)
        made.put(None)

    threading.Thread(target=make, daemon=True).start()
    while (
        message := made.get()
    ) is not None and message.receipt_ns - LAPS_START_NS <= nanoseconds(duration_s):
        yield message


def drive(connection: Connection, objects: int, duration_s: float) -> None:
    """Send every message when it is due, and in the end the number of detections by sensor."""
    sent: dict[str, int] = {}
    shift_ns = None
    for message in made_ahead(objects, duration_s):
        if shift_ns is None:
            shift_ns = time.time_ns() + nanoseconds(_BEGIN_S) - LAPS_START_NS
        sleep_until(message.receipt_ns + shift_ns)
        if isinstance(message, fgtrack.DetectionList):
            sent[message.sensor] = sent.get(message.sensor, 0) + len(message.objects)
        connection.send(replace(message, stamp_ns=message.stamp_ns + shift_ns))
    connection.send(sent)


@dataclass
class Receiver:
    """The thread that stamps messages with their receipt and passes them on, until the vehicle has stopped."""

    connection: Connection
    tracker: fgtrack.Tracker
    sent: dict[str, int] = field(default_factory=dict)
    """Detections by sensor."""
    begun: threading.Event = field(default_factory=threading.Event)
    over: threading.Event = field(default_factory=threading.Event)

    def run(self) -> None:
        """Receive everything."""
        while isinstance(message := self.connection.recv(), Sent):
            self.tracker.receive(replace(message, receipt_ns=time.time_ns()))
            self.begun.set()
        self.sent |= message
        self.over.set()


@dataclass
class Part:
    """Measurements of a part of the time."""

    until_s: float
    memory_mb: float
    ticks: int
    tick_ms: list[float]
    """Median, 99th percentile, largest."""
    cpu_ms: list[float]
    """Of the ticking thread alone: other processes of the machine take nothing of it."""
    missed: int
    skipped: int
    tracks: int

    def row(self) -> tuple[str, ...]:
        """Return the row of the table."""
        times = (
            f"{p50:.2f} / {p99:.2f} / {worst:.1f}"
            for p50, p99, worst in (self.tick_ms, self.cpu_ms)
        )
        missed = f"{self.missed} of {self.ticks}"
        return (
            f"{self.until_s / 60.0:.3g}",
            f"{self.memory_mb:.1f}",
            *times,
            missed,
            str(self.skipped),
            str(self.tracks),
        )


def spread(values: Sequence[float]) -> list[float]:
    """Median, 99th percentile, largest."""
    return np.quantile(values, (0.5, 0.99, 1.0)).tolist()


def track(
    receiver: Receiver, hz: float, duration_s: float, num_parts: int
) -> list[Part]:
    """Tick at multiples of the period, from the first message until the vehicle has stopped."""
    step_ns = round(1e9 / hz)
    receiver.begun.wait()
    begun_ns = due_ns = -(-time.time_ns() // step_ns) * step_ns
    parts: list[Part] = []
    tick_ms, cpu_ms, missed, skipped = list[float](), list[float](), 0, 0
    while True:
        sleep_until(due_ns)
        over = receiver.over.is_set()  # then this tick processes all
        before_ns, cpu_ns = time.perf_counter_ns(), time.thread_time_ns()
        report = receiver.tracker.tick(due_ns)
        cpu_ms.append((time.thread_time_ns() - cpu_ns) / 1e6)
        tick_ms.append((time.perf_counter_ns() - before_ns) / 1e6)
        done_ns = time.time_ns()
        missed += done_ns > due_ns + step_ns
        passed_s = (due_ns - begun_ns) / 1e9
        if over or (
            passed_s >= duration_s / num_parts * (len(parts) + 1)
            and len(parts) + 1 < num_parts
        ):
            times = (len(tick_ms), spread(tick_ms), spread(cpu_ms))
            parts.append(
                Part(passed_s, memory_mb(), *times, missed, skipped, len(report.tracks))
            )
            progress(" ".join(parts[-1].row()))
            tick_ms, cpu_ms, missed, skipped = [], [], 0, 0
        if over:
            return parts
        following_ns = max(due_ns + step_ns, -(-done_ns // step_ns) * step_ns)
        skipped += (following_ns - due_ns) // step_ns - 1
        due_ns = following_ns


def main(
    out: Annotated[
        Path, typer.Option("-o", help="Folder for live.md and live.json.")
    ] = Path("out/live"),
    duration_s: Annotated[
        float, typer.Option(help="By the clock of the machine.")
    ] = 3600.0,
    hz: Annotated[float, typer.Option(help="Ticks in a second.")] = 50.0,
    objects: int = 3,
    estimator: str = "smoother-banded",
    parts: Annotated[int, typer.Option(help="Rows of the table.")] = 12,
) -> None:
    """Drive, track, print the table; write live.md and live.json. Exits 1 where a detection is not accounted for."""
    out.mkdir(parents=True, exist_ok=True)
    machine = short_machine([yardstick_us()])
    tracker = fgtrack.Tracker.from_config(
        "smoother",
        map="oval",
        pit_map="oval",
        estimator=estimator,
        set={"clock.node_hz": hz},
    )
    context = multiprocessing.get_context("spawn")
    receiving, sending = context.Pipe(duplex=False)
    vehicle = context.Process(
        target=drive, args=(sending, objects, duration_s), daemon=True
    )
    vehicle.start()
    sending.close()
    receiver = Receiver(receiving, tracker)
    threading.Thread(target=receiver.run, daemon=True).start()
    measured = track(receiver, hz, duration_s, parts)
    vehicle.join()
    sent = receiver.sent
    counted = {
        sensor: sum(counts.values()) for sensor, counts in tracker.counts.items()
    }
    result = {
        "sent": sent,
        "counts": tracker.counts,
        "refused": tracker.refused,
        "failures": tracker.failures,
        "lateness": {name: asdict(one) for name, one in tracker.lateness.items()},
        "timing": asdict(tracker.timing),
        "parts": [asdict(part) for part in measured],
    }
    (out / "live.json").write_text(
        json.dumps(result, indent=1, default=dict) + "\n", encoding="utf-8"
    )
    half_mb = [part.memory_mb for part in measured[max(len(measured) // 2 - 1, 0) :]]
    header = [
        "until [min]",
        "memory [MB]",
        "tick p50 / p99 / worst [ms]",
        "of that CPU [ms]",
        "deadlines missed",
    ]
    lines = [
        machine,
        "",
        table([*header, "ticks skipped", "tracks"], [part.row() for part in measured]),
        "",
        f"{estimator}, {plural(objects)}, {hz:g} Hz, {measured[-1].until_s / 3600.0:.2g} h: memory grew by "
        f"{half_mb[-1] - half_mb[0]:.1f} MB in the second half. {sum(sent.values())} detections were sent, "
        f"{sum(counted.values())} ended in a disposition; failures: {sum(tracker.failures.values())}.",
    ]
    text = "\n".join(lines) + "\n"
    (out / "live.md").write_text(text, encoding="utf-8")
    print(text, end="")
    if counted != sent:
        raise SystemExit(f"sent {sent}, accounted for {counted}")


if __name__ == "__main__":
    typer.run(main)
