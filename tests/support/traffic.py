"""Messages and ticks of a live tracker, and what its reports contain."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from fgtrack.core.types import Detection, DetectionList, EgoState, TickReport
from fgtrack.pipeline.live import Tracker

MS = 1_000_000
START_NS = 1_600_000_000_000_000_000
NUM_TICKS = 60
Ticks = list[tuple[int, list[EgoState | DetectionList]]]


def traffic(seed: int, num_ticks: int = NUM_TICKS) -> Ticks:
    """Ticks of 20 ms with an ego, three cars, clutter, yaws, identities and lists that are up to 0.3 s late."""
    rng, messages = np.random.default_rng(seed), []
    for k in range(num_ticks * 2):
        at_ns = START_NS + k * 10 * MS
        late_ns = int(rng.integers(0, 60)) * MS
        messages.append(
            EgoState(at_ns, at_ns + late_ns, 0.2 * k, 0.01 * k, 0.02, 20.0, 0.01)
        )
        if k % 5:
            continue
        for sensor, usual_ms in (("lidar_cluster", 60), ("radar", 20)):
            delay_ms = usual_ms + int(rng.integers(0, 200)) * int(rng.random() < 0.3)
            cars = [
                car(k, lane, sensor, rng) for lane in range(3) if rng.random() < 0.9
            ]
            if rng.random() < 0.1:
                cars.append(Detection(x_m=float(rng.uniform(-60, 60)), y_m=30.0))
            messages.append(
                DetectionList(sensor, at_ns, at_ns + delay_ms * MS, cars, frame="ego")
            )
    ticks: Ticks = []
    waiting = sorted(messages, key=lambda each: each.receipt_ns)
    for k in range(num_ticks):
        now_ns = START_NS + (k + 1) * 20 * MS
        come = [each for each in waiting if each.receipt_ns <= now_ns]
        ticks.append((now_ns, come))
        waiting = waiting[len(come) :]
    return ticks


def car(k: int, lane: int, sensor: str, rng: np.random.Generator) -> Detection:
    """Detection of the car of a lane, seen from the ego; lane 0 is slower than the ego."""
    x_m = 15.0 + 20.0 * lane + (-0.05 if lane == 0 else 0.02) * k
    x_m, y_m = (float(mean + 0.2 * rng.normal()) for mean in (x_m, 6.0 * (lane - 1)))
    if sensor == "radar":
        speed_mps = float(20.0 + lane + rng.normal())
        return Detection(x_m=x_m, y_m=y_m, speed_mps=speed_mps, id=f"car {lane}")
    yaw_rad = float(0.05 * rng.normal() + (np.pi if rng.random() < 0.1 else 0.0))
    return Detection(x_m=x_m, y_m=y_m, yaw_rad=yaw_rad, class_name="car")


def gone_on(tracker: Tracker, ticks: Ticks) -> list[TickReport]:
    reports = []
    for now_ns, messages in ticks:
        for message in messages:
            tracker.receive(message)
        reports.append(tracker.tick(now_ns))
    return reports


def bits(reports: Sequence[TickReport]) -> list[object]:
    """Everything in reports, with the bits of all numbers."""
    return [
        (
            report.tick,
            report.now_ns,
            [
                (
                    track.track_id,
                    track.status,
                    track.num_measured,
                    repr(track.object),
                    track.score,
                    *of(track.state),
                )
                for track in report.tracks
            ],
            [repr(update) for update in report.updates],
            [(each.track_id, each.lag_s, *of(each.state)) for each in report.smoothed],
        )
        for report in reports
    ]


def of(state: Any) -> tuple[int, bytes, bytes]:
    return state.stamp_ns, state.mean.tobytes(), state.covariance.tobytes()
