"""What the sensors saw: delays, how far the ego moved in them, speeds and places of objects (Karle et al. 2023)."""

from dataclasses import dataclass

import numpy as np

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray
from fgtrack.evaluation.innovations import message_delays
from fgtrack.evaluation.runs import JudgedRun
from fgtrack.evaluation.sight import ego_states


@dataclass(frozen=True, eq=False)
class Sensed:
    """What one sensor contributed to the confirmed tracks of a run (section III-H, figure 5; IV-B, figure 6)."""

    delay_s: FloatArray
    """Receipt minus stamp of every message with a detection, shape (m,)."""
    moved_m: FloatArray
    """Way of the ego in that time, its speed at the stamp times the delay, shape (m,); NaN where it is not known."""
    object_speed_mps: FloatArray
    """Speed of the track at every fused detection, shape (n,)."""
    relative_speed_mps: FloatArray
    """The same less the ego's, shape (n,); NaN where the ego is not known."""
    distance_m: FloatArray
    """Distance of the track from the ego, shape (n,)."""
    ahead_m: FloatArray
    """How far it is ahead of the ego, shape (n,)."""
    detections: FloatArray
    """Fused detections of every track that has any of this sensor, shape (tracks,)."""


def sensed(one: JudgedRun) -> dict[str, Sensed]:
    """By sensor. Raises `DataError` where the map that the run names is no map."""
    run, samples = one.run, one.samples
    found = {}
    for sensor in np.unique(run.tables["updates"]["sensor"]).tolist():
        receipts_ns, delay_s = message_delays(run.tables["updates"].where(run.tables["updates"]["sensor"] == sensor))
        ego = ego_states(run.tables["ego"], receipts_ns - np.round(delay_s * NS_PER_S).astype(np.int64))
        mine = samples.sensors == sensor
        counts = np.unique(samples.track_ids[mine], return_counts=True)[1]
        found[sensor] = Sensed(
            delay_s=delay_s,
            moved_m=np.full(len(delay_s), np.nan) if ego is None else delay_s * ego[:, 3],
            object_speed_mps=samples.object_speed_mps[mine],
            relative_speed_mps=samples.relative_speed_mps[mine],
            distance_m=samples.distance_m[mine],
            ahead_m=samples.ahead_m[mine],
            detections=counts.astype(np.float64),
        )
    return found
