"""From a run back to raw detections: whose they are, and where they were, had they been sensed at another time."""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import replace
from functools import partial
from typing import NamedTuple

from fgtrack.core.types import FUSED, DetectionList, Disposition
from fgtrack.estimation.base import Measurement
from fgtrack.estimation.factor_graph.clock_calibration.time_shift import ShiftableMeasurement
from fgtrack.io.run import NO_TRACK, Run
from fgtrack.models.road import OpenSpace
from fgtrack.models.sensors import SensorModel
from fgtrack.pipeline.config import Config
from fgtrack.pipeline.ego_path import EgoPath
from fgtrack.tracking.inbox import Batch, stamps
from fgtrack.tracking.preprocess import Preprocess

#: Components that a wrong stamp moves by metres. Speed and yaw would add little, and as much error as their standard
#: deviations are wrong by.
_POSITION = ("x_m", "y_m", "range_m", "bearing_rad")


class Remeasure:
    """Measurements of detections, transformed to the map and merged as the tracker does, at any time."""

    def __init__(self, config: Config, path: EgoPath | None) -> None:
        """`path`: that of the ego; None where all detections are in the map frame."""
        self._path = path
        self._preprocess = Preprocess(OpenSpace(), config.merge, config.motion.model(), config.ego.detection_origin_m)
        self._sensors = {name: _position_only(sensor) for name, sensor in config.sensors.items()}

    def measurement(
        self, message: DetectionList, stamp_ns: int, indices: tuple[int, ...]
    ) -> ShiftableMeasurement | None:
        """Detections `indices` of `message` as one; None where the ego or the position is not known."""
        if self._path is not None and not self._path.start_ns <= stamp_ns <= self._path.end_ns:
            return None
        used = self._sensors[message.sensor].std.keys()
        if not all(_is_position(used & set(message.objects[index].measured)) for index in indices):
            return None
        return ShiftableMeasurement(message.sensor, stamp_ns, partial(self._measured, message, indices))

    def _measured(self, message: DetectionList, indices: tuple[int, ...], time_ns: int) -> Measurement:
        pose = None if self._path is None else self._path(time_ns)
        candidates, _ = self._preprocess(Batch(message, time_ns, indices), self._sensors[message.sensor], pose)
        return candidates[0].measurement


def _is_position(names: Set[str]) -> bool:
    return {"x_m", "y_m"} <= names or {"range_m", "bearing_rad"} <= names


def _position_only(sensor: SensorModel) -> SensorModel:
    std = {name: value for name, value in sensor.std.items() if name in _POSITION}
    return replace(sensor, std=std, yaw_from_map_std_rad=None, max_range_m=None, correlation=None)


def measurements_by_track(
    run: Run,
    processed: Sequence[DetectionList],
    raw: Sequence[DetectionList],
    sensors: Mapping[str, SensorModel],
    remeasure: Remeasure,
) -> list[list[ShiftableMeasurement]]:
    """The measurements of each track of `run`, in order of stamp.

    Parameters
    ----------
    processed
        The lists that the tracker got, all of `sensors`.
    raw
        The same lists, with the stamps that the measurements are to have.
    """
    places = _places(processed)
    batches = [stamps(message, sensors[message.sensor]) for message in raw]
    groups: dict[tuple[int, int, int], list[tuple[int, bool]]] = defaultdict(list)
    for row in _rows(run):
        place = places.get(row.detection)
        if place is not None:
            index = row.detection[-1]
            groups[row.track_id, place, batches[place][index]].append((index, row.leads))
    tracks: dict[int, list[ShiftableMeasurement]] = defaultdict(list)
    for (track_id, place, stamp_ns), members in groups.items():
        if any(leads for _, leads in members):
            found = remeasure.measurement(raw[place], stamp_ns, tuple(sorted(index for index, _ in members)))
            if found is not None:
                tracks[track_id].append(found)
    return [sorted(tracks[track_id], key=lambda item: item.stamp_ns) for track_id in sorted(tracks)]


#: What identifies a detection in a run: columns of its updates.
_DETECTION = ("sensor", "stamp_ns", "receipt_ns", "index")
_Detection = tuple[str, int, int, int]


class _Row(NamedTuple):
    """A detection that belongs to a track."""

    detection: _Detection
    track_id: int
    leads: bool
    """False where it was merged into another one."""


def _rows(run: Run) -> Iterator[_Row]:
    updates = run.updates
    columns = (updates[name].tolist() for name in (*_DETECTION, "track_id", "disposition"))
    for sensor, stamp_ns, receipt_ns, index, track_id, disposition in zip(*columns, strict=True):
        leads = disposition in FUSED
        if track_id != NO_TRACK and (leads or disposition == Disposition.MERGED):
            yield _Row((sensor, stamp_ns, receipt_ns, index), track_id, leads)


def _places(messages: Sequence[DetectionList]) -> dict[_Detection, int]:
    """Which message a detection is of; without those that several different messages may be meant by."""
    places: dict[_Detection, int] = {}
    unclear = set()
    for place, message in enumerate(messages):
        for index, item in enumerate(message.objects):
            stamp_ns = message.stamp_ns if item.stamp_ns is None else item.stamp_ns
            detection = message.sensor, stamp_ns, message.receipt_ns, index
            first = places.setdefault(detection, place)
            if messages[first].objects != message.objects:
                unclear.add(detection)
    return {detection: place for detection, place in places.items() if detection not in unclear}
