"""Ego states that contradict their neighbours: strays are left out, jumps are followed and counted."""

from dataclasses import replace

import pytest

from fgtrack.core.types import EgoState
from fgtrack.tracking.ego.trajectory import CONTRADICTS, EgoTrajectory

MS = 1_000_000
SPEED_MPS = 60.0


def driven(
    count: int = 40, step_ms: int = 10, speed_mps: float = SPEED_MPS
) -> list[EgoState]:
    return [
        EgoState(
            k * step_ms * MS,
            k * step_ms * MS,
            1e-3 * SPEED_MPS * k * step_ms,
            0.0,
            0.0,
            speed_mps,
        )
        for k in range(count)
    ]


def moved(ego: EgoState, by_ms: float) -> EgoState:
    return replace(ego, stamp_ns=ego.stamp_ns + round(by_ms * MS))


class Recorded(EgoTrajectory):
    """A trajectory that keeps the states it takes, in their order."""

    def __init__(self) -> None:
        super().__init__(1.0, 1.0, memory_s=10.0)
        self.taken: list[EgoState] = []

    def _insert(self, ego: EgoState) -> str | None:
        self.taken.append(ego)
        return super()._insert(ego)


def judged(states: list[EgoState]) -> tuple[list[EgoState], int, int]:
    """States taken, number of those left out, number of jumps."""
    trajectory = Recorded()
    left_out = [trajectory.receive(ego) for ego in states].count(CONTRADICTS)
    return trajectory.taken, left_out, trajectory.jumps


@pytest.mark.parametrize("by_ms", [900.0, 500.0, 100.0, -100.0, -900.0])
def test_a_stray_stamp_is_left_out(by_ms: float) -> None:
    states = driven()
    strays = {k for k in range(40) if k % 10 == 3}
    shown = [moved(ego, by_ms) if k in strays else ego for k, ego in enumerate(states)]
    assert judged(shown) == (
        [ego for k, ego in enumerate(states) if k not in strays],
        4,
        0,
    )


@pytest.mark.parametrize("by_ms", [500.0, -900.0])
def test_a_clock_that_is_set_is_followed_and_counted_once(by_ms: float) -> None:
    states = driven()
    shown = [moved(ego, by_ms) if k >= 20 else ego for k, ego in enumerate(states)]
    assert judged(shown) == (shown, 0, 1)


@pytest.mark.parametrize(
    "states",
    [
        driven(),
        driven(step_ms=1500),
        driven(step_ms=200, speed_mps=0.0),
        [
            replace(ego, x_m=ego.x_m + 1.9 * (-1) ** k)
            for k, ego in enumerate(driven(speed_mps=55.0))
        ][::2],
        [
            replace(
                ego, y_m=9.0 * (k % 3), covariance=(25.0, *[0.0] * 5, 25.0, *[0.0] * 18)
            )
            for k, ego in enumerate(driven())
        ],
    ],
    ids=[
        "healthy",
        "far apart",
        "speed unknown",
        "small errors",
        "large errors, said so",
    ],
)
def test_states_that_may_be_right_are_all_taken(states: list[EgoState]) -> None:
    taken, left_out, jumps = judged(states)
    assert (taken, left_out, jumps) == (states, 0, 0)


def test_a_trajectory_tells_what_it_left_out_and_where_it_jumped() -> None:
    trajectory, states = EgoTrajectory(1.0, 1.0, memory_s=10.0), driven(60)
    shown = [
        moved(ego, 400.0) if k >= 40 or k == 20 else ego for k, ego in enumerate(states)
    ]
    assert [
        reason for reason in map(trajectory.receive, shown) if reason is not None
    ] == [CONTRADICTS]
    assert trajectory.jumps == 1
    pose = trajectory.pose_at(states[20].stamp_ns, 0)
    assert pose is not None
    assert pose.x_m == pytest.approx(states[20].x_m)
