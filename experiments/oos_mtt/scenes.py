"""Scenes of the benchmark of Garcia-Fernandez and Yi: reading, drawing, and the score of trajectories."""

import gzip
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fgtrack import NS_PER_S, Detection, DetectionList, FloatArray
from fgtrack.evaluation import Scenes, t_gospa

SENSOR = "sensor"
NOISE_M = 2.0
"""Standard deviation of a measured coordinate."""
DETECTION_PROBABILITY = 0.9
AREA_M = (800.0, 400.0)
FALSE_PER_SCAN = 10.0
CLUTTER_PER_M2 = FALSE_PER_SCAN / (AREA_M[0] * AREA_M[1])
DENSITY_M2PS3 = 0.2
"""Density of the white noise of the acceleration."""
APPEARANCES_PER_S = 0.12
DEATHS_PER_S = 0.02
BIRTH_MEAN = np.array([200.0, 250.0, 3.0, 0.0])
"""Mean x, y in m, and velocity in m/s, of an object that appears."""
BIRTH_STD = np.array([50.0, 50.0, 1.0, 1.0])
C_M = 10.0
SWITCH_M = 1.0
"""Cut-off distance and cost of a switch of the metric."""

Trajectory = Mapping[int, FloatArray]
"""Positions (2,) of an object by index of the time of the truth."""


@dataclass(frozen=True)
class Scan:
    """A scan as it was received."""

    stamp_s: float
    points_m: FloatArray
    """Measured positions, shape (n, 2)."""
    is_late: bool
    """True if a newer scan was received before."""


@dataclass(frozen=True)
class Scene:
    """Scans in the order of receipt, and the truth."""

    scans: tuple[Scan, ...]
    times_s: FloatArray
    """Times of the truth, shape (k,)."""
    truth: tuple[Trajectory, ...]

    def in_order(self) -> "Scene":
        """Return the scene with all scans in the order of their stamps."""
        ordered = sorted(self.scans, key=lambda scan: scan.stamp_s)
        scans = tuple(Scan(scan.stamp_s, scan.points_m, False) for scan in ordered)
        return Scene(scans, self.times_s, self.truth)

    def messages(self) -> Iterator[DetectionList]:
        """Yield the scans as object lists; a late scan is received at the newest stamp so far."""
        newest_ns = 0
        for scan in self.scans:
            stamp_ns = nanoseconds(scan.stamp_s)
            newest_ns = max(newest_ns, stamp_ns)
            objects = [Detection(x_m=x, y_m=y) for x, y in scan.points_m.tolist()]
            yield DetectionList(SENSOR, stamp_ns, newest_ns, objects, frame="map")


def nanoseconds(time_s: float) -> int:
    """Return a time of a scene in ns."""
    return round(time_s * NS_PER_S)


def read_scene(path: Path) -> Scene:
    """Read a scene from a text file, which may be compressed; `path` ends in `.txt` or `.txt.gz`."""
    content = path.read_bytes()
    text = gzip.decompress(content) if path.suffix == ".gz" else content
    scans: list[Scan] = []
    points: list[tuple[float, float]] = []
    times_s: dict[int, float] = {}
    truth: dict[int, dict[int, FloatArray]] = {}
    for line in text.decode().splitlines():
        kind, *words = line.split()
        if kind == "SCAN":
            points = []
            stamp_s = float(words[1])
            newest_s = max((scan.stamp_s for scan in scans), default=-math.inf)
            scans.append(Scan(stamp_s, np.zeros((0, 2)), stamp_s < newest_s))
            if not scans[-1].is_late:
                times_s[int(words[2])] = stamp_s
        elif kind == "Z":
            points.append((float(words[0]), float(words[1])))
            last = scans[-1]
            scans[-1] = Scan(last.stamp_s, np.array(points), last.is_late)
        elif kind == "T":
            number, index = int(words[0]), int(words[1])
            position_m = np.array([float(words[3]), float(words[5])])
            truth.setdefault(number, {})[index - 1] = position_m
    return Scene(
        tuple(scans),
        np.array([times_s[index] for index in sorted(times_s)]),
        tuple(truth.values()),
    )


def squared_per_scan(
    scene: Scene, trajectories: Iterable[Trajectory]
) -> Mapping[str, float]:
    """Return T-GOSPA squared and its parts in m^2 per time of the truth: `total_m2`, `localisation_m2` ..."""
    num_times = len(scene.times_s)
    true_m = np.full((num_times, len(scene.truth), 2), np.inf)
    for column, path in enumerate(scene.truth):
        true_m[list(path), column] = list(path.values())
    rows = sorted(
        (index, number, *position_m)
        for number, path in enumerate(trajectories)
        for index, position_m in path.items()
    )
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)
    ticks = table[:, 0].astype(np.int64)
    present = np.isfinite(true_m[:, :, 0])
    scenes = Scenes.of(
        ticks,
        table[:, 1].astype(np.int64),
        np.linalg.norm(true_m[ticks] - table[:, None, 2:], axis=-1),
        present,
        present,
    )
    found = t_gospa(scenes, C_M, SWITCH_M)
    return {"total_m2": found["rms_m"] ** 2} | {
        name: value for name, value in found.items() if name != "rms_m"
    }


def draw_scene(rng: np.random.Generator, num_scans: int = 120) -> Scene:
    """Draw a scene of the benchmark's model."""
    stamps_s = np.cumsum(rng.exponential(1.0, num_scans))
    born_s = [
        *np.zeros(rng.poisson(APPEARANCES_PER_S * stamps_s[0])),
        *rng.uniform(0.0, stamps_s[-1], rng.poisson(APPEARANCES_PER_S * stamps_s[-1])),
    ]
    paths = [_path(rng, start_s, stamps_s) for start_s in born_s]
    scans = [_points(rng, paths, k) for k in range(num_scans)]
    order = np.arange(num_scans, dtype=np.float64)
    order[4::5] += rng.poisson(1.0, len(order[4::5])) + 0.5
    received = np.argsort(order, kind="stable").tolist()
    newest = np.maximum.accumulate(received).tolist()
    is_late = [k < last for k, last in zip(received, newest, strict=True)]
    true_indices = sorted(
        k for k, late in zip(received, is_late, strict=True) if not late
    )
    truth = [
        {
            index: path[k, :2]
            for index, k in enumerate(true_indices)
            if np.isfinite(path[k, 0])
        }
        for path in paths
    ]
    return Scene(
        tuple(
            Scan(float(stamps_s[k]), scans[k], late)
            for k, late in zip(received, is_late, strict=True)
        ),
        stamps_s[true_indices],
        tuple(path for path in truth if path),
    )


def transition(dt_s: float) -> tuple[FloatArray, FloatArray]:
    """Return F and Q of x, y, vx, vy after `dt_s`."""
    forward = np.kron(np.array([[1.0, dt_s], [0.0, 1.0]]), np.eye(2))
    noise = np.array([[dt_s**3 / 3.0, dt_s**2 / 2.0], [dt_s**2 / 2.0, dt_s]])
    return forward, DENSITY_M2PS3 * np.kron(noise, np.eye(2))


def _path(rng: np.random.Generator, start_s: float, stamps_s: FloatArray) -> FloatArray:
    """Draw the states of an object at the stamps, shape (n, 4); NaN where it does not exist."""
    end_s = start_s + rng.exponential(1.0 / DEATHS_PER_S)
    state = BIRTH_MEAN + BIRTH_STD * rng.standard_normal(4)
    states = np.full((len(stamps_s), 4), np.nan)
    before_s = start_s
    for k in np.flatnonzero((stamps_s >= start_s) & (stamps_s < end_s)).tolist():
        forward, noise = transition(stamps_s[k] - before_s)
        spread = np.linalg.cholesky(noise + 1e-12 * np.eye(4))
        state = forward @ state + spread @ rng.standard_normal(4)
        states[k] = state
        before_s = stamps_s[k]
    return states


def _points(rng: np.random.Generator, paths: list[FloatArray], k: int) -> FloatArray:
    """Draw the measured positions of scan `k`, shape (n, 2), in random order."""
    seen_m = [
        path[k, :2] + NOISE_M * rng.standard_normal(2)
        for path in paths
        if np.isfinite(path[k, 0]) and rng.random() < DETECTION_PROBABILITY
    ]
    false_m = rng.uniform(0.0, AREA_M, (rng.poisson(FALSE_PER_SCAN), 2))
    return rng.permutation(np.concatenate([np.reshape(seen_m, (-1, 2)), false_m]))
