"""Streaming accuracy of the estimators, on the demo and with 50 objects (docs/metrics.md, "Streaming accuracy").

    python experiments/bench_streaming.py

The demo has its tuned noise, the traffic is that of `bench_tracker.py` with the settings of `smoother`.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from bench_report import progress, short_machine, table
from bench_tracker import scene, yardstick_us

import fgtrack
from fgtrack import Message, Tables
from fgtrack.evaluation import Columns, short

METHODS = ("smoother-banded", "smoother", "ekf-replay", "ekf-backward-forward")
JUDGED = {
    "asked": "at its stamp [m]",
    "ready": "when ready [m]",
    "predicted": "predicted to then [m]",
}
_MARKS = {
    "best": " (best)",
    "tie": " (tie)",
    "unresolved": " (not resolved)",
    "worse": "",
}


def streams(
    duration_s: float | None, objects: int
) -> dict[str, tuple[Sequence[Message], str]]:
    """Messages and configuration by title; the demo and the traffic are at most `duration_s` long."""
    demo = list(fgtrack.simulate("default", seed=1, duration_s=duration_s))
    return {
        "the demo": (demo, "tuned"),
        f"{objects} objects": (scene(objects, min(duration_s or 8.0, 8.0)), "smoother"),
    }


def compared(
    messages: Sequence[Message], config: str, methods: Sequence[str], rounds: int
) -> Tables:
    """The methods on one stream, in turn; of every tick the median time of all rounds counts."""
    settings = {
        "smoother.lagged_s": [],
        "smoother.final": False,
        "evaluation.multi_object": False,
    }
    runs: dict[str, list[fgtrack.Run]] = {name: [] for name in methods}
    for number in range(rounds):
        for name, found in runs.items():
            progress(f"round {number + 1} of {rounds}: replaying {name}")
            found.append(
                fgtrack.replay(
                    messages,
                    config,
                    map="oval",
                    pit_map="oval",
                    estimator=name,
                    set=settings,
                )
            )
    return fgtrack.compare(*map(typical, runs.values()), streaming=True)


def typical(runs: Sequence[fgtrack.Run]) -> fgtrack.Run:
    """The first of equal `runs`, with the median time of every tick, as the machine has other work, too."""
    process_ns = np.median(
        [run.tables["timing"]["process_ns"] for run in runs], axis=0
    ).astype(np.int64)
    return runs[0].with_tables(
        timing=Columns({**runs[0].tables["timing"], "process_ns": process_ns})
    )


def rows(tables: Tables) -> list[list[str]]:
    """Rows of one stream: errors as judged, by method, and the times."""
    result = []
    for load in tables.tables["load"].plain():
        mine = [
            row
            for row in tables.tables["streaming"].plain()
            if row["run"] == load["run"]
        ]
        errors = {
            row[
                "judged"
            ]: f"{short(row['position_rmse_m'])}{_MARKS[str(row['standing'])]}"
            for row in mine
        }
        times = " / ".join(
            f"{1e3 * float(load[f'ready_after_{q}_s'] or 0.0):.3g}"
            for q in ("p50", "p99")
        )
        late = f"{load['deadline_misses']} of {load['ticks']}"
        result.append(
            [str(load["run"]), *(errors.get(name, "-") for name in JUDGED), times, late]
        )
    return result


def main(
    out: Annotated[Path, typer.Option("-o", help="Folder for streaming.md.")] = Path(
        "out/speed"
    ),
    duration_s: Annotated[
        float | None, typer.Option(help="Shorter than the demo's minute.")
    ] = None,
    objects: Annotated[int, typer.Option(help="Of the dense traffic.")] = 50,
    rounds: Annotated[int, typer.Option(min=1, help="Replays of every method.")] = 3,
    methods: Annotated[str, typer.Option(help="Estimators, with commas.")] = ",".join(
        METHODS
    ),
) -> None:
    """Replay, print the tables, write streaming.md."""
    out.mkdir(parents=True, exist_ok=True)
    parts = [short_machine([yardstick_us()])]
    for title, (messages, config) in streams(duration_s, objects).items():
        tables = compared(messages, config, methods.split(","), rounds)
        header = [title, *JUDGED.values(), "ready after p50 / p99 [ms]", "late ticks"]
        parts += [
            table(header, rows(tables)),
            *(line for line in tables.verdict if "evaluated when" in line),
        ]
    text = "\n\n".join(parts) + "\n"
    (out / "streaming.md").write_text(text, encoding="utf-8")
    print(text, end="")


if __name__ == "__main__":
    typer.run(main)
