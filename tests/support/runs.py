"""Runs of a simulated race, for the tests of pictures, reports and viewers."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import fgtrack


def replayed(
    folder: Path,
    duration_s: float,
    estimators: Sequence[str],
    settings: Mapping[str, object] | None = None,
) -> Path:
    """`folder` with `drive.jsonl`, the default scenario, and a run of each estimator in `runs`."""
    fgtrack.simulate(
        "default", seed=3, duration_s=duration_s, out=folder / "drive.jsonl"
    )
    for name in estimators:
        fgtrack.replay(
            folder / "drive.jsonl",
            "tuned",
            map="oval",
            pit_map="oval",
            estimator=name,
            set=settings,
            out=folder / "runs" / name,
        )
    return folder
