"""Lines on what a run received: nothing, half of it twice, a sensor that falls silent, detections that fail."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from fgtrack.cli.main import run as command
from fgtrack.config.settings import Config
from fgtrack.core.types import Detection, DetectionList, EgoState, Message
from fgtrack.evaluation.diagnostics import diagnostics, received_nothing, repeated
from fgtrack.inputs.stream import write_stream
from fgtrack.pipeline.replay import replay_in_memory
from fgtrack.runs import Run

MS = 1_000_000
START_NS = 10**18
CONFIG = """\
estimator: ekf-replay
sensors: {radar: {std: {x_m: 0.5, y_m: 0.5}}, lidar: {std: {x_m: 0.5, y_m: 0.5}}}
birth: {kind: measured, ego_speed_factor: 0.0}
ego: {detection_origin_x_m: 0.0}
"""


def scene(
    duration_s: float = 30.0,
    has_list: Callable[[str, float], bool] = lambda sensor, now_s: True,
    has_ego: Callable[[float], bool] = lambda now_s: True,
) -> Iterator[Message]:
    """One car 20 m ahead of an ego at 10 m/s, seen by two sensors at 10 Hz that report it in the frame of the ego."""
    for k in range(round(20 * duration_s)):
        now_s = 0.05 * k
        now_ns = START_NS + 50 * MS * k
        if has_ego(now_s):
            yield EgoState(now_ns, now_ns, 10.0 * now_s, 0.0, 0.0, 10.0)
        for sensor in ("lidar", "radar") if k % 2 == 0 else ():
            if has_list(sensor, now_s):
                objects = (Detection(x_m=20.0, y_m=1.0),)
                yield DetectionList(sensor, now_ns, now_ns + 10 * MS, objects, "ego")


def run_of(messages: Iterator[Message]) -> Run:
    ordered = sorted(messages, key=lambda message: message.receipt_ns)
    return replay_in_memory(
        ordered, Config.from_dict(YAML(typ="safe", pure=True).load(CONFIG))
    )


def lines(messages: Iterator[Message]) -> list[str]:
    return list(map(str, diagnostics(run_of(messages))))


def test_a_steady_drive_has_no_line() -> None:
    assert lines(scene()) == []


@pytest.mark.parametrize(
    ("silent_s", "told"),
    [
        ((12.0, 99.0), "no list from 11.9 s to the end (18.0 s"),
        ((8.0, 20.0), "no list from 7.9 s to 20.0 s (12.1 s"),
        ((-1.0, 9.0), "no list from 0.0 s to 9.0 s (9.0 s"),
    ],
)
def test_a_sensor_that_falls_silent_is_named_with_the_time(
    silent_s: tuple[float, float], told: str
) -> None:
    start_s, end_s = silent_s
    (line,) = lines(
        scene(
            has_list=lambda sensor, now_s: (
                sensor == "lidar" or not start_s <= now_s < end_s
            )
        )
    )
    assert line.startswith(f"radar: {told}; its mean period is 0.1 s)")


def test_gaps_that_a_sensor_often_makes_are_no_silence() -> None:
    def has_list(sensor: str, now_s: float) -> bool:
        return sensor == "lidar" or now_s % 8.0 < 2.0

    assert lines(scene(40.0, has_list)) == []


def test_detections_without_a_pose_of_the_ego_are_named_above_5_percent() -> None:
    (line,) = [
        line
        for line in lines(scene(has_ego=lambda now_s: now_s < 24.0))
        if "radar" in line
    ]
    assert line.startswith("radar: ")
    assert "detections failed (17 %): no ego pose was known at the stamps of 5" in line
    assert not [
        line
        for line in lines(scene(has_ego=lambda now_s: now_s < 28.5))
        if "failed" in line
    ]


def test_looped_playback_is_named_and_nothing_else() -> None:
    def looped(message: Message) -> Message:
        stamp_ns = START_NS + (message.stamp_ns - START_NS) % (15_000 * MS)
        return replace(message, stamp_ns=stamp_ns)

    (line,) = lines(map(looped, scene()))
    assert line.startswith(
        "recording: stamps return that were received before (50 % of ego after 15 s, 50 % of lidar after 15 s, "
    )


def test_late_reports_with_stamps_in_whole_seconds_are_no_loop() -> None:
    """Reports of ships: other reports have the same second, and some of them were received long before."""

    def report(number: int, message: Message) -> Message:
        stamp_ns = message.stamp_ns // (1000 * MS) * 1000 * MS
        late_ns = 3000 * MS if number % 3 == 0 else 0
        return replace(
            message, stamp_ns=stamp_ns, receipt_ns=message.receipt_ns + late_ns
        )

    reports = [
        report(number, message) if isinstance(message, DetectionList) else message
        for number, message in enumerate(scene())
    ]
    reports.sort(key=lambda message: message.receipt_ns)
    assert not [line for line in lines(reports) if "looped" in line]


def test_stamps_ahead_of_their_receipts_are_named_as_a_clock() -> None:
    def ahead(message: Message) -> Message:
        is_radar = isinstance(message, DetectionList) and message.sensor == "radar"
        return (
            replace(message, stamp_ns=message.stamp_ns + 18_000 * MS)
            if is_radar
            else message
        )

    (line,) = lines(map(ahead, scene()))
    assert line.startswith(
        "radar: 300 of 300 invalid: its stamps lie 18 s after their receipts"
    )


def test_copies_of_a_list_are_no_loop() -> None:
    def copied() -> Iterator[Message]:
        for message in scene():
            yield message
            if isinstance(message, DetectionList):
                yield replace(message, receipt_ns=message.receipt_ns + 30 * MS)

    assert repeated(run_of(copied())) is None


def test_a_run_without_detections_is_named() -> None:
    def empty(message: Message) -> Message:
        return (
            replace(message, objects=())
            if isinstance(message, DetectionList)
            else message
        )

    line = received_nothing(run_of(map(empty, scene())))
    assert line is not None
    assert "(lidar: 300 empty lists, radar: 300 empty lists)" in line
    none = received_nothing(run_of(scene(has_list=lambda sensor, now_s: False)))
    assert none is not None
    assert "(no detection list)" in none


@pytest.mark.parametrize("case", ["empty", "loop"])
def test_such_a_recording_has_exit_code_1_and_one_line(
    case: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("c.yaml").write_text(CONFIG)
    messages = list(scene(has_list=lambda sensor, now_s: case == "loop"))
    if case == "loop":
        messages = [
            replace(
                item, stamp_ns=START_NS + (item.stamp_ns - START_NS) % (15_000 * MS)
            )
            for item in messages
        ]
    write_stream("a.jsonl", sorted(messages, key=lambda item: item.receipt_ns))
    assert command(["replay", "a.jsonl", "-c", "c.yaml", "-o", "run"]) == 1
    errors = [
        line for line in capsys.readouterr().err.splitlines() if "error: " in line
    ]
    assert len(errors) == 1
    assert (
        "looped playback" if case == "loop" else "no detection was received"
    ) in errors[0]
    assert Path("run/meta.json").exists()


def test_a_mapped_table_that_the_recording_lacks_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    mapped = "input: {detections: {sonar: {topic: /sonar/objects}}}\n"
    Path("c.yaml").write_text(
        CONFIG.replace("lidar: {", "sonar: {std: {x_m: 1.0, y_m: 1.0}}, lidar: {")
        + mapped
    )
    messages = sorted(scene(5.0), key=lambda item: item.receipt_ns)
    write_stream("a.jsonl", messages)
    assert command(["replay", "a.jsonl", "-c", "c.yaml", "-o", "run"]) == 0
    assert (
        "warning: sonar: no list was read from /sonar/objects"
        in capsys.readouterr().err
    )
