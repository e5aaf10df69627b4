import json
import math

import pytest

from fgtrack.core.errors import DataError
from fgtrack.core.types import Detection, DetectionList, EgoState
from fgtrack.inputs.errors import UntilBreak
from fgtrack.inputs.settings import InputConfig, TopicInput
from fgtrack.inputs.source import open_input

HEADER = "time_ns;detection_input;ego_state;tracking_input;match_dict;filter_log;object_dict;pred_dict;cycle_time_ns"
EGO = {
    "is_updated": True,
    "in_pit": False,
    "t": 90,
    "state": [1.0, 2.0, 3.0, 40.0, 0.1, -1.0],
}


def row(time_ns, detections, ego=EGO):
    return ";".join(
        json.dumps(cell) for cell in (time_ns, detections, ego, [], {}, {}, {}, {}, 5)
    )


def found(keys, *states):
    return [[{"state": list(state), "t": 70, "keys": keys} for state in states], 70]


def log(folder, *rows):
    (folder / "data_logs.csv").write_text("\n".join([HEADER, *rows]))
    return folder


def test_a_log_gives_the_ego_and_then_the_detections_of_every_tick(tmp_path):
    rows = [
        row(
            100,
            {
                "radar": found(["x", "y", "yaw", "v"], (1.0, 2.0, 30.0)),
                "lidar": [[], 60],
            },
        ),
        row(120, None),
        row(140, None, EGO | {"t": 130}),
    ]
    messages = list(open_input(log(tmp_path, *rows)).messages())
    assert messages[0] == EgoState(
        90,
        100,
        1.0,
        2.0,
        pytest.approx(3.0 + math.pi / 2 - 2 * math.pi),
        40.0,
        0.1,
        -1.0,
        in_pit=False,
    )
    assert messages[1] == DetectionList("lidar", 60, 100, (), "ego")
    assert messages[2] == DetectionList(
        "radar", 70, 100, (Detection(x_m=1.0, y_m=2.0, speed_mps=30.0),), "ego"
    )
    assert [(type(m).__name__, m.receipt_ns) for m in messages[3:]] == [
        ("EgoState", 140)
    ]


@pytest.mark.parametrize(
    ("frame", "yaw_rad"), [("ego", 0.5), ("map", 0.5 + math.pi / 2)]
)
def test_a_measured_yaw_is_turned_only_in_the_map_frame(tmp_path, frame, yaw_rad):
    folder = log(
        tmp_path, row(100, {"lidar": found(["x", "y", "yaw"], (1.0, 2.0, 0.5))})
    )
    config = InputConfig(detections={"lidar": TopicInput("", frame=frame)})
    message = list(open_input(folder, config).messages())[1]
    assert message.frame == frame
    assert message.objects[0].yaw_rad == pytest.approx(yaw_rad)


def test_a_log_that_breaks_off_gives_its_whole_rows(tmp_path):
    log(tmp_path, row(100, None), row(120, None, EGO | {"t": 110})[:-60])
    readable = UntilBreak(open_input(tmp_path).messages())
    assert len(list(readable)) == 1
    assert str(readable.error).startswith(
        f"{tmp_path / 'data_logs.csv'}:3: is not a row"
    )


@pytest.mark.parametrize(
    "text", ["a;b\n1;2\n", f"{HEADER}\n1;2\n", f"{HEADER}\n{row(1, {'lidar': 3})}\n"]
)
def test_what_is_no_such_log_is_one_line(tmp_path, text):
    (tmp_path / "data_logs.csv").write_text(text)
    with pytest.raises(DataError, match=r"data_logs\.csv:\d+: "):
        list(open_input(tmp_path).messages())
