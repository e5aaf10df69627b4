"""Fabricated run folders for the tests of evaluation: two cars, what the tracks do is told tick by tick."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fgtrack.core.types import (
    DetectionList,
    Disposition,
    EgoState,
    FinalTrack,
    Revision,
    SmoothedReport,
    TickReport,
    TrackReport,
    TrackState,
    TrackStatus,
    TruthState,
    UpdateRecord,
)
from fgtrack.runs import Run, RunWriter, load_run

START_NS = 1_700_000_000_000_000_000
TICK_NS = 20_000_000


@dataclass(frozen=True)
class Car:
    """Constant speed on a circle (or a line, for yaw rate 0)."""

    object_id: int
    x_m: float
    y_m: float
    yaw_rad: float
    speed_mps: float
    yaw_rate_radps: float = 0.0

    def state(self, t_s: float) -> tuple[float, float, float, float]:
        """x, y, yaw, speed after `t_s`."""
        turned = self.yaw_rate_radps * t_s
        yaw = self.yaw_rad + turned / 2
        chord = self.speed_mps * t_s * float(np.sinc(turned / (2 * math.pi)))
        heading = math.remainder(self.yaw_rad + turned, 2 * math.pi)
        return (
            self.x_m + chord * math.cos(yaw),
            self.y_m + chord * math.sin(yaw),
            heading,
            self.speed_mps,
        )

    def truth(self, ticks: Iterable[int], *, pose: bool = True) -> list[TruthState]:
        """Truth at `ticks`; without `pose` only its position."""
        rows = []
        for tick in ticks:
            stamp_ns = START_NS + tick * TICK_NS
            x_m, y_m, yaw_rad, speed_mps = self.state(tick * TICK_NS / 1e9)
            motion = (yaw_rad, speed_mps) if pose else (None, None)
            rows.append(
                TruthState(stamp_ns, stamp_ns, self.object_id, x_m, y_m, *motion)
            )
        return rows

    def track(
        self,
        tick: float,
        track_id: int,
        *,
        along_m: float = 0.0,
        across_m: float = 0.0,
        yaw_rad: float = 0.0,
        speed_mps: float = 0.0,
        num_measured: int = 9,
    ) -> TrackReport:
        """A track of this car that is wrong by the given errors."""
        x_m, y_m, heading, speed = self.state(tick * TICK_NS / 1e9)
        c, s = math.cos(heading), math.sin(heading)
        mean = np.array(
            [
                x_m + c * along_m - s * across_m,
                y_m + s * along_m + c * across_m,
                math.remainder(heading + yaw_rad, 2 * math.pi),
                speed + speed_mps,
                self.yaw_rate_radps,
            ]
        )
        state = TrackState(START_NS + round(tick * TICK_NS), mean, np.eye(5))
        status = TrackStatus.TENTATIVE if num_measured < 3 else TrackStatus.CONFIRMED
        return TrackReport(track_id, status, state, num_measured)

    def later(
        self, tick: float, track_id: int, lag_s: float | None = None, **errors: float
    ) -> SmoothedReport:
        """What is known later of this car at `tick`; finally, without `lag_s`."""
        return SmoothedReport(
            track_id, self.track(tick, track_id, **errors).state, lag_s
        )


#: A car that drives west, where the heading jumps, and one that drives round and round.
WEST = Car(7, 100.0, 0.0, math.pi, 20.0)
ROUND = Car(8, 0.0, 500.0, 0.3, 30.0, yaw_rate_radps=0.5)


def write_run(
    path: Path,
    tracks: Sequence[Sequence[TrackReport]] = (),
    *,
    truth: Iterable[TruthState] = (),
    updates: Mapping[int, Sequence[UpdateRecord]] | None = None,
    smoothed: Mapping[int, Sequence[SmoothedReport]] | None = None,
    smoothed_lag_s: float | None = None,
    meta: Mapping[str, object] | None = None,
    config_text: str = "",
    process_ns: Sequence[int] = (),
    num_detections: Sequence[int] = (),
    ego: Iterable[EgoState] = (),
    detections: Iterable[DetectionList] = (),
    revisions: Iterable[Revision] = (),
    final_tracks: Iterable[FinalTrack] = (),
) -> Run:
    """A run with the `tracks` of every tick, and the `updates` and `smoothed` states by tick."""
    updates, smoothed = updates or {}, smoothed or {}
    ticks = max(len(tracks), len(process_ns), 1 + max(updates, default=-1))
    with RunWriter(path, config_text, smoothed_lag_s=smoothed_lag_s) as writer:
        for row in truth:
            writer.write_truth(row)
        for state in ego:
            writer.write_ego(state)
        for message in detections:
            writer.write_detections(message)
        for tick in range(ticks):
            rows = tuple(tracks[tick]) if tick < len(tracks) else ()
            records = tuple(updates.get(tick, ()))
            report = TickReport(
                tick,
                START_NS + tick * TICK_NS,
                rows,
                records,
                tuple(smoothed.get(tick, ())),
            )
            duration = process_ns[tick] if tick < len(process_ns) else 1_000_000
            count = num_detections[tick] if tick < len(num_detections) else len(records)
            writer.write_tick(report, duration, count)
        writer.write_decisions(revisions, final_tracks)
        writer.finish(meta or {"estimator": "smoother"})
    return load_run(path)


def update(
    sensor: str = "lidar",
    *,
    tick: int = 0,
    delay_ns: int = 0,
    index: int = 0,
    disposition: Disposition = Disposition.IN_SEQUENCE,
    track_id: int | None = 1,
    nis: float | None = None,
    **innovation: float,
) -> UpdateRecord:
    """An update of the detection sensed at `tick`."""
    stamp_ns = START_NS + tick * TICK_NS
    return UpdateRecord(
        sensor,
        stamp_ns,
        stamp_ns + delay_ns,
        index,
        disposition,
        track_id,
        nis,
        dict(innovation),
    )


def run_beside(path: Path) -> Run:
    """WEST, tracked with an error of 2 m along from the start on; the ego drives beside it at 30 m/s."""
    tracks = [[WEST.track(k, 1, along_m=2.0)] for k in range(150)]
    updates = {k: [update("lidar", tick=k, x_m=0.3, y_m=0.1)] for k in range(1, 150)}
    updates |= {
        k: [
            *updates[k],
            update(
                "radar",
                tick=k - 5,
                delay_ns=100_000_000,
                x_m=-1.0,
                y_m=0.0,
                speed_mps=2.0,
            ),
        ]
        for k in (100, 120)
    }
    updates[0] = [update("lidar", tick=0, disposition=Disposition.BIRTH)]
    with RunWriter(path, "") as writer:
        for row in WEST.truth(range(250)):
            writer.write_truth(row)
        for tick in range(150):
            x_m, y_m, yaw_rad, _ = WEST.state(tick * TICK_NS / 1e9)
            now_ns = START_NS + tick * TICK_NS
            writer.write_ego(
                EgoState(now_ns, now_ns, x_m + 30.0, y_m + 3.0, yaw_rad, 30.0)
            )
            writer.write_tick(
                TickReport(tick, now_ns, tuple(tracks[tick]), tuple(updates[tick])),
                2_000_000,
                1,
            )
        writer.finish({"estimator": "ekf-replay"})
    return load_run(path)
