"""Position errors of run folders by their CSV files alone, without fgtrack's metrics.

    fgtrack simulate default -o out/drive.jsonl --seed 1
    fgtrack replay out/drive.jsonl -c tuned -e drop,ekf-backward-forward,ekf-replay -o out/check
    python experiments/ledger/check.py out/check/*

Every confirmed track is compared with the nearest true object at the tick, 20 ticks a second, from one second after its
birth on. Each run has decided for itself, so its numbers may differ from the ledger's, which has one association.
"""

import sys
from pathlib import Path

import numpy as np
import pandas as pd

GATE_M, SETTLE_NS, STEP_NS = 5.0, 10**9, 10**9 // 20


def rms_m(folder: Path) -> float:
    """Root mean square of the distances of confirmed tracks from the truth."""
    tracks, truth = (
        pd.read_csv(folder / "tracks.csv"),
        pd.read_csv(folder / "truth.csv"),
    )
    tracks = tracks[
        tracks["stamp_ns"] - tracks.groupby("track_id")["stamp_ns"].transform("min")
        >= SETTLE_NS
    ]
    tracks = tracks[tracks["status"] != "tentative"]
    stamps = np.unique(tracks["stamp_ns"])
    grid = np.searchsorted(stamps, np.arange(stamps[0], stamps[-1] + 1, STEP_NS))
    tracks = tracks[
        tracks["stamp_ns"].isin(stamps[np.unique(grid[grid < len(stamps)])])
    ]
    squares = np.full(len(tracks), np.inf)
    for number, path in truth.groupby("object_id"):
        if number == -1:  # the ego
            continue
        at = tracks["stamp_ns"]
        x = np.interp(at, path["stamp_ns"], path["x_m"], left=np.nan, right=np.nan)
        y = np.interp(at, path["stamp_ns"], path["y_m"], left=np.nan, right=np.nan)
        squares = np.fmin(squares, (tracks["x_m"] - x) ** 2 + (tracks["y_m"] - y) ** 2)
    squares = squares[squares <= GATE_M**2]
    return float(np.sqrt(squares.mean()))


if __name__ == "__main__":
    for argument in sys.argv[1:]:
        print(f"{Path(argument).name}: {rms_m(Path(argument)):.4f} m")
