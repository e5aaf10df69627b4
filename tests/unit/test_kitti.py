import math
from pathlib import Path

import numpy as np
import pytest
from support.kitti import (
    CENTRE_PX,
    FOCAL_PX,
    RECTIFIED_FROM_IMU,
    box,
    calibration,
    folder,
    label,
    oxts,
    pose,
)

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.types import Detection, DetectionList, EgoState, Message, TruthState
from fgtrack.inputs.formats.kitti_view import Box
from fgtrack.inputs.settings import InputConfig, KittiInput
from fgtrack.inputs.source import open_input


def messages(path: Path, **settings: object) -> list[Message]:
    return list(open_input(path, InputConfig(kitti=KittiInput(**settings))).messages())


def lists(path: Path, **settings: object) -> list[DetectionList]:
    return [
        item for item in messages(path, **settings) if isinstance(item, DetectionList)
    ]


def test_a_frame_gives_truth_ego_and_the_detections_of_every_folder(tmp_path):
    drive = folder(
        tmp_path,
        oxts=[oxts(), oxts()],
        label_02=[label(1, 5, "Car", 10.0, 0.0, 0.0)],
        camera=[box(1, 590.0, 610.0)],
        laser=[pose(0, 10.0, 0.0, 0.0)],
    )
    found = [
        (type(item).__name__, item.stamp_ns, getattr(item, "sensor", ""))
        for item in messages(drive)
    ]
    assert found == [
        ("EgoState", 0, ""),
        ("DetectionList", 0, "camera"),
        ("DetectionList", 0, "laser"),
        ("TruthState", 103_600_000, ""),
        ("EgoState", 103_600_000, ""),
        ("DetectionList", 103_600_000, "camera"),
        ("DetectionList", 103_600_000, "laser"),
    ]
    assert [(item.frame, len(item.objects)) for item in lists(drive)] == [
        ("sensor", 0),
        ("ego", 1),
        ("sensor", 1),
        ("ego", 0),
    ]
    assert all(item.receipt_ns == item.stamp_ns for item in messages(drive))


def test_a_box_in_space_is_a_position_and_a_yaw_in_the_ego_frame(tmp_path):
    (found,) = lists(folder(tmp_path, laser=[pose(0, 20.0, 3.0, 0.4)]))
    (detection,) = found.objects
    assert detection.measured == ("x_m", "y_m", "yaw_rad")
    assert (detection.x_m, detection.y_m, detection.yaw_rad) == pytest.approx(
        (20.0, 3.0, 0.4)
    )
    assert (detection.length_m, detection.width_m, detection.height_m) == (
        4.0,
        1.6,
        1.5,
    )
    assert detection.z_m == pytest.approx(-1.5 + 0.5 * 1.5)
    assert (detection.score, detection.class_name) == (9.0, "car")


def test_a_box_in_the_image_is_the_bearing_of_its_middle_from_the_camera(tmp_path):
    (found,) = lists(folder(tmp_path, camera=[box(0, 400.0, 460.0)]))
    assert found.objects == (
        Detection(bearing_rad=pytest.approx(math.atan2(170.0, FOCAL_PX)), score=1.0),
    )


def test_the_bearing_of_a_wide_box_is_less_certain(tmp_path):
    drive = folder(tmp_path, camera=[box(0, 590.0, 610.0), box(0, 550.0, 650.0)])
    (found,) = lists(drive, box_std=0.1)
    far, near = (math.sqrt(item.covariance[0]) for item in found.objects)
    assert (far, near) == pytest.approx(
        (0.1 * 2.0 * math.atan(10 / FOCAL_PX), 0.1 * 2.0 * math.atan(50 / FOCAL_PX))
    )


def test_roll_and_pitch_are_taken_out(tmp_path):
    """A point 10 m ahead of a unit that looks down by 0.1 rad is nearer; one to the left of a rolled unit too."""
    tilted, laser = (
        [oxts(pitch_rad=0.1), oxts(roll_rad=0.1)],
        [pose(0, 10.0, 0.0, 0.0), pose(1, 10.0, 4.0, 0.0)],
    )
    drive = folder(tmp_path, oxts=tilted, laser=laser)
    (pitched,), (rolled,) = (item.objects for item in lists(drive))
    assert (pitched.x_m, pitched.y_m) == pytest.approx(
        (10.0 * math.cos(0.1) - 1.5 * math.sin(0.1), 0.0)
    )
    assert (rolled.x_m, rolled.y_m) == pytest.approx(
        (10.0, 4.0 * math.cos(0.1) + 1.5 * math.sin(0.1))
    )


def test_the_map_begins_at_the_first_frame_with_x_to_the_east(tmp_path):
    metre_deg = math.degrees(1.0 / 6_378_137.0)
    drive = folder(
        tmp_path,
        oxts=[
            oxts(yaw_rad=3.0),
            oxts(
                100.0 * metre_deg,
                50.0 * metre_deg / math.cos(math.radians(49.0)),
                0.0,
                0.0,
                3.5,
                8.0,
                0.2,
                -1.0,
            ),
        ],
        label_02=[
            label(0, 3, "Car", 10.0, 0.0, 0.3),
            label(0, 4, "Tram", 10.0, 0.0, 0.3),
        ],
    )
    truth, first, second = messages(drive)
    assert first == EgoState(0, 0, 0.0, 0.0, 3.0, 0.0, 0.0, 0.0)
    assert isinstance(second, EgoState)
    assert (second.x_m, second.y_m) == pytest.approx((50.0, 100.0), abs=0.01)
    assert second.yaw_rad == pytest.approx(3.5 - 2.0 * math.pi)
    assert (second.speed_mps, second.yaw_rate_radps, second.accel_mps2) == (
        8.0,
        0.2,
        -1.0,
    )
    assert isinstance(truth, TruthState)
    assert truth.object_id == 3
    assert (truth.x_m, truth.y_m) == pytest.approx(
        (10.0 * math.cos(3.0), 10.0 * math.sin(3.0))
    )
    assert truth.yaw_rad == pytest.approx(3.3 - 2.0 * math.pi)


def test_truth_does_not_step_with_the_reported_position(tmp_path):
    """A parked car, seen from an ego at 10 m/s that reports 0.58 m more from the tenth frame on."""
    metre_deg = math.degrees(1.0 / 6_378_137.0)
    at_m = [1.036 * k for k in range(20)]
    reported_m = [x_m + 0.58 * (k >= 10) for k, x_m in enumerate(at_m)]
    egos = [
        oxts(x_m * metre_deg, yaw_rad=0.5 * math.pi, speed_mps=10.0)
        for x_m in reported_m
    ]
    labels = [label(k, 1, "Car", 50.0 - x_m, 0.0, 0.0) for k, x_m in enumerate(at_m)]
    received = messages(folder(tmp_path, oxts=egos, label_02=labels))
    states = [item for item in received if isinstance(item, EgoState)]
    assert [state.y_m for state in states] == pytest.approx(reported_m, abs=0.01)
    parked_m = [item.y_m for item in received if isinstance(item, TruthState)]
    assert parked_m == pytest.approx([50.0] * 20, abs=0.06)


def test_a_neighbouring_class_and_regions_are_ignored(tmp_path):
    """The region spans 20 px around the middle and 14 px high: a car of 1.5 m is half inside it from 37.5 m on."""
    region = f"0 -1 DontCare -1 -1 -10 {CENTRE_PX[0] - 10} 180 {CENTRE_PX[0] + 10} 194 -1 -1 -1 -1000 -1000 -1000 -10"
    labels = [
        label(0, 3, "Car", 10.0, 0.0, 0.3),
        label(0, 4, "Van", 20.0, 0.0, 0.3),
        region,
    ]
    car, van, dont_care, _ = messages(folder(tmp_path, label_02=labels))
    assert [item.ignored for item in (car, van, dont_care)] == [False, True, True]
    assert (van.object_id, van.outline_m) == (4, None)
    assert dont_care.object_id == -2
    corners = np.reshape(dont_care.outline_m, (4, 2))
    near, far = 0.75 * FOCAL_PX / 14.0, 150.0
    side_rad = math.atan2(10.0, FOCAL_PX)
    ahead = 2.0 + math.cos(side_rad) * np.array([near, near, far, far])
    aside = 0.5 + math.sin(side_rad) * np.array([near, -near, -far, far])
    assert corners == pytest.approx(np.column_stack([ahead, aside]))


def test_a_region_too_flat_to_hold_a_car_near_by_begins_at_half_of_the_distance_where_it_ends(
    tmp_path,
):
    """1 px high a car of 1.5 m is half inside it at 525 m, behind its end at 150 m."""
    region = f"0 -1 DontCare -1 -1 -10 {CENTRE_PX[0]} 180 {CENTRE_PX[0] + 10} 181 -1 -1 -1 -1000 -1000 -1000 -10"
    dont_care, *_ = messages(folder(tmp_path, label_02=[region]))
    distances_m = np.hypot(*(np.reshape(dont_care.outline_m, (4, 2)) - [2.0, 0.5]).T)
    assert distances_m == pytest.approx([75.0, 75.0, 150.0, 150.0])


KITTI = "0 7 Car 0 0 0.1 400 170 460 190 1.5 1.6 4.0"


@pytest.mark.parametrize(("score", "value"), [("", None), (" 0.8", 0.8)])
def test_results_in_the_form_of_the_data_set_are_detections(tmp_path, score, value):
    x_m, y_m, z_m = RECTIFIED_FROM_IMU @ [20.0, 3.0, -1.5, 1.0]
    line = f"{KITTI} {x_m} {y_m} {z_m} {-0.4 - 0.5 * math.pi}{score}"
    folder(tmp_path / "one", laser=[line, line.replace("Car", "Cyclist")])
    (found,) = lists(tmp_path / "one")
    (car,) = found.objects
    assert (car.x_m, car.y_m, car.yaw_rad) == pytest.approx((20.0, 3.0, 0.4))
    assert (car.length_m, car.score, car.class_name) == (4.0, value, "car")


@pytest.mark.parametrize(
    ("line", "score"),
    [
        (f"{KITTI} -1000 -1000 -1000 -10 0.8", 0.8),
        (f"{KITTI} -1000 -1000 -1000 -10", None),
        ("0,2,400,170,460,190,0.7,1.5,1.6,4.0,-1000,-1000,-1000,-10,0.1", 0.7),
    ],
)
def test_results_without_a_place_in_space_are_bearings(tmp_path, line, score):
    (found,) = lists(folder(tmp_path, camera=[line]))
    bearing_rad = pytest.approx(math.atan2(170.0, FOCAL_PX))
    assert (found.frame, found.objects) == (
        "sensor",
        (Detection(bearing_rad=bearing_rad, score=score, class_name="car"),),
    )
    with pytest.raises(
        DataError,
        match=r"camera: some boxes have a position, others only a box in the image",
    ):
        lists(folder(tmp_path, camera=[pose(0, 10.0, 0.0, 0.0), line]))


def test_classes_are_named(tmp_path):
    drive = folder(
        tmp_path,
        laser=[pose(0, 10.0, 0.0, 0.0, kind=1), pose(0, 20.0, 0.0, 0.0)],
        label_02=[
            label(0, 3, "Car", 10.0, 0.0, 0.3),
            label(0, 4, "Pedestrian", 20.0, 0.0, 0.3),
        ],
    )
    truth, _, found = messages(drive, classes=("Pedestrian",))
    assert (truth.object_id, [item.class_name for item in found.objects]) == (
        4,
        ["pedestrian"],
    )


def test_other_classes_low_scores_and_boxes_cut_off_are_left_out(tmp_path):
    drive = folder(
        tmp_path,
        laser=[
            pose(0, 10.0, 0.0, 0.0, kind=1),
            pose(0, 20.0, 0.0, 0.0, 1.0),
            pose(0, 30.0, 0.0, 0.0, 5.0),
        ],
        camera=[
            box(0, 0.5, 60.0),
            box(0, 1100.0, 1240.5),
            box(0, 300.0, 360.0, 0.5),
            box(0, 300.0, 360.0, 0.9),
        ],
    )
    camera, laser = lists(drive, min_score={"laser": 3.0, "camera": 0.9})
    assert [round(item.x_m) for item in laser.objects] == [30]
    assert laser.left_out == ("input.kitti.classes", "input.kitti.min_score")
    assert camera.left_out == (
        *["input.kitti.image_width_px"] * 2,
        "input.kitti.min_score",
    )
    assert len(camera.objects) == 1
    camera, laser = lists(drive, image_width_px=1300.0)
    assert (len(camera.objects), len(laser.objects)) == (3, 2)


@pytest.mark.parametrize(
    ("turned_rad", "expected"),
    [
        (0.0, (600 + 700 / 20.8, 180, 600 + 700 * 5 / 19.2, 180 + 700 * 1.5 / 19.2)),
        (
            0.5 * math.pi,
            (600 + 700 * 2.2 / 22, 180, 600 + 700 * 3.8 / 18, 180 + 700 * 1.5 / 18),
        ),
        (
            math.pi,
            (600 + 700 / 20.8, 180, 600 + 700 * 5 / 19.2, 180 + 700 * 1.5 / 19.2),
        ),
    ],
)
def test_a_box_in_the_image_is_the_hull_of_its_corners(turned_rad, expected):
    """1.5 m high, 1.6 m wide and 4 m long, 3 m to the right, 20 m ahead, with its roof at the height of the camera."""
    projection = np.array(
        [[700.0, 0.0, 600.0, 0.0], [0.0, 700.0, 180.0, 0.0], [0.0, 0.0, 1.0, 0.0]]
    )
    found = Box(1.5, 1.6, 4.0, 3.0, 1.5, 20.0, turned_rad)
    assert found.image_px(projection) == pytest.approx(expected)
    cut = found._replace(x_m=17.0).image_px(projection)
    assert cut == pytest.approx((cut[0], 180.0, 1241.0, expected[3]))
    assert found._replace(x_m=40.0).image_px(projection) is None
    assert found._replace(z_m=-20.0).image_px(projection) is None


def test_the_other_spellings_of_a_calibration_say_the_same(tmp_path):
    files = {"laser": [pose(0, 20.0, 3.0, 0.4)]}
    one = folder(tmp_path / "one", **files)
    spelt = calibration("R0_rect:", "Tr_velo_to_cam:", "Tr_imu_to_velo:")
    assert lists(folder(tmp_path / "other", calib=[spelt], **files)) == lists(one)


def test_an_input_is_a_folder_of_one_sequence_a_file_or_a_sequence_by_name(tmp_path):
    folder(tmp_path, "0001", laser=[pose(0, 10.0, 0.0, 0.0)])
    assert len(lists(tmp_path)) == 1
    folder(tmp_path, "0012", laser=[pose(0, 30.0, 0.0, 0.0)])
    assert (
        lists(tmp_path / "oxts/0012.txt")
        == lists(tmp_path, sequence=12)
        == lists(tmp_path, sequence="0012")
    )
    with pytest.raises(
        CallError, match=r"contains the sequences 0001, 0012: set .*oxts/0001\.txt"
    ):
        open_input(tmp_path)
    with pytest.raises(CallError, match="contains the sequences 0001, 0012: set"):
        messages(tmp_path, sequence=7)


def _with_zeros(name):
    """A calibration in which all numbers of a matrix are 0."""
    lines = calibration().splitlines()
    return "\n".join(
        f"{name}: {' '.join(['0'] * (len(line.split()) - 1))}"
        if line.startswith(name)
        else line
        for line in lines
    )


@pytest.mark.parametrize(
    ("files", "where"),
    [
        ({"oxts": ["1 2 3"]}, r"oxts/0001\.txt:1: "),
        ({"oxts": [oxts(yaw_rad=math.inf)]}, r"oxts/0001\.txt:1: "),
        ({"calib": ["P2: 1 2 x"]}, r"calib/0001\.txt:1: "),
        ({"calib": ["P2: 1 2 3"]}, r"calib/0001\.txt: "),
        (
            {"calib": [calibration().replace("P2: ", "P2: nan ", 1)]},
            r"calib/0001\.txt:3: .*not finite",
        ),
        (
            {"calib": [calibration().replace("P2: ", "P2: 1e300 ", 1)]},
            r"calib/0001\.txt:3: .*too large",
        ),
        (
            {"calib": [_with_zeros("P2")]},
            r"calib/0001\.txt: is not a calibration .*P2 is singular",
        ),
        (
            {"calib": [_with_zeros("R_rect")]},
            r"calib/0001\.txt: is not a calibration .*Tr is singular",
        ),
        (
            {"laser": [pose(0, 1.0, 2.0, 0.0), "0,2,3"]},
            r"laser/0001\.txt:2: .*3 fields",
        ),
        ({"laser": ["car"]}, r"laser/0001\.txt:1: "),
        (
            {"laser": [pose(7, 1.0, 2.0, 0.0)]},
            r"laser/0001\.txt:1: .*frame 7 does not exist",
        ),
        ({"label_02": ["0 1 Car 0 0"]}, r"label_02/0001\.txt:1: "),
    ],
)
def test_a_damaged_file_is_one_line_that_names_it(tmp_path, files, where):
    drive = folder(tmp_path, **files)
    with pytest.raises(DataError, match=where) as caught:
        messages(drive)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("file", "line", "broken", "end"),
    [
        ("laser", 3, pose(2, 11.0, 0.0, 0.0)[:20], 2),
        (
            "laser",
            3,
            "",
            1,
        ),  # a line without a frame may belong to that of the line above
        ("laser", 1, "", 0),
        ("label_02", 3, "2 5 Car 0", 2),
        ("oxts", 3, oxts()[:40], 2),
    ],
)
def test_a_sequence_is_read_up_to_the_frame_of_a_damaged_line(
    tmp_path, file, line, broken, end
):
    files = {
        "oxts": [oxts()] * 4,
        "label_02": [label(frame, 5, "Car", 10.0, 0.0, 0.0) for frame in range(4)],
        "laser": [pose(frame, 10.0, 0.0, 0.0) for frame in range(4)],
    }
    intact = messages(folder(tmp_path / "intact", **files))
    files[file][line - 1] = broken
    received = []
    with pytest.raises(DataError, match=rf"{file}/0001\.txt:{line}: "):
        received.extend(open_input(folder(tmp_path / "damaged", **files)).messages())
    assert received == [item for item in intact if item.stamp_ns < end * 103_600_000]


def test_what_is_not_finite_in_a_detection_is_left_to_the_tracker_without_a_warning(
    tmp_path,
):
    whole = pose(0, 10.0, 0.0, 0.0)
    cells = whole.split(",")
    lines = [",".join([*cells[:10], bad, *cells[11:]]) for bad in ("inf", "nan")] + [
        whole
    ]
    (found,) = lists(folder(tmp_path, laser=lines))
    assert [math.isfinite(item.x_m + item.y_m) for item in found.objects] == [
        False,
        False,
        True,
    ]
