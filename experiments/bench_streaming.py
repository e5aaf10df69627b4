"""Which method is best when it pays for its time: streaming accuracy on the demo and with 50 objects.

    python experiments/bench_streaming.py

Both streams are replayed by every method in turn; what was published is judged when it was ready, with the times that
this machine took (of each tick the median over the rounds). The demo is the default scenario with its seed and fitted
noise, 50 objects are the traffic of `bench_tracker.py` with the settings of `smoother`. How it is judged:
docs/metrics.md, section "Streaming accuracy".
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from bench_report import progress, put_into, short_machine
from bench_tracker import scene, yardstick_us

import fgtrack
from fgtrack.core.types import Message
from fgtrack.evaluation.tables import Tables, short
from fgtrack.io.run import Table

METHODS = ("smoother-banded", "smoother", "ekf-replay", "ekf-backward-forward")
_DEMO_SEED = 1
_SAID = ("is judged when it is ready", "users also predict")  # sentences of the verdict
_TITLES = {"asked": "at its stamp", "ready": "when ready", "predicted": "predicted to then"}
_MARKS = {"best": " (best)", "tie": " (tie)", "worse": ""}


def streams(duration_s: float | None, objects: int) -> dict[str, tuple[Sequence[Message], str]]:
    """Messages and configuration by title; the demo and the traffic are at most `duration_s` long."""
    demo = list(fgtrack.simulate("default", seed=_DEMO_SEED, duration_s=duration_s))
    return {
        "the demo": (demo, "tuned"),
        f"{objects} objects": (scene(objects, min(duration_s or 8.0, 8.0)), "smoother"),
    }


def compared(messages: Sequence[Message], config: str, methods: Sequence[str], rounds: int) -> Tables:
    """The methods on one stream, in turn; of every tick the median time of all rounds counts."""
    settings = {"smoother.lagged_s": [], "smoother.final": False, "evaluation.multi_object": False}
    runs: dict[str, list[fgtrack.Run]] = {name: [] for name in methods}
    for number in range(rounds):
        for name, found in runs.items():
            progress(f"round {number + 1} of {rounds}: replaying {name}")
            found.append(fgtrack.replay(messages, config, map="oval", pit_map="oval", estimator=name, set=settings))
    return fgtrack.compare(*map(typical, runs.values()), streaming=True)


def typical(runs: Sequence[fgtrack.Run]) -> fgtrack.Run:
    """The first of equal `runs`, with the median time of every tick, as the machine has other work, too."""
    process_ns = np.median([run.tables["timing"]["process_ns"] for run in runs], axis=0).astype(np.int64)
    return runs[0].with_tables(timing=Table({**runs[0].tables["timing"], "process_ns": process_ns}))


def table(title: str, tables: Tables) -> str:
    """The rows of one stream as Markdown: what is judged, by method, and the times."""
    streaming, load = tables.tables["streaming"], tables.tables["load"]
    lines = [
        f"| {title} | {' [m] | '.join(_TITLES.values())} [m] | ready after p50 / p99 [ms] | late ticks | load [%] |",
        f"|{'---|' * 7}",
    ]
    for record in load.plain():
        mine = [row for row in streaming.plain() if row["run"] == record["run"]]
        cells = {row["judged"]: f"{short(row['position_rmse_m'])}{_MARKS[str(row['standing'])]}" for row in mine}
        times = " / ".join(f"{1e3 * float(record[f'ready_after_{q}_s'] or 0.0):.3g}" for q in ("p50", "p99"))
        late = f"{record['deadline_misses']} of {record['ticks']}"
        judged = " | ".join(cells.get(name, "-") for name in _TITLES)
        lines.append(f"| {record['run']} | {judged} | {times} | {late} | {100.0 * float(record['load'] or 0.0):.3g} |")
    return "\n".join(lines)


def main(
    out: Annotated[Path, typer.Option("-o", help="Folder for streaming.md.")] = Path("out/speed"),
    duration_s: Annotated[float | None, typer.Option(help="Shorter than the demo's minute.")] = None,
    objects: Annotated[int, typer.Option(help="Of the dense traffic.")] = 50,
    rounds: Annotated[int, typer.Option(min=1, help="Replays of every method.")] = 3,
    methods: Annotated[str, typer.Option(help="Estimators, with commas.")] = ",".join(METHODS),
    page: Annotated[Path | None, typer.Option(help="Put the tables into this page, between its marks.")] = None,
) -> None:
    """Replay, print the tables, write streaming.md."""
    out.mkdir(parents=True, exist_ok=True)
    parts = [short_machine([yardstick_us()])]
    for title, (messages, config) in streams(duration_s, objects).items():
        tables = compared(messages, config, methods.split(","), rounds)
        said = [
            line
            for line in tables.verdict
            if any(part in line for part in ("evaluated when", "users also", "falls behind"))
        ]
        parts += [table(title, tables), *said]
    text = "\n\n".join(parts) + "\n"
    (out / "streaming.md").write_text(text, encoding="utf-8")
    if page is not None:
        put_into(page, "streaming", text)
    print(text, end="")


if __name__ == "__main__":
    typer.run(main)
