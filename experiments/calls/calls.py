"""How many functions does one detection run through?

    python experiments/calls/calls.py -o out/calls

A tracker with one track gets a list with one detection. The profiler of Python counts the calls of functions of fgtrack
in `receive` and `tick`, and in the access to the report. The pose of the ego is received before. Calls inside compiled
loops do not count.
"""

import csv
import sys
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Annotated

import typer

import fgtrack
from fgtrack import Config, Detection, DetectionList, EgoState, Tracker

START_NS = 1_000_000_000_000
PERIOD_NS = 100_000_000
DELAY_NS = 20_000_000
#: Lists before the counted one: the track is confirmed, and all modules are imported.
NUM_BEFORE = 39
PACKAGE = str(Path(fgtrack.__file__).parent)
HEADER = ("estimator", "calls", "functions", "files", "depth")


@dataclass
class Profile:
    """Counts of a profiled call."""

    calls: int = 0
    functions: set[tuple[str, str]] = field(default_factory=set)
    depth: int = 0
    deepest: int = 0

    def __call__(self, frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        if not code.co_filename.startswith(PACKAGE):
            return
        if event == "call":
            self.calls += 1
            self.functions.add((code.co_filename, code.co_qualname))
            self.depth += 1
            self.deepest = max(self.deepest, self.depth)
        elif event == "return":
            self.depth -= 1


def counted(estimator: str) -> Profile:
    """Counts for one detection with this estimator."""
    sensors = {"radar": {"std": {"x_m": 0.3, "y_m": 0.3}}}
    tracker = Tracker(Config().replace({"sensors": sensors, "estimator": estimator}))
    for k in range(NUM_BEFORE):
        receive_ego(tracker, k)
        fuse_one(tracker, k)
    receive_ego(tracker, NUM_BEFORE)
    profile = Profile()
    sys.setprofile(profile)
    try:
        fuse_one(tracker, NUM_BEFORE)
    finally:
        sys.setprofile(None)
    return profile


def receive_ego(tracker: Tracker, k: int) -> None:
    """Give the tracker the pose of the ego at the stamp of list number `k`."""
    stamp_ns = START_NS + k * PERIOD_NS
    tracker.receive(EgoState(stamp_ns, stamp_ns, 0.0, 0.0, 0.0, 0.0))


def fuse_one(tracker: Tracker, k: int) -> None:
    """Give the tracker list number `k` with one detection, tick, and read the report."""
    stamp_ns = START_NS + k * PERIOD_NS
    receipt_ns = stamp_ns + DELAY_NS
    detection = Detection(x_m=20.0 + 0.5 * k, y_m=3.0)
    tracker.receive(DetectionList("radar", stamp_ns, receipt_ns, [detection], "ego"))
    report = tracker.tick(receipt_ns)
    assert len(report.tracks) <= 1
    assert len(report.updates) == 1


def main(
    out: Annotated[Path, typer.Option("-o", help="Folder for the table.")] = Path(
        "out/calls"
    ),
    estimators: Annotated[
        str, typer.Option(help="Estimators, separated by commas.")
    ] = "ekf-replay,smoother-banded,smoother",
) -> None:
    """Count for each estimator, write and print calls.csv."""
    out.mkdir(parents=True, exist_ok=True)
    path = out / "calls.csv"
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(HEADER)
        for name in estimators.split(","):
            found = counted(name)
            files = {file_name for file_name, _ in found.functions}
            writer.writerow(
                [name, found.calls, len(found.functions), len(files), found.deepest]
            )
    print(path.read_text())


if __name__ == "__main__":
    typer.run(main)
