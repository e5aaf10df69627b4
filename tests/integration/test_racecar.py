"""A recording with the message types of RACECAR (Kulkarni et al. 2023): Indy cars, one radar track per message."""

import math
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer

from fgtrack.config.reading import read_config
from fgtrack.core.errors import CallError, DataError
from fgtrack.core.types import DetectionList, EgoState, TruthState
from fgtrack.evaluation.metrics import evaluate
from fgtrack.inputs.ros.messages import ODOMETRY, MessageFactory
from fgtrack.inputs.ros.typestore import typestore_of
from fgtrack.inputs.settings import Filter, InputConfig, TopicInput
from fgtrack.inputs.source import open_input
from fgtrack.pipeline.public import replay

ESR = "delphi_esr_msgs/msg/EsrTrack"
START_NS = 1_640_000_000_000_000_000
SPEED_MPS = 40.0
DELAY_NS = 60_000_000
OPPONENTS = {2: (60.0, 3.0, 42.0), 3: (35.0, -3.0, 39.0)}  # ahead, left, speed


def position(car: int, t_s: float) -> tuple[float, float, float]:
    """x, y, speed on a straight to the east; car 1 is the ego."""
    ahead_m, left_m, speed_mps = OPPONENTS.get(car, (0.0, 0.0, SPEED_MPS))
    return ahead_m + speed_mps * t_s, left_m, speed_mps


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("racecar") / "MULTI-FAST"
    store = typestore_of((ESR, ODOMETRY))
    make = MessageFactory()
    rng = np.random.default_rng(4)

    def header(stamp_ns: int, frame_id: str):
        time = store.types["builtin_interfaces/msg/Time"](
            sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9
        )
        return store.types["std_msgs/msg/Header"](stamp=time, frame_id=frame_id)

    def odometry(car: int, stamp_ns: int, t_s: float):
        x_m, y_m, speed_mps = position(car, t_s)
        return make.odometry(EgoState(stamp_ns, stamp_ns, x_m, y_m, 0.0, speed_mps))

    def track(slot: int, car: int, stamp_ns: int, t_s: float):
        x_m, y_m, speed_mps = position(car, t_s)
        ego_x_m = position(1, t_s)[0] + 2.0
        ahead_m, left_m = x_m - ego_x_m, y_m
        range_m = math.hypot(ahead_m, left_m)
        return store.types[ESR](
            header=header(stamp_ns, "radar_front"),
            canmsg=f"5{slot:02X}",
            id=slot,
            lat_rate=0.0,
            grouping_changed=False,
            oncoming=False,
            status=3 if car in OPPONENTS else 0,
            angle=-math.degrees(math.atan2(left_m, ahead_m) + rng.normal(0.0, 0.005)),
            range=range_m + rng.normal(0.0, 0.2),
            bridge_object=False,
            rolling_count=False,
            width=1.5,
            range_accel=0.0,
            med_range_mode=0,
            range_rate=(speed_mps - SPEED_MPS) * ahead_m / range_m
            + rng.normal(0.0, 0.1),
        )

    sent = []
    for tick in range(400):  # 100 Hz
        stamp_ns, t_s = START_NS + tick * 10_000_000, 0.01 * tick
        for car in (1, *OPPONENTS):
            sent.append(
                (
                    stamp_ns + car,
                    f"/vehicle_{car}/local_odometry",
                    odometry(car, stamp_ns, t_s),
                )
            )
        if tick % 5 == 0:
            for slot, car in enumerate((2, 0, 3, 0)):
                late_ns = DELAY_NS + slot * 1_000_000
                message = track(slot, car, stamp_ns + slot * 100_000, t_s)
                sent.append(
                    (stamp_ns + late_ns, "/vehicle_1/radar_front/esr_track", message)
                )
    with Writer(
        path, version=Writer.VERSION_LATEST, storage_plugin=StoragePlugin.SQLITE3
    ) as bag:
        connections = {}
        for log_ns, topic, message in sorted(sent, key=lambda item: item[0]):
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, kind, typestore=store)
            bag.write(connections[topic], log_ns, store.serialize_cdr(message, kind))
    return path


def lists(recording: Path, config: InputConfig) -> list[DetectionList]:
    return [
        item
        for item in open_input(recording, config).messages()
        if isinstance(item, DetectionList)
    ]


def test_the_shipped_configuration_tracks_both_opponents(recording):
    run = replay(recording, "racecar")
    found = evaluate(run).multi_object
    assert found is not None
    assert found.clear["mota"] > 0.8
    assert found.clear["id_switches"] == 0
    assert set(np.unique(run.truth["object_id"]).tolist()) == {2, 3}
    assert np.median(
        run.updates["receipt_ns"] - run.updates["stamp_ns"]
    ) == pytest.approx(DELAY_NS, abs=3e6)


def test_the_tracks_of_a_cycle_are_one_scan(recording):
    config = read_config("racecar").input
    scans = lists(recording, config)
    assert len(scans) == 80
    assert [len(scan.objects) for scan in scans] == [2] * 80
    first = scans[0].objects[0]
    assert first.bearing_rad == pytest.approx(math.atan2(3.0, 58.0), abs=0.03)
    assert scans[0].receipt_ns == START_NS + DELAY_NS + 3_000_000


def test_topics_of_truth_are_an_object_each(recording):
    topics = tuple(
        TopicInput(f"/vehicle_{car}/local_odometry", object_id=name)
        for car, name in ((2, None), (3, "poli"))
    )
    truth = [
        item
        for item in open_input(recording, InputConfig(truth=topics)).messages()
        if isinstance(item, TruthState)
    ]
    ids = [item.object_id for item in truth]
    assert ids[:2] == [0, ids[1]]
    assert len(set(ids)) == 2
    assert (truth[0].x_m, truth[0].y_m, truth[0].speed_mps) == OPPONENTS[2]


@pytest.mark.parametrize(
    ("item", "error", "complaint"),
    [
        (
            {"filters": {"rcs": Filter(min=0.0)}},
            CallError,
            "without `fields`, a filter may use .*score.*, not 'rcs'",
        ),
        (
            {"fields": {"range_m": "rangee"}},
            DataError,
            "there is no field 'rangee'; there are header, canmsg, id",
        ),
        (
            {"fields": {"range_m": "range"}, "filters": {"snr": Filter(min=0.0)}},
            DataError,
            "there is no field 'snr'",
        ),
    ],
)
def test_what_does_not_fit_is_one_line_with_what_there_is(
    recording, item, error, complaint
):
    topic = TopicInput("/vehicle_1/radar_front/esr_track", **item)
    with pytest.raises(error, match=complaint) as caught:
        lists(recording, InputConfig(detections={"radar": topic}))
    assert "\n" not in str(caught.value)
