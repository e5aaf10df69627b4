"""Time and memory of lists with far more detections than objects: clutter, crowds, and lists that come all at once.

    python experiments/bench_crowds.py                         # a minute
    python experiments/bench_crowds.py --detections 2000       # to see that it works

Prints a table: processor time of one list, or of one tick, and the most memory that it has in use beyond what it began
with (of a second run, whose objects are made anew).
"""

import time
import tracemalloc
from collections.abc import Callable, Iterator
from typing import Annotated

import numpy as np
import typer

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import Detection, DetectionList, FloatArray
from fgtrack.estimation.base import Measurement, StatesAt
from fgtrack.models.measurement import measurement_model
from fgtrack.models.motion import CTRV
from fgtrack.pipeline.build import build_tracker
from fgtrack.pipeline.shipped import read_config
from fgtrack.tracking.association import GatedEuclidean, GatedMahalanobis
from fgtrack.tracking.detections import ConnectedMerge
from fgtrack.tracking.preprocess import Candidate

START_NS = 1_600_000_000 * NS_PER_S
PERIOD_NS = NS_PER_S // 20
WARM_UP = 4
ASSOCIATIONS = {
    "distance": GatedEuclidean(),
    "distance and NIS": GatedEuclidean(max_nis=400.0),
    "Mahalanobis": GatedMahalanobis(),
}

Row = tuple[str, float, float]
"""What was done, processor time in s, memory in MB."""


def measured(what: str, prepared: Callable[[], Callable[[], object]]) -> Row:
    """The row of what `prepared` gives, called twice."""
    call = prepared()
    before = time.process_time()
    call()
    took_s = time.process_time() - before
    call = prepared()
    tracemalloc.start()
    call()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return what, took_s, peak / 1e6


def candidates(points_m: FloatArray) -> list[Candidate]:
    """Detections at `points_m`, shape (n, 2)."""
    model, R = measurement_model(("x_m", "y_m"), CTRV()), 0.09 * np.eye(2)
    return [
        Candidate(k, (), Measurement(START_NS, model, point, R), point, R, {"x_m": point[0], "y_m": point[1]})
        for k, point in enumerate(points_m)
    ]


def association(name: str, detections: int, tracks: int, side_m: float) -> Callable[[], object]:
    """Detections and tracks everywhere in a square, associated."""
    rng = np.random.default_rng(0)
    found = candidates(rng.uniform(0.0, side_m, size=(detections, 2)))
    means = np.zeros((tracks, 5))
    means[:, :2] = rng.uniform(0.0, side_m, size=(tracks, 2))
    states = StatesAt(tuple(range(tracks)), means, np.tile(0.09 * np.eye(5), (tracks, 1, 1)))
    return lambda: ASSOCIATIONS[name](found, states)


def merge(detections: int, side_m: float) -> Callable[[], object]:
    """Detections everywhere in a square, merged."""
    points = np.random.default_rng(0).uniform(0.0, side_m, size=(detections, 2))
    return lambda: ConnectedMerge(distance_m=5.1).groups(points)


def tick(estimator: str, objects: int, clutter: int, lists: int, side_m: float) -> Callable[[], object]:
    """A tick with `lists` lists of `objects` objects that stand still in a square, and clutter in each."""
    rng = np.random.default_rng(0)
    config = read_config("open_space", ["merge={kind: connected, distance_m: 5.1}"], estimator=estimator)
    tracker, sensor = build_tracker(config), next(iter(config.sensors))
    points = rng.uniform(0.0, side_m, size=(objects, 2))
    for k in range(WARM_UP + lists):
        stray = rng.uniform(0.0, side_m, size=(clutter if k >= WARM_UP else 0, 2))
        stamp_ns = START_NS + k * PERIOD_NS
        seen = [Detection(x_m=x, y_m=y) for x, y in np.vstack([points, stray]).tolist()]
        tracker.receive(DetectionList(sensor, stamp_ns, stamp_ns, seen, "map"))
        if k < WARM_UP:
            tracker.tick(stamp_ns)
    return lambda: tracker.tick(stamp_ns)


def rows(detections: int, tracks: int, lists: int) -> Iterator[Row]:
    """All rows of the table."""
    for name in ASSOCIATIONS:
        for side_m in (10_000.0, 100.0):
            what = f"association by {name}: {detections} detections, {tracks} tracks, {side_m:g} m square"
            yield measured(what, lambda name=name, side_m=side_m: association(name, detections, tracks, side_m))
    yield measured(f"merge: {detections} detections, 10000 m square", lambda: merge(detections, 10_000.0))
    for estimator in ("ekf-replay", "ekf-backward-forward"):
        what = f"tick, {estimator}: one list, {tracks} objects, {detections} of clutter, 1000 m square"
        yield measured(what, lambda name=estimator: tick(name, tracks, detections, 1, 1000.0))
        what = f"tick, {estimator}: {lists} lists at once, 20 objects"
        yield measured(what, lambda name=estimator: tick(name, 20, 0, lists, 1000.0))


def main(
    detections: Annotated[int, typer.Option(min=5, help="Of a list.")] = 100_000,
    tracks: Annotated[int, typer.Option(min=1)] = 500,
    lists: Annotated[int, typer.Option(min=1, help="That come all at once.")] = 1000,
) -> None:
    """Time and memory of lists with far more detections than objects."""
    print("| what | processor time [s] | memory [MB] |\n| --- | --- | --- |")
    for what, took_s, memory_mb in rows(detections, tracks, lists):
        print(f"| {what} | {took_s:.2f} | {memory_mb:.0f} |", flush=True)


if __name__ == "__main__":
    typer.run(main)
