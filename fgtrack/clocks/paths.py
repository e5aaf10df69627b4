"""Paths over time: of the ego, of true objects, and the positions measured along tracks."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline, make_smoothing_spline

from fgtrack.config.settings import Config
from fgtrack.core.checks import LARGEST
from fgtrack.core.errors import DataError
from fgtrack.core.geometry import rotations
from fgtrack.core.time import NS_PER_S, nanoseconds, seconds
from fgtrack.core.types import (
    EGO_ID,
    FUSED,
    BoolArray,
    DetectionList,
    Disposition,
    EgoState,
    FloatArray,
    IntArray,
    Message,
    TruthState,
)
from fgtrack.models.road import Road
from fgtrack.runs import NO_TRACK, Run
from fgtrack.tracking.ego.trajectory import EgoPose, is_finite
from fgtrack.tracking.inbox import Inbox, record
from fgtrack.tracking.preprocess import Preprocess

__all__ = [
    "EgoPath",
    "ObjectPath",
    "MeasuredPositions",
    "measured_positions",
    "true_paths",
]

# Least number of values for a smoothing spline.
_FEWEST = 5
# A path is not interpolated in longer gaps.
_GAP_S = 3.0
_EGO_CUTOFF_HZ = 2.0
# Components of a position, which a wrong stamp moves by metres. Speed and yaw are not used: they would add
# little information, and errors of their standard deviations would matter.
_POSITION = ("x_m", "y_m", "range_m", "bearing_rad")


class EgoPath:
    """Smoothing spline through the positions and the unwrapped yaw of the ego.

    An interpolating line would move as fast as its noise: 2 cm at 100 Hz are 3 m/s. The
    spline minimises sum (y - f)^2 + lam integral f''^2. It is a low-pass that halves
    the amplitude of a sine of 2 Hz.

    The states may have any order. Raises `DataError` for fewer than five states.
    """

    def __init__(self, states: Iterable[EgoState]) -> None:
        by_stamp = {state.stamp_ns: state for state in states if is_finite(state)}
        if len(by_stamp) < _FEWEST:
            raise DataError(
                f"the ego has {len(by_stamp)} states with different stamps, at least {_FEWEST} are needed"
            )
        stamps_ns = sorted(by_stamp)
        self._start_ns = stamps_ns[0]
        self._end_ns = stamps_ns[-1]
        times_s = np.array(
            [seconds(stamp_ns - self._start_ns) for stamp_ns in stamps_ns]
        )
        values = np.array(
            [
                [item.x_m, item.y_m, item.yaw_rad]
                for item in map(by_stamp.__getitem__, stamps_ns)
            ]
        )
        values[:, 2] = np.unwrap(values[:, 2])
        density_s = float(times_s[-1]) / (len(times_s) - 1)
        lam = 1.0 / (density_s * (2.0 * np.pi * _EGO_CUTOFF_HZ) ** 4)
        self._spline = make_smoothing_spline(times_s, values, lam=lam)

    def __call__(self, times_ns: IntArray) -> FloatArray:
        """Return x, y and unwrapped yaw at `times_ns` (m,), shape (m, 3).

        NaN before the first and after the last state.
        """
        poses = np.asarray(self._spline((times_ns - self._start_ns) / NS_PER_S))
        poses[(times_ns < self._start_ns) | (times_ns > self._end_ns)] = np.nan
        return poses


@dataclass(frozen=True)
class ObjectPath:
    """Path of one object in the map frame."""

    stamps_ns: IntArray
    """Ascending times of the measured positions, shape (n,)."""
    curve: BSpline
    """Position in m as a function of the seconds since the first measured position."""

    @classmethod
    def through(
        cls, stamps_ns: IntArray, positions_m: FloatArray
    ) -> "ObjectPath | None":
        """Return the smoothing spline through noisy positions (n, 2); None for too few positions.

        Generalised cross-validation chooses the stiffness (Woltring, Advances in
        Engineering Software 8, 1986).
        """
        known_ns, rows = np.unique(stamps_ns, return_index=True)
        if len(known_ns) < 2 * _FEWEST:
            return None
        return cls(
            known_ns,
            make_smoothing_spline(
                (known_ns - known_ns[0]) / NS_PER_S, positions_m[rows]
            ),
        )

    def __call__(self, times_ns: IntArray) -> FloatArray:
        """Return the positions at `times_ns` (m,), shape (m, 2); NaN outside the path and in its long gaps."""
        index = np.clip(
            np.searchsorted(self.stamps_ns, times_ns), 1, len(self.stamps_ns) - 1
        )
        unknown = (times_ns < self.stamps_ns[0]) | (times_ns > self.stamps_ns[-1])
        unknown |= self.stamps_ns[index] - self.stamps_ns[index - 1] > nanoseconds(
            _GAP_S
        )
        result = np.asarray(self.curve((times_ns - self.stamps_ns[0]) / NS_PER_S))
        result[unknown] = np.nan
        return result


@dataclass(frozen=True)
class MeasuredPositions:
    """Positions of one track that one sensor measured."""

    stamps_ns: IntArray
    """Stamps of the measurements, shape (n,)."""
    positions_m: FloatArray
    """Positions in the ego frame, or in the map frame where `in_map`, shape (n, 2)."""
    in_map: BoolArray
    """Mask of positions in the map frame, shape (n,)."""
    ego: EgoPath | None
    """Path of the ego; None if all positions are in the map frame."""

    def at(self, times_ns: IntArray) -> FloatArray:
        """Return the positions in the map, shape (n, 2), as if they had been measured at `times_ns` (n,).

        The pose of the ego is taken at `times_ns`. NaN where it is not known.
        """
        if self.ego is None:
            return self.positions_m
        pose = self.ego(times_ns)
        moved_m = pose[:, :2] + np.einsum(
            "nij,nj->ni", rotations(pose[:, 2]), self.positions_m
        )
        return np.where(self.in_map[:, None], self.positions_m, moved_m)

    def chosen(self, rows: BoolArray | slice) -> "MeasuredPositions":
        """Return the measurements in `rows`."""
        return MeasuredPositions(
            self.stamps_ns[rows], self.positions_m[rows], self.in_map[rows], self.ego
        )


def true_paths(messages: Iterable[Message]) -> list[ObjectPath]:
    """Return the paths of all true objects with at least two states."""
    states: dict[int, dict[int, tuple[float, float]]] = defaultdict(dict)
    for item in messages:
        if not isinstance(item, TruthState) or item.ignored or item.object_id == EGO_ID:
            continue
        if max(abs(item.x_m), abs(item.y_m)) <= LARGEST:  # the limit of detections
            states[item.object_id][item.stamp_ns] = (item.x_m, item.y_m)
    paths = []
    for each in states.values():
        if len(each) > 1:
            stamps_ns = np.array(sorted(each))
            positions_m = np.array([each[stamp_ns] for stamp_ns in stamps_ns.tolist()])
            paths.append(
                ObjectPath(
                    stamps_ns,
                    make_interp_spline(
                        (stamps_ns - stamps_ns[0]) / NS_PER_S, positions_m, k=1
                    ),
                )
            )
    return paths


def measured_positions(
    run: Run, lists: Sequence[DetectionList], config: Config, ego: EgoPath | None
) -> dict[str, dict[int, MeasuredPositions]]:
    """Return the positions that `run` fused, by name of the sensor and id of the track.

    `lists` are the detection lists of the run. They are transformed and merged as in the tracker. `ego` is None if all
    detections are in the map frame.
    """
    updates = run.tables["updates"]
    fused = updates.where(
        np.isin(updates["disposition"], list(FUSED)) & (updates["track_id"] != NO_TRACK)
    )
    keys = zip(
        *(
            fused[name].tolist()
            for name in ("sensor", "stamp_ns", "receipt_ns", "index")
        ),
        strict=True,
    )
    tracks = dict(zip(keys, fused["track_id"].tolist(), strict=True))
    preprocess = Preprocess(
        Road(),
        config.merge,
        config.motion.model(config.used_sensors),
        config.ego.detection_origin_m,
    )
    sensors = {
        name: replace(
            sensor,
            std={
                component: value
                for component, value in sensor.std.items()
                if component in _POSITION
            },
            std_growth={
                component: value
                for component, value in sensor.std_growth.items()
                if component in _POSITION
            },
            yaw_from_map_std_rad=None,
            max_range_m=None,
            correlation=None,
        )
        for name, sensor in config.sensors.items()
    }
    inbox = Inbox(sensors)
    rows: dict[tuple[str, int], list[tuple[int, FloatArray, bool]]] = defaultdict(list)
    for message in lists:
        inbox.put(message)
        for batch in inbox.collect():
            pose = np.zeros(3) if ego is None else ego(np.array([batch.stamp_ns]))[0]
            if np.isnan(pose[0]):
                continue
            placed = None if ego is None else EgoPose(pose[0], pose[1], pose[2], 0.0)
            for item in preprocess(batch, sensors[message.sensor], placed)[0]:
                row = record(message, item.leader, Disposition.BIRTH)
                track_id = tracks.get(
                    (row.sensor, row.stamp_ns, row.receipt_ns, row.index)
                )
                if track_id is not None and item.position_m is not None:
                    is_map = ego is None or message.frame == "map"
                    z_m = (
                        item.position_m
                        if is_map
                        else (item.position_m - pose[:2]) @ rotations(pose[2])
                    )
                    rows[message.sensor, track_id].append((batch.stamp_ns, z_m, is_map))
    result: dict[str, dict[int, MeasuredPositions]] = {sensor: {} for sensor, _ in rows}
    for (sensor, track_id), each in rows.items():
        stamps_ns, positions_m, in_map = map(np.array, zip(*each, strict=True))
        result[sensor][track_id] = MeasuredPositions(
            stamps_ns, positions_m, in_map, ego
        )
    return result
