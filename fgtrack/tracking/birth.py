"""Prior of a new track (Karle et al. 2023, section III-E)."""

import math
from collections.abc import Mapping
from dataclasses import field, replace
from typing import Any, Literal

import numpy as np
from pydantic import PositiveFloat

from fgtrack.core.geometry import rotation
from fgtrack.core.settings import settings
from fgtrack.core.time import seconds
from fgtrack.core.types import YAW, EgoState, FloatArray
from fgtrack.estimation.base import Measurement, Start, StatesAt
from fgtrack.models.correlated_errors import (
    component_cross,
    position_cross,
    total_error,
)
from fgtrack.models.measurement import position_gradient
from fgtrack.models.road import Road
from fgtrack.tracking.preprocess import Candidate


@settings
class Birth:
    """Assumption on the first state of a track: value and standard deviation of each component that is not measured."""

    kind: Literal["measured", "fixed"] = "measured"
    """`measured`: a measured component starts with its own standard deviation, the others with the one assumed;
    `fixed`: every object starts with the same covariance, whatever the sensor measured (as published)."""
    ego_speed_factor: float = 0.0
    """An object is assumed as fast as the ego times this; 0 for traffic that has nothing to do with the ego."""
    yaw_std_rad: PositiveFloat = 0.5
    """Standard deviation of a yaw from the map."""
    speed_std_mps: PositiveFloat = 100.0
    """Standard deviation of a speed that is not measured. The default excludes no vehicle: the gate of 3.7 standard
    deviations passes airliners, race cars lie within one; a second position makes it irrelevant."""
    yaw_rate_std_radps: PositiveFloat = 0.5
    """Standard deviation of the yaw rate."""
    accel_std_mps2: PositiveFloat = 1.0
    """Standard deviation of the acceleration."""
    slow_ego_mps: float = 0.0
    """Below this ego speed an object is assumed to accelerate as the ego does (models with acceleration)."""
    along_std_m: PositiveFloat = 0.1
    """Standard deviation of the position along the heading (`kind: fixed`)."""
    across_std_m: PositiveFloat = 0.1
    """Standard deviation of the position across the heading (`kind: fixed`)."""

    appearances_per_s: PositiveFloat | None = None
    """Number of objects that appear in a second, at `mean` with `std`; null if objects appear anywhere. It serves
    `association.kind: hypotheses`."""
    mean: Mapping[str, float] = field(default_factory=dict)
    """Mean of the first state of objects that appear: `x_m`, `y_m`, `vx_mps` and `vy_mps`."""
    std: Mapping[str, PositiveFloat] = field(default_factory=dict)
    """Standard deviations of the same entries."""

    def prior(
        self, candidate: Candidate, road: Road, ego: EgoState | None, ego_in_pit: bool
    ) -> Start | None:
        """Return the first state of a track at the stamp of `candidate`; None if the candidate gives no position.

        Measured components have priority. Map heading, road curvature and a share of the ego speed replace missing
        components.
        """
        if candidate.position_m is None:
            return None
        measurement, values = candidate.measurement, candidate.values
        yaw_rad, curvature_radpm = values.get("yaw_rad"), 0.0
        if road.has_track:
            view = road.view(candidate.position_m[None])
            curvature_radpm = float(view.curvature_radpm[0])
            if yaw_rad is None:
                yaw_rad = float(view.yaw_rad[0])
        assumed_mps = (
            0.0 if ego is None or ego_in_pit else self.ego_speed_factor * ego.speed_mps
        )
        speed_mps = values.get("speed_mps", assumed_mps)
        slow = ego is not None and ego.speed_mps < self.slow_ego_mps
        if self.kind == "measured":
            R = total_error(measurement.model, measurement.R)
            stds = dict(zip(values, np.sqrt(np.diag(R)).tolist(), strict=True))
            crosses = _crosses(measurement, R)
            position = (
                np.zeros((2, 2))
                if candidate.position_covariance is None
                else candidate.position_covariance
            )
            speed_variance = (
                speed_mps**2 + stds.get("speed_mps", self.speed_std_mps) ** 2
            )
            position = position + candidate.stamp_std_s**2 * speed_variance * np.eye(
                2
            )  # in an unknown direction
        else:
            stds, crosses, turn = {}, {}, rotation(yaw_rad or 0.0)
            position = (
                turn @ np.diag([self.along_std_m**2, self.across_std_m**2]) @ turn.T
            )
        return Start(
            stamp_ns=measurement.stamp_ns,
            position_m=candidate.position_m,
            position_covariance=position,
            **crosses,
            yaw_rad=yaw_rad,
            yaw_std_rad=stds.get("yaw_rad", self.yaw_std_rad)
            if yaw_rad is not None
            else None,
            speed_mps=speed_mps,
            speed_std_mps=stds.get("speed_mps", self.speed_std_mps),
            yaw_rate_radps=speed_mps * curvature_radpm,
            yaw_rate_std_radps=self.yaw_rate_std_radps,
            accel_mps2=ego.accel_mps2 if ego is not None and slow else 0.0,
            accel_std_mps2=self.accel_std_mps2,
        )


def _crosses(measurement: Measurement, R: FloatArray) -> dict[str, Any]:
    """Return the cross-covariances of a `Start` between its position and the other measured components.

    The position is a function of z. Its covariance with a yaw or speed of the same z is G R, with the derivative G.
    """
    components, model = measurement.model.components, measurement.model
    position = position_cross(model, measurement.z, measurement.pose)
    yaw, speed = component_cross(model, "yaw_rad"), component_cross(model, "speed_mps")
    G = position_gradient(components, measurement.z, measurement.pose)
    measured = [name for name in ("yaw_rad", "speed_mps") if name in components]
    if G is not None:
        for name in measured:
            x_m, y_m = (G @ R[:, components.index(name)]).tolist()
            position[name] = x_m, y_m
    if len(measured) == 2:
        yaw["speed_mps"] = float(
            R[components.index("yaw_rad"), components.index("speed_mps")]
        )
    return {"position_cross": position, "yaw_cross": yaw, "speed_cross": speed}


def in_any_direction(
    states: StatesAt,
    stamp_ns: int,
    starts: Mapping[int, Start],
    directed: Mapping[int, tuple[Start, int]] | None = None,
) -> StatesAt:
    """Return `states` at `stamp_ns`, with equal position variances in all directions for the tracks of `starts`.

    A state with an unknown yaw is linearised along an assumed yaw, so its predicted position spreads only along this
    yaw. Until a second position gives the direction, the position gets the same variance (speed_std dt)^2 across.

    `directed` are the starts of tracks with a second position, and the stamp of this position. Before this stamp the
    state of a filter follows from the first position alone: it spreads by at least half of speed_std dt along the yaw.
    A smoother has used both positions.
    """
    covariances = states.covariances.copy()
    for row, track_id in enumerate(states.track_ids):
        start, until_ns = starts.get(track_id), stamp_ns
        if start is None:
            start, until_ns = (directed or {}).get(track_id, (None, stamp_ns))
            if start is None or until_ns <= stamp_ns:
                continue
        yaw_rad = float(states.means[row, YAW])
        std_m = start.speed_std_mps * seconds(stamp_ns - start.stamp_ns)
        along, across = np.array(
            [
                [math.cos(yaw_rad), math.sin(yaw_rad)],
                [-math.sin(yaw_rad), math.cos(yaw_rad)],
            ]
        )
        if (
            until_ns > stamp_ns
            and along @ covariances[row, :2, :2] @ along < (0.5 * std_m) ** 2
        ):
            continue
        covariances[row, :2, :2] += np.outer(std_m * across, std_m * across)
    return replace(states, covariances=covariances)
