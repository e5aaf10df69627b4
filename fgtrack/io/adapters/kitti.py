"""The KITTI tracking data set: detections of road users, the ego's motion, and labelled truth at 10 Hz.

Geiger, Lenz, Urtasun, "Are we ready for autonomous driving? The KITTI vision benchmark suite", CVPR 2012;
www.cvlibs.net/datasets/kitti, laid out as `oxts/ calib/ label_02/` with a text file per sequence. Every other folder
beside them with a file of the sequence, or with a folder of it and a file per frame, holds the detections of a sensor
of that name, in one of these forms:

- `frame,class,left,top,right,bottom,score,h,w,l,x,y,z,rotation_y,alpha`, as AB3DMOT publishes them;
- `frame track type truncated occluded alpha left top right bottom h w l x y z rotation_y score`, as the data set's own
  results of tracking; in a file per frame without frame and track, as its results of object detection;
- `frame,left,top,right,bottom,score`: a box in the image of camera 2.

Boxes in space give position, yaw and size; where there is none, the bearing of the middle of the box in the image.

Choices that the data leave open:

- Frame k is at k x 0.1 s and received at once: the data have no receipt times (`fgtrack convert` gives delays).
- The map frame begins where the ego does; x to the east, y to the north, in the Mercator projection of the data set's
  own development kit. The ego frame is that of the inertial unit, levelled by its roll and pitch.
- A bearing is from camera 2 and relative to the ego's heading: `frame` is `sensor`, and the sensor's `mount` is the
  place of the camera, without a yaw, since the calibration has turned the bearing already.
- A box that touches the left or right border of the image shows a part of a car, whose middle is elsewhere: left out.
- Detections and truth of other classes than `input.kitti.classes` are left out. As in the data set's own evaluation a
  neighbouring class (a van for a car) is ignored, and so is what lies in a `DontCare` region: behind it as seen from
  camera 2, from the distance on at which a car looks so small that it can be in it.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from itertools import count
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.geometry import wrap_angle
from fgtrack.core.types import Detection, DetectionList, Frame, Message, TruthState
from fgtrack.io.adapters.common import split
from fgtrack.io.adapters.kitti_view import PERIOD_NS, View, lines, read_views
from fgtrack.io.config import InputConfig, KittiInput
from fgtrack.io.source import FileFormat

__all__ = ["CLASS_NAMES", "FORMAT", "PERIOD_NS", "is_sequence", "read_sequence", "view_of_sequence"]

_TYPES = ("Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist", "Tram", "Misc")
CLASS_NAMES: Mapping[str, str] = {name.lower(): name for name in _TYPES}
"""Types of the data set by the names that detections get."""

_OXTS, _CALIB, _LABELS = "oxts", "calib", "label_02"
_DONT_CARE = "DontCare"
_CLASSES = {1: "Pedestrian", 2: "Car", 3: "Cyclist"}  # as AB3DMOT counts them
_NEIGHBOURS: Mapping[str, str] = {"Car": "Van", "Pedestrian": "Person_sitting"}
_BORDER_PX = 2.0
_NOWHERE_M = -999.0  # a box without a place in space is at -1000
_BOX_FIELDS, _AB3DMOT_FIELDS, _KITTI_FIELDS = 6, 15, 18
_FORMS = "6 fields (a box in the image), 15 (as AB3DMOT) or 18 (as the results of the data set)"
_CAR_HEIGHT_M, _INSIDE = 1.5, 0.5  # as high and as far inside a region that it counts as in it
_FAR_M = 150.0

_Parsed = TypeVar("_Parsed")


class Row(NamedTuple):
    """A line of a file, split."""

    place: str
    """File and line, for messages."""
    fields: list[str]


Rows = Mapping[int, list[Row]]
"""The lines of a file, or of all files of a folder, by frame."""


def read_sequence(folder: Path, sequence: str, settings: KittiInput) -> Iterator[Message]:
    """Messages of `sequence` in receipt order; at a frame the truth comes first, then the ego, then the detections.

    Raises
    ------
    DataError
        A file is missing or not what the data set holds; the message names file and line.
    """
    views = _views(folder, sequence)
    labels = folder / _LABELS / f"{sequence}.txt"
    truth = _rows(labels, len(views)) if labels.exists() else {}
    rows_of = {place.parent.name: _rows(place, len(views)) for place in _detection_places(folder, sequence)}
    detections = {sensor: (rows, _frame(rows)) for sensor, rows in rows_of.items()}
    for frame, view in enumerate(views):
        yield from _read(truth.get(frame, []), partial(_truth, view, settings))
        yield from _regions(view, truth.get(frame, []))
        yield view.ego
        for sensor, (rows, refers_to) in detections.items():
            parse = partial(_detection, view, sensor, settings, refers_to)
            found: Iterator[Detection | str] = _read(rows.get(frame, []), parse)
            objects, left_out = split(found)
            yield DetectionList(sensor, view.ego.stamp_ns, view.ego.receipt_ns, objects, refers_to, left_out)


def view_of_sequence(path: Path) -> list[View]:
    """The ego at every frame of the sequence that `path`, a folder or a file of `oxts/`, means; raises as a reader."""
    return _views(*_located(path))


def _views(folder: Path, sequence: str) -> list[View]:
    return read_views(folder / _OXTS / f"{sequence}.txt", folder / _CALIB / f"{sequence}.txt")


def _located(path: Path, named: int | str | None = None) -> tuple[Path, str]:
    """Folder and name of the sequence that `path`, a folder or a file of `oxts/`, and `named` mean.

    Raises `CallError` where they mean none.
    """
    if path.is_file():
        return path.parent.parent, path.stem
    known = sorted(file.stem for file in (path / _OXTS).glob("*.txt"))
    if named is None and len(known) != 1:
        raise CallError(
            f"{path}: holds {len(known)} sequences, name one by its file: {path / _OXTS}/{(known or ['0000'])[0]}.txt"
        )
    sequence = known[0] if named is None else f"{named:04d}" if isinstance(named, int) else named
    if sequence not in known:
        raise CallError(f"{path}: holds no sequence {sequence}, but {', '.join(known)} (input.kitti.sequence)")
    return path, sequence


def is_sequence(path: Path) -> bool:
    """True if `path` is a folder of the data set, or a file of its `oxts/`."""
    folder = path.parent.parent if path.is_file() and path.parent.name == _OXTS else path
    return (folder / _OXTS).is_dir() and (folder / _CALIB).is_dir()


def _open(path: Path, config: InputConfig) -> partial[Iterator[Message]]:
    return partial(read_sequence, *_located(path, config.kitti.sequence), config.kitti)


FORMAT = FileFormat(
    "a KITTI tracking folder (oxts/, calib/) or the oxts/NNNN.txt of a sequence in it", is_sequence, _open
)


def _detection_places(folder: Path, sequence: str) -> list[Path]:
    """Files, or folders with a file per frame, of what detected something in `sequence`."""
    places = [*folder.glob(f"*/{sequence}.txt"), *(each for each in folder.glob(f"*/{sequence}") if each.is_dir())]
    kept = {place.parent.name: place for place in sorted(places) if place.is_file() or any(place.glob("[0-9]*.txt"))}
    return [place for name, place in sorted(kept.items()) if name not in (_OXTS, _CALIB, _LABELS)]


def _truth(view: View, settings: KittiInput, fields: list[str]) -> TruthState | None:
    kind = fields[2]
    ignored = kind in {_NEIGHBOURS.get(name) for name in settings.classes}
    if not ignored and kind not in settings.classes:
        return None
    x_m, y_m, z_m, turned_rad = map(float, fields[13:17])
    ego = view.ego
    position_m, yaw_rad = view.pose(x_m, y_m, z_m, turned_rad)
    x_m, y_m = view.in_map(position_m).tolist()
    yaw_rad = wrap_angle(yaw_rad + ego.yaw_rad)
    return TruthState(ego.stamp_ns, ego.receipt_ns, int(fields[1]), x_m, y_m, yaw_rad, ignored=ignored)


def _regions(view: View, rows: list[Row]) -> Iterator[TruthState]:
    """The regions of a frame; their ids count down from -2."""
    boxes = [row for row in rows if row.fields[2:3] == [_DONT_CARE]]
    yield from _read(boxes, partial(_region, view, count(-2, -1)))


def _region(view: View, ids: Iterator[int], fields: list[str]) -> TruthState:
    left_px, top_px, right_px, bottom_px = map(float, fields[6:10])
    near_m = _CAR_HEIGHT_M * _INSIDE * view.calibration.projection[1, 1] / max(bottom_px - top_px, 1.0)
    near_m, far_m = min(near_m, 0.5 * _FAR_M), _FAR_M
    v_px = 0.5 * (top_px + bottom_px)
    sides = np.array([view.bearing_rad(u_px, v_px) for u_px in (left_px, right_px)])
    rays = np.column_stack([np.cos(sides), np.sin(sides)])
    camera_m = (view.levelled_from_imu @ view.calibration.camera_m)[:2]
    corners = view.in_map(camera_m + np.vstack([near_m * rays, far_m * rays[::-1]]))
    x_m, y_m = corners.mean(axis=0).tolist()
    outline_m = tuple(corners.ravel().tolist())
    ego = view.ego
    return TruthState(ego.stamp_ns, ego.receipt_ns, next(ids), x_m, y_m, ignored=True, outline_m=outline_m)


def _detection(view: View, sensor: str, settings: KittiInput, frame: Frame, fields: list[str]) -> Detection | str:
    """The object of a line; for another class, one below the score, and a box that the image cuts off the setting."""
    kind: str | None = None
    score: float | None = None
    if len(fields) == _AB3DMOT_FIELDS:
        kind = _CLASSES.get(int(fields[1]), fields[1])
        image, score, space = fields[2:6], float(fields[6]), fields[7:14]
    elif len(fields) in (_KITTI_FIELDS - 1, _KITTI_FIELDS):  # the score is last and may be missing
        kind = fields[2]
        image, space = fields[6:10], fields[10:17]
        if len(fields) == _KITTI_FIELDS:
            score = float(fields[17])
    elif len(fields) == _BOX_FIELDS:
        image, score, space = fields[1:5], float(fields[5]), []
    else:
        raise ValueError(f"{len(fields)} fields in place of {_FORMS}")
    if kind is not None and kind not in settings.classes:
        return "input.kitti.classes"
    if score is not None and score < settings.min_score.get(sensor, -math.inf):
        return "input.kitti.min_score"
    name = None if kind is None else kind.lower()
    if not space or float(space[3]) < _NOWHERE_M:
        if frame != "sensor":
            raise ValueError("a box in the image alone, where others of the file are in space: give it a folder")
        return _in_image(view, settings, list(map(float, image)), score, name)
    if frame == "sensor":
        raise ValueError("a box in space, where the file begins with one in the image alone: give it a folder")
    height_m, width_m, length_m, x_m, y_m, z_m, turned_rad = map(float, space)
    position_m, yaw_rad = view.pose(x_m, y_m, z_m, turned_rad)
    ahead_m, aside_m, bottom_m = position_m.tolist()
    return Detection(
        x_m=ahead_m,
        y_m=aside_m,
        yaw_rad=yaw_rad,
        z_m=bottom_m + 0.5 * height_m,
        length_m=length_m,
        width_m=width_m,
        height_m=height_m,
        score=score,
        class_name=name,
    )


def _in_image(
    view: View, settings: KittiInput, box_px: list[float], score: float | None, name: str | None
) -> Detection | str:
    left_px, top_px, right_px, bottom_px = box_px
    if left_px < _BORDER_PX or right_px > settings.image_width_px - 1.0 - _BORDER_PX:
        return "input.kitti.image_width_px"
    v_px = 0.5 * (top_px + bottom_px)
    covariance = None
    if settings.box_std is not None:
        width_rad = view.bearing_rad(left_px, v_px) - view.bearing_rad(right_px, v_px)
        covariance = ((settings.box_std * width_rad) ** 2,)
    bearing_rad = view.bearing_rad(0.5 * (left_px + right_px), v_px)
    return Detection(bearing_rad=bearing_rad, covariance=covariance, score=score, class_name=name)


def _frame(rows: Rows) -> Frame:
    """Frame of the detections of a file; bearings are from the camera."""
    first = next((found[0].fields for found in rows.values() if found), None)
    if first is None:
        return "ego"
    flat = len(first) >= _KITTI_FIELDS - 1 and first[13].startswith("-1000")
    return "sensor" if flat or len(first) == _BOX_FIELDS else "ego"


def _read(rows: list[Row], parse: Callable[[list[str]], _Parsed | None]) -> Iterator[_Parsed]:
    """Results of `parse` for the fields of `rows`, without what it leaves out."""
    for row in rows:
        try:
            with np.errstate(all="ignore"):  # of what is not finite: the tracker counts it
                found = parse(row.fields)
        except (ValueError, IndexError) as error:
            raise DataError(f"{row.place}: is no line of the data set ({error})") from error
        if found is not None:
            yield found


def _rows(place: Path, num_frames: int) -> Rows:
    """Lines of a file of the sequence, or of the files of its frames in a folder, as if they were one."""
    rows: dict[int, list[Row]] = {}
    for where, fields in _split(place):
        try:
            frame = int(fields[0])
        except ValueError as error:
            raise DataError(f"{where}: does not begin with the number of a frame") from error
        if not 0 <= frame < num_frames:
            raise DataError(f"{where}: is of frame {frame}, but {_OXTS} has {num_frames} frames")
        rows.setdefault(frame, []).append(Row(where, fields))
    return rows


def _split(place: Path) -> Iterator[tuple[str, list[str]]]:
    """File and line, and fields, of a file, or of the files of a folder, whose names are frames."""
    for file in sorted(place.glob("*.txt")) if place.is_dir() else [place]:
        first = [file.stem, "-1"] if place.is_dir() else []
        for number, line in enumerate(lines(file), 1):
            yield f"{file}:{number}", [*first, *(line.split(",") if "," in line else line.split())]
