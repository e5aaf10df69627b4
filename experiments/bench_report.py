"""What the benchmark has measured: rows, promises, tables and the figure."""

import importlib.metadata
import os
import platform
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from bench_tracker import NODE_HZ, PUBLISHED_MS_PER_US, Cell, Measured

ALL_OBJECTS = (1, 2, 5, 10, 20, 50, 100, 200)
BANDED, SMOOTHER, REPLAY, BACKWARD, PAPER = (
    *("smoother-banded", "smoother", "ekf-replay", "ekf-backward-forward"),
    "karle2023.yaml",
)
MAIN = (BANDED, SMOOTHER, REPLAY, BACKWARD, PAPER)


@dataclass(frozen=True)
class Row:
    """What all rounds of a cell say."""

    cell: Cell
    median_ms: float
    p99_ms: float
    """Of the medians over the rounds of every tick, as the machine has other work, too."""
    largest_ms: float
    per_detection_us: float
    yardstick_us: float
    published_ratio: float
    """How many times as fast as the published implementation; NaN where that was not measured."""
    memory_mb: float = float("nan")
    """Peak of a process of its own, above what it needs without a tracker."""

    @property
    def lost_tracks(self) -> bool:
        """Whether there were fewer tracks than objects."""
        return bool(np.isnan(self.median_ms))

    @classmethod
    def of(cls, cell: Cell, rounds: Sequence[Measured]) -> "Row":
        """Of the rounds of `cell`; without tracks of all objects the times would flatter, so there are none."""
        nan = float("nan")
        if min(one.tracks for one in rounds) < cell.count:
            return cls(cell, nan, nan, nan, nan, rounds[0].yardstick_us, nan)
        ticks_ms = np.median([one.ticks_ms for one in rounds], axis=0)
        published = PUBLISHED_MS_PER_US.get(cell.count, nan)
        return cls(
            cell,
            median_ms=float(np.median(ticks_ms)),
            p99_ms=float(np.quantile(ticks_ms, 0.99)),
            largest_ms=median(one.largest_ms for one in rounds),
            per_detection_us=median(one.per_detection_us for one in rounds),
            yardstick_us=median(one.yardstick_us for one in rounds),
            published_ratio=median(published * one.yardstick_us / one.median_ms for one in rounds),
        )


@dataclass(frozen=True)
class Bar:
    """A promise and what was measured; NaN where it was not."""

    what: str
    measured: float
    required: float
    at_most: bool = False

    @property
    def verdict(self) -> str:
        """Whether it holds."""
        if np.isnan(self.measured):
            return "not measured"
        return "yes" if (self.measured <= self.required if self.at_most else self.measured >= self.required) else "NO"


@dataclass
class Results:
    """Everything measured."""

    rows: list[Row] = field(default_factory=list)
    per_detection: list[dict[str, Any]] = field(default_factory=list)
    floors: list[dict[str, float]] = field(default_factory=list)
    against: list[dict[str, float]] = field(default_factory=list)
    stone_soup_us: float = float("nan")
    """Mean time of one prediction and update."""
    missing: list[str] = field(default_factory=list)
    """What was not measured, and why."""

    def row(self, label: str, count: int, lag_s: float = 1.0) -> Row | None:
        """The row with the paper's delays."""
        wanted = (label, count, lag_s, None)
        return next(
            (r for r in self.rows if (r.cell.label, r.cell.count, r.cell.lag_s, r.cell.delay_s) == wanted), None
        )

    def bars(self) -> list[Bar]:
        """What is promised, and what was measured."""

        def published(label: str, count: int, required: float, lag_s: float = 1.0) -> Bar:
            row = self.row(label, count, lag_s)
            lag = f", {lag_s:g} s lag" if "smoother" in label else ""
            what = f"{label}, {plural(count)}{lag}: times as fast as the published implementation"
            return Bar(what, row.published_ratio if row else float("nan"), required)

        banded = {count: self.row(BANDED, count) for count in (5, 10, 50, 200)}
        fifty, few, many, ten = banded[50], banded[5], banded[200], banded[10]
        return [
            published(BANDED, 50, 4.0),
            Bar(
                f"{BANDED}, 50 objects, 1 s lag: 99 % quantile of a tick, in medians",
                fifty.p99_ms / fifty.median_ms if fifty else float("nan"),
                2.5,
                at_most=True,
            ),
            published(BANDED, 50, 3.0, 3.0),
            published(BANDED, 10, 2.0),
            published(BANDED, 1, 1.0),
            published(REPLAY, 50, 6.0),
            published(BACKWARD, 50, 8.0),
            published(PAPER, 50, 12.0),
            Bar(
                f"{BANDED}: time per detection with 200 objects over that with 5",
                many.per_detection_us / few.per_detection_us if few and many else float("nan"),
                1.3,
                at_most=True,
            ),
            Bar(
                f"{BANDED}, 10 objects: times as fast as Stone Soup's EKF, per detection",
                self.stone_soup_us / ten.per_detection_us if ten else float("nan"),
                4.0,
            ),
            *(
                Bar(f"{SMOOTHER}, {plural(one['count'])}: times as fast as the older checkout", one["ratio"], 1.5)
                for one in self.against
            ),
        ]

    def as_dict(self) -> dict[str, Any]:
        """JSON values."""
        return {
            "machine": machine(),
            "bars": [{**asdict(bar), "verdict": bar.verdict} for bar in self.bars()],
            "ticks": [asdict(row) for row in self.rows],
            "per_detection": self.per_detection,
            "stone_soup_us": self.stone_soup_us,
            "missing": self.missing,
            "floor": self.floors,
            "against": self.against,
        }


def machine() -> dict[str, str]:
    """What the numbers belong to."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    versions = {name: importlib.metadata.version(name) for name in ("numpy", "scipy", "gtsam", "numba")}
    return {
        "processor": names[0] if names else platform.processor(),
        "cores": str(os.cpu_count()),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        **versions,
    }


def short_machine(yardsticks_us: Sequence[float]) -> str:
    """What the numbers belong to, in a line."""
    text = ", ".join(f"{name} {value}" for name, value in machine().items())
    if not yardsticks_us:
        return text
    return f"{text}; yardstick {median(yardsticks_us):.2f} us ({min(yardsticks_us):.2f} to {max(yardsticks_us):.2f})"


def tables(results: Results) -> str:
    """All tables as Markdown."""
    parts = [
        short_machine([row.yardstick_us for row in results.rows]),
        _table(
            ["what", "measured", "required", "holds"],
            [
                (
                    bar.what,
                    _short(bar.measured),
                    f"at {'most' if bar.at_most else 'least'} {bar.required:g}",
                    bar.verdict,
                )
                for bar in results.bars()
            ],
        ),
        _table(
            [
                *(
                    "ticks with detections",
                    "objects",
                    "lag [s]",
                    "delay [s]",
                    "median [ms]",
                    "p99 [ms]",
                    "largest [ms]",
                ),
                *("per detection [us]", "times as fast as published", "memory [MB]"),
            ],
            [_tick_cells(row) for row in results.rows],
        ),
        _table(
            ["one object, per detection", "median [us]", "in sequence", "late", "p99", "mean", "error at the end [m]"],
            [tuple(map(_short, one.values())) for one in results.per_detection],
        ),
        *results.missing,
        _table(
            ["floor: objects", "rows", "LAPACK [us]", "gtsam [us]"],
            [tuple(map(_short, one.values())) for one in results.floors],
        ),
        _table(
            [f"{SMOOTHER}: objects", "now [ms]", "older checkout [ms]", "ratio", "lowest", "highest"],
            [tuple(map(_short, one.values())) for one in results.against],
        ),
    ]
    return "\n\n".join(filter(None, parts)) + "\n"


def _tick_cells(row: Row) -> tuple[str, ...]:
    one = row.cell
    delay = "paper's" if one.delay_s is None else f"{one.delay_s:g}"
    lag = f"{one.lag_s:g}" if "smoother" in one.label else "-"
    numbers = (row.median_ms, row.p99_ms, row.largest_ms, row.per_detection_us, row.published_ratio, row.memory_mb)
    return (one.label, str(one.count), lag, delay, *map(_short, numbers))


def plural(count: float) -> str:
    """So many objects."""
    return f"{count:g} object{'' if count == 1 else 's'}"


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """As Markdown; without the columns in which nothing was measured."""
    if not rows:
        return ""
    kept = [k for k in range(len(header)) if any(row[k] != "-" for row in rows)]
    lines = (header, ["---"] * len(header), *rows)
    return "\n".join(f"| {' | '.join(line[k] for k in kept)} |" for line in lines)


def _short(value: float | str) -> str:
    return (
        value
        if isinstance(value, str)
        else "-"
        if np.isnan(value)
        else f"{value:.3g}"
        if abs(value) < 1e3
        else f"{value:.0f}"
    )


def draw(results: Results, path: Path) -> None:
    """Time of a tick against the number of objects, both logarithmic."""
    figure, axes = plt.subplots(figsize=(6.5, 4.2), layout="constrained")
    for label in MAIN:
        rows = [row for n in ALL_OBJECTS if (row := results.row(label, n)) is not None]
        if rows:
            axes.loglog([row.cell.count for row in rows], [row.median_ms for row in rows], "o-", label=label)
            color = axes.lines[-1].get_color()
            axes.loglog([row.cell.count for row in rows], [row.p99_ms for row in rows], ":", color=color, lw=1)
    if results.rows:
        yard_us = median(row.yardstick_us for row in results.rows)
        published_ms = [ms * yard_us for ms in PUBLISHED_MS_PER_US.values()]
        axes.loglog(list(PUBLISHED_MS_PER_US), published_ms, "ks--", label="published implementation")
    axes.axhline(1e3 / NODE_HZ, color="0.5", lw=1)
    axes.annotate(" node period", (1.0, 1e3 / NODE_HZ), color="0.4", va="bottom")
    axes.set(xlabel="objects", ylabel="tick with detections [ms] (dotted: 99 % quantile)")
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=90, pil_kwargs={"optimize": True})
    plt.close(figure)


def progress(line: str) -> None:
    """Say what is being measured."""
    print(line, file=sys.stderr, flush=True)


def put_into(page: Path, name: str, text: str) -> None:
    """Replace what `page` has between the marks of `name`. Raises `ValueError` where it has no such marks."""
    begin, end = f"<!-- begin {name} -->\n", f"<!-- end {name} -->\n"
    before, mark, rest = page.read_text(encoding="utf-8").partition(begin)
    _, last, after = rest.partition(end)
    if not mark or not last:
        raise ValueError(f"{page}: has no marks {begin.strip()} and {end.strip()}")
    page.write_text(f"{before}{begin}\n{text.strip()}\n\n{end}{after}", encoding="utf-8")


def finite(value: Any) -> Any:
    """`value` with None for what is not a number."""
    if isinstance(value, Mapping):
        return {key: finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [finite(entry) for entry in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
