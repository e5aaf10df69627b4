"""Where the ego vehicle was at a detection's stamp."""

import bisect
import math
from typing import NamedTuple, Protocol

from fgtrack.core.geometry import wrap_angle
from fgtrack.core.time import nanoseconds, seconds
from fgtrack.core.types import EgoState
from fgtrack.tracking.validity import is_number


class EgoPose(NamedTuple):
    """Pose of the ego reference point in the map."""

    x_m: float
    y_m: float
    yaw_rad: float
    speed_mps: float


class EgoSource(Protocol):
    """Holds the ego's past."""

    @property
    def current(self) -> EgoState | None:
        """Newest known state."""

    @property
    def in_pit(self) -> bool:
        """Whether the ego was last said to drive in the pit lane."""

    def receive(self, ego: EgoState) -> str | None:
        """Take a message; the reason, where it is refused."""

    def start_tick(self) -> None:
        """A tick begins."""

    def pose_at(self, stamp_ns: int, present_ns: int) -> EgoPose | None:
        """Pose at `stamp_ns`, or None where it is not known; `present_ns` is the tracking time."""


def is_finite(ego: EgoState) -> bool:
    """Whether every number of `ego` is one (see `is_number`)."""
    return all(map(is_number, (ego.x_m, ego.y_m, ego.yaw_rad, ego.speed_mps, ego.yaw_rate_radps, ego.accel_mps2)))


def extrapolated(ego: EgoState, stamp_ns: int) -> EgoPose:
    """Pose of `ego` moved along its heading to `stamp_ns`, with the yaw extrapolated (not wrapped)."""
    dt_s = seconds(stamp_ns - ego.stamp_ns)
    travelled_m = ego.speed_mps * dt_s
    return EgoPose(
        ego.x_m + travelled_m * math.cos(ego.yaw_rad),
        ego.y_m + travelled_m * math.sin(ego.yaw_rad),
        ego.yaw_rad + ego.yaw_rate_radps * dt_s,
        ego.speed_mps,
    )


def low_passed(
    yaw_rad: float, yaw_rate_radps: float, ego: EgoState, yaw_weight: float, yaw_rate_weight: float
) -> EgoState:
    """`ego` with its yaw and yaw rate drawn towards the given ones; the weights are those of the new values."""
    return EgoState(
        ego.stamp_ns,
        ego.receipt_ns,
        ego.x_m,
        ego.y_m,
        wrap_angle(yaw_rad + yaw_weight * wrap_angle(ego.yaw_rad - yaw_rad)),
        ego.speed_mps,
        (1.0 - yaw_rate_weight) * yaw_rate_radps + yaw_rate_weight * ego.yaw_rate_radps,
        ego.accel_mps2,
        ego.in_pit,
    )


class EgoTrajectory:
    """Low-passed ego states, each filtered once, and interpolated between their stamps.

    The low-pass pulls towards the previous state *extrapolated to the new stamp*, so a steady turn is not delayed.
    """

    def __init__(self, yaw_weight: float, yaw_rate_weight: float, memory_s: float, max_extrapolation_s: float) -> None:
        self._yaw_weight = yaw_weight
        self._yaw_rate_weight = yaw_rate_weight
        self._memory_ns = nanoseconds(memory_s)
        self._max_extrapolation_ns = nanoseconds(max_extrapolation_s)
        self._states: list[EgoState] = []
        self._stamps: list[int] = []
        self._in_pit = False

    @property
    def current(self) -> EgoState | None:
        """See `EgoSource.current`."""
        return self._states[-1] if self._states else None

    @property
    def in_pit(self) -> bool:
        """See `EgoSource.in_pit`."""
        return self._in_pit

    def receive(self, ego: EgoState) -> str | None:
        """See `EgoSource.receive`; a late state is put in its place, unfiltered."""
        if ego.in_pit is not None:
            self._in_pit = ego.in_pit
        if not is_finite(ego):
            return "not finite"
        place = bisect.bisect_left(self._stamps, ego.stamp_ns)
        if place < len(self._stamps) and self._stamps[place] == ego.stamp_ns:
            return "repeated stamp"
        if self._states and place == len(self._states):
            ego = self._filtered(self._states[-1], ego)
        self._stamps.insert(place, ego.stamp_ns)
        self._states.insert(place, ego)
        keep = bisect.bisect_left(self._stamps, self._stamps[-1] - self._memory_ns)
        if keep > 64:  # in portions: cutting a list copies it
            del self._stamps[: keep - 1], self._states[: keep - 1]
        return None

    def _filtered(self, previous: EgoState, ego: EgoState) -> EgoState:
        expected_rad = previous.yaw_rad + previous.yaw_rate_radps * seconds(ego.stamp_ns - previous.stamp_ns)
        return low_passed(expected_rad, previous.yaw_rate_radps, ego, self._yaw_weight, self._yaw_rate_weight)

    def start_tick(self) -> None:
        """See `EgoSource.start_tick`; nothing depends on ticks here."""

    def pose_at(self, stamp_ns: int, present_ns: int) -> EgoPose | None:
        """See `EgoSource.pose_at`; beyond its ends the trajectory is extrapolated for a limited time."""
        if not self._stamps:
            return None
        place = bisect.bisect_left(self._stamps, stamp_ns)
        if 0 < place < len(self._stamps):
            return _interpolated(self._states[place - 1], self._states[place], stamp_ns)
        end = self._states[min(place, len(self._states) - 1)]
        if abs(stamp_ns - end.stamp_ns) > self._max_extrapolation_ns:
            return None
        return extrapolated(end, stamp_ns)


def _interpolated(before: EgoState, after: EgoState, stamp_ns: int) -> EgoPose:
    share = (stamp_ns - before.stamp_ns) / (after.stamp_ns - before.stamp_ns)
    return EgoPose(
        before.x_m + share * (after.x_m - before.x_m),
        before.y_m + share * (after.y_m - before.y_m),
        before.yaw_rad + share * wrap_angle(after.yaw_rad - before.yaw_rad),
        before.speed_mps + share * (after.speed_mps - before.speed_mps),
    )
