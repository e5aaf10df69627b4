"""A day of simulated race at 50 Hz, in one process, as fast as it goes.

    python experiments/bench_soak.py                               # 24 hours of race, twice
    python experiments/bench_soak.py --hours 0.02 --parts 4        # a short run

One car stays near the ego; others overtake or are overtaken. Lists are late, bursty, repeated or lost; sensors fall
silent; their clocks are off, drift and jitter; some stamps are off by up to an hour, also of the ego. The race is made
lap by lap and the rows of a run folder are only counted and hashed, so that nothing but the tracker can grow.
"""

import gc
import json
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any

import matplotlib.pyplot as plt
import numpy as np
import typer
from bench_memory import LAPS_START_NS, joined, memory_mb, whole_laps
from bench_report import progress, short_machine, table
from bench_tracker import NODE_HZ, yardstick_us
from joblib import Parallel, delayed

import fgtrack
from fgtrack import (
    DetectionList,
    Disposition,
    EgoState,
    Message,
    TruthState,
    nanoseconds,
    simulate,
)
from fgtrack.estimation.failures import Failure
from fgtrack.pipeline.clock import clock_ticks
from fgtrack.runs.rows import Row, text
from fgtrack.runs.sink import RunSink
from fgtrack.sim import (
    LIDAR_DELAY,
    RADAR_DELAY,
    ArrivalClock,
    Clutter,
    ConstantDelay,
    DriftClock,
    JitterClock,
    LossyDelay,
    MarkovTimeDelay,
    OffsetClock,
    Scenario,
    SimulatedSensor,
    TrackVehicle,
)

Sent = EgoState | DetectionList

#: By how much a stamp is off, now and then.
_WRONG_S = (-3600.0, -60.0, -5.0, -1.0, 0.5, 5.0, 60.0, 3600.0)
_WRONG_LIST, _WRONG_EGO, _REPEATED, _NO_NUMBERS = 1e-3, 1e-4, 5e-3, 1e-3
#: Failures that wrong stamps and false tracks bring about, and no fault of the tracker.
_OF_THE_DATA = (Failure.STEP_DAMPED,)
_MOST_GROWTH = 0.01


def race(rng: np.random.Generator, lap_s: float, speed_mps: float) -> Scenario:
    """Return one lap: the ego and one car beside it as in every lap; others, delays and clocks are drawn."""
    ego_m = 100.0
    cars = [TrackVehicle(arc_m=ego_m + 25.0, lateral_m=3.0, speed=((0.0, speed_mps),))]
    for _ in range(int(rng.integers(0, 4))):
        faster_mps, beside_s = (
            rng.choice((-1.0, 1.0)) * rng.uniform(4.0, 12.0),
            rng.uniform(0.0, lap_s),
        )
        start_m = ego_m - faster_mps * beside_s
        lateral_m = rng.uniform(-5.0, 0.0)
        cars.append(
            TrackVehicle(
                arc_m=start_m,
                lateral_m=lateral_m,
                speed=((0.0, speed_mps + faster_mps),),
            )
        )
    silent_s = rng.uniform(0.0, lap_s - 3.0)
    slow = MarkovTimeDelay(LIDAR_DELAY, ConstantDelay(0.27), 0.04, 0.67)
    lidar = SimulatedSensor(
        "lidar_cluster",
        {"x_m": 0.3, "y_m": 0.1},
        max_range_m=98.0,
        max_range_behind_m=57.0,
        detection_probability=0.95,
        clutter=Clutter(0.02, "track"),
        split_probability=0.02,
        outlier_probability=0.01,
        drop_outs=((silent_s, silent_s + 2.0),) if rng.random() < 0.2 else (),
        delay=LossyDelay(0.03, slow),
        clock=(
            OffsetClock(rng.uniform(-0.01, 0.01)),
            DriftClock(40.0),
            JitterClock(0.002),
        ),
    )
    radar = SimulatedSensor(
        "radar",
        {"x_m": 0.8, "y_m": 0.4, "speed_mps": 1.0},
        phase_s=0.02,
        field_of_view_rad=1.57,
        max_range_m=105.0,
        detection_probability=0.8,
        clutter=Clutter(0.02, "track", (0.0, 5.0)),
        delay=MarkovTimeDelay(
            RADAR_DELAY, ConstantDelay(0.35), to_bad_per_s=0.05, to_good_per_s=1.0
        ),
        clock=(ArrivalClock(), OffsetClock(-0.06))
        if rng.random() < 0.2
        else (JitterClock(0.002),),
    )
    driven = TrackVehicle(arc_m=ego_m, speed=((0.0, speed_mps),))
    return Scenario(
        driven, tuple(cars), (lidar, radar), duration_s=lap_s, truth_rate_hz=1.0
    )


def messages(hours: float, seed: int) -> Iterator[Sent]:
    """The race in order of receipt, made lap by lap."""
    lap_s, speed_mps = whole_laps()
    laps_rng, wrong_rng = np.random.default_rng(seed).spawn(2)

    def lap(number: int, begun_ns: int) -> Iterable[Message]:
        (rng,) = laps_rng.spawn(1)
        drawn = simulate(
            replace(race(rng, lap_s, speed_mps), start_ns=begun_ns), seed=rng
        )
        return [message for message in drawn if not isinstance(message, TruthState)]

    ends_ns = LAPS_START_NS + nanoseconds(3600.0 * hours)
    for message in corrupted(
        wrong_rng, joined(lap, lap_s, int(np.ceil(3600.0 * hours / lap_s)))
    ):
        if message.receipt_ns > ends_ns:
            return
        yield message


def corrupted(
    rng: np.random.Generator, race_messages: Iterable[Message]
) -> Iterator[Sent]:
    """The race with wrong stamps, values that are not numbers, and lists that are repeated, some after others."""
    again: list[DetectionList] = []
    for message in race_messages:
        while again and again[0].receipt_ns <= message.receipt_ns:
            yield again.pop(0)
        if isinstance(message, TruthState):
            continue
        wrong = rng.random() < (
            _WRONG_EGO if isinstance(message, EgoState) else _WRONG_LIST
        )
        if wrong:
            message = replace(
                message,
                stamp_ns=message.stamp_ns + nanoseconds(float(rng.choice(_WRONG_S))),
            )
        if isinstance(message, DetectionList):
            if message.objects and rng.random() < _NO_NUMBERS:
                invalid = fgtrack.Detection(x_m=float("nan"), y_m=float("nan"))
                message = replace(message, objects=(invalid, *message.objects[1:]))
            if rng.random() < _REPEATED:
                due_ns = message.receipt_ns + nanoseconds(float(rng.uniform(0.0, 0.2)))
                again = sorted(
                    [*again, replace(message, receipt_ns=due_ns)],
                    key=lambda one: one.receipt_ns,
                )
        yield message
    yield from again


class HashedRun(RunSink):
    """Takes a run as it goes; keeps the hash and the number of its rows."""

    def __init__(self) -> None:
        super().__init__("", None, 0.3)
        self._sha = sha256()
        self.rows = 0

    def _append(self, table: str, found: Sequence[Row]) -> None:
        self._sha.update(f"{table}\n{text(table, found)}".encode())
        self.rows += len(found)

    def _digest(self) -> str:
        return self._sha.hexdigest()

    @property
    def digest(self) -> str:
        """SHA-256 of all rows so far, in hex; the times of ticks are 0 in them."""
        return self._digest()


@dataclass(frozen=True)
class Part:
    """Measurements of a part of the race; counts and rows are of all the race up to its end."""

    until_h: float
    memory_mb: float
    tick_us: tuple[float, float]
    """Median and 99th percentile of the ticks with detections: time of the processor."""
    yardstick_us: float
    tracks: float
    """Mean number."""
    sent: int
    """Detections."""
    counts: Mapping[str, int]
    """By disposition."""
    refused: Mapping[str, int]
    failures: Mapping[str, int]
    rows: int
    digest: str
    wall_s: float

    @property
    def in_yardsticks(self) -> float:
        """Median tick."""
        return self.tick_us[0] / self.yardstick_us


def soak(hours: float, parts: int, estimator: str, seed: int, file: Path) -> list[Part]:
    """Track the race; `file` has every part as soon as it is over."""
    tracker = fgtrack.Tracker.from_config(
        "smoother", map="oval", pit_map="oval", estimator=estimator
    )
    run, found = HashedRun(), list[Part]()
    spent_us, tracked, detections = (
        np.empty(int(3600.0 * hours * NODE_HZ / parts) + 2),
        0,
        0,
    )
    ticks = with_lists = 0
    began_s = time.perf_counter()
    for tick in clock_ticks(messages(hours, seed), NODE_HZ):
        lists = sum(
            len(message.objects)
            for message in tick.messages
            if isinstance(message, DetectionList)
        )
        before_ns = time.thread_time_ns()
        for message in tick.messages:
            tracker.receive(message)
        report = tracker.tick(tick.now_ns)
        if lists and with_lists < len(spent_us):
            spent_us[with_lists] = (time.thread_time_ns() - before_ns) / 1e3
            with_lists += 1
        run.write_tick(report, 0, lists)
        detections, tracked, ticks = (
            detections + lists,
            tracked + len(report.tracks),
            ticks + 1,
        )
        passed_h = (tick.now_ns - LAPS_START_NS) / 3.6e12
        if passed_h >= hours * (len(found) + 1) / parts:
            gc.collect()
            counts = sum(map(Counter, tracker.counts.values()), Counter[str]())
            median_us, p99_us = np.quantile(spent_us[:with_lists], (0.5, 0.99)).tolist()
            found.append(
                Part(
                    passed_h,
                    memory_mb(),
                    (median_us, p99_us),
                    yardstick_us(),
                    tracked / ticks,
                    detections,
                    {str(each): counts[each] for each in Disposition},
                    dict(tracker.refused),
                    dict(tracker.failures),
                    run.rows,
                    run.digest,
                    time.perf_counter() - began_s,
                )
            )
            file.write_text(
                json.dumps([asdict(part) for part in found], indent=1) + "\n",
                encoding="utf-8",
            )
            progress(f"{estimator}: {' '.join(row(found[-1]))}")
            tracked = ticks = with_lists = 0
    return found


def row(part: Part) -> tuple[str, ...]:
    """Return the row of the table."""
    times = f"{part.tick_us[0] / 1e3:.2f} / {part.tick_us[1] / 1e3:.2f}"
    counts = (part.counts["birth"], part.sent, sum(part.counts.values()))
    measured = (
        f"{part.until_h:.3g}",
        f"{part.memory_mb:.1f}",
        times,
        f"{part.in_yardsticks:.0f}",
        f"{part.tracks:.2f}",
    )
    return (*measured, *map(str, counts), part.digest[:12])


def problems(runs: Sequence[Sequence[Part]]) -> list[str]:
    """Return the promises that do not hold; runs that broke off are judged as far as they go."""
    failed = []
    for number, parts in enumerate(runs, start=1):
        failed += [
            f"run {number}: {part.sent} detections were sent, {sum(part.counts.values())} ended in a disposition"
            for part in parts
            if part.sent != sum(part.counts.values())
        ][:1]
        failures = {
            kind: count
            for kind, count in parts[-1].failures.items()
            if kind not in _OF_THE_DATA
        }
        if failures:
            failed.append(f"run {number}: failures: {failures}")
        if growth(parts) > _MOST_GROWTH:
            failed.append(f"run {number}: memory grew by {100.0 * growth(parts):.2f} %")
    for together in zip(*runs, strict=False):
        if len({(part.digest, part.rows) for part in together}) > 1:
            failed.append(f"the runs differ up to {together[0].until_h:.3g} h")
            break
    return failed


def growth(parts: Sequence[Part]) -> float:
    """Return the growth of memory from the end of the first sixth of the time to its largest afterwards; a share."""
    held_mb = [part.memory_mb for part in parts[max(len(parts) // 6 - 1, 0) :]]
    return max(held_mb) / held_mb[0] - 1.0


def summary(estimator: str, runs: Sequence[Sequence[Part]], rows: int = 12) -> str:
    """Return the first run as Markdown, and the comparison of all."""
    first, last = runs[0], runs[0][-1]
    chosen = sorted(
        {round((k + 1) * len(first) / rows) - 1 for k in range(rows)} - {-1}
    )
    header = [
        "until [h]",
        "memory [MB]",
        "tick p50 / p99 [ms]",
        "p50 in yardsticks",
        "tracks",
        "births",
        "sent",
    ]
    shares = {
        name: f"{name} {100.0 * count / max(last.sent, 1):.2g} %"
        for name, count in last.counts.items()
        if count
    }
    refused = [f"{name} {count}" for name, count in sorted(last.refused.items())]
    failures = [f"{name} {count}" for name, count in last.failures.items()]
    ticks, third = [part.in_yardsticks for part in first], max(len(first) // 3, 1)
    slowing = float(np.median(ticks[-third:]) / np.median(ticks[:third]))
    lines = [
        short_machine([part.yardstick_us for part in first]),
        table(
            [*header, "with a disposition", "digest of all rows"],
            [row(first[number]) for number in chosen],
        ),
        f"{estimator}: {len(runs)} times {last.until_h:.3g} h of race in {last.wall_s / 3600.0:.2g} h. Memory grew by "
        f"{100.0 * growth(first):.2f} % after the first sixth, the median tick changed by "
        f"{100.0 * (slowing - 1.0):.0f} % from the first third to the last. "
        f"Refused: {', '.join(refused) or 'nothing'}; failures: {', '.join(failures) or 'none'}. "
        f"Dispositions: {', '.join(shares.values())}.",
        *(f"NOT AS PROMISED: {problem}" for problem in problems(runs)),
    ]
    return "\n\n".join(lines) + "\n"


def draw(estimator: str, parts: Sequence[Part], path: Path) -> None:
    """Draw memory, time of a tick and tracks over the time of the race."""
    until_h = [part.until_h for part in parts]
    figure, axes = plt.subplots(
        3, figsize=(7.0, 5.5), sharex=True, layout="constrained"
    )
    axes[0].plot(until_h, [part.memory_mb for part in parts], label=estimator)
    axes[1].plot(until_h, [part.in_yardsticks for part in parts])
    axes[1].plot(
        until_h,
        [part.tick_us[1] / part.yardstick_us for part in parts],
        ":",
        color="C0",
    )
    axes[2].plot(until_h, [part.tracks for part in parts])
    axes[0].legend(fontsize=8, loc="lower right")
    axes[2].set_xlabel("time of the race [h]")
    for each, label in zip(
        axes,
        ("memory [MB]", "tick [yardsticks]\n(dotted: 99 %)", "tracks, mean"),
        strict=True,
    ):
        each.set(ylabel=label, ylim=(0.0, 1.15 * each.dataLim.ymax))
        each.grid(alpha=0.3)
    figure.savefig(path, dpi=90, pil_kwargs={"optimize": True})
    plt.close(figure)


def main(
    out: Annotated[
        Path, typer.Option("-o", help="Folder for the table, figure and numbers.")
    ] = Path("out/soak"),
    hours: Annotated[float, typer.Option(help="Of the race.")] = 24.0,
    parts: Annotated[int, typer.Option(help="Points of the figure.")] = 48,
    estimator: str = "ekf-replay",
    runs: Annotated[int, typer.Option(help="That must give the same rows.")] = 2,
    jobs: int = 2,
    seed: int = 0,
) -> None:
    """Race, print the table; write soak.md, soak.png and the parts. Exits 1 where a promise does not hold."""
    out.mkdir(parents=True, exist_ok=True)
    files = [out / f"{estimator}-{number}.json" for number in range(1, runs + 1)]
    measured: list[Any] = Parallel(n_jobs=jobs)(
        delayed(soak)(hours, parts, estimator, seed, file) for file in files
    )
    said = summary(estimator, measured)
    (out / "soak.md").write_text(said, encoding="utf-8")
    draw(estimator, measured[0], out / "soak.png")
    print(said, end="")
    if problems(measured):
        raise SystemExit(1)


if __name__ == "__main__":
    typer.run(main)
