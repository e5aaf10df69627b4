"""Geometry of a KITTI sequence: calibration, the ego at every frame, transforms between camera and ego frame."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fgtrack.core.checks import LARGEST
from fgtrack.core.errors import DataError
from fgtrack.core.files import read_whole
from fgtrack.core.geometry import rotation, wrap_angle
from fgtrack.core.types import EgoState, FloatArray
from fgtrack.inputs.formats.common import reported_as
from fgtrack.models.dead_reckoning import (
    PositionEstimate,
    ReportedErrors,
    estimate_position,
)

OXTS = "oxts"
CALIB = "calib"
PERIOD_NS = 103_600_000
"""Period of the frames, as in the odometry benchmark's times of such drives: the LiDAR turns 9.65 times a second."""
IMAGE_PX = (1242.0, 375.0)
"""Width and height of the images; some sequences have a few pixels less."""

#: Largest text file; the data set's files have a few MB.
_LARGEST_MB = 16.0
_EARTH_RADIUS_M = 6_378_137.0
#: Errors of the inertial and satellite navigation (OxTS RT3003): 0.5 m of drifting position, 0.03 m/s of velocity.
_EGO_ERRORS = ReportedErrors(0.5**2, 20.0, 0.03**2)


class Box(NamedTuple):
    """A box in space, as in labels and results: the centre of its bottom face in the rectified camera frame."""

    height_m: float
    width_m: float
    length_m: float
    x_m: float
    y_m: float
    z_m: float
    rotation_y_rad: float

    def image_px(
        self, projection: FloatArray
    ) -> tuple[float, float, float, float] | None:
        """Return left, top, right and bottom of the box in the image of camera 2, limited to the image.

        None if no part of the box is visible. `projection` is the projection of camera 2, as in `View`.
        """
        signs = np.array(
            [[a, b, c] for a in (-0.5, 0.5) for b in (-1.0, 0.0) for c in (-0.5, 0.5)]
        )
        corners = signs * np.array([self.length_m, self.height_m, self.width_m])
        # The rotation is about y, which points down.
        corners[:, ::2] = corners[:, ::2] @ rotation(self.rotation_y_rad)
        corners += np.array([self.x_m, self.y_m, self.z_m])
        points = np.column_stack([corners, np.ones(8)]) @ projection.T
        points = points[points[:, 2] > 0.1]
        if not len(points):
            return None
        pixels = points[:, :2] / points[:, 2:]
        low = np.maximum(pixels.min(axis=0), 0.0)
        high = np.minimum(pixels.max(axis=0), np.array(IMAGE_PX) - 1.0)
        return (*low.tolist(), *high.tolist()) if (low < high).all() else None


class View(NamedTuple):
    """The ego at a frame, the tilt of the inertial unit, and the calibration."""

    ego: EgoState
    levelled_from_imu: FloatArray
    """Rotation from the frame of the inertial unit to the ego frame, shape (3, 3)."""
    projection: FloatArray
    """Projection to homogeneous image points of camera 2 from the rectified frame of camera 0, shape (3, 4)."""
    rectified_from_imu: FloatArray
    """Transform from the frame of the inertial unit to the rectified frame of camera 0, shape (4, 4)."""
    estimate: PositionEstimate
    """Dead-reckoned position of the ego, without the steps of the reported positions; labels are relative to it."""

    def position_m(self, rectified_m: list[float]) -> FloatArray:
        """Return the position in the ego frame, shape (3,), of a point in the rectified camera frame."""
        return (
            self.levelled_from_imu
            @ np.linalg.solve(self.rectified_from_imu, [*rectified_m, 1.0])[:3]
        )

    def pose(
        self, x_m: float, y_m: float, z_m: float, rotation_y_rad: float
    ) -> tuple[FloatArray, float]:
        """Return position (3,) and yaw, in the ego frame, of an object in the rectified camera frame.

        `rotation_y_rad` is the rotation about the camera's y axis, as in the labels.
        """
        heading = [math.cos(rotation_y_rad), 0.0, -math.sin(rotation_y_rad)]
        return self.position_m([x_m, y_m, z_m]), self._azimuth_rad(heading)

    def rectified(
        self, position_m: FloatArray, yaw_rad: float
    ) -> tuple[FloatArray, float]:
        """Return position (3,) and rotation about y in the rectified camera frame: the inverse of `pose`."""
        turn = self.rectified_from_imu[:3, :3] @ self.levelled_from_imu.T
        heading = turn @ [math.cos(yaw_rad), math.sin(yaw_rad), 0.0]
        return turn @ position_m + self.rectified_from_imu[:3, 3], math.atan2(
            -heading[2], heading[0]
        )

    def bearing_rad(self, u_px: float, v_px: float) -> float:
        """Return the bearing of an image point from camera 2; 0 along the ego's heading."""
        return self._azimuth_rad(
            np.linalg.solve(self.projection[:, :3], [u_px, v_px, 1.0]).tolist()
        )

    def in_map(self, position_m: FloatArray) -> FloatArray:
        """Return the positions in the map, shape (..., 2), of points in the ego frame."""
        return (
            np.array(self.estimate.position_m)
            + position_m[..., :2] @ rotation(self.ego.yaw_rad).T
        )

    def _azimuth_rad(self, rectified: list[float]) -> float:
        direction = np.linalg.solve(self.rectified_from_imu[:3, :3], rectified)
        ahead, aside, _ = (self.levelled_from_imu @ direction).tolist()
        return math.atan2(aside, ahead)


def lines_of(file: Path) -> Iterator[tuple[str, list[str]]]:
    """Yield for each line of `file` the start of an error message, and the line's fields.

    Blanks or commas separate the fields.
    """
    text = read_whole(file, _LARGEST_MB).decode(errors="replace").rstrip()
    for number, line in enumerate(text.splitlines(), 1):
        fields = line.strip().split(",") if "," in line else line.split()
        yield f"{file}:{number}: is not a line of the data set", fields


def _calibration(file: Path) -> tuple[FloatArray, FloatArray]:
    """Return `projection` and `rectified_from_imu` of `View`. Raises the exceptions that malformed values cause."""
    matrices = {}
    for where, (name, *values) in lines_of(file):
        with reported_as(where):
            matrix = np.array(values, dtype=np.float64)
            if not (np.abs(matrix) <= LARGEST).all():
                raise ValueError("a number is not finite, or too large")
            matrices[name.strip(":").replace("R0_", "R_").replace("_to_", "_")] = matrix
    with reported_as(f"{file}: is not a calibration of the data set"):
        rectified_from_camera = np.eye(4)
        rectified_from_camera[:3, :3] = matrices["R_rect"].reshape(3, 3)
        camera_from_velodyne, velodyne_from_imu = (
            np.vstack([matrices[name].reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])
            for name in ("Tr_velo_cam", "Tr_imu_velo")
        )
        projection = matrices["P2"].reshape(3, 4)
        rectified_from_imu = (
            rectified_from_camera @ camera_from_velodyne @ velodyne_from_imu
        )
        for name, matrix in (
            ("P2", projection[:, :3]),
            ("R_rect and Tr", rectified_from_imu[:3, :3]),
        ):
            if np.linalg.matrix_rank(matrix) < len(matrix):
                raise ValueError(f"the matrix {name} is singular")
        return projection, rectified_from_imu


def read_views(folder: Path, sequence: str) -> tuple[list[View], DataError | None]:
    """Return the ego at the frames of a sequence up to the first malformed line, and the error of this line."""
    calibration = _calibration(folder / CALIB / f"{sequence}.txt")
    views: list[View] = []
    scale = 1.0
    origin_m = np.zeros(2)
    try:
        for where, fields in lines_of(folder / OXTS / f"{sequence}.txt"):
            with reported_as(where):
                (
                    latitude_deg,
                    longitude_deg,
                    roll_rad,
                    pitch_rad,
                    yaw_rad,
                    speed_mps,
                    accel_mps2,
                    yaw_rate_radps,
                ) = (float(fields[index]) for index in (0, 1, 3, 4, 5, 8, 14, 22))
                if not views:
                    scale = math.cos(math.radians(latitude_deg))
                    origin_m = _mercator(latitude_deg, longitude_deg, scale)
                x_m, y_m = (
                    _mercator(latitude_deg, longitude_deg, scale) - origin_m
                ).tolist()
                stamp_ns = len(views) * PERIOD_NS
                ego = EgoState(
                    stamp_ns,
                    stamp_ns,
                    x_m,
                    y_m,
                    wrap_angle(yaw_rad),
                    speed_mps,
                    yaw_rate_radps,
                    accel_mps2,
                )
                about_x = np.eye(3)
                about_y = np.eye(3)
                about_x[1:, 1:] = rotation(roll_rad)
                # Rows and columns x and z: a rotation about y turns z to x.
                about_y[::2, ::2] = rotation(-pitch_rad)
                velocity_mps = (
                    speed_mps * math.cos(yaw_rad),
                    speed_mps * math.sin(yaw_rad),
                )
                last = views[-1].estimate if views else None
                estimate = estimate_position(
                    last, stamp_ns, (x_m, y_m), velocity_mps, _EGO_ERRORS
                )
                views.append(View(ego, about_y @ about_x, *calibration, estimate))
    except DataError as error:
        return views, error
    return views, None


def _mercator(latitude_deg: float, longitude_deg: float, scale: float) -> FloatArray:
    """Return the position to the east and north, shape (2,), true to scale at the latitude with the cosine `scale`."""
    north = math.log(math.tan(math.radians(45.0 + 0.5 * latitude_deg)))
    return scale * _EARTH_RADIUS_M * np.array([math.radians(longitude_deg), north])
