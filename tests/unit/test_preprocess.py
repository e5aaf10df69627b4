import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.tracking import StraightRoad, batch

from fgtrack.core.geometry import rotation
from fgtrack.core.types import Detection, Disposition, FloatArray, Frame
from fgtrack.karle2023.tracker_parts import NeighbourhoodMerge
from fgtrack.models.measurement import SensorPose, measurement_model
from fgtrack.models.motion import CTRV
from fgtrack.models.road import Road
from fgtrack.models.sensors import Mount, SensorModel
from fgtrack.tracking.detections import ConnectedMerge, Merge, NoMerge
from fgtrack.tracking.ego.trajectory import EgoPose
from fgtrack.tracking.preprocess import Candidates, Preprocess, StampError

LIDAR = SensorModel(
    std={"x_m": 0.3, "y_m": 0.3, "yaw_rad": 0.4}, mount=Mount(2.0, 1.0, math.pi / 2)
)
POINTS = SensorModel(std={"x_m": 0.3, "y_m": 0.3}, yaw_from_map_std_rad=0.35)
POLAR = SensorModel(
    std={"range_m": 0.5, "bearing_rad": 0.02}, mount=Mount(2.0, 1.0, math.pi / 2)
)
EGO = EgoPose(100.0, 50.0, math.pi / 2, 20.0)
ORIGIN_M = (-1.74, 0.0)
ALONE, OPEN = NoMerge(), Road()


def candidates(
    *objects: Detection,
    sensor: SensorModel = LIDAR,
    frame: Frame = "ego",
    merge: Merge = ALONE,
    road: Road = OPEN,
    ego: EgoPose | None = EGO,
) -> Candidates:
    found, records = Preprocess(road, merge, CTRV(), ORIGIN_M)(
        batch(*objects, frame=frame), sensor, ego
    )
    assert records == []
    return found


@pytest.mark.parametrize(
    ("frame", "x_m", "y_m", "yaw_rad"),
    [
        ("map", 10.0, 3.0, 0.1),
        (
            "ego",
            100.0 - 3.0,
            50.0 - 1.74 + 10.0,
            0.1 + math.pi / 2,
        ),  # ahead is north, left is west
        (
            "sensor",
            100.0 - 1.0 - 10.0,
            50.0 - 1.74 + 2.0 - 3.0,
            0.1 - math.pi,
        ),  # looks west
    ],
)
def test_a_detection_comes_to_the_map_from_its_frame(
    frame: Frame, x_m: float, y_m: float, yaw_rad: float
) -> None:
    [found] = candidates(Detection(x_m=10.0, y_m=3.0, yaw_rad=0.1), frame=frame)
    assert found.values == pytest.approx({"x_m": x_m, "y_m": y_m, "yaw_rad": yaw_rad})
    assert found.position_m == pytest.approx([x_m, y_m])
    assert found.measurement.z == pytest.approx([x_m, y_m, yaw_rad])


@pytest.mark.parametrize("frame", ["map", "ego", "sensor"])
def test_an_object_lies_behind_the_near_side_that_the_sensor_sees(frame: Frame) -> None:
    [seen] = candidates(Detection(x_m=30.0, y_m=40.0), sensor=POINTS, frame=frame)
    [moved] = candidates(
        Detection(x_m=30.0, y_m=40.0),
        sensor=replace(POINTS, near_side_m=2.0),
        frame=frame,
    )
    origin_m = np.array([100.0, 50.0 - 1.74])
    assert seen.position_m is not None
    assert moved.position_m is not None
    away_m = seen.position_m - origin_m
    assert moved.position_m == pytest.approx(
        seen.position_m + 2.0 * away_m / np.hypot(*away_m)
    )
    assert moved.measurement.z[:2] == pytest.approx(moved.position_m)


def test_a_range_is_as_much_longer_as_the_near_side_is_nearer() -> None:
    [found] = candidates(
        Detection(range_m=30.0, bearing_rad=0.1), sensor=replace(POLAR, near_side_m=2.0)
    )
    assert found.values == pytest.approx({"range_m": 32.0, "bearing_rad": 0.1})


def test_without_an_ego_nothing_is_moved_and_a_near_side_must_be_finite() -> None:
    sensor = replace(POINTS, near_side_m=2.0)
    [found] = candidates(
        Detection(x_m=30.0, y_m=40.0), sensor=sensor, frame="map", ego=None
    )
    assert found.position_m == pytest.approx([30.0, 40.0])
    with pytest.raises(ValueError, match="near_side_m"):
        replace(POINTS, near_side_m=math.inf)


def test_the_sensor_pose_has_lever_arm_mount_and_the_velocity_of_the_ego() -> None:
    [found] = candidates(
        Detection(range_m=10.0, bearing_rad=0.1), sensor=POLAR, frame="sensor"
    )
    pose = found.measurement.pose
    assert (pose.x_m, pose.y_m) == pytest.approx((99.0, 50.26))
    assert pose.yaw_rad == pytest.approx(math.pi)
    assert (pose.vx_mps, pose.vy_mps) == pytest.approx((0.0, 20.0))
    ego_frame = candidates(Detection(range_m=10.0, bearing_rad=0.1), sensor=POLAR)[
        0
    ].measurement.pose
    assert (ego_frame.x_m, ego_frame.y_m, ego_frame.yaw_rad) == pytest.approx(
        (100.0, 48.26, math.pi / 2)
    )


@given(
    x=st.floats(-80, 80),
    y=st.floats(-80, 80),
    ego_yaw=st.floats(-3.1, 3.1),
    mount_yaw=st.floats(-3.1, 3.1),
)
def test_a_polar_and_a_cartesian_detection_of_one_place_agree(
    x: float, y: float, ego_yaw: float, mount_yaw: float
) -> None:
    if math.hypot(x, y) < 0.1:
        return
    mount = Mount(2.0, 1.0, mount_yaw)
    ego = EgoPose(5.0, -7.0, ego_yaw, 10.0)
    polar = Detection(range_m=math.hypot(x, y), bearing_rad=math.atan2(y, x))
    [a] = candidates(polar, sensor=replace(POLAR, mount=mount), frame="sensor", ego=ego)
    [b] = candidates(
        Detection(x_m=x, y_m=y),
        sensor=replace(LIDAR, mount=mount),
        frame="sensor",
        ego=ego,
    )
    assert a.position_m == pytest.approx(b.position_m, abs=1e-9)
    model = a.measurement.model
    state = np.array([*b.position_m, 0.0, 0.0, 0.0])
    predicted = model.predict(
        state, a.measurement.pose
    )  # the measurement stays in the sensor frame
    assert model.residual(a.measurement.z, predicted) == pytest.approx(
        [0.0, 0.0], abs=1e-9
    )


def test_a_sensors_deviations_lie_along_and_across_the_line_of_sight() -> None:
    radar = SensorModel(std={"x_m": 2.0, "y_m": 0.5})
    [found] = candidates(Detection(x_m=10.0, y_m=10.0), sensor=radar)
    sight = rotation(math.pi / 2 + math.pi / 4)
    assert pytest.approx(sight @ np.diag([4.0, 0.25]) @ sight.T) == found.measurement.R
    assert found.position_covariance == pytest.approx(found.measurement.R)


@pytest.mark.parametrize(
    ("frame", "turned_rad"), [("map", 0.0), ("ego", math.pi / 2), ("sensor", math.pi)]
)
def test_a_detections_own_covariance_is_turned_with_its_frame(
    frame: Frame, turned_rad: float
) -> None:
    own = np.array([[4.0, 0.5, 0.1], [0.5, 1.0, 0.2], [0.1, 0.2, 0.3]])
    item = Detection(
        x_m=10.0, y_m=3.0, yaw_rad=0.1, covariance=tuple(own.ravel().tolist())
    )
    [found] = candidates(item, frame=frame)
    turn = np.eye(3)
    turn[:2, :2] = rotation(turned_rad)
    assert pytest.approx(turn @ own @ turn.T) == found.measurement.R
    [ignored] = candidates(
        item, frame=frame, sensor=replace(LIDAR, message_covariance=False)
    )
    assert pytest.approx(np.diag([0.09, 0.09, 0.16])) == ignored.measurement.R


def test_only_the_components_that_the_sensor_measures_are_taken_of_a_covariance() -> (
    None
):
    own = np.diag([4.0, 5.0, 6.0, 7.0])
    item = Detection(
        x_m=10.0,
        y_m=3.0,
        yaw_rad=0.1,
        speed_mps=9.0,
        covariance=tuple(own.ravel().tolist()),
    )
    sensor = SensorModel(std={"x_m": 0.3, "y_m": 0.3, "speed_mps": 0.2})
    [found] = candidates(item, sensor=sensor, frame="map")
    assert found.measurement.model.components == ("x_m", "y_m", "speed_mps")
    assert pytest.approx(np.diag([4.0, 5.0, 7.0])) == found.measurement.R


def test_the_position_covariance_of_range_and_bearing_is_along_and_across_the_line_of_sight() -> (
    None
):
    [found] = candidates(Detection(range_m=50.0, bearing_rad=0.2), sensor=POLAR)
    sight = rotation(math.pi / 2 + 0.2)
    assert found.position_covariance == pytest.approx(
        sight @ np.diag([0.25, (50.0 * 0.02) ** 2]) @ sight.T
    )
    assert pytest.approx(np.diag([0.25, 0.0004])) == found.measurement.R


def test_a_bearing_alone_has_no_place() -> None:
    [placed, bearing] = candidates(
        Detection(bearing_rad=0.2),
        Detection(range_m=9.0, bearing_rad=0.2),
        sensor=POLAR,
        road=StraightRoad(),
    )
    assert (placed.leader, bearing.leader) == (1, 0)  # placed ones first
    assert (bearing.position_m, bearing.position_covariance) == (None, None)
    assert bearing.measurement.model.components == ("bearing_rad",)


def test_a_yaw_that_was_not_measured_comes_from_the_map_with_its_own_deviation() -> (
    None
):
    own = Detection(
        x_m=1.0,
        y_m=2.0,
        yaw_rad=3.0,
        covariance=tuple(np.diag([4.0, 4.0, 9.0]).ravel().tolist()),
    )
    for item, variance in ((Detection(x_m=1.0, y_m=2.0), 0.09), (own, 4.0)):
        [found] = candidates(
            item, sensor=POINTS, frame="map", road=StraightRoad(yaw_rad=0.4)
        )
        assert found.values == {"x_m": 1.0, "y_m": 2.0, "yaw_rad": 0.4}
        assert (
            pytest.approx(np.diag([variance, variance, 0.35**2])) == found.measurement.R
        )
    [measured] = candidates(
        Detection(x_m=1.0, y_m=2.0, yaw_rad=0.1),
        frame="map",
        road=StraightRoad(yaw_rad=0.4),
    )
    assert measured.values["yaw_rad"] == 0.1
    [unknown] = candidates(Detection(x_m=1.0, y_m=2.0), sensor=POINTS, frame="map")
    assert "yaw_rad" not in unknown.values


def test_detections_off_the_road_are_recorded_and_dropped_before_the_merge() -> None:
    step = Preprocess(
        StraightRoad(half_width_m=5.0), ConnectedMerge(distance_m=3.0), CTRV(), ORIGIN_M
    )
    items = [Detection(x_m=1.0, y_m=y_m) for y_m in (6.0, 4.0, -9.0, 3.0)]
    found, records = step(batch(*items, frame="map"), POINTS, EGO)
    assert [(record.index, record.disposition) for record in records] == [
        (0, Disposition.OUT_OF_BOUNDS),
        (2, Disposition.OUT_OF_BOUNDS),
    ]
    [merged] = found
    assert (merged.leader, merged.merged) == (1, (3,))
    assert merged.position_m == pytest.approx([1.0, 3.5])


def test_detections_beyond_the_range_of_the_sensor_are_recorded_and_dropped() -> None:
    step = Preprocess(Road(), NoMerge(), CTRV(), ORIGIN_M)
    items = [Detection(x_m=29.9, y_m=0.0), Detection(x_m=30.1, y_m=0.0)]
    found, records = step(batch(*items), replace(POINTS, max_range_m=30.0), EGO)
    assert [item.leader for item in found] == [0]
    assert [(record.index, record.disposition) for record in records] == [
        (1, Disposition.OUT_OF_BOUNDS)
    ]


# --- merge

CHAIN = np.array([[0.0, 0.0], [4.0, 0.0], [8.0, 0.0], [50.0, 0.0], [50.0, 5.1]])


def test_a_chain_of_neighbours_is_one_object() -> None:
    groups = ConnectedMerge(5.1).groups(CHAIN)
    assert list(groups.items()) == [(0, (0, 1, 2)), (3, (3, 4))]


def test_the_published_merge_makes_an_object_of_every_neighbourhood() -> None:
    groups = NeighbourhoodMerge().groups(np.vstack([CHAIN, [[90.0, 0.0]]]))
    assert groups == {0: (0, 1), 1: (0, 1, 2), 2: (1, 2), 3: (3, 4), 5: (5,)}
    assert list(groups)[-1] == 5


@pytest.mark.parametrize(
    "merge", [ConnectedMerge(5.1), NeighbourhoodMerge(), NoMerge()]
)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(0, 12))
def test_every_detection_leads_or_is_merged_into_exactly_one_candidate(
    merge: Merge, seed: int, count: int
) -> None:
    points = np.random.default_rng(seed).uniform(0.0, 15.0, size=(count, 2)).round(1)
    items = [Detection(x_m=x, y_m=y, yaw_rad=0.0) for x, y in points.tolist()]
    found = candidates(*items, merge=merge, frame="map")
    indices = [i for item in found for i in (item.leader, *item.merged)]
    assert sorted(indices) == list(range(count))


def test_a_merged_yaw_is_the_mean_direction_and_the_published_one_is_not() -> None:
    yaws = np.array([math.pi - 0.1, -math.pi + 0.1])
    assert abs(ConnectedMerge(5.1).mean("yaw_rad", yaws)) == pytest.approx(math.pi)
    jump = np.array(
        [-math.pi / 2 - 0.1, -math.pi / 2 + 0.1]
    )  # where the published yaw jumps
    assert ConnectedMerge(5.1).mean("yaw_rad", jump) == pytest.approx(-math.pi / 2)
    assert NeighbourhoodMerge().mean("yaw_rad", jump) == pytest.approx(math.pi / 2)
    assert NeighbourhoodMerge().mean("yaw_rad", yaws) == pytest.approx(math.pi)
    assert ConnectedMerge(5.1).mean("x_m", np.array([1.0, 2.0, 6.0])) == 3.0


def test_merged_detections_keep_what_all_of_them_measure() -> None:
    items = (Detection(x_m=0.0, y_m=0.0001, yaw_rad=0.2), Detection(x_m=2.0, y_m=0.0))
    [found] = candidates(*items, merge=ConnectedMerge(5.1), frame="map")
    assert found.measurement.model.components == ("x_m", "y_m")
    assert pytest.approx(0.09 * np.eye(2)) == found.measurement.R
    assert found.values == pytest.approx({"x_m": 1.0, "y_m": 0.00005})


def test_the_covariance_of_merged_detections_is_the_mean_of_theirs() -> None:
    own = [
        Detection(x_m=float(k), y_m=0.0, covariance=(1.0 + k, 0.0, 0.0, 4.0 * k + 1.0))
        for k in range(3)
    ]
    [found] = candidates(*own, sensor=POINTS, merge=ConnectedMerge(5.1), frame="map")
    assert pytest.approx(np.diag([2.0, 5.0])) == found.measurement.R


@pytest.mark.parametrize("merge", [ConnectedMerge(5.1), NeighbourhoodMerge()])
def test_detections_that_say_in_different_ways_where_they_are_merge_into_the_first(
    merge: Merge,
) -> None:
    both = SensorModel(
        std={"x_m": 0.3, "y_m": 0.3, "range_m": 0.5, "bearing_rad": 0.02}
    )
    items = (
        Detection(range_m=20.0, bearing_rad=0.0),
        Detection(x_m=20.0, y_m=0.5, bearing_rad=0.0),
    )
    [found] = candidates(*items, sensor=both, merge=merge)
    assert (found.leader, found.merged) == (0, (1,))
    assert found.values == {"range_m": 20.0, "bearing_rad": 0.0}


def test_a_yaw_that_the_map_gave_is_assumed_and_one_that_was_measured_is_not() -> None:
    point, known = (
        Detection(x_m=10.0, y_m=3.0),
        Detection(x_m=10.0, y_m=3.0, yaw_rad=0.1),
    )
    both = replace(LIDAR, yaw_from_map_std_rad=0.35)
    assert candidates(point, sensor=POINTS, road=StraightRoad())[
        0
    ].measurement.assumed == ("yaw_rad",)
    assert candidates(known, sensor=POINTS, road=StraightRoad())[
        0
    ].measurement.assumed == ("yaw_rad",)
    assert candidates(point, sensor=both, road=StraightRoad())[
        0
    ].measurement.assumed == ("yaw_rad",)
    assert (
        candidates(known, sensor=both, road=StraightRoad())[0].measurement.assumed == ()
    )
    assert candidates(point, sensor=POINTS)[0].measurement.assumed == ()
    [merged] = candidates(
        known, point, sensor=both, road=StraightRoad(), merge=ConnectedMerge(5.1)
    )
    assert merged.measurement.assumed == ("yaw_rad",)


def test_a_curvature_from_the_map_is_assumed_and_turns_the_state() -> None:
    """Beside what was measured; a bearing alone has no place on the map."""
    curved = replace(POINTS, curvature_from_map_std_radpm=0.002)
    [found] = candidates(
        Detection(x_m=10.0, y_m=3.0),
        sensor=curved,
        road=StraightRoad(curvature_radpm=0.01),
    )
    measurement = found.measurement
    assert measurement.model.components == ("x_m", "y_m", "yaw_rad", "curvature_radpm")
    assert measurement.assumed == ("yaw_rad", "curvature_radpm")
    assert found.values["curvature_radpm"] == measurement.z[3] == 0.01
    assert measurement.R[3, 3] == pytest.approx(0.002**2)
    assert candidates(Detection(x_m=10.0, y_m=3.0), sensor=curved)[
        0
    ].measurement.model.components == ("x_m", "y_m")
    seen = SensorModel(std={"bearing_rad": 0.02}, curvature_from_map_std_radpm=0.002)
    [bearing] = candidates(
        Detection(bearing_rad=0.1), sensor=seen, road=StraightRoad(), frame="sensor"
    )
    assert bearing.measurement.model.components == ("bearing_rad",)


@pytest.mark.parametrize("frame", ["sensor", "ego", "map"])
def test_noise_grows_along_and_across_the_line_of_sight(frame: Frame) -> None:
    sensor = replace(
        LIDAR, std={"x_m": 0.3, "y_m": 0.1}, std_growth={"x_m": 0.01, "y_m": 0.02}
    )
    [found] = candidates(Detection(x_m=40.0, y_m=30.0), sensor=sensor, frame=frame)
    pose = found.measurement.pose
    offset_m = found.position_m - np.array([pose.x_m, pose.y_m])
    range_m, turn = np.hypot(*offset_m), rotation(math.atan2(offset_m[1], offset_m[0]))
    expected = np.diag([0.3**2 + (0.01 * range_m) ** 2, 0.1**2 + (0.02 * range_m) ** 2])
    np.testing.assert_allclose(
        turn.T @ found.measurement.R @ turn, expected, atol=1e-12
    )


def test_noise_of_range_and_bearing_grows_too_and_a_covariance_of_its_own_does_not() -> (
    None
):
    polar = replace(POLAR, std_growth={"range_m": 0.03})
    [found] = candidates(
        Detection(range_m=50.0, bearing_rad=0.1), sensor=polar, frame="sensor"
    )
    np.testing.assert_allclose(np.diag(found.measurement.R), [0.5**2 + 1.5**2, 0.02**2])
    own = replace(POINTS, std_growth={"x_m": 0.1, "y_m": 0.1})
    [kept] = candidates(
        Detection(x_m=50.0, y_m=0.0, covariance=(0.04, 0.0, 0.0, 0.04)), sensor=own
    )
    np.testing.assert_allclose(kept.measurement.R, 0.04 * np.eye(2), atol=1e-12)
    [bearing] = candidates(
        Detection(bearing_rad=0.1),
        sensor=replace(polar, std_growth={"bearing_rad": 0.1}),
    )
    np.testing.assert_allclose(
        bearing.measurement.R, [[0.02**2]]
    )  # how far it is, is not known


# --- errors of stamps


@pytest.mark.parametrize(
    "names", [("x_m", "y_m"), ("range_m", "bearing_rad", "range_rate_mps")]
)
def test_the_error_of_a_stamp_moves_an_object_by_its_velocity(
    names: tuple[str, ...],
) -> None:
    motion, pose, std_s = CTRV(), SensorPose(5.0, -3.0, 0.3, 10.0, 1.0), 0.02
    model, x, P = (
        measurement_model(names, motion),
        np.array([40.0, 20.0, 0.7, 30.0, 0.2]),
        np.diag([1.0, 2, 0.1, 3, 0.2]),
    )

    def rate(state: FloatArray) -> FloatArray:
        ahead, behind = (
            model.predict(motion.predict(state, dt_s), pose) for dt_s in (1e-4, -1e-4)
        )
        return model.residual(ahead, behind) / 2e-4

    D = np.stack(
        [(rate(x + step) - rate(x - step)) / 2e-3 for step in 1e-3 * np.eye(5)], axis=-1
    )
    [found] = StampError(motion, std_s).noise(model, pose, x[None], P[None])
    v = rate(x)
    np.testing.assert_allclose(
        found, std_s**2 * (np.outer(v, v) + D @ P @ D.T), rtol=1e-4
    )


# --- several batches


def test_batches_in_one_pass_give_what_each_gives_alone() -> None:
    step = Preprocess(
        StraightRoad(half_width_m=500.0),
        ConnectedMerge(distance_m=3.0),
        CTRV(),
        ORIGIN_M,
    )
    points = [Detection(x_m=x_m, y_m=0.0) for x_m in (10.0, 11.0, 900.0)]
    seen = [
        Detection(range_m=20.0, bearing_rad=0.1),
        Detection(bearing_rad=0.2),
        Detection(range_m=900.0),
    ]
    bearings = replace(POLAR, max_range_m=50.0, near_side_m=0.5)
    posed = [
        step.posed(batch(*points), POINTS, EGO),
        step.posed(batch(frame="sensor"), POLAR, EGO),
        step.posed(batch(*seen, frame="sensor"), bearings, EGO),
        step.posed(batch(*points[:1], frame="map"), LIDAR, None),
    ]
    together = step.together(posed)
    alone = [step(each.batch, each.sensor, each.ego) for each in posed]
    assert [records for _, records in together] == [records for _, records in alone]
    assert [len(found) for found, _ in together] == [1, 0, 3, 1]
    for (found, _), (expected, _) in zip(together, alone, strict=True):
        assert found.leaders == expected.leaders
        assert found.merged == expected.merged
        np.testing.assert_array_equal(found.lines, expected.lines)
        for item, other in zip(found, expected, strict=True):
            assert item.values == other.values
            np.testing.assert_array_equal(item.measurement.R, other.measurement.R)
