import math

import numpy as np
import pytest

from fgtrack.core.types import Detection, DetectionList, EgoState, FloatArray, Message
from fgtrack.meaning.coverage import Coverage, coverages
from fgtrack.models.sensors import Mount

MS = 1_000_000


def traffic(
    rng: np.random.Generator, num_scans: int, period_s: float = 0.05
) -> FloatArray:
    """Positions of eight cars that wander about the ego up to 80 m off, shape (scans, 8, 2)."""
    phase, rate = rng.uniform(0.0, math.tau, (2, 8)), rng.uniform(0.1, 0.5, (2, 8))
    times_s = period_s * np.arange(num_scans)[:, None]
    radius_m = 42.5 + 37.5 * np.sin(rate[0] * times_s + phase[0])
    angle_rad = rate[1] * times_s + phase[1]
    return np.stack(
        [radius_m * np.cos(angle_rad), radius_m * np.sin(angle_rad)], axis=-1
    )


def seen(
    axis_rad: float,
    field_of_view_rad: float,
    max_range_m: float = 1e9,
    clutter: float = 0.0,
    scans: int = 1200,
):
    """Lists of a sensor at the ego that sees all cars in its sector and range, and clutter anywhere."""
    rng = np.random.default_rng(1)
    for k, cars_m in enumerate(traffic(rng, scans)):
        points_m = cars_m + rng.normal(0.0, 0.3, cars_m.shape)
        off_rad = np.abs(
            np.angle(np.exp(1j * (np.arctan2(cars_m[:, 1], cars_m[:, 0]) - axis_rad)))
        )
        points_m = points_m[
            (off_rad <= field_of_view_rad / 2) & (np.hypot(*cars_m.T) <= max_range_m)
        ]
        ghosts_m = rng.uniform(-150.0, 150.0, (rng.poisson(clutter), 2))
        yield k, np.concatenate([points_m, ghosts_m])


def lists(scans, frame="ego") -> list[Message]:
    return [
        DetectionList(
            "one",
            50 * k * MS,
            50 * k * MS + MS,
            [Detection(x_m=x, y_m=y) for x, y in points_m],
            frame,
        )
        for k, points_m in scans
    ]


def coverage(messages: list[Message], **mounts: Mount) -> Coverage:
    return coverages(messages, mounts)["one"]


@pytest.mark.parametrize(
    ("axis_rad", "field_of_view_rad", "clutter"),
    [(0.0, 0.6, 0.2), (math.pi, 1.57, 0.0), (-math.pi / 2, 2.5, 0.2), (0.5, 1.57, 0.2)],
)
def test_the_sector_of_a_sensor_is_found_wherever_it_looks(
    axis_rad, field_of_view_rad, clutter
) -> None:
    found = coverage(lists(seen(axis_rad, field_of_view_rad, clutter=clutter)))
    assert found.field_of_view_rad == pytest.approx(field_of_view_rad, abs=0.25)
    assert math.cos(found.axis_rad - axis_rad) > math.cos(0.1)
    assert (found.rate_hz, found.silence_s, found.revisit_s) == pytest.approx(
        (20.0, 0.05, 0.05)
    )
    assert (found.scans, found.measured, found.num_lists) == (
        True,
        {"x_m", "y_m"},
        1200,
    )


def test_the_range_is_that_of_nearly_all_detections_and_some_more() -> None:
    assert coverage(lists(seen(0.0, 2.0, 60.0))).range_m == pytest.approx(66.0, abs=1.5)
    assert coverage(lists(seen(0.0, 2.0, 60.0, clutter=0.05))).range_m == pytest.approx(
        66.0, abs=3.0
    )


@pytest.mark.parametrize("field_of_view_rad", [math.tau, 4.7])
def test_a_sensor_that_sees_more_than_half_a_circle_is_taken_to_look_all_around(
    field_of_view_rad,
) -> None:
    found = coverage(lists(seen(0.0, field_of_view_rad)))
    assert (found.axis_rad, found.field_of_view_rad) == (0.0, None)
    assert found.range_m is not None


def test_a_car_that_passes_on_one_side_shows_that_a_sensor_looks_all_around() -> None:
    scans = [(k, np.array([[60.0 - 0.1 * k, 3.5]])) for k in range(1200)]
    assert coverage(lists(scans)).field_of_view_rad is None
    assert coverage(lists(scans[:580])).field_of_view_rad is not None


def test_few_detections_show_nothing() -> None:
    scans = [(k, np.array([[30.0, 0.1 * k]])) for k in range(101)]
    assert coverage(lists(scans[:100])).field_of_view_rad is not None
    few = coverage(lists(scans[:99]))
    assert (few.field_of_view_rad, few.range_m, few.num_detections) == (None, None, 99)
    nothing = coverage(lists([(0, np.empty((0, 2)))]))
    assert (nothing.measured, nothing.rate_hz, nothing.num_lists) == (
        frozenset(),
        None,
        1,
    )


def test_detections_in_the_map_are_seen_from_the_ego() -> None:
    def pose(k):
        return 20.0 * 0.05 * k, -100.0, 2.0 + 0.01 * k

    def messages():
        for k, points_m in seen(0.0, 1.57, 60.0):
            x_m, y_m, yaw_rad = pose(k)
            if k % 2 == 0:
                yield EgoState(
                    50 * k * MS,
                    50 * k * MS + MS,
                    x_m,
                    y_m,
                    math.remainder(yaw_rad, math.tau),
                    20.0,
                )
            cosine, sine = math.cos(yaw_rad), math.sin(yaw_rad)
            turned = points_m @ np.array([[cosine, sine], [-sine, cosine]]) + [x_m, y_m]
            yield from lists([(k, turned)], "map")

    found = coverage(list(messages()))
    assert found.field_of_view_rad == pytest.approx(1.57, abs=0.2)
    assert (found.axis_rad, found.range_m) == (0.0, pytest.approx(66.0, abs=1.5))
    alone = coverage([one for one in messages() if isinstance(one, DetectionList)])
    assert (alone.field_of_view_rad, alone.range_m) == (None, None)


def test_the_axis_of_a_known_mount_and_of_the_sensor_frame_stays() -> None:
    ahead_left = list(seen(0.5, 1.0))
    assert coverage(lists(ahead_left, "sensor")).axis_rad == 0.0
    assert coverage(lists(ahead_left, "sensor")).field_of_view_rad == pytest.approx(
        2.0, abs=0.25
    )
    mounted = coverage(lists(ahead_left), one=Mount(yaw_rad=0.5))
    assert (mounted.axis_rad, mounted.field_of_view_rad) == (
        0.0,
        pytest.approx(1.0, abs=0.2),
    )


def test_bearings_alone_give_a_sector_and_no_range() -> None:
    messages = [
        DetectionList(one.sensor, one.stamp_ns, one.receipt_ns, [
            Detection(bearing_rad=math.atan2(each.y_m, each.x_m)) for each in one.objects
        ])
        for one in lists(seen(math.pi, 1.57, clutter=0.1))
    ]  # fmt: skip
    found = coverage(messages)
    assert (found.field_of_view_rad, found.range_m) == (
        pytest.approx(1.57, abs=0.2),
        None,
    )
    assert math.cos(found.axis_rad) < -0.99


def test_an_object_that_keeps_its_place_does_not_make_the_area_small() -> None:
    rng = np.random.default_rng(1)
    places_m = np.array([30.0, 0.0]) + 0.3 * rng.standard_normal((200, 2))
    messages = [
        DetectionList("radar", k * 10**8, k * 10**8, [Detection(x_m=x_m, y_m=y_m)])
        for k, (x_m, y_m) in enumerate(places_m.tolist())
    ]
    area_m2 = coverages(messages)["radar"].area_m2
    assert area_m2 is not None
    assert 0.5 * 0.35 * 30.0**2 < area_m2 < 200.0


def of_sizes(*sizes: int) -> Coverage:
    found = []
    for number, size in enumerate(sizes):
        objects = [
            Detection(x_m=10.0 * number, y_m=float(k + number % 2)) for k in range(size)
        ]
        found.append(DetectionList("any", number, number, objects))
    return coverages(found)["any"]


@pytest.mark.parametrize(
    ("sizes", "scans"),
    [
        ([1] * 20, False),
        ([1] * 18 + [2] * 2, False),
        ([1] * 19 + [0], True),
        ([1, 2] * 10, True),
        ([1] * 9, True),
    ],
)
def test_lists_of_one_object_are_no_scans_unless_one_is_empty(
    sizes: list[int], scans: bool
) -> None:
    assert of_sizes(*sizes).scans == scans


def test_clutter_is_at_most_as_dense_as_all_detections() -> None:
    assert of_sizes(*[1] * 11).density_per_m2 == pytest.approx(1.0 / 100.0)
    assert of_sizes(*[1] * 9).density_per_m2 == math.inf
    line = [
        DetectionList("any", k, k, [Detection(range_m=float(k), bearing_rad=0.0)])
        for k in range(20)
    ]
    assert coverages(line)["any"].density_per_m2 == math.inf


@pytest.mark.parametrize("scans", [12, 40, 300])
@pytest.mark.parametrize("distance_m", [3e3, 1e6, -1e8])
def test_one_stray_detection_changes_neither_area_nor_density(
    distance_m: float, scans: int
) -> None:
    messages = list(seen(0.0, math.tau, clutter=1.0, scans=scans))
    expected = coverage(lists(messages))
    k, points_m = messages[scans // 2]
    messages[scans // 2] = k, np.append(points_m, [[distance_m, 0.5 * distance_m]], 0)
    result = coverage(lists(messages))
    assert result.density_per_m2 == pytest.approx(expected.density_per_m2, rel=0.05)
    assert result.range_m == expected.range_m
    if expected.area_m2 is not None:
        assert result.area_m2 == pytest.approx(expected.area_m2, rel=0.1)
    if expected.persistence is not None and result.persistence is not None:
        assert result.persistence.clutter_per_list == pytest.approx(
            expected.persistence.clutter_per_list, abs=0.3
        )


@pytest.mark.parametrize("step_m", [0.0, 1e-3, 0.1, 0.5, 2.0])
def test_exact_and_gridded_positions_recur_everywhere(step_m: float) -> None:
    """Cars on straight lines at all ranges, seen in every list: no range beyond which clutter prevails."""
    speeds = np.array([[22.0, 0.0], [18.0, 0.3], [-21.0, 0.2], [1.0, 4.0]])
    starts = np.array([[30.0, 0.0], [160.0, 3.5], [-25.0, -3.5], [10.0, 8.0]])
    messages: list[Message] = []
    for k in range(300):
        points_m = starts + k / 30.0 * speeds  # the stamps are rounded to nanoseconds
        if step_m:
            points_m = step_m * np.round(points_m / step_m)
        objects = [Detection(x_m=x, y_m=y) for x, y in points_m.tolist()]
        stamp_ns = k * 1_000_000_000 // 30
        messages.append(DetectionList("one", stamp_ns, stamp_ns, objects, "ego"))
    result = coverage(messages).persistence
    assert result is not None
    assert result.max_range_m is None
    assert result.detection_probability == pytest.approx(0.9)
    assert result.clutter_per_list < 0.1


def test_exact_positions_of_a_parked_car_make_no_clutter_of_a_moving_one() -> None:
    """Most misfits are exactly 0, and the coordinates form no grid: only the floor of the scatter is left."""
    messages: list[Message] = []
    for k in range(300):
        t_s = k / 30.0
        x_m, y_m = 10.0 + 8.0 * t_s + np.sin(0.9 * t_s), 8.0 + 2.0 * np.sin(t_s)
        objects = [
            Detection(x_m=30.0, y_m=0.0),
            Detection(x_m=float(x_m), y_m=float(y_m)),
        ]
        stamp_ns = k * 1_000_000_000 // 30
        messages.append(DetectionList("one", stamp_ns, stamp_ns, objects, "ego"))
    result = coverage(messages).persistence
    assert result is not None
    assert result.clutter_per_list < 0.1
