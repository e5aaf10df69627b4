"""Motion of the ego from its successive poses, for recordings without speed or without heading."""

import math
from collections import deque
from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace
from operator import attrgetter

from fgtrack.core.geometry import wrap_angle
from fgtrack.core.time import nanoseconds, seconds
from fgtrack.core.types import EgoState, Message

MOTION = ("yaw_rad", "speed_mps", "yaw_rate_radps")
"""Components of the ego that are computed if the recording does not measure them."""
#: Shortest time between two poses from which the motion is computed.
_SHORTEST_S = 0.2
#: Shortest distance between two positions from which a heading is computed, and the longest time of the way.
_SHORTEST_M = 1.0
_LONGEST_S = 5.0
#: A shorter way may be noise at rest, and turns no heading.
_RESTING_M = 0.2
#: Largest turn rate of a vehicle.
_FASTEST_RADPS = 1.0


class EgoMotion:
    """Computes components of successive states of the ego that the recording does not measure.

    The heading is the direction of the last metre or more; the ego drives forwards. At
    rest the heading stays. Speed and yaw rate follow from the pose at least 0.2 s
    before. Heading and speed are NaN until there is an earlier pose.
    """

    def __init__(self, missing: Collection[str]) -> None:
        """Prepare the computation of `missing`, names among `MOTION`."""
        self._missing = frozenset(missing)
        #: States within the last seconds, and at least one.
        self._before: deque[EgoState] = deque()
        self._yaw_rad = math.nan
        #: Stamps and directions of earlier ways.
        self._courses: deque[tuple[int, float]] = deque()
        #: State at which the heading was computed last.
        self._turned: EgoState | None = None

    def completed(self, state: EgoState) -> EgoState:
        """Return `state` with the missing components, computed from this state and the states before."""
        if not self._missing:
            return state
        if "yaw_rad" in self._missing:
            state = self._with_heading(state)
        state = self._with_rates(state)
        if math.isfinite(state.x_m + state.y_m):
            self._before.append(state)
        oldest_ns = state.stamp_ns - nanoseconds(_LONGEST_S)
        while len(self._before) > 1 and self._before[0].stamp_ns < oldest_ns:
            self._before.popleft()
        return state

    def _with_heading(self, state: EgoState) -> EgoState:
        far = self._earlier(state, _SHORTEST_S, _SHORTEST_M)
        moved = self._turned is None or (
            math.hypot(state.x_m - self._turned.x_m, state.y_m - self._turned.y_m)
            >= _RESTING_M
        )
        if far is not None and moved:
            course_rad = math.atan2(state.y_m - far.y_m, state.x_m - far.x_m)
            # On a bend, the course is the heading at the middle of the way.
            middle_ns = (state.stamp_ns + far.stamp_ns) // 2
            latest_ns = middle_ns - nanoseconds(_SHORTEST_S)
            while len(self._courses) > 1 and self._courses[1][0] <= latest_ns:
                self._courses.popleft()
            rate_radps = 0.0
            if self._courses and self._courses[0][0] < middle_ns:
                before_ns, before_rad = self._courses[0]
                turn_rad = wrap_angle(course_rad - before_rad)
                rate_radps = turn_rad / seconds(middle_ns - before_ns)
                rate_radps = min(max(rate_radps, -_FASTEST_RADPS), _FASTEST_RADPS)
            rest_s = seconds(state.stamp_ns - middle_ns)
            self._courses.append((middle_ns, course_rad))
            self._turned = state
            self._yaw_rad = wrap_angle(course_rad + rate_radps * rest_s)
        return replace(state, yaw_rad=self._yaw_rad)

    def _with_rates(self, state: EgoState) -> EgoState:
        before = self._earlier(state, _SHORTEST_S) or self._earlier(state, 0.0)
        if before is None:
            return replace(state, speed_mps=math.nan) if self._lacks_speed else state
        after_s = seconds(state.stamp_ns - before.stamp_ns)
        turn_rad = state.yaw_rad - before.yaw_rad
        turn_rad = wrap_angle(turn_rad) if math.isfinite(turn_rad) else 0.0
        if self._lacks_speed:
            middle_rad = state.yaw_rad - 0.5 * turn_rad
            forward_m = (state.x_m - before.x_m) * math.cos(middle_rad)
            forward_m += (state.y_m - before.y_m) * math.sin(middle_rad)
            state = replace(state, speed_mps=forward_m / after_s)
        if "yaw_rate_radps" in self._missing:
            state = replace(state, yaw_rate_radps=turn_rad / after_s)
        return state

    @property
    def _lacks_speed(self) -> bool:
        return "speed_mps" in self._missing

    def _earlier(
        self, state: EgoState, shortest_s: float, shortest_m: float = 0.0
    ) -> EgoState | None:
        """Return the newest state at least `shortest_s` earlier and `shortest_m` away; None without such a state."""
        latest_ns = state.stamp_ns - max(nanoseconds(shortest_s), 1)
        for each in reversed(self._before):
            if each.stamp_ns <= latest_ns and (
                math.hypot(state.x_m - each.x_m, state.y_m - each.y_m) >= shortest_m
            ):
                return each
        return None


def missing_motion(given: Collection[str]) -> tuple[str, ...]:
    """Return the names of heading, speed and yaw rate that must be computed, because `given` lacks them.

    If only the yaw rate is missing, it is not computed.
    """
    missing = tuple(name for name in MOTION if name not in given)
    return () if missing == MOTION[2:] else missing


def with_motion(
    messages: Iterator[Message], missing: Collection[str]
) -> Iterator[Message]:
    """Return `messages` with the `missing` components of the ego's states."""
    if not missing:
        return messages
    motion = EgoMotion(missing)
    return (
        motion.completed(each) if isinstance(each, EgoState) else each
        for each in messages
    )


def completed_states(
    states: Iterable[EgoState], missing: Collection[str]
) -> list[EgoState]:
    """Return all `states` of a recording with the `missing` components, then in the order of their stamps.

    The first states, which have no earlier pose, get the heading and the speed of the
    first state with both.
    """
    if not missing:
        return list(states)
    motion = EgoMotion(missing)
    result = [
        motion.completed(each) for each in sorted(states, key=attrgetter("stamp_ns"))
    ]
    first = next(
        (k for k, each in enumerate(result) if math.isfinite(each.speed_mps)), 0
    )
    for k in range(first):
        known = {
            name: getattr(result[first], name) for name in missing if name in MOTION[:2]
        }
        result[k] = replace(result[k], **known)
    return result
