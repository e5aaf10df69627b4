"""Two cars that meet in the open, without a map: as many tracks with every estimator."""

import math

import numpy as np
import pytest
from support.examples import slow

import fgtrack
from fgtrack.core.geometry import rotation
from fgtrack.core.time import NS_PER_S, nanoseconds
from fgtrack.core.types import (
    Detection,
    DetectionList,
    EgoState,
    FloatArray,
    TrackStatus,
)

FEW = ("smoother-banded", "ekf-replay", "ekf-backward-forward")
DURATION_S, MIDDLE_S, SPEED_MPS = 6.0, 3.0, 60.0
EGO_M = np.array([-40.0, 10.0])
TICK_NS = 20_000_000

#: Velocities of both cars in m/s, shape (2, 2), and how far to the left the second one is where they meet, in m.
Meeting = tuple[FloatArray, float]


def crossing(angle_deg: float) -> Meeting:
    """Both in one place at one time, at an angle to one another."""
    half_rad = math.radians(angle_deg / 2.0)
    return SPEED_MPS * np.array(
        [[math.cos(half_rad), sign * math.sin(half_rad)] for sign in (1.0, -1.0)]
    ), 0.0


MEETINGS: dict[str, Meeting] = {
    "through one another, 10 degrees": crossing(10.0),
    "through one another, 30 degrees": crossing(30.0),
    "through one another, 90 degrees": crossing(90.0),
    "overtaking": (np.array([[SPEED_MPS, 0.0], [SPEED_MPS + 10.0, 0.0]]), 0.0),
    "opposite": (np.array([[SPEED_MPS, 0.0], [-SPEED_MPS, 0.0]]), 3.0),
    "beside": (np.array([[SPEED_MPS, 0.0], [SPEED_MPS, 0.0]]), 6.0),
}


def messages(
    meeting: Meeting, towards_deg: float, seed: int
) -> list[EgoState | DetectionList]:
    """What LiDAR and RADAR send with the paper's delays; the ego drives beside, all head for `towards_deg`."""
    velocity_mps, apart_m = meeting
    rng, turn = np.random.default_rng(seed), rotation(math.radians(towards_deg))

    def ego_m(time_s: float) -> FloatArray:
        return EGO_M + np.array([SPEED_MPS * (time_s - MIDDLE_S), 0.0])

    sent: list[EgoState | DetectionList] = []
    for time_s in np.arange(0.0, DURATION_S, 0.02).tolist():
        stamp_ns = NS_PER_S + nanoseconds(time_s)
        x_m, y_m = (turn @ ego_m(time_s)).tolist()
        sent.append(
            EgoState(stamp_ns, stamp_ns, x_m, y_m, math.radians(towards_deg), SPEED_MPS)
        )
    for sensor, phase_s, delay_s, std_m in (
        ("lidar_cluster", 0.0, 0.15, 0.3),
        ("radar", 0.023, 0.06, 0.9),
    ):
        for time_s in (phase_s + np.arange(0.05, DURATION_S - 0.05, 0.05)).tolist():
            cars_m = velocity_mps * (time_s - MIDDLE_S) + [[0.0, 0.0], [0.0, apart_m]]
            relative_m = cars_m - ego_m(time_s) + std_m * rng.standard_normal((2, 2))
            speeds_mps = np.hypot(*velocity_mps.T) + 0.2 * rng.standard_normal(2)
            objects = [
                Detection(
                    x_m=x_m, y_m=y_m, speed_mps=speed_mps if sensor == "radar" else None
                )
                for (x_m, y_m), speed_mps in zip(
                    relative_m.tolist(), speeds_mps.tolist(), strict=True
                )
            ]
            stamp_ns = NS_PER_S + nanoseconds(time_s)
            receipt_ns = stamp_ns + nanoseconds(delay_s + 0.02 * rng.random())
            sent.append(DetectionList(sensor, stamp_ns, receipt_ns, objects))
    return sorted(sent, key=lambda message: message.receipt_ns)


def confirmed(
    sent: list[EgoState | DetectionList],
    estimator: str,
    config: str | None = "smoother",
    **settings: object,
) -> int:
    """How many tracks are ever confirmed."""
    tracker = fgtrack.Tracker.from_config(config, estimator=estimator, set={**settings})
    ids, waiting = set[int](), iter(sent)
    message: EgoState | DetectionList | None = next(waiting)
    for now_ns in range(NS_PER_S, sent[-1].receipt_ns + TICK_NS, TICK_NS):
        while message is not None and message.receipt_ns <= now_ns:
            tracker.receive(message)
            message = next(waiting, None)
        tracks = tracker.tick(now_ns).tracks
        ids.update(
            track.track_id
            for track in tracks
            if track.status is not TrackStatus.TENTATIVE
        )
    return len(ids)


MERGE = {"merge": {"kind": "connected", "distance_m": 5.1}}
NO_MERGE = {"merge": {"kind": "none"}}


EXISTENCE = {"lifecycle": {"kind": "existence"}}
STD = {
    "lidar_cluster": {"x_m": 0.3, "y_m": 0.3},
    "radar": {"x_m": 0.9, "y_m": 0.9, "speed_mps": 0.2},
}
#: Configuration, its changes, and how many tracks are the most.
SETTINGS: dict[str, tuple[str | None, dict[str, object], int]] = {
    "counters, merged": ("smoother", MERGE, 4),
    "counters, not merged": ("smoother", NO_MERGE, 4),
    "existence, merged": ("smoother", {**MERGE, **EXISTENCE}, 6),
    "existence, not merged": ("smoother", {**NO_MERGE, **EXISTENCE}, 3),
    "defaults": (
        None,
        {"sensors": {sensor: {"std": std} for sensor, std in STD.items()}},
        5,
    ),
}


FAST = [*MEETINGS][:3]


@pytest.mark.parametrize(
    ("seed", "name"),
    [*enumerate(FAST), *slow(*enumerate([*MEETINGS][len(FAST) :], len(FAST)))],
)
def test_two_cars_that_meet_are_as_many_tracks_with_every_estimator(
    seed: int, name: str
) -> None:
    """Each meeting heads elsewhere, with other noise and settings."""
    sent = messages(MEETINGS[name], (60.0, 150.0, -100.0)[seed % 3], seed)
    config, changes, most = list(SETTINGS.values())[seed % len(SETTINGS)]
    found = {
        estimator: confirmed(sent, estimator, config, **changes) for estimator in FEW
    }
    assert 2 <= min(found.values()) <= max(found.values()) <= most, found
    assert max(found.values()) - min(found.values()) <= 1, found
