"""The KITTI tracking data set: LiDAR and camera detections of cars, the ego's motion, and labelled truth at 10 Hz.

Geiger, Lenz, Urtasun, "Are we ready for autonomous driving? The KITTI vision benchmark suite", CVPR 2012;
www.cvlibs.net/datasets/kitti, laid out as `oxts/ calib/ label_02/` with a text file per sequence. Every other folder
beside them with a file of the sequence holds the detections of a sensor of that name, in one of two forms:

- `frame,class,left,top,right,bottom,score,h,w,l,x,y,z,rotation_y,alpha` (as AB3DMOT publishes them): position and yaw;
- `frame,left,top,right,bottom,score`: the bearing of the middle of the box in the image of camera 2.

Choices that the data leave open:

- Frame k is at k x 0.1 s and received at once: the data have no receipt times (`fgtrack convert` gives delays).
- The map frame begins where the ego does: x to the east, y to the north, in the Mercator projection of the data set's
  own development kit. The ego frame is that of the inertial unit, levelled by its roll and pitch.
- A bearing is from camera 2 and relative to the ego's heading: `frame` is `sensor`, and the sensor's `mount` is the
  place of the camera, without a yaw, since the calibration has turned the bearing already.
- A box that touches the left or right border of the image shows a part of a car, whose middle is elsewhere: left out.
- Truth is what is labelled `Car`; detections are of cars too, and other classes in their files are left out.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.geometry import rotation, wrap_angle
from fgtrack.core.types import Detection, DetectionList, EgoState, FloatArray, Frame, Message, TruthState
from fgtrack.io.config import InputConfig, KittiInput
from fgtrack.io.source import FileFormat

PERIOD_NS = 100_000_000
_OXTS, _CALIB, _LABELS = "oxts", "calib", "label_02"
_EARTH_RADIUS_M = 6_378_137.0
_CAR = 2  # the class of AB3DMOT
_BORDER_PX = 2.0
_POSE_FIELDS, _BOX_FIELDS = 15, 6

_Parsed = TypeVar("_Parsed")


class Row(NamedTuple):
    """A line of a file, split."""

    number: int
    """Of the line, from 1."""
    fields: list[str]


Rows = Mapping[int, list[Row]]
"""The lines of a file by frame."""


class Calibration(NamedTuple):
    """How camera 2 and the frame of labels and detections stand in the frame of the inertial unit."""

    projection: FloatArray
    """Image point, homogeneous, from a point in the rectified frame of camera 0, shape (3, 4)."""
    rectified_from_imu: FloatArray
    """Shape (4, 4)."""

    def point(self, rectified_m: Sequence[float]) -> FloatArray:
        """Point in the frame of the inertial unit, shape (3,)."""
        return np.asarray(np.linalg.solve(self.rectified_from_imu, [*rectified_m, 1.0])[:3])

    def direction(self, rectified: Sequence[float]) -> FloatArray:
        """Direction in the frame of the inertial unit, shape (3,)."""
        return np.asarray(np.linalg.solve(self.rectified_from_imu[:3, :3], rectified))

    def ray(self, u_px: float, v_px: float) -> FloatArray:
        """Direction from camera 2 to an image point, in the frame of the inertial unit, shape (3,)."""
        return self.direction(np.linalg.solve(self.projection[:, :3], [u_px, v_px, 1.0]).tolist())


class View(NamedTuple):
    """The ego at a frame, how the inertial unit is tilted, and the calibration."""

    ego: EgoState
    levelled_from_imu: FloatArray
    """Shape (3, 3)."""
    calibration: Calibration

    def pose(self, x_m: float, y_m: float, z_m: float, rotation_y_rad: float) -> tuple[FloatArray, float]:
        """Position (2,) and yaw in the ego frame of an object given in the rectified camera frame."""
        heading = self.calibration.direction([math.cos(rotation_y_rad), 0.0, -math.sin(rotation_y_rad)])
        return self._level(self.calibration.point([x_m, y_m, z_m])), self._azimuth_rad(heading)

    def bearing_rad(self, u_px: float, v_px: float) -> float:
        """Bearing of an image point from camera 2, 0 along the ego's heading."""
        return self._azimuth_rad(self.calibration.ray(u_px, v_px))

    def _level(self, imu: FloatArray) -> FloatArray:
        """The horizontal part of a vector of the inertial unit, in the ego frame, shape (2,)."""
        return np.asarray((self.levelled_from_imu @ imu)[:2])

    def _azimuth_rad(self, imu: FloatArray) -> float:
        ahead, aside = self._level(imu).tolist()
        return math.atan2(aside, ahead)


def read_sequence(folder: Path, sequence: str, settings: KittiInput) -> Iterator[Message]:
    """Messages of `sequence` in receipt order; at a frame the truth comes first, then the ego, then the detections.

    Raises
    ------
    DataError
        A file is missing or not what the data set holds; the message names file and line.
    """
    views = _views(folder / _OXTS / f"{sequence}.txt", _calibration(folder / _CALIB / f"{sequence}.txt"))
    labels = folder / _LABELS / f"{sequence}.txt"
    truth = _rows(labels, " ", len(views)) if labels.exists() else {}
    detections = [(file, _rows(file, ",", len(views))) for file in _detection_files(folder, sequence)]
    for frame, view in enumerate(views):
        yield from _read(labels, truth.get(frame, []), partial(_truth, view))
        yield view.ego
        for file, rows in detections:
            sensor = file.parent.name
            least = settings.min_score.get(sensor, -math.inf)
            objects = _read(file, rows.get(frame, []), partial(_detection, view, least, settings))
            yield DetectionList(sensor, view.ego.stamp_ns, view.ego.receipt_ns, list(objects), _frame(rows))


def _recognises(path: Path) -> bool:
    folder = path.parent.parent if path.is_file() and path.parent.name == _OXTS else path
    return (folder / _OXTS).is_dir() and (folder / _CALIB).is_dir()


def _open(path: Path, config: InputConfig) -> partial[Iterator[Message]]:
    if path.is_file():
        return partial(read_sequence, path.parent.parent, path.stem, config.kitti)
    known = sorted(file.stem for file in (path / _OXTS).glob("*.txt"))
    named = config.kitti.sequence
    if named is None and len(known) != 1:
        raise CallError(
            f"{path}: holds {len(known)} sequences, name one by its file: {path / _OXTS}/{(known or ['0000'])[0]}.txt"
        )
    sequence = known[0] if named is None else f"{named:04d}" if isinstance(named, int) else named
    if sequence not in known:
        raise CallError(f"{path}: holds no sequence {sequence}, but {', '.join(known)} (input.kitti.sequence)")
    return partial(read_sequence, path, sequence, config.kitti)


FORMAT = FileFormat(
    "a KITTI tracking folder (oxts/, calib/) or the oxts/NNNN.txt of a sequence in it", _recognises, _open
)


def _detection_files(folder: Path, sequence: str) -> list[Path]:
    files = sorted(folder.glob(f"*/{sequence}.txt"))
    return [file for file in files if file.parent.name not in (_OXTS, _CALIB, _LABELS)]


def _calibration(file: Path) -> Calibration:
    matrices: dict[str, FloatArray] = {}
    for number, line in enumerate(_lines(file), 1):
        name, _, values = line.replace(":", " ", 1).strip().partition(" ")
        try:
            matrices[name.replace("R0_", "R_").replace("_to_", "_")] = np.array(values.split(), dtype=np.float64)
        except ValueError as error:
            raise DataError(f"{file}:{number}: is no matrix ({error})") from error
    try:
        rectified_from_camera = np.eye(4)
        rectified_from_camera[:3, :3] = matrices["R_rect"].reshape(3, 3)
        camera_from_velodyne, velodyne_from_imu = (_rigid(matrices[name]) for name in ("Tr_velo_cam", "Tr_imu_velo"))
        projection = matrices["P2"].reshape(3, 4)
    except (KeyError, ValueError) as error:
        raise DataError(f"{file}: is no calibration of the data set ({error!r})") from error
    return Calibration(projection, rectified_from_camera @ camera_from_velodyne @ velodyne_from_imu)


def _rigid(values: FloatArray) -> FloatArray:
    return np.vstack([values.reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])


def _views(file: Path, calibration: Calibration) -> list[View]:
    """What is known of the ego at every frame."""
    views: list[View] = []
    origin_m, scale = np.zeros(2), 1.0
    for number, line in enumerate(_lines(file), 1):
        try:
            values = [float(value) for value in line.split()]
            latitude_deg, longitude_deg, _, roll_rad, pitch_rad, yaw_rad = values[:6]
            speed_mps, accel_mps2, yaw_rate_radps = values[8], values[14], values[22]
            if not views:
                scale = math.cos(math.radians(latitude_deg))
            position_m = _mercator(latitude_deg, longitude_deg, scale)
        except (ValueError, IndexError) as error:
            raise DataError(f"{file}:{number}: is no line of the data set ({error})") from error
        if not views:
            origin_m = position_m
        x_m, y_m = (position_m - origin_m).tolist()
        stamp_ns = len(views) * PERIOD_NS
        ego = EgoState(stamp_ns, stamp_ns, x_m, y_m, wrap_angle(yaw_rad), speed_mps, yaw_rate_radps, accel_mps2)
        views.append(View(ego, _levelling(roll_rad, pitch_rad), calibration))
    return views


def _mercator(latitude_deg: float, longitude_deg: float, scale: float) -> FloatArray:
    """Position to the east and north, shape (2,), true to scale at the latitude whose cosine is `scale`."""
    north = math.log(math.tan(math.radians(45.0 + 0.5 * latitude_deg)))
    return scale * _EARTH_RADIUS_M * np.array([math.radians(longitude_deg), north])


def _levelling(roll_rad: float, pitch_rad: float) -> FloatArray:
    """Rotation, shape (3, 3), from a frame that is rolled and pitched to a level one of the same heading."""
    about_x, about_y = np.eye(3), np.eye(3)
    about_x[1:, 1:] = rotation(roll_rad)
    about_y[::2, ::2] = rotation(-pitch_rad)  # rows and columns x and z, which y turns from z to x
    return np.asarray(about_y @ about_x)


def _truth(view: View, fields: list[str]) -> TruthState | None:
    if fields[2] != "Car":
        return None
    x_m, y_m, z_m, turned_rad = map(float, fields[13:17])
    ego = view.ego
    position_m, yaw_rad = view.pose(x_m, y_m, z_m, turned_rad)
    x_m, y_m = (np.array([ego.x_m, ego.y_m]) + rotation(ego.yaw_rad) @ position_m).tolist()
    return TruthState(ego.stamp_ns, ego.receipt_ns, int(fields[1]), x_m, y_m, wrap_angle(yaw_rad + ego.yaw_rad))


def _detection(view: View, min_score: float, settings: KittiInput, fields: list[str]) -> Detection | None:
    """The car of a line; None for another class, one below the score, and a box that the image cuts off."""
    if len(fields) == _POSE_FIELDS:
        if int(fields[1]) != _CAR or float(fields[6]) < min_score:
            return None
        x_m, y_m, z_m, turned_rad = map(float, fields[10:14])
        position_m, yaw_rad = view.pose(x_m, y_m, z_m, turned_rad)
        return Detection(x_m=float(position_m[0]), y_m=float(position_m[1]), yaw_rad=yaw_rad)
    if len(fields) == _BOX_FIELDS:
        left_px, top_px, right_px, bottom_px, score = map(float, fields[1:])
        cut_off = left_px < _BORDER_PX or right_px > settings.image_width_px - 1.0 - _BORDER_PX
        if cut_off or score < min_score:
            return None
        v_px = 0.5 * (top_px + bottom_px)
        covariance = None
        if settings.box_std is not None:
            width_rad = view.bearing_rad(left_px, v_px) - view.bearing_rad(right_px, v_px)
            covariance = ((settings.box_std * width_rad) ** 2,)
        return Detection(bearing_rad=view.bearing_rad(0.5 * (left_px + right_px), v_px), covariance=covariance)
    raise ValueError(f"{len(fields)} fields in place of {_POSE_FIELDS}, a box in space, or {_BOX_FIELDS}, in the image")


def _frame(rows: Rows) -> Frame:
    """Frame of the detections of a file; bearings are from the camera."""
    first = next((found[0] for found in rows.values()), None)
    return "sensor" if first is not None and len(first.fields) == _BOX_FIELDS else "ego"


def _read(file: Path, rows: list[Row], parse: Callable[[list[str]], _Parsed | None]) -> Iterator[_Parsed]:
    """What `parse` makes of the fields of `rows`, without what it leaves out."""
    for row in rows:
        try:
            found = parse(row.fields)
        except (ValueError, IndexError) as error:
            raise DataError(f"{file}:{row.number}: is no line of the data set ({error})") from error
        if found is not None:
            yield found


def _rows(file: Path, separator: str, num_frames: int) -> Rows:
    rows: dict[int, list[Row]] = {}
    for number, line in enumerate(_lines(file), 1):
        fields = line.split(separator)
        try:
            frame = int(fields[0])
        except ValueError as error:
            raise DataError(f"{file}:{number}: does not begin with the number of a frame") from error
        if not 0 <= frame < num_frames:
            raise DataError(f"{file}:{number}: is of frame {frame}, but {_OXTS} has {num_frames} frames")
        rows.setdefault(frame, []).append(Row(number, fields))
    return rows


def _lines(file: Path) -> list[str]:
    """The lines of `file`, without empty ones at its end."""
    try:
        return [line.strip() for line in file.read_text(encoding="utf-8").rstrip().splitlines()]
    except OSError as error:
        raise DataError(f"{file}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise DataError(f"{file}: is no text ({error.reason})") from error
