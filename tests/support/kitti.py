"""A made-up sequence in the layout of the KITTI tracking data set."""

import math
from pathlib import Path

import numpy as np

#: A camera that looks ahead from 2 m ahead and 0.5 m to the left of the inertial unit, 0.1 m above it.
RECTIFIED_FROM_IMU = np.array(
    [[0.0, -1.0, 0.0, 0.5], [0.0, 0.0, -1.0, 0.1], [1.0, 0.0, 0.0, -2.0]]
)
FOCAL_PX, CENTRE_PX = 700.0, (600.0, 180.0)


def numbers(matrix: object) -> str:
    return " ".join(str(float(value)) for value in np.ravel(matrix))


def calibration(
    r_rect: str = "R_rect", velodyne: str = "Tr_velo_cam", imu: str = "Tr_imu_velo"
) -> str:
    projection = [
        [FOCAL_PX, 0.0, CENTRE_PX[0], 0.0],
        [0.0, FOCAL_PX, CENTRE_PX[1], 0.0],
        [0.0, 0.0, 1.0, 0.0],
    ]
    lines = [f"P{k}: {numbers(projection)}" for k in range(4)]
    lines += [
        f"{r_rect} {numbers(np.eye(3))}",
        f"{velodyne} {numbers(RECTIFIED_FROM_IMU)}",
    ]
    return "\n".join([*lines, f"{imu} {numbers(np.eye(3, 4))}"]) + "\n\n"


def oxts(
    north_deg: float = 0.0,
    east_deg: float = 0.0,
    roll_rad: float = 0.0,
    pitch_rad: float = 0.0,
    yaw_rad: float = 0.0,
    speed_mps: float = 0.0,
    yaw_rate_radps: float = 0.0,
    accel_mps2: float = 0.0,
) -> str:
    values = np.zeros(30)
    values[:6] = 49.0 + north_deg, 8.0 + east_deg, 110.0, roll_rad, pitch_rad, yaw_rad
    values[8], values[14], values[22] = speed_mps, accel_mps2, yaw_rate_radps
    return numbers(values)


def label(
    frame: int, track: int, kind: str, ahead_m: float, aside_m: float, yaw_rad: float
) -> str:
    x_m, y_m, z_m = RECTIFIED_FROM_IMU @ [ahead_m, aside_m, -1.5, 1.0]
    return f"{frame} {track} {kind} 0 0 0.0 1 2 3 4 1.5 1.6 4.0 {x_m} {y_m} {z_m} {-yaw_rad - 0.5 * math.pi}"


def pose(
    frame: int,
    ahead_m: float,
    aside_m: float,
    yaw_rad: float,
    score: float = 9.0,
    kind: int = 2,
) -> str:
    x_m, y_m, z_m = RECTIFIED_FROM_IMU @ [ahead_m, aside_m, -1.5, 1.0]
    return f"{frame},{kind},1,2,3,4,{score},1.5,1.6,4.0,{x_m},{y_m},{z_m},{-yaw_rad - 0.5 * math.pi},0.0"


def box(frame: int, left_px: float, right_px: float, score: float = 1.0) -> str:
    return (
        f"{frame},{left_px},{CENTRE_PX[1] - 10},{right_px},{CENTRE_PX[1] + 10},{score}"
    )


def folder(at: Path, sequence: str = "0001", **files: list[str]) -> Path:
    given = {"oxts": [oxts()], "calib": [calibration()], **files}
    for name, lines in given.items():
        (at / name).mkdir(parents=True, exist_ok=True)
        (at / name / f"{sequence}.txt").write_text("\n".join(lines))
    return at
