"""Agreement of the positions of two sensors: the common displacement between their detections of the same objects."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import starmap

import numpy as np

from fgtrack.clocks.paths import (
    EgoPath,
    MeasuredPositions,
    ObjectPath,
    measured_positions,
)
from fgtrack.config.settings import Config
from fgtrack.core.errors import DataError
from fgtrack.core.finding import Finding, percent
from fgtrack.core.geometry import rotations
from fgtrack.core.types import (
    BoolArray,
    DetectionList,
    EgoState,
    FloatArray,
    IntArray,
    Message,
)
from fgtrack.meaning.corrected import corrected
from fgtrack.runs import COLUMNS, Run

__all__ = ["Agreement", "agreement_findings", "agreements"]

# Pairs of detections at a larger distance belong to different objects.
_REACH_M = 40.0
# Width of a cell in the histogram of displacements.
_CELL_M = 1.0
# Least number of pairs, and least share of them at the common displacement, for a statement.
_FEWEST = 30
_LEAST_SHARE = 0.3
# Number of stretches of time for the standard error of the displacement, and its 95 % quantile (Student's t).
_STRETCHES = 8
_T95 = 2.365
# Least radius around the common displacement, and rounds of its estimate.
_LEAST_RADIUS_M = 3.0
_ROUNDS = 3
# A smaller displacement is no error of a mount: vehicles are as wide.
_LEAST_LIMIT_M = 1.0


@dataclass(frozen=True)
class Agreement:
    """Displacement between the positions that a sensor and a reference sensor measure of the same objects."""

    sensor: str
    reference: str
    pairs: int
    """Number of stamps at which a detection of the sensor lies within 40 m of an object of the reference."""
    share: float
    """Share of these stamps at which such a detection has the most frequent displacement."""
    displacement_m: tuple[float, float]
    """Median of the sensor's position minus the reference's position; NaN for too few pairs.

    The axes point ahead and to the left of the ego, or to the east and north if `in_map`.
    """
    half_m: float
    """Half-width of the 95 % interval of each coordinate of the displacement; infinite for too few pairs."""
    limit_m: float
    """Largest displacement that does not count as a disagreement: the scatter of the pairs, but at least 1 m."""
    in_map: bool
    """True if the axes of the displacement are those of the map; False for the axes of the ego."""

    @property
    def distance_m(self) -> float:
        """Length of the displacement."""
        return math.hypot(*self.displacement_m)

    @property
    def is_known(self) -> bool:
        """True if enough pairs have a common displacement, and its 95 % interval is narrower than the limit."""
        return (
            self.pairs >= _FEWEST
            and self.share >= _LEAST_SHARE
            and self.half_m <= self.limit_m
        )

    @property
    def is_off(self) -> bool:
        """True if the sensors disagree: the displacement is known, and longer than `limit_m` plus `half_m`."""
        return self.is_known and self.distance_m > self.limit_m + self.half_m

    def __str__(self) -> str:
        axes = ("east", "north") if self.in_map else ("ahead", "left")
        first, second = (
            f"{round(value, 1) + 0.0:.1f} m {axis}"
            for value, axis in zip(self.displacement_m, axes, strict=True)
        )
        return (
            f"lies {first} and {second} of {self.reference} (± {self.half_m:.1f} m, {self.pairs} pairs; limit "
            f"{self.limit_m:.1f} m)"
        )


def agreements(
    messages: Sequence[Message], config: Config, run: Run
) -> list[Agreement]:
    """Return the agreement of each sensor with the reference, the sensor with the most detections in tracks.

    `run` is a run of `messages`. Only sensors with positions, or with range and bearing, are compared. A sensor without
    a detection near an object of the reference has 0 pairs. The result is empty if the ego has too few states.
    """
    lists = [
        corrected(item, config.sensors)
        for item in messages
        if isinstance(item, DetectionList) and item.sensor in config.used_sensors
    ]
    try:
        ego = _ego_path(run) if any(item.frame != "map" for item in lists) else None
    except DataError:  # too few ego states
        return []
    seen = measured_positions(run, lists, config, ego)
    counts = {
        name: sum(len(one.stamps_ns) for one in tracks.values())
        for name, tracks in seen.items()
        if config.sensors[name].gives_position
    }
    if not counts:
        return []
    reference = max(sorted(counts), key=counts.__getitem__)
    paths = [
        path
        for one in seen[reference].values()
        if (path := ObjectPath.through(one.stamps_ns, one.at(one.stamps_ns)))
        is not None
    ]
    names = [
        name for name in config.used_sensors if config.sensors[name].gives_position
    ]
    return [
        _agreement(name, reference, seen.get(name, {}), paths, ego)
        for name in names
        if name != reference and any(item.sensor == name for item in lists)
    ]


def _ego_path(run: Run) -> EgoPath:
    poses = run.tables["ego"]
    rows = zip(*(poses[name].tolist() for name in COLUMNS["ego"]), strict=True)
    return EgoPath(starmap(EgoState, rows))


def _agreement(
    sensor: str,
    reference: str,
    tracks: Mapping[int, MeasuredPositions],
    paths: Sequence[ObjectPath],
    ego: EgoPath | None,
) -> Agreement:
    stamps_ns, displacements_m = _displacements(tracks, paths, ego)
    count = len(np.unique(stamps_ns))
    if count < _FEWEST:
        nowhere = math.nan, math.nan
        return Agreement(
            sensor,
            reference,
            count,
            0.0,
            nowhere,
            math.inf,
            _LEAST_LIMIT_M,
            ego is None,
        )
    near = _mode(displacements_m)
    chosen = displacements_m[near]
    centre_m = np.median(chosen, axis=0)
    limit_m = max(_LEAST_LIMIT_M, float(chosen.std(axis=0).max()))
    parts = np.array_split(
        chosen[np.argsort(stamps_ns[near], kind="stable")], _STRETCHES
    )
    medians_m = np.array([np.median(part, axis=0) for part in parts if len(part)])
    half_m = (
        _T95 * float(medians_m.std(axis=0, ddof=1).max()) / math.sqrt(len(medians_m))
        if len(medians_m) == _STRETCHES
        else math.inf
    )
    share = len(np.unique(stamps_ns[near])) / count
    ahead_m, left_m = centre_m.tolist()
    return Agreement(
        sensor, reference, count, share, (ahead_m, left_m), half_m, limit_m, ego is None
    )


def _displacements(
    tracks: Mapping[int, MeasuredPositions],
    paths: Sequence[ObjectPath],
    ego: EgoPath | None,
) -> tuple[IntArray, FloatArray]:
    """Return stamps (n,) and displacements (n, 2) of the detections in `tracks` from `paths` of the reference.

    A detection is compared with each path, and the displacement counts if it is shorter than `_REACH_M`. It is
    given along and left of the `ego`, or along the axes of the map if `ego` is None.
    """
    stamps: list[IntArray] = []
    offsets: list[FloatArray] = []
    for one in tracks.values():
        measured_m = one.at(one.stamps_ns)
        for path in paths:
            off_m = measured_m - path(one.stamps_ns)
            if ego is not None:
                yaws_rad = ego(one.stamps_ns)[:, 2]
                off_m = np.einsum("nji,nj->ni", rotations(yaws_rad), off_m)
            near = np.isfinite(off_m).all(axis=1) & (np.hypot(*off_m.T) < _REACH_M)
            stamps.append(one.stamps_ns[near])
            offsets.append(off_m[near])
    if not stamps:
        return np.empty(0, np.int64), np.empty((0, 2))
    return np.concatenate(stamps), np.concatenate(offsets)


def _mode(points_m: FloatArray) -> BoolArray:
    """Return the mask (n,) of the displacements `points_m` (n, 2) that lie near the most frequent displacement."""
    cells = np.rint(points_m / _CELL_M).astype(np.int64)
    size = 2 * math.ceil(_REACH_M / _CELL_M) + 3
    counts = np.zeros((size, size))
    np.add.at(counts, tuple((cells + size // 2).T), 1.0)
    smooth = sum(
        np.roll(counts, shift, axis=(0, 1))
        for shift in [(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1)]
    )
    peak = np.unravel_index(int(np.argmax(smooth)), counts.shape)
    centre_m = (np.array(peak) - size // 2) * _CELL_M
    radius_m = _LEAST_RADIUS_M
    for _ in range(_ROUNDS):
        near = np.hypot(*(points_m - centre_m).T) <= radius_m
        centre_m = np.median(points_m[near], axis=0)
        radius_m = max(_LEAST_RADIUS_M, 3.0 * float(points_m[near].std(axis=0).max()))
    return np.asarray(np.hypot(*(points_m - centre_m).T) <= radius_m)


def agreement_findings(found: Sequence[Agreement]) -> Iterator[Finding]:
    """Yield a finding for each sensor that disagrees with the reference sensor."""
    for one in found:
        if one.is_off:
            text = (
                f"its detections of the same objects disagree with {one.reference}: it {one}, at "
                f"{percent(one.share)} of them. A mount or a frame is wrong (sensors.{one.sensor}.mount, "
                f"sensors.{one.reference}.mount, `frame`), or the objects are larger than the noise."
            )
            yield Finding("agreement", one.sensor, 82.0, text)
