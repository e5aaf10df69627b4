"""Too little memory fails what needs it, with a clear line: nothing is written past an end, and the tracker goes on."""

import json
import subprocess
import sys
from collections import Counter
from importlib import import_module
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from fgtrack.config.reading import read_config
from fgtrack.core.types import Detection, DetectionList
from fgtrack.models.sensors import SensorModel
from fgtrack.pipeline.live import Tracker

START_NS = 1_600_000_000_000_000_000
MS = 1_000_000
ESTIMATORS = ("ekf-replay", "smoother", "smoother-banded", "ekf-backward-forward")
GROWING = (
    "fgtrack.karle2023.backward_forward",
    "fgtrack.estimation.filters.replay_bank",
    "fgtrack.estimation.smoothing.bank",
    "fgtrack.estimation.smoothing.nodes",
    "fgtrack.estimation.smoothing.solver",
    "fgtrack.tracking.lives.existence",
    "fgtrack.tracking.guarded_bank",
    "fgtrack.tracking.list_association",
    "fgtrack.tracking.list_update",
    "fgtrack.tracking.tracker",
    "fgtrack.tracking.tracks",
    "fgtrack.tracking.lives.counters",
    "fgtrack.tracking.lives.visibility",
    "fgtrack.tracking.rows",
)
ALLOCATING = ("array", "concatenate", "empty", "full", "tile", "vstack", "zeros")
NUM_OBJECTS = 11


class Numpy(ModuleType):
    """NumPy, but the allocation number `at` by one of the `GROWING` modules raises."""

    def __init__(self) -> None:
        super().__init__("numpy")
        self.at, self.count = 0, 0

    def __getattr__(self, name: str) -> Any:
        own = getattr(np, name)
        if name not in ALLOCATING:
            return own

        def allocate(*arguments: Any, **named: Any) -> Any:
            self.count += 1
            if self.count == self.at:
                raise MemoryError("unable to allocate an array")
            return own(*arguments, **named)

        return allocate


@pytest.fixture
def numpy(monkeypatch: pytest.MonkeyPatch) -> Numpy:
    made = Numpy()
    for name in GROWING:
        monkeypatch.setattr(import_module(name), "np", made)
    nodes = import_module("fgtrack.estimation.smoothing.nodes")
    for name, few in (
        ("_FEW_TRACKS", 1),
        ("_FEW_NODES", 16),
        ("_FEW_VALUES", 1),
        ("_FEW_COMPONENTS", 1),
    ):
        monkeypatch.setattr(nodes, name, few)
    visibility = import_module("fgtrack.tracking.lives.visibility")
    monkeypatch.setattr(visibility, "_FEWEST_TRACKS", 1)
    monkeypatch.setattr(visibility, "_FEWEST_ENTRIES", 2)
    return made


def tracker(estimator: str) -> Tracker:
    config = read_config(None, {"estimator": estimator})
    sensor = SensorModel(
        std={"x_m": 0.3, "y_m": 0.3, "speed_mps": 0.5}, clutter_per_m2=1e-6
    )
    return Tracker(config.__class__(**{**vars(config), "sensors": {"lidar": sensor}}))


def run(one: Tracker, num_ticks: int = 10) -> tuple[list[int], int, Counter[str]]:
    """Objects whose tracks the last tick publishes, ticks that raised, and how often each detection was reported."""
    rows, raised, places = Counter[str](), 0, list[int]()
    for k in range(num_ticks):
        now_ns = START_NS + 100 * k * MS
        places_m = [
            (2.0 * k, 100.0 * number) for number in range(NUM_OBJECTS if k > 2 else 3)
        ]
        items = tuple(Detection(x, y, speed_mps=20.0) for x, y in places_m)
        one.receive(DetectionList("lidar", now_ns, now_ns, items, "map"))
        try:
            report = one.tick(now_ns)
        except MemoryError:
            raised += 1
            continue
        rows.update(f"{row.stamp_ns} {row.index}" for row in report.updates)
        places = sorted(round(track.y_m / 100.0) for track in report.tracks)
    return places, raised, rows


@pytest.mark.long
@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_each_allocation_may_fail_and_no_detection_is_lost(
    estimator: str, numpy: Numpy
) -> None:
    every = run(tracker(estimator))
    assert every[0] == list(range(NUM_OBJECTS))
    numpy.count = 0
    run(tracker(estimator), num_ticks=8)
    last = numpy.count  # two more ticks to recover in
    made = tracker(estimator)
    first = numpy.count - last
    rng = np.random.default_rng(7)
    chosen = sorted(
        rng.choice(
            np.arange(first + 1, last + 1), min(last - first, 120), replace=False
        ).tolist()
    )
    for at in chosen:
        made = tracker(estimator)
        numpy.count, numpy.at = first, at
        places, raised, rows = run(made)
        numpy.at = 0
        assert raised <= 1, at
        assert rows == every[2], at
        assert places == every[0], at
        assert (
            not {"not finite", "not positive definite"}
            & (+Counter(made.failures)).keys()
        ), at
        if any(made.failures.values()):
            assert made._tracker.failures.first is not None
            assert made._tracker.failures.first.startswith("not enough memory"), at


_CROWD = """
import json, resource, sys
from fgtrack import Detection, DetectionList, Tracker
estimator, number, spare_mb = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
MS, S = 10**6, 10**9
one, sent = Tracker("open_space", estimator=estimator), 0
for k in range(30):
    now_ns = 1000 * S + 50 * k * MS
    places_m = [(20.0 + 0.5 * k, 1.0)]
    if k == 10:
        pages = int(open("/proc/self/statm").read().split()[0])
        size = pages * resource.getpagesize() + spare_mb * 2**20
        resource.setrlimit(resource.RLIMIT_AS, (size, resource.RLIM_INFINITY))
        side = int(number**0.5) + 1
        places_m += [(100.0 + 20.0 * (i % side), 20.0 * (i // side)) for i in range(number)]
    if k == 12:
        resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    items = [Detection(x_m=x, y_m=y) for x, y in places_m]
    sent += len(items)
    one.receive(DetectionList("radar", now_ns, now_ns, items, frame="map"))
    try:
        report = one.tick(now_ns)
    except MemoryError:
        pass
counts = sum(sum(each.values()) for each in one.counts.values())
failures = {name: count for name, count in one.failures.items() if count}
print(json.dumps([sent, counts, len(report.tracks), failures, one._tracker.failures.first]))
"""


@pytest.mark.long
@pytest.mark.parametrize("spare_mb", [4, 40])
@pytest.mark.parametrize("estimator", ["ekf-replay", "smoother", "smoother-banded"])
def test_a_crowd_that_does_not_fit_into_memory_ends_no_process(
    estimator: str, spare_mb: int
) -> None:
    words = [sys.executable, "-c", _CROWD, estimator, "3000", str(spare_mb)]
    done = subprocess.run(
        words, capture_output=True, text=True, check=False, timeout=300
    )
    assert done.returncode == 0, done.stderr[-2000:]
    sent, counted, num_tracks, failures, first = json.loads(
        done.stdout.splitlines()[-1]
    )
    assert counted == sent
    assert num_tracks >= 1  # the car that was there before, or its successor
    assert not {"not finite", "not positive definite"} & failures.keys()
    if failures:
        assert first.startswith("not enough memory")
