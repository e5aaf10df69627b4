"""A tracker is ready when it is made: no tick loads or compiles anything that making the tracker has not."""

import ast
import builtins
import importlib
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fgtrack.config.reading import read_config
from fgtrack.core import linalg
from fgtrack.core.types import Detection, DetectionList, EgoState
from fgtrack.estimation.failures import Failure
from fgtrack.estimation.registry import list_estimators
from fgtrack.pipeline import rehearsal
from fgtrack.pipeline.live import Tracker
from fgtrack.tracking import association

START_NS, MS = 50_000_000_000, 1_000_000
SENSORS: dict[str, object] = {
    "lidar": {"std": {"x_m": 0.3, "y_m": 0.3, "yaw_rad": 0.1}},
    "radar": {
        "std": {"range_m": 0.5, "bearing_rad": 0.02, "range_rate_mps": 0.3},
        "loss": {"kind": "huber", "width": 1.5},
    },
    "camera": {"std": {"bearing_rad": 0.01}, "births": False},
}
#: Settings under which ticks need other modules.
SETTINGS: dict[str, dict[str, object]] = {
    "existence": {
        "sensors": SENSORS,
        "merge": {"kind": "connected", "distance_m": 2.0},
    },
    "counting": {
        "sensors": SENSORS,
        "lifecycle": {"kind": "counting"},
        "association": {"kind": "euclidean", "gate_m": 5.0},
    },
    "soft association": {
        "sensors": {"lidar": SENSORS["lidar"]},
        "association": {"kind": "mahalanobis", "joint_from": 3},
        "lifecycle": {"kind": "existence", "weigh_births": True},
    },
    "map": {
        "sensors": {"lidar": {"std": {"x_m": 0.3, "y_m": 0.3}}},
        "map.track": "oval",
    },
}


def drive(tracker: Tracker, seed: int, num_scans: int = 40) -> None:
    """Ticks among five cars, with clutter, misses, outliers, split objects and lists that are up to 0.4 s late."""
    rng, waiting = np.random.default_rng(seed), list[EgoState | DetectionList]()
    for k in range(num_scans):
        at_ns = START_NS + 50 * k * MS
        tracker.receive(EgoState(at_ns, at_ns, 1.5 * k, -200.0, 0.0, 30.0))
        for name, sensor in tracker.config.sensors.items():
            places_m = [
                (8.0 + 7.0 * row + rng.normal(0.0, 0.2), rng.normal(0.0, 0.2))
                for row in range(5)
                if rng.random() < 0.9
            ]
            places_m += [(x_m + 1.0, y_m) for x_m, y_m in places_m[:1] if k % 4 == 0]
            places_m += [tuple(rng.uniform(-40.0, 40.0, 2)) for _ in range(k % 3)]
            late_ns = int(rng.integers(0, 400)) * MS * int(rng.random() < 0.3)
            objects = [seen(x_m, y_m, sensor.components) for x_m, y_m in places_m]
            waiting.append(DetectionList(name, at_ns, at_ns + late_ns, objects))
        for message in [each for each in waiting if each.receipt_ns <= at_ns]:
            tracker.receive(message)
            waiting.remove(message)
        tracker.tick(at_ns)
        tracker.tracks_at(at_ns - 100 * MS)
    tracker.finish()


def seen(x_m: float, y_m: float, components: tuple[str, ...]) -> Detection:
    values: dict[str, Any] = {
        "x_m": x_m,
        "y_m": y_m,
        "yaw_rad": 0.0,
        "range_m": float(np.hypot(x_m, y_m)),
        "bearing_rad": float(np.arctan2(y_m, x_m)),
        "range_rate_mps": 0.0,
    }
    return Detection(**{name: values[name] for name in components})


@contextmanager
def noted_imports(monkeypatch: pytest.MonkeyPatch) -> Iterator[set[str]]:
    """The names of all modules that are imported meanwhile, also of modules that are loaded already."""
    names = set[str]()

    def noting(imported: Callable[..., Any]) -> Callable[..., Any]:
        def note(name: str, *args: Any, **named: Any) -> Any:
            names.add(name)
            return imported(name, *args, **named)

        return note

    with monkeypatch.context() as patch:
        patch.setattr(builtins, "__import__", noting(builtins.__import__))
        for module in (linalg, rehearsal):
            patch.setattr(module, "import_module", noting(importlib.import_module))
        yield names


CASES = [(name, settings) for name in list_estimators() for settings in SETTINGS]
FAST = (("ekf-replay", "existence"), ("smoother-banded", "soft association"))


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        pytest.param(
            *each, id="-".join(each), marks=[] if each in FAST else pytest.mark.slow
        )
        for each in CASES
    ],
)
def test_a_tick_imports_nothing_that_making_its_tracker_has_not(
    name: str, settings: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for cache in (
        linalg.kernels,
        linalg._lapack,
        association.chi_square_quantile,
        association.quantiles,
    ):
        cache.cache_clear()
    monkeypatch.setattr(rehearsal, "_rehearsed", set())
    with noted_imports(monkeypatch) as made:
        tracker = Tracker(estimator=name, set=SETTINGS[settings])
    with noted_imports(monkeypatch) as ticked:
        drive(tracker, seed=4)
    assert sum(tracker.counts["lidar"].values()) > 150
    assert ticked - made == set()


def imports_of_functions(folder: Path) -> set[str]:
    """The modules that the functions of a package import when they are called."""
    functions = (
        node
        for path in folder.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.FunctionDef)
    )
    return {
        node.module
        for function in functions
        for node in ast.walk(function)
        if isinstance(node, ast.ImportFrom) and node.module
    }


def test_making_a_tracker_imports_what_the_rare_functions_of_tracking_import(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A least-cost assignment of many cars side by side came after 14 s, and its import took 0.25 s."""
    names = imports_of_functions(Path(association.__file__).parent)
    assert "scipy.sparse.csgraph" in names
    monkeypatch.setattr(rehearsal, "_rehearsed", set())
    with noted_imports(monkeypatch) as made:
        Tracker("karle2023", map="oval", pit_map="oval")
    assert names - made == set()


SCRIPT = """
import sys
from test_rehearsal import SETTINGS, Tracker, drive
tracker = Tracker(estimator="ekf-replay", set=SETTINGS["existence"])
before = set(sys.modules)
drive(tracker, seed=5)
print([name for name in set(sys.modules) - before if name.startswith(("fgtrack", "scipy", "numba"))])
"""


@pytest.mark.slow
def test_a_new_process_loads_nothing_after_its_tracker_is_made() -> None:
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT],
        cwd=__file__.rpartition("/")[0],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == "[]\n"


@pytest.mark.parametrize(
    "name",
    [
        "karle2023",
        "adsb",
        "kitti",
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ("smoother", "racecar", "ais", "open_space", "v2x")
        ),
    ],
)
def test_the_scene_of_a_rehearsal_has_tracks_and_no_failures(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = []

    def kept(*args: Any) -> Any:
        made.append(build(*args))
        return made[-1]

    build = rehearsal.build_tracker
    monkeypatch.setattr(rehearsal, "build_tracker", kept)
    monkeypatch.setattr(rehearsal, "_rehearsed", set())
    rehearsal.rehearse(read_config(name, None))
    [tracker] = made
    assert set(tracker.failures.counts) <= {Failure.STEP_DAMPED}
    assert tracker._tracks._next_id >= 4
    rehearsal.rehearse(read_config(name, None))
    assert len(made) == 1  # once in a process
