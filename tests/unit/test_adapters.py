import math
from dataclasses import replace
from types import SimpleNamespace as Message

import numpy as np
import pytest
from support.messages import tilted

from fgtrack.core.types import Detection
from fgtrack.inputs.formats import ADAPTERS
from fgtrack.inputs.formats.common import object_id, yaw_rad
from fgtrack.inputs.formats.fields import FieldError, ego_by_fields, objects_by_fields
from fgtrack.inputs.formats.objects import ego_from_odometry
from fgtrack.inputs.settings import Field, Filter


def xyz(x=0.0, y=0.0, z=0.0):
    return Message(x=x, y=y, z=z)


def quaternion(yaw=None, norm=1.0):
    w, x, y, z = (0.0,) * 4 if yaw is None else norm * tilted(yaw)
    return Message(x=x, y=y, z=z, w=w)


def pose(x, y, yaw=None):
    return Message(position=xyz(x, y), orientation=quaternion(yaw))


def header(stamp_ns=1_500_000_002, frame_id="base_link"):
    return Message(
        stamp=Message(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9),
        frame_id=frame_id,
    )


def square(size, **cells):
    """Row-major covariance of a 6 x 6 matrix; `c05=2.0` sets row 0, column 5, and its mirror."""
    values = [0.0] * (size * size)
    for name, value in cells.items():
        row, column = int(name[1]), int(name[2])
        values[row * size + column] = values[column * size + row] = value
    return values


POSE_COVARIANCE = square(6, c00=1.0, c11=2.0, c55=3.0, c01=0.1, c05=0.2, c15=0.3)
XY_YAW = (1.0, 0.1, 0.2, 0.1, 2.0, 0.3, 0.2, 0.3, 3.0)


def read(name, message):
    return ADAPTERS.load(name)(message)


def autoware():
    kinematics = Message(
        pose_with_covariance=Message(
            pose=pose(1.0, 2.0, 0.5), covariance=POSE_COVARIANCE
        ),
        has_position_covariance=True,
        orientation_availability=2,
        twist_with_covariance=Message(
            twist=Message(linear=xyz(-3.0)), covariance=square(6, c00=0.25)
        ),
        has_twist=True,
        has_twist_covariance=True,
    )
    shape = Message(dimensions=xyz(4.5, 1.9, 1.6))
    labels = [Message(label=2, probability=0.2), Message(label=1, probability=0.7)]
    item = Message(
        kinematics=kinematics,
        shape=shape,
        existence_probability=0.9,
        classification=labels,
    )
    return Message(header=header(), objects=[item])


@pytest.mark.parametrize(
    "package", ["autoware_perception_msgs", "autoware_auto_perception_msgs"]
)
def test_autoware_gives_pose_and_a_speed_with_the_sign_of_the_forward_axis(package):
    found = read(f"{package}/msg/DetectedObjects", autoware())
    (item,) = found.objects
    assert (found.stamp_ns, found.frame) == (1_500_000_002, "ego")
    assert (item.x_m, item.y_m, item.speed_mps) == (1.0, 2.0, -3.0)
    assert item.yaw_rad == pytest.approx(0.5)
    assert item.covariance[10:] == (3.0, 0.0, 0.0, 0.0, 0.0, 0.25)
    assert (item.length_m, item.width_m, item.height_m, item.z_m) == (
        4.5,
        1.9,
        1.6,
        0.0,
    )
    assert (item.score, item.class_name) == (0.9, "car")


@pytest.mark.parametrize(
    "package", ["autoware_perception_msgs", "autoware_auto_perception_msgs"]
)
def test_tracked_objects_are_read_as_detected_ones_with_their_id(package):
    message = autoware()
    tracked = message.objects[0]
    for name in ("has_position_covariance", "has_twist", "has_twist_covariance"):
        delattr(tracked.kinematics, name)
    tracked.object_id = Message(uuid=[5] + [0] * 15)
    (found,) = read(f"{package}/msg/TrackedObjects", message).objects
    (expected,) = read(f"{package}/msg/DetectedObjects", autoware()).objects
    assert found == replace(expected, object_id=5)


def test_a_delphi_esr_counts_degrees_clockwise():
    track = Message(
        header=header(),
        status=3,
        range=50.0,
        angle=90.0,
        range_rate=-2.0,
        id=7,
        width=0.0,
    )
    (found,) = read("delphi_esr_msgs/msg/EsrTrack", track).objects
    bearing_rad = pytest.approx(-0.5 * math.pi)
    assert found == Detection(
        range_m=50.0, bearing_rad=bearing_rad, range_rate_mps=-2.0, object_id=7
    )
    track.width = 0.8
    assert read("delphi_esr_msgs/msg/EsrTrack", track).objects[0].width_m == 0.8
    track.status = 0
    assert read("delphi_esr_msgs/msg/EsrTrack", track).objects == ()


@pytest.mark.parametrize(
    ("changes", "values"),
    [
        ({"orientation_availability": 0}, (None, 3.0, 9)),
        ({"orientation_availability": 1}, (None, 3.0, 9)),
        ({"has_twist": False}, (0.5, None, 9)),
        ({"has_position_covariance": False}, (0.5, -3.0, 0)),
        (
            {"has_twist_covariance": False},
            (0.5, -3.0, 0),
        ),  # it would not cover the speed
    ],
)
def test_what_autoware_marks_as_absent_is_absent(changes, values):
    message = autoware()
    vars(message.objects[0].kinematics).update(changes)
    (item,) = read("autoware_perception_msgs/msg/DetectedObjects", message).objects
    assert (item.yaw_rad, item.speed_mps, len(item.covariance or ())) == pytest.approx(
        values
    )


def vision(size=1.0, results=True, **identity):
    kind = Message(class_id="car", score=0.7)
    covariance = Message(
        hypothesis=kind,
        pose=Message(pose=pose(5.0, 6.0, -1.0), covariance=POSE_COVARIANCE),
    )
    box = Message(center=pose(1.0, 2.0, 0.5), size=xyz(size, size, size))
    item = Message(
        header=header(0), results=[covariance] if results else [], bbox=box, **identity
    )
    return Message(header=header(frame_id="/map"), detections=[item])


@pytest.mark.parametrize(
    ("identity", "object_id"),
    [
        ({"id": "12"}, 12),
        ({"id": ""}, None),
        ({"id": "car"}, object_id("car")),
        ({"tracking_id": "4"}, 4),
        ({}, None),
    ],
)
def test_vision_detections_of_every_version_give_pose_covariance_and_id(
    identity, object_id
):
    found = read("vision_msgs/msg/Detection3DArray", vision(**identity))
    (item,) = found.objects
    assert found.frame == "map"
    assert (item.x_m, item.y_m, item.object_id, item.stamp_ns) == (
        1.0,
        2.0,
        object_id,
        None,
    )
    assert (item.class_name, item.score) == ("car", 0.7)
    assert item.covariance == XY_YAW


def test_a_box_without_size_leaves_the_pose_to_the_hypothesis():
    (item,) = read("vision_msgs/msg/Detection3DArray", vision(size=0.0)).objects
    assert (item.x_m, item.y_m) == (5.0, 6.0)
    (item,) = read(
        "vision_msgs/msg/Detection3DArray", vision(size=0.0, results=False)
    ).objects
    assert (item.x_m, item.covariance) == (1.0, None)


def test_a_radar_track_has_a_speed_without_sign_and_no_yaw():
    item = Message(
        uuid=Message(uuid=[3] + [0] * 15),
        position=xyz(1.0, 2.0),
        velocity=xyz(-3.0, 4.0),
        position_covariance=[1.0, 0.1, 0.0, 2.0, 0.0, 0.0],
        size=xyz(4.0, 2.0, 1.5),
        velocity_covariance=[1.0, 0.5, 0.0, 2.0, 0.0, 0.0],
    )
    (found,) = read(
        "radar_msgs/msg/RadarTracks", Message(header=header(), tracks=[item])
    ).objects
    assert (found.speed_mps, found.yaw_rad, found.object_id) == (5.0, None, 3)
    assert (found.length_m, found.width_m, found.height_m) == (4.0, 2.0, 1.5)
    assert found.covariance == pytest.approx(
        (1.0, 0.1, 0.0, 0.1, 2.0, 0.0, 0.0, 0.0, 1.16)
    )


def test_a_pose_array_keeps_every_pose_with_and_without_an_orientation():
    message = Message(header=header(), poses=[pose(1.0, 2.0, 0.5), pose(math.nan, 2.0)])
    first, second = read("geometry_msgs/msg/PoseArray", message).objects
    assert first.yaw_rad == pytest.approx(0.5)
    assert second.yaw_rad is None
    assert math.isnan(second.x_m)


def test_the_yaw_of_a_quaternion_does_not_depend_on_its_norm():
    assert yaw_rad(quaternion(-2.0, norm=7.0)) == pytest.approx(-2.0)
    assert yaw_rad(quaternion()) is None
    assert math.isnan(yaw_rad(Message(x=math.nan, y=0.0, z=0.0, w=1.0)))


def test_paths_read_vectors_quaternions_and_the_stamps_of_objects():
    item = Message(
        p=pose(1.0, 2.0, 0.5), v=[3.0, 4.0], vel=xyz(3.0, 4.0), t=2.5, number=4
    )
    message = Message(header=header(frame_id="odom"), tracks=[item])
    fields = {
        "objects": "tracks",
        "x_m": "p.position.x",
        "yaw_rad": "p.orientation",
        "speed_mps": ["vel.x", "vel.y"],
        "object_stamp": "t",
        "object_id": "number",
    }
    found = objects_by_fields(message, fields)
    assert (found.stamp_ns, found.frame) == (1_500_000_002, "map")
    assert found.objects == (
        Detection(
            x_m=1.0,
            yaw_rad=pytest.approx(0.5),
            speed_mps=5.0,
            stamp_ns=2_500_000_000,
            object_id=4,
        ),
    )


def test_a_message_without_a_list_is_one_object_and_without_a_header_has_no_stamp():
    message = Message(a=1, b=2.0, at=Message(sec=1, nanosec=2))
    found = objects_by_fields(message, {"x_m": "a", "y_m": "b"})
    assert (found.stamp_ns, found.frame, found.objects) == (
        None,
        None,
        (Detection(x_m=1.0, y_m=2.0),),
    )
    assert (
        objects_by_fields(message, {"x_m": "a", "stamp": "at"}).stamp_ns
        == 1_000_000_002
    )


@pytest.mark.parametrize(
    ("fields", "complaint"),
    [
        ({"x_m": "a.b"}, r"^a\.b: there is no field 'b'; there are no fields$"),
        ({"x_m": "text"}, "^text: 'far' is not a number$"),
        (
            {"objects": "a", "x_m": "a"},
            "^a: is not a list of objects, give the path of a list$",
        ),
        ({"class_name": ["a", "text"]}, "a single field is needed"),
    ],
)
def test_a_path_that_does_not_lead_to_a_value_is_named(fields, complaint):
    with pytest.raises(FieldError, match=complaint):
        objects_by_fields(Message(a=1, text="far"), fields)


def test_the_ego_is_read_by_paths():
    fields = {
        "x_m": "x",
        "y_m": "y",
        "yaw_rad": "q",
        "speed_mps": "v",
        "in_pit": "pit",
        "stamp": "ns",
    }
    state = ego_by_fields(
        Message(x=1, y=2, q=quaternion(), v=3, pit=1, ns=5), fields, 9
    )
    assert (state.stamp_ns, state.receipt_ns, state.in_pit) == (5, 9, True)
    assert math.isnan(state.yaw_rad)


# --- the covariance of odometry


def uncertain_odometry(
    vx=3.0, vy=0.0, pose_covariance=(0.0,) * 36, twist_covariance=(0.0,) * 36
):
    return Message(
        header=header(),
        pose=Message(pose=pose(1.0, 2.0, 0.5), covariance=pose_covariance),
        twist=Message(
            twist=Message(linear=xyz(vx, vy), angular=xyz(z=0.2)),
            covariance=twist_covariance,
        ),
    )


def covariance_of(*values):
    return np.reshape(
        ego_from_odometry(uncertain_odometry(*values), 7).covariance, (5, 5)
    )


TWIST_COVARIANCE = square(6, c00=0.25, c11=0.16, c55=0.01, c05=0.02)


def test_odometry_is_an_ego_or_an_object_with_a_speed_along_its_heading():
    message = uncertain_odometry(-3.0, 0.0, POSE_COVARIANCE, TWIST_COVARIANCE)
    ego = ego_from_odometry(message, 7)
    values = (1.0, 2.0, pytest.approx(0.5), -3.0)
    assert (ego.stamp_ns, ego.receipt_ns, ego.yaw_rate_radps) == (1_500_000_002, 7, 0.2)
    found = read("nav_msgs/msg/Odometry", message)
    (item,) = found.objects
    assert (found.stamp_ns, found.frame) == (1_500_000_002, "ego")
    assert [
        (each.x_m, each.y_m, each.yaw_rad, each.speed_mps) for each in (ego, item)
    ] == [values] * 2
    assert item.covariance == (
        *XY_YAW[:3],
        0.0,
        *XY_YAW[3:6],
        0.0,
        *XY_YAW[6:],
        0.0,
        0.0,
        0.0,
        0.0,
        0.25,
    )


def test_odometry_gives_the_covariance_of_pose_speed_and_yaw_rate():
    found = covariance_of(0.0, 0.0, POSE_COVARIANCE, TWIST_COVARIANCE)
    expected = np.zeros((5, 5))
    expected[:3, :3] = [[1.0, 0.1, 0.2], [0.1, 2.0, 0.3], [0.2, 0.3, 3.0]]
    expected[3:, 3:] = [[0.25, 0.02], [0.02, 0.01]]
    np.testing.assert_allclose(found, expected)


@pytest.mark.parametrize(("vx", "vy"), [(3.0, 4.0), (-3.0, 4.0)])
def test_the_variance_of_the_speed_is_that_along_the_velocity(vx, vy):
    found = covariance_of(vx, vy, POSE_COVARIANCE, TWIST_COVARIANCE)
    assert found[3, 3] == pytest.approx(0.36 * 0.25 + 0.64 * 0.16)
    assert found[3, 4] == pytest.approx(
        0.6 * 0.02
    )  # backwards, both the speed and vx are negative


@pytest.mark.parametrize("velocity", [math.inf, 1e308, math.nan])
def test_a_velocity_or_covariance_without_limits_is_read_without_a_warning(velocity):
    message = uncertain_odometry(
        velocity, velocity, POSE_COVARIANCE, square(6, c00=1e308, c11=math.inf, c55=1.0)
    )
    assert ego_from_odometry(message, 7).covariance[0] == 1.0
    (item,) = read("nav_msgs/msg/Odometry", message).objects
    assert not math.isfinite(item.covariance[-1])


@pytest.mark.parametrize(
    "unknown",
    [
        (0.0,) * 36,
        (-1.0, *(0.0,) * 35),
        (math.nan, *(1.0,) * 35),
        square(6, c00=1.0, c11=1.0, c55=1e3),
        square(6, c00=1.0, c11=1.0),
        square(6, c00=1.0, c11=1.0, c55=-math.inf),
        square(6, c00=1.0, c11=1.0, c55=1e-3, c01=math.inf),
    ],
)
def test_a_part_that_is_not_known_is_zero_and_nothing_at_all_is_none(unknown):
    both = ego_from_odometry(
        uncertain_odometry(pose_covariance=unknown, twist_covariance=unknown), 7
    )
    assert both.covariance is None
    pose_alone = covariance_of(3.0, 0.0, POSE_COVARIANCE, unknown)
    assert pose_alone[0, 0] == 1.0
    assert not pose_alone[3:].any()


def test_a_field_is_scaled_shifted_and_turned_into_radians():
    """A compass heading of 350 degrees is a yaw of -260, or 100; a sign is a scale."""
    message = Message(angle=350.0, side=2.0, kmh=36.0, bare=7)
    fields = {
        "x_m": "bare",
        "y_m": Field("side", scale=-1.0, offset=0.5),
        "yaw_rad": Field("angle", scale=-1.0, offset=90.0, degrees=True),
        "speed_mps": Field("kmh", scale=1 / 3.6),
    }
    (found,) = objects_by_fields(message, fields).objects
    assert (found.x_m, found.y_m, found.speed_mps) == (7.0, -1.5, pytest.approx(10.0))
    assert found.yaw_rad == pytest.approx(math.radians(100.0))
    for angle, expected in (
        (8.4, 9.4 - 2.0 * math.pi),
        (8.5, 9.5),
    ):  # more than 1.5 turns may be degrees
        (item,) = objects_by_fields(
            Message(angle=angle), {"yaw_rad": Field("angle", offset=1.0)}
        ).objects
        assert item.yaw_rad == pytest.approx(expected)
    ego = ego_by_fields(
        message, fields | {"yaw_rate_radps": Field("angle", degrees=True)}, 5
    )
    assert (ego.yaw_rad, ego.yaw_rate_radps) == pytest.approx(
        (math.radians(100.0), math.radians(350.0))
    )


def test_what_describes_an_object_is_read_by_paths_and_places_in_lists():
    item = Message(results=[Message(name="bus", p=0.7)], dims=[12.0, 2.5], tag="bus-12")
    fields = {
        "class_name": "results.0.name",
        "score": "results.0.p",
        "length_m": "dims.0",
        "width_m": "dims.1",
        "object_id": "tag",
    }
    (found,) = objects_by_fields(item, fields).objects
    assert found == Detection(
        class_name="bus",
        score=0.7,
        length_m=12.0,
        width_m=2.5,
        object_id=object_id("bus-12"),
    )
    with pytest.raises(FieldError, match=r"results\.1\.name: there is no field '1'"):
        objects_by_fields(item, {"class_name": "results.1.name"})


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (7, 7),
        ("7", 7),
        (" -7 ", -7),
        ("", None),
        ("9223372036854775807", (1 << 63) - 1),
    ],
)
def test_an_id_that_is_an_integer_stays_it(given, expected):
    assert object_id(given) == expected


def test_any_other_id_is_a_number_that_is_always_the_same():
    names = [
        "car",
        "car ",
        "Car",
        "7a",
        "9223372036854775808",
        "１",
        "fd8420396768425eabec9bdddf7e64b6",
    ]
    numbers = [object_id(name) for name in names]
    assert numbers[0] == numbers[1] == 276_895_352_868_199
    assert len({*numbers}) == len(names) - 1
    assert all(0 < number < 1 << 48 for number in numbers)


@pytest.mark.parametrize(
    ("given", "passing"),
    [
        (Filter(min=2.0), [2, 2.5]),
        (Filter(max=2.0), [-1.0, 2]),
        (Filter(min=0.0, max=2.0), [2]),
        (Filter(one_of=(2, "car")), [2, "car"]),
        (Filter(none_of=(2, "car")), [-1.0, 2.5, None, math.nan]),
        (Filter(), [-1.0, 2, 2.5, "car", None, math.nan]),
    ],
)
def test_a_filter_lets_pass_what_it_says(given, passing):
    values = [-1.0, 2, 2.5, "car", None, math.nan]
    assert [value for value in values if given.passes(value)] == passing


def test_a_filter_that_nothing_can_pass_is_refused():
    with pytest.raises(ValueError, match=r"min: is 2.0, must be at most max = 1.0"):
        Filter(min=2.0, max=1.0)
