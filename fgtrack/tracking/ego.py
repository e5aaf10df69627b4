"""Where the ego vehicle was at a detection's stamp."""

import bisect
import math
from abc import ABC, abstractmethod
from dataclasses import replace
from typing import NamedTuple

from fgtrack.core.geometry import wrap_angle
from fgtrack.core.time import nanoseconds, seconds
from fgtrack.core.types import EgoState
from fgtrack.tracking.inbox import is_number


class EgoPose(NamedTuple):
    """Pose of the ego reference point in the map, and how it moves."""

    x_m: float
    y_m: float
    yaw_rad: float
    speed_mps: float
    yaw_rate_radps: float = 0.0


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
        ego.yaw_rate_radps,
    )


class EgoSource(ABC):
    """Holds the ego's past; the weights of its low-pass are those of new values."""

    def __init__(self, yaw_weight: float, yaw_rate_weight: float) -> None:
        self.current: EgoState | None = None
        """Newest known state."""
        self.in_pit = False
        """Whether the ego was last said to drive in the pit lane."""
        self._yaw_weight = yaw_weight
        self._yaw_rate_weight = yaw_rate_weight

    def receive(self, ego: EgoState) -> str | None:
        """Take a message; the reason, where it is refused."""
        if ego.in_pit is not None:
            self.in_pit = ego.in_pit
        return self._store(ego) if is_finite(ego) else "not finite"

    @abstractmethod
    def _store(self, ego: EgoState) -> str | None:
        """Take a state; the reason, where it is refused."""

    @abstractmethod
    def start_tick(self) -> None:
        """A tick begins."""

    @abstractmethod
    def pose_at(self, stamp_ns: int, present_ns: int) -> EgoPose | None:
        """Pose at `stamp_ns`, or None where it is not known; `present_ns` is the tracking time."""

    def _low_passed(self, ego: EgoState, yaw_rad: float, yaw_rate_radps: float) -> EgoState:
        """`ego` with its yaw and yaw rate drawn towards the given ones."""
        return replace(
            ego,
            yaw_rad=wrap_angle(yaw_rad + self._yaw_weight * wrap_angle(ego.yaw_rad - yaw_rad)),
            yaw_rate_radps=(1.0 - self._yaw_rate_weight) * yaw_rate_radps + self._yaw_rate_weight * ego.yaw_rate_radps,
        )


class EgoTrajectory(EgoSource):
    """Low-passed ego states, each filtered once, and interpolated between their stamps.

    The low-pass pulls towards the previous state *extrapolated to the new stamp*, so a steady turn is not delayed.
    """

    def __init__(self, yaw_weight: float, yaw_rate_weight: float, memory_s: float, max_extrapolation_s: float) -> None:
        super().__init__(yaw_weight, yaw_rate_weight)
        self._memory_ns = nanoseconds(memory_s)
        self._max_extrapolation_ns = nanoseconds(max_extrapolation_s)
        self._states: list[EgoState] = []
        self._stamps: list[int] = []

    def _store(self, ego: EgoState) -> str | None:
        """See `EgoSource._store`; a late state is put in its place, unfiltered."""
        place = bisect.bisect_left(self._stamps, ego.stamp_ns)
        if place < len(self._stamps) and self._stamps[place] == ego.stamp_ns:
            return "repeated stamp"
        if place == len(self._states):
            if self.current is not None:
                turned_rad = self.current.yaw_rate_radps * seconds(ego.stamp_ns - self.current.stamp_ns)
                ego = self._low_passed(ego, self.current.yaw_rad + turned_rad, self.current.yaw_rate_radps)
            self.current = ego
        self._stamps.insert(place, ego.stamp_ns)
        self._states.insert(place, ego)
        keep = bisect.bisect_left(self._stamps, self._stamps[-1] - self._memory_ns)
        if keep > 64:  # in portions: cutting a list copies it
            del self._stamps[: keep - 1], self._states[: keep - 1]
        return None

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
        before.yaw_rate_radps + share * (after.yaw_rate_radps - before.yaw_rate_radps),
    )
