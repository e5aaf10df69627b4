"""Promises, tables and figure of the speed benchmark, and what all benchmarks print of machine and commit."""

import importlib.metadata
import os
import platform
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import date
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from bench_tracker import NODE_HZ, Cell, Measured

REPLAY, BACKWARD, PAPER = "ekf-replay", "ekf-backward-forward", "karle2023.yaml"
BANDED, SMOOTHER = "smoother-banded", "smoother"
REVISED = "ekf-replay, hypotheses"
"""Late lists change decisions about newer lists (`association.kind: hypotheses`)."""
REQUIRED_RATIOS = {
    1: {
        REPLAY: 4.0,
        BACKWARD: 4.0,
        PAPER: 5.0,
        BANDED: 3.0,
        SMOOTHER: 1.5,
        REVISED: 1.5,
    },
    10: {
        REPLAY: 10.0,
        BACKWARD: 10.0,
        PAPER: 12.0,
        BANDED: 6.0,
        SMOOTHER: 1.0,
        REVISED: 8.0,
    },
    50: {
        REPLAY: 25.0,
        BACKWARD: 25.0,
        PAPER: 30.0,
        BANDED: 12.0,
        SMOOTHER: 1.0,
        REVISED: 15.0,
    },
}
"""Times as fast as the published implementation, by cars and row."""
MAIN = tuple(REQUIRED_RATIOS[1])
LARGEST_P99 = 2.5  # medians
LARGEST_MS = {(REPLAY, 1000): 20.0, (BANDED, 300): 20.0}
COSTED = (
    10,
    50,
    200,
    1000,
)  # objects, whose cost must not grow; a tenth is within the noise
LARGEST_OVER_POSITION = 4.0  # times the time of x and y
REQUIRED_READING, LARGEST_REPLAY_S = 20.0, {REPLAY: 3.0, BANDED: 5.0}
PUBLISHED_MS_PER_US = {1: 0.56, 10: 3.45, 50: 20.4}
"""Median tick of the published implementation in ms per microsecond of yardstick, where its code is not at hand."""


@dataclass(frozen=True)
class Row:
    """All rounds of a cell."""

    cell: Cell
    median_ms: float
    """Median over the rounds."""
    p50_ms: float
    """As the next ones of the least time of every tick in any round: the same ticks, without what the machine did."""
    p99_ms: float
    per_detection_us: float
    tracks: float
    ratios: list[float] = field(default_factory=list)
    """Times as fast as the published implementation, by round."""

    @classmethod
    def of(
        cls, cell: Cell, rounds: Sequence[Measured], published_ms: Sequence[float]
    ) -> "Row":
        """Return the row of all rounds; `published_ms`: medians of the published implementation, by round, if any."""
        medians_ms = [median(one.ticks_ms) for one in rounds]
        least_ms = np.min([one.ticks_ms for one in rounds], axis=0)
        p50_ms, p99_ms = np.quantile(least_ms, (0.5, 0.99)).tolist()
        per_detection_us = 1e3 * float(least_ms.sum()) / rounds[0].detections
        ratios = [
            theirs / ours
            for theirs, ours in zip(published_ms, medians_ms, strict=False)
        ]
        tracks = min(one.tracks for one in rounds)
        return cls(
            cell, median(medians_ms), p50_ms, p99_ms, per_detection_us, tracks, ratios
        )


@dataclass(frozen=True)
class Promise:
    """A requirement and what was measured; NaN where it was not."""

    what: str
    measured: float
    required: float
    at_most: bool = False
    rounds: Sequence[float] = ()

    @property
    def verdict(self) -> str:
        """Return yes, NO, or that it was not measured."""
        if np.isnan(self.measured):
            return "not measured"
        return (
            "yes"
            if (
                self.measured <= self.required
                if self.at_most
                else self.measured >= self.required
            )
            else "NO"
        )

    def cell(self, short: bool = False) -> str:
        """Return the measured value, its lowest and highest round unless `short`, and where missed the requirement."""
        between = (
            f" ({min(self.rounds):.3g} to {max(self.rounds):.3g})"
            if self.rounds and not short
            else ""
        )
        return f"{_short(self.measured)}{between}{f' (target {self.required:g})' if self.verdict == 'NO' else ''}"


@dataclass
class Results:
    """Everything measured."""

    rows: list[Row] = field(default_factory=list)
    yardsticks_us: list[float] = field(default_factory=list)
    published_ms: dict[int, list[float]] = field(default_factory=dict)
    """Median tick of the published implementation by cars, of each round."""
    is_run: bool = False
    """True if the published implementation was run; else its times are those of the yardstick."""
    reading: dict[str, list[float]] = field(default_factory=dict)
    """Times real time by format, of each round."""
    replay_s: dict[str, list[float]] = field(default_factory=dict)
    """Processor time of `fgtrack replay` of the demo's minute by estimator, of each round."""
    over_position: dict[str, list[float]] = field(default_factory=dict)
    """Time of a list of 50 objects over that of a list of x and y, by estimator and kind, of each round."""
    stone_soup_us: float = float("nan")
    """Median time of one prediction and update."""

    def row(self, label: str, count: int) -> Row | None:
        """Return the row with a lag of 1 s and the paper's delays; None where cars were lost."""
        wanted = (label, count, 1.0, None)
        rows = (
            r
            for r in self.rows
            if (r.cell.label, r.cell.count, r.cell.lag_s, r.cell.delay_s) == wanted
        )
        return next((row for row in rows if row.tracks >= count), None)

    def ratio(self, label: str, count: int) -> Promise:
        """Return how many times as fast as the published implementation a cell is."""
        row, required = self.row(label, count), REQUIRED_RATIOS[count][label]
        ratios = row.ratios if row else []
        what = f"{label}, {plural(count)}: times as fast as published"
        return Promise(
            what, median(ratios) if ratios else float("nan"), required, rounds=ratios
        )

    def p99(self, label: str, count: int) -> Promise:
        """Return the 99 % quantile of a cell in medians."""
        row = self.row(label, count)
        measured = row.p99_ms / row.p50_ms if row else float("nan")
        return Promise(
            f"{label}, {plural(count)}: 99 % quantile in medians",
            measured,
            LARGEST_P99,
            at_most=True,
        )

    def others(self) -> list[Promise]:
        """Return the promises beside those of every cell."""
        promises = []
        for (label, count), largest_ms in LARGEST_MS.items():
            row = self.row(label, count)
            what = f"{label}, {plural(count)}: median tick [ms]"
            promises.append(
                Promise(
                    what,
                    row.median_ms if row else float("nan"),
                    largest_ms,
                    at_most=True,
                )
            )
        costs = [
            row.per_detection_us if (row := self.row(REPLAY, n)) else float("nan")
            for n in COSTED
        ]
        for (few, many), (first, second) in zip(
            pairwise(COSTED), pairwise(costs), strict=True
        ):
            what = f"{REPLAY}: cost of an object among {many} over that among {few}"
            promises.append(Promise(what, second / first, 1.1, at_most=True))
        for what, found in self.over_position.items():
            promises.append(
                Promise(
                    f"{what}, 50 objects: times the time of x and y",
                    median(found),
                    LARGEST_OVER_POSITION,
                    at_most=True,
                    rounds=found,
                )
            )
        for name, times in self.reading.items():
            promises.append(
                Promise(
                    f"reading {name}, 10 objects: times real time",
                    median(times),
                    REQUIRED_READING,
                )
            )
        for name, spent_s in self.replay_s.items():
            what = f"fgtrack replay of the demo's minute, {name}: processor time [s]"
            promises.append(
                Promise(what, median(spent_s), LARGEST_REPLAY_S[name], at_most=True)
            )
        return promises

    def promises(self) -> list[Promise]:
        """Return all."""
        cells = [(label, count) for count in REQUIRED_RATIOS for label in MAIN]
        return [
            *(self.ratio(*cell) for cell in cells),
            *(self.p99(*cell) for cell in cells),
            *self.others(),
        ]

    def as_dict(self) -> dict[str, Any]:
        """Return JSON values."""
        promises = [
            {**asdict(promise), "verdict": promise.verdict}
            for promise in self.promises()
        ]
        return {"machine": machine(), "promises": promises, **asdict(self)}


def machine() -> dict[str, str]:
    """Return commit, date, processor and versions that numbers belong to."""
    describe = [
        "git",
        "-C",
        str(Path(__file__).parent),
        "describe",
        "--always",
        "--dirty",
    ]
    commit = (
        subprocess.run(describe, capture_output=True, text=True).stdout.strip()
        or "unknown"
    )
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [
        line.partition(":")[2].strip()
        for line in lines
        if line.startswith("model name")
    ]
    return {
        "commit": f"{commit}, {date.today().isoformat()}",
        "processor": names[0] if names else platform.processor(),
        "cores": str(os.cpu_count()),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        **{
            name: importlib.metadata.version(name)
            for name in ("numpy", "scipy", "gtsam", "numba")
        },
    }


def short_machine(yardsticks_us: Sequence[float]) -> str:
    """Return `machine` and the yardstick as one line."""
    text = ", ".join(f"{name} {value}" for name, value in machine().items())
    return f"{text}; yardstick {median(yardsticks_us):.2f} us ({min(yardsticks_us):.2f} to {max(yardsticks_us):.2f})"


def tables(results: Results) -> str:
    """Return all tables as Markdown."""
    quantiles = [
        (str(n), *(results.p99(label, n).cell() for label in MAIN))
        for n in REQUIRED_RATIOS
    ]
    others = [
        (
            one.what,
            one.cell(),
            f"at {'most' if one.at_most else 'least'} {one.required:g}",
            one.verdict,
        )
        for one in results.others()
    ]
    kept = [row for row in results.rows if row.tracks >= row.cell.count]
    head = [
        "ticks with detections",
        "objects",
        "lag [s]",
        "delay [s]",
        "median [ms]",
        "p99 [ms]",
        "per detection [us]",
    ]
    parts = [
        short_machine(results.yardsticks_us),
        _missed(results),
        _ratios(results),
        table([f"p99 in medians (at most {LARGEST_P99}), objects", *MAIN], quantiles),
        table(["requirement", "measured", "required", "holds"], others),
        table(head, [_ticks(row) for row in kept]),
        *(
            f"{row.cell.label}, {plural(row.cell.count)}: only {row.tracks:g} tracks"
            for row in results.rows
            if row not in kept
        ),
        ""
        if np.isnan(results.stone_soup_us)
        else f"Stone Soup: {results.stone_soup_us:.3g} us per detection.",
    ]
    return "\n\n".join(filter(None, parts)) + "\n"


def page_tables(results: Results) -> str:
    """Return the answer and the tables of the page, without the spread of the rounds."""
    fastest = [label for label in MAIN if label in (REPLAY, BANDED, SMOOTHER)]
    many, few = (
        [results.ratio(label, n).measured for label in fastest]
        for n in (max(REQUIRED_RATIOS), 1)
    )
    answer = (
        f"With {plural(max(REQUIRED_RATIOS))}, {_times(fastest, many)} times as fast as "
        "the published implementation"
    )
    p99 = [results.p99(label, n) for n in REQUIRED_RATIOS for label in MAIN]
    values = [one.measured for one in p99 if not np.isnan(one.measured)] or [
        float("nan")
    ]
    kept = sum(one.verdict == "yes" for one in p99)
    quantiles = f"{min(values):.3g} to {max(values):.3g} ({kept} of {len(p99)} at most {LARGEST_P99:g})"
    own = machine()
    parts = [
        f"{answer}; with {plural(1)}, {_times(fastest, few)}. {_missed(results)}",
        f"Measured at commit {own['commit']}, {own['processor']}, {own['cores']} cores, Python {own['python']}.",
        _ratios(results, short=True),
        table(
            ["other requirements", "measured"],
            [
                *((one.what, one.cell(short=True)) for one in results.others()),
                ("99 % quantile, in medians", quantiles),
            ],
        ),
    ]
    return "\n\n".join(parts) + "\n"


def _times(labels: Sequence[str], ratios: Sequence[float]) -> str:
    return ", ".join(
        f"`{label}` is {_short(float(f'{ratio:.2g}'))}"
        for label, ratio in zip(labels, ratios, strict=True)
    )


def _missed(results: Results) -> str:
    judged = results.promises()
    source = (
        "was run in turns with fgtrack"
        if results.is_run
        else "is stood for by the yardstick"
    )
    missed = sum(one.verdict == "NO" for one in judged)
    return f"{missed} of {len(judged)} requirements missed. The published implementation {source}."


def _ratios(results: Results, short: bool = False) -> str:
    published = {
        count: f"{median(ms):.3g}" for count, ms in results.published_ms.items()
    }
    rows = [
        (
            str(n),
            published.get(n, "-"),
            *(results.ratio(label, n).cell(short) for label in MAIN),
        )
        for n in REQUIRED_RATIOS
    ]
    return table(["times as fast as published, objects", "published [ms]", *MAIN], rows)


def _ticks(row: Row) -> tuple[str, ...]:
    delay = "paper's" if row.cell.delay_s is None else f"{row.cell.delay_s:g}"
    lag = f"{row.cell.lag_s:g}" if "smoother" in row.cell.label else "-"
    return (
        row.cell.label,
        str(row.cell.count),
        lag,
        delay,
        *map(_short, (row.median_ms, row.p99_ms, row.per_detection_us)),
    )


def plural(count: float) -> str:
    """Return so many objects."""
    return f"{count:g} object{'' if count == 1 else 's'}"


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    return "\n".join(
        f"| {' | '.join(line)} |" for line in (header, ["---"] * len(header), *rows)
    )


def _short(value: float) -> str:
    return (
        "-"
        if np.isnan(value)
        else f"{value:.3g}"
        if abs(value) < 1e3
        else f"{value:.0f}"
    )


def draw(results: Results, path: Path) -> None:
    """Draw the time of a tick against the number of objects, both logarithmic."""
    figure, axes = plt.subplots(figsize=(6.5, 4.2), layout="constrained")
    counts = sorted({row.cell.count for row in results.rows})
    for label in MAIN:
        rows = [row for n in counts if (row := results.row(label, n)) is not None]
        if rows:
            (line,) = axes.loglog(
                [row.cell.count for row in rows],
                [row.median_ms for row in rows],
                "o-",
                label=label,
            )
            axes.loglog(
                [row.cell.count for row in rows],
                [row.p99_ms for row in rows],
                ":",
                color=line.get_color(),
                lw=1,
            )
    if results.published_ms:
        medians_ms = [median(ms) for ms in results.published_ms.values()]
        axes.loglog(
            list(results.published_ms),
            medians_ms,
            "ks--",
            label="published implementation",
        )
    axes.axhline(1e3 / NODE_HZ, color="0.5", lw=1)
    axes.annotate(" node period", (1.0, 1e3 / NODE_HZ), color="0.4", va="bottom")
    axes.set(
        xlabel="objects", ylabel="tick with detections [ms] (dotted: 99 % quantile)"
    )
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=90, pil_kwargs={"optimize": True})
    plt.close(figure)


def progress(line: str) -> None:
    """Print what is being measured on stderr."""
    print(line, file=sys.stderr, flush=True)


def put_into(page: Path, name: str, text: str) -> None:
    """Replace what `page` has between the marks of `name`. Raises `ValueError` where it has no such marks."""
    begin, end = f"<!-- begin {name} -->\n", f"<!-- end {name} -->\n"
    before, mark, rest = page.read_text(encoding="utf-8").partition(begin)
    _, last, after = rest.partition(end)
    if not mark or not last:
        raise ValueError(f"{page}: has no marks {begin.strip()} and {end.strip()}")
    page.write_text(
        f"{before}{begin}\n{text.strip()}\n\n{end}{after}", encoding="utf-8"
    )


def finite(value: Any) -> Any:
    """Return `value` with None for what is not a number."""
    if isinstance(value, Mapping):
        return {str(key): finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [finite(entry) for entry in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
