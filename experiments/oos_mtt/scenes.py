"""Scenes of the benchmark of Garcia-Fernandez and Yi: reading, drawing, and the score of trajectories."""

import gzip
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fgtrack import NS_PER_S, Detection, DetectionList, FloatArray
from fgtrack.evaluation import Scenes, t_gospa
from fgtrack.sim import LATE_SCANS, draw_late_scans

SENSOR = "sensor"
MODEL = LATE_SCANS
"""Model of the scenes."""
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
    drawn = draw_late_scans(rng, num_scans)
    stamps_s = drawn.stamps_s.tolist()
    is_late = [k < last for k, last in zip(drawn.received, drawn.newest, strict=True)]
    scans = [
        Scan(stamps_s[k], drawn.points_m[k], late)
        for k, late in zip(drawn.received, is_late, strict=True)
    ]
    times_s = sorted(scan.stamp_s for scan in scans if not scan.is_late)
    truth = [
        {index: path[time_s] for index, time_s in enumerate(times_s) if time_s in path}
        for path in drawn.paths
    ]
    return Scene(tuple(scans), np.array(times_s), tuple(path for path in truth if path))


def transition(dt_s: float) -> tuple[FloatArray, FloatArray]:
    """Return F and Q of x, y, vx, vy after `dt_s`."""
    forward = np.kron(np.array([[1.0, dt_s], [0.0, 1.0]]), np.eye(2))
    noise = np.array([[dt_s**3 / 3.0, dt_s**2 / 2.0], [dt_s**2 / 2.0, dt_s]])
    return forward, MODEL.acceleration_density_m2ps3 * np.kron(noise, np.eye(2))
