"""Innovations of the tracks that count, in local coordinates, with how long, how fast and where each object was."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fgtrack.core.geometry import wrap_angles
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.evaluation.innovations import residuals, track_states
from fgtrack.evaluation.matching import confirmed
from fgtrack.evaluation.roads import roads
from fgtrack.evaluation.sight import ego_states
from fgtrack.evaluation.statistics import Moments
from fgtrack.io.run import Run
from fgtrack.models.measurement import ANGULAR

#: Residuals of table I of Karle et al. 2023: x_loc, y_loc, psi and v.
LOCAL_NAMES = ("along_m", "across_m", "yaw_rad", "speed_mps")


@dataclass(frozen=True, eq=False)
class ResidualSamples:
    """Innovations of the tracks that were `confirmed`, n in all, by stamp."""

    sensors: npt.NDArray[np.str_]
    """Shape (n,)."""
    track_ids: IntArray
    """Shape (n,)."""
    values: Mapping[str, FloatArray]
    """By name of `LOCAL_NAMES`, each of shape (n,); NaN where not measured. Along and across the direction of the
    track. Where no yaw is measured and the track is on a map, its heading there is taken for one, as in the paper."""
    observed_s: FloatArray
    """Time since the first detection of the track, shape (n,)."""
    object_speed_mps: FloatArray
    """Speed of the track, shape (n,)."""
    relative_speed_mps: FloatArray
    """The same less the ego's, shape (n,); NaN where the ego is not known."""
    ahead_m: FloatArray
    """Position of the track ahead of the ego, shape (n,); NaN where the ego is not known."""
    left_m: FloatArray
    """The same to the left, shape (n,)."""

    @property
    def distance_m(self) -> FloatArray:
        """Distance of the track from the ego, shape (n,)."""
        return np.hypot(self.ahead_m, self.left_m)

    def moments(self, chosen: BoolArray | None = None) -> dict[str, Moments]:
        """Mean and spread of every residual, of the `chosen` samples, shape (n,), or of all."""
        of = np.ones(len(self.sensors), dtype=bool) if chosen is None else chosen
        return {
            name: (Moments.of_angles if name in ANGULAR else Moments.of)(values[of])
            for name, values in self.values.items()
        }


def residual_samples(run: Run) -> ResidualSamples:
    """The samples of `run`. Raises `DataError` where the map that it names is no map."""
    ids = np.unique(run.tables["tracks"]["track_id"][confirmed(run.tables["tracks"])])
    local = residuals(run)
    known = np.isin(run.tables["updates"]["track_id"], ids) & np.isfinite([local[name] for name in LOCAL_NAMES]).any(
        axis=0
    )
    rows = np.flatnonzero(known)
    rows = rows[np.argsort(run.tables["updates"]["stamp_ns"][rows], kind="stable")]
    sensors, track_ids, stamps_ns = (run.tables["updates"][name][rows] for name in ("sensor", "track_id", "stamp_ns"))
    states = track_states(run, known)[rows]
    values = {name: local[name][rows] for name in LOCAL_NAMES}
    values["yaw_rad"] = _with_map(run, values["yaw_rad"], states)
    ahead_m, left_m, ego_speed_mps = _around_ego(run, states, stamps_ns)
    return ResidualSamples(
        sensors=sensors,
        track_ids=track_ids,
        values=values,
        observed_s=_observed_s(run, track_ids, stamps_ns),
        object_speed_mps=states[:, 3],
        relative_speed_mps=states[:, 3] - ego_speed_mps,
        ahead_m=ahead_m,
        left_m=left_m,
    )


def _with_map(run: Run, yaw_rad: FloatArray, states: FloatArray) -> FloatArray:
    """`yaw_rad`, shape (n,), with the heading of the map less the track's yaw where it is NaN."""
    track = roads(run)[0].get("track")
    wanted = np.flatnonzero(np.isnan(yaw_rad) & np.isfinite(states).all(axis=1))
    if track is None or not len(wanted):
        return yaw_rad
    filled = yaw_rad.copy()
    filled[wanted] = wrap_angles(track.heading(states[wanted, :2]) - states[wanted, 2])
    return filled


def _around_ego(run: Run, states: FloatArray, stamps_ns: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Positions ahead and left of the ego, and its speed, shape (n,) each; NaN where it is not known."""
    ego = ego_states(run.tables["ego"], stamps_ns)
    if ego is None:
        unknown = np.full(len(states), np.nan)
        return unknown, unknown, unknown
    dx_m, dy_m = (states[:, :2] - ego[:, :2]).T
    c, s = np.cos(ego[:, 2]), np.sin(ego[:, 2])
    return c * dx_m + s * dy_m, c * dy_m - s * dx_m, ego[:, 3]


def _observed_s(run: Run, track_ids: IntArray, stamps_ns: IntArray) -> FloatArray:
    """Time since the first detection of each track, shape (n,); a detection older than it counts as the first."""
    ids, numbers = np.unique(run.tables["updates"]["track_id"], return_inverse=True)
    born_ns = np.full(len(ids), np.iinfo(np.int64).max)
    births = run.tables["updates"]["disposition"] == "birth"
    np.minimum.at(born_ns, numbers[births], run.tables["updates"]["stamp_ns"][births])
    since_ns = stamps_ns - born_ns[np.searchsorted(ids, track_ids)]
    return np.asarray(np.maximum(since_ns, 0) / NS_PER_S)
