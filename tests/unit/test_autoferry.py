import json
import math

import pytest

from fgtrack.core.errors import DataError
from fgtrack.core.types import Detection, DetectionList, TruthState
from fgtrack.inputs.source import open_input


def record(sensor: int, time_text: str, measurement: object) -> str:
    return (
        f'{{"sensorID": {sensor}, "measurements": [], "ownshipPosition": [10.0, 20.0], '
        f'"time": {time_text}, "measurement": {json.dumps(measurement)}}}'
    )


def scenario(folder, *records: str, truth: object = None):
    (folder / "scenario9_detections.json").write_text(f"[{','.join(records)}]")
    if truth is not None:
        (folder / "scenario9_groundTruth.json").write_text(json.dumps(truth))
    return folder


def lists(folder) -> list[DetectionList]:
    return [
        item
        for item in open_input(folder).messages()
        if isinstance(item, DetectionList)
    ]


@pytest.mark.parametrize(
    ("measurement", "points"),
    [
        (
            [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]],
            [(24.0, 11.0), (25.0, 12.0), (26.0, 13.0)],
        ),
        ([[1.0, 2.0], [4.0, 5.0]], [(24.0, 11.0), (25.0, 12.0)]),
        ([1.0, 4.0], [(24.0, 11.0)]),
        ([[1.0], [4.0]], [(24.0, 11.0)]),
        ([], []),
    ],
)
def test_points_get_the_own_ship_and_become_east_and_north(
    tmp_path, measurement, points
):
    (message,) = lists(scenario(tmp_path, record(1, "1.0", measurement)))
    assert (message.sensor, message.frame) == ("lidar", "map")
    assert [(item.x_m, item.y_m) for item in message.objects] == points


@pytest.mark.parametrize(
    ("measurement", "bearings"),
    [
        (0.0, [math.pi / 2]),
        ([0.5 * math.pi], [0.0]),
        ([-3.0, 1.0], [math.pi / 2 + 3.0 - 2 * math.pi, math.pi / 2 - 1.0]),
        ([], []),
    ],
)
def test_bearings_from_the_north_become_bearings_from_the_east(
    tmp_path, measurement, bearings
):
    message, other = lists(
        scenario(tmp_path, record(3, "1.0", measurement), record(4, "1.0", measurement))
    )
    assert (message.sensor, message.frame, message.objects) == (
        "infrared",
        "ego",
        other.objects,
    )
    assert (other.sensor, other.frame) == ("daylight", "ego")
    assert [item.bearing_rad for item in message.objects] == [
        pytest.approx(value) for value in bearings
    ]
    assert message.objects == tuple(
        Detection(bearing_rad=item.bearing_rad) for item in message.objects
    )


def test_the_stamp_is_the_decimal_text_to_the_nanosecond(tmp_path):
    (message,) = lists(scenario(tmp_path, record(2, "1.6201148918494244E+9", [])))
    assert message.stamp_ns == 1_620_114_891_849_424_400


def test_the_file_order_is_the_receipt_order_and_the_newest_stamp_so_far_the_receipt(
    tmp_path,
):
    folder = scenario(
        tmp_path, record(3, "2.0", []), record(4, "1.5", []), record(1, "2.5", [])
    )
    messages = list(open_input(folder).messages())
    assert [(type(m).__name__, m.stamp_ns, m.receipt_ns) for m in messages] == [
        ("EgoState", 2_000_000_000, 2_000_000_000),
        ("DetectionList", 2_000_000_000, 2_000_000_000),
        ("DetectionList", 1_500_000_000, 2_000_000_000),
        ("EgoState", 2_500_000_000, 2_500_000_000),
        ("DetectionList", 2_500_000_000, 2_500_000_000),
    ]
    ego = messages[0]
    assert (ego.x_m, ego.y_m, ego.yaw_rad) == (20.0, 10.0, 0.0)


def test_a_repeated_fix_is_one_truth_state_in_time_order(tmp_path):
    fixes = [
        {"targetID": target, "position": [1.0, 2.0, 0], "time": time_s}
        for target, time_s in ((2, 3), (1, 2))
    ]
    folder = scenario(
        tmp_path, record(1, "1.0", []), record(1, "4.0", []), truth=[fixes, fixes]
    )
    truth = [
        item for item in open_input(folder).messages() if isinstance(item, TruthState)
    ]
    assert truth == [
        TruthState(2 * 10**9, 2 * 10**9, 1, x_m=2.0, y_m=1.0),
        TruthState(3 * 10**9, 3 * 10**9, 2, x_m=2.0, y_m=1.0),
    ]


@pytest.mark.parametrize(
    "text",
    ["", "{}", "[1]", "[{}]", "[[]]"]
    + [
        f"[{record(*values)}]"
        for values in ((7, "1.0", []), (1, "1.0", [[1.0], []]), (1, "1e30", []))
    ],
)
def test_a_damaged_scenario_is_one_line_that_names_the_file(tmp_path, text):
    (tmp_path / "scenario9_detections.json").write_text(text)
    with pytest.raises(DataError, match=r"scenario9_detections\.json: ") as caught:
        list(open_input(tmp_path).messages())
    assert "\n" not in str(caught.value)
