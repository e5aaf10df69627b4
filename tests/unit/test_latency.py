"""Usual delays and watermarks: what is learned from stamps and receipts, and how far it is trusted."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fgtrack.core.linalg import kernels
from fgtrack.models.sensors import Mount, SensorModel
from fgtrack.tracking.ego.trajectory import EgoPose
from fgtrack.tracking.lives.latency import (
    FOREVER,
    NEVER,
    Delays,
    Durations,
    Views,
    Watermarks,
)

MS, S = 1_000_000, 1_000_000_000
START_NS = 1_600_000_000 * S
POSITION = SensorModel(std={"x_m": 0.3, "y_m": 0.3})


def learned(
    delays_ms: list[float], period_ms: float = 100.0, first_ms: float = 0.0
) -> Delays:
    """Delays of a sensor with this period, in order of receipt."""
    delays = Delays()
    messages = [
        (first_ms + k * period_ms, first_ms + k * period_ms + late)
        for k, late in enumerate(delays_ms)
    ]
    for stamp_ms, receipt_ms in sorted(messages, key=lambda each: each[1]):
        delays.add(START_NS + round(stamp_ms * MS), START_NS + round(receipt_ms * MS))
        delays.processed(START_NS + round(stamp_ms * MS))
    return delays


def watermark_ms(delays: Delays, now_ms: float, most_ms: float = 60_000.0) -> float:
    return (
        delays.watermark_ns(START_NS + round(now_ms * MS), round(most_ms * MS))
        - START_NS
    ) / MS


def test_nothing_is_awaited_of_a_sensor_that_never_sent_anything() -> None:
    assert Delays().watermark_ns(START_NS, S) == FOREVER


def test_the_watermark_is_the_newest_stamp_until_the_next_list_is_overdue() -> None:
    delays = learned([700.0] * 5)  # the newest stamp is 400 ms, received at 1,100 ms
    assert [watermark_ms(delays, now_ms) for now_ms in (1100.0, 1150.0, 1200.0)] == [
        400.0,
        400.0,
        400.0,
    ]
    assert watermark_ms(delays, 1200.001) == pytest.approx(500.001)
    assert watermark_ms(delays, 5000.0) == 4300.0


def test_a_list_that_has_come_counts_once_it_is_processed() -> None:
    delays = learned([700.0] * 5)
    delays.add(START_NS + 500 * MS, START_NS + 1200 * MS)
    assert watermark_ms(delays, 1200.0) == 400.0
    delays.processed(START_NS + 500 * MS)
    assert watermark_ms(delays, 1200.0) == 500.0


def test_lists_in_disorder_are_awaited_for_their_usual_delay() -> None:
    delays = learned(
        [100.0, 100.0, 900.0, 100.0, 100.0, 100.0]
    )  # that of 200 ms comes last, at 1,100 ms
    assert watermark_ms(delays, 1100.0) == 200.0


@pytest.mark.parametrize("period_ms", [40.0, 500.0])
@pytest.mark.parametrize("rank", [0, 7, 59])
def test_one_delay_of_an_hour_does_not_keep_tracks_for_an_hour(
    period_ms: float, rank: int
) -> None:
    """Neither an early one, which no track could use, nor the newest one."""
    delays = learned([100.0] * 60, period_ms)
    late_ns = START_NS + round(60 * period_ms * MS) + 100 * MS
    for k in range(60 - rank):
        delays.add(late_ns - 3600 * S if k == 0 else late_ns - 100 * MS, late_ns)
    assert delays.usual_ns(3 * S) == 100 * MS
    if rank < 59:
        assert delays.usual_ns() == 100 * MS


def test_a_delay_that_has_changed_is_followed_at_once_and_forgotten_later() -> None:
    delays = learned([100.0] * 100)
    delays.add(START_NS + 10 * S, START_NS + 12 * S)
    assert delays.usual_ns() == 2 * S
    for k in range(200):
        delays.add(
            START_NS + 10 * S + k * 100 * MS, START_NS + 10 * S + (k + 1) * 100 * MS
        )
    assert delays.usual_ns() == 100 * MS


def test_what_comes_too_late_for_every_track_is_not_awaited() -> None:
    delays = learned([5000.0] * 10)
    assert delays.usual_ns(3 * S) == 3 * S
    assert watermark_ms(delays, 5900.0, most_ms=3000.0) == 2900.0
    sensors = {
        "refused": SensorModel(std=POSITION.std, max_delay_s=0.2),
        "taken": POSITION,
    }
    watermarks = Watermarks(sensors, ["ego"])
    for name in ("refused", "taken"):
        for k in range(10):
            watermarks.delays[name].add(
                START_NS + k * 100 * MS, START_NS + k * 100 * MS + 500 * MS
            )
            watermarks.delays[name].processed(START_NS + k * 100 * MS)
    now_ns = START_NS + 5 * S
    assert (now_ns - watermarks.at(now_ns, now_ns - 3 * S)).tolist() == [
        200 * MS,
        500 * MS,
    ]
    assert (now_ns - watermarks.at(now_ns, now_ns - 300 * MS)).tolist() == [
        200 * MS,
        300 * MS,
    ]


def test_a_clock_that_is_ahead_has_a_watermark_ahead_of_now() -> None:
    assert watermark_ms(learned([-300.0] * 5), 1000.0) == 1300.0


def test_a_stamp_far_ahead_teaches_nothing() -> None:
    delays = learned([100.0] * 5)
    delays.add(START_NS + 3600 * S, START_NS + 500 * MS)
    assert delays.messages == 6
    assert watermark_ms(delays, 510.0) == 400.0
    assert watermark_ms(delays, 2000.0) == 1900.0


@given(st.lists(st.integers(0, 1000), min_size=1, max_size=250), st.integers(-1, 1001))
def test_of_fifty_durations_the_longest_one_is_unusual(
    all_ns: list[int], most_ns: int
) -> None:
    durations = Durations()
    for each in all_ns:
        durations.add(each)
    possible = sorted(each for each in all_ns[-100:] if each <= most_ns)
    num_unusual = len(possible) // 50
    expected = possible[-1 - num_unusual] if possible else None
    assert durations.usual_ns(most_ns) == expected
    assert durations.shortest_ns == min(all_ns[-100:])


@given(
    st.lists(st.floats(0.0, 3000.0), min_size=1, max_size=40),
    st.sampled_from([40.0, 100.0, 500.0]),
    st.floats(0.0, 10_000.0),
)
def test_every_list_up_to_the_watermark_has_come_by_the_delays_known_so_far(
    delays_ms: list[float], period_ms: float, after_ms: float
) -> None:
    """No list that is still due, with a delay as long as that of any other one, has an older stamp."""
    delays = learned(delays_ms, period_ms)
    last_ms = max(k * period_ms + late for k, late in enumerate(delays_ms))
    mark_ms = watermark_ms(delays, last_ms + after_ms)
    due_ms, newest_ms = (
        last_ms + after_ms - max(delays_ms),
        (len(delays_ms) - 1) * period_ms,
    )
    assert min(due_ms, newest_ms) - 1e-3 <= mark_ms <= due_ms + 1e-3


def test_watermarks_never_depend_on_anything_but_stamps_and_receipts() -> None:
    generator = np.random.default_rng(0)
    delays_ms = generator.uniform(30.0, 900.0, 80).tolist()
    one, other = learned(delays_ms), learned(delays_ms)
    for now_ms in range(100, 10_000, 37):  # asked often, and once
        one.watermark_ns(START_NS + now_ms * MS, 3 * S)
    assert one.watermark_ns(START_NS + 10 * S, 3 * S) == other.watermark_ns(
        START_NS + 10 * S, 3 * S
    )
    marks = [
        one.watermark_ns(START_NS + now_ms * MS, 3 * S)
        for now_ms in range(9000, 20_000, 50)
    ]
    assert all(later >= earlier for earlier, later in pairwise(marks))


def test_only_sensors_that_could_show_an_object_are_awaited() -> None:
    watermarks_ns = np.array([START_NS, START_NS - S, FOREVER])
    could_show = np.array(
        [
            [True, False, True],
            [False, True, True],
            [False, False, False],
            [False, False, True],
        ]
    )
    expected_ns = np.full((4, 3), NEVER)
    expected_ns[2, 1], expected_ns[3, 1] = (
        START_NS - S,
        START_NS - S + 1,
    )  # the list of the last one has not come
    decided_ns = kernels("fgtrack.tracking.lives.latency_kernels").decided_ns.py_func
    found = [
        decided_ns(own, watermarks_ns, FOREVER, could_show, expected_ns)
        for own in range(4)
    ]
    assert found == [START_NS, START_NS - S, FOREVER, START_NS - S]
    assert decided_ns(0, watermarks_ns, 5, could_show, expected_ns) == 5


def test_a_sensor_could_show_what_is_in_its_view_and_a_camera_shows_no_position() -> (
    None
):
    sensors = {
        "ahead": SensorModel(
            std=POSITION.std, field_of_view_rad=2.0, view_range_m=50.0
        ),
        "behind": SensorModel(
            std=POSITION.std, field_of_view_rad=2.0, mount=Mount(yaw_rad=np.pi)
        ),
        "around": POSITION,
        "camera": SensorModel(std={"bearing_rad": 0.01}),
    }
    views, places_m = Views(sensors), np.array([[20.0, 0.0], [-20.0, 0.0], [60.0, 0.0]])
    ego = EgoPose(0.0, 0.0, 0.0, 0.0, 0.0)
    seen = [
        [True, False, True, False],
        [False, True, True, False],
        [False, False, True, False],
    ]
    assert views.of(places_m, ego).tolist() == seen
    assert views.of(places_m, None).tolist() == [[True, True, True, False]] * 3
    assert views.at_birth(places_m[2], ego, 0).tolist() == [True, False, True, False]
    assert views.at_birth(None, ego, 0).tolist() == [True, True, True, False]
