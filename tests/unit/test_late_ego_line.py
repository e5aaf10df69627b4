"""An ego that is later than the lists that it places is named, with the number and what to do."""

from dataclasses import replace

import pytest
from support.late_ego import Drive, drive

from fgtrack.advice.advise import advise
from fgtrack.config.settings import Config
from fgtrack.core.diagnostic import late_ego
from fgtrack.core.types import DetectionList, EgoState
from fgtrack.evaluation.diagnostics import diagnostics
from fgtrack.inputs.info import describe
from fgtrack.inputs.stream import write_stream
from fgtrack.models.sensors import SensorModel
from fgtrack.pipeline.live import Tracker
from fgtrack.pipeline.replay import replay_in_memory

LATE = drive(Drive(late_s=0.4, duration_s=4.0), 1).messages
IN_TIME = drive(Drive(late_s=0.0, duration_s=4.0), 1).messages
CONFIG = Config(sensors={"lidar": SensorModel(std={"x_m": 0.1, "y_m": 0.1})})
LINE = "arrive up to 350 ms later than the lists that need them (delay 400 ms, lidar 50 ms)"


def in_the_map(
    messages: list[EgoState | DetectionList],
) -> list[EgoState | DetectionList]:
    return [
        replace(each, frame="map") if isinstance(each, DetectionList) else each
        for each in messages
    ]


def test_the_line_names_the_largest_difference_and_only_sensors_that_are_sooner() -> (
    None
):
    line = str(late_ego(0.3, {"radar": 0.05, "camera": 0.4, "lidar": 0.1}))
    assert "250 ms later" in line
    assert "radar 50 ms, lidar 100 ms" in line
    assert "camera" not in line
    assert "send the ego's states sooner" in line
    assert (
        late_ego(0.3, {"camera": 0.4})
        is late_ego(0.1, {})
        is late_ego(0.06, {"radar": 0.05})
        is None
    )


@pytest.mark.parametrize(
    ("messages", "is_late"), [(LATE, True), (IN_TIME, False), (in_the_map(LATE), False)]
)
def test_replay_info_and_a_live_tracker_say_that_the_ego_is_late(
    tmp_path, messages, is_late: bool
) -> None:
    assert is_late == any(
        LINE in str(line) for line in diagnostics(replay_in_memory(messages, CONFIG))
    )
    write_stream(tmp_path / "a.jsonl", messages)
    notes = {topic.name: topic.note for topic in describe(tmp_path / "a.jsonl").topics}
    assert is_late == (LINE in (notes["ego"] or ""))
    tracker = Tracker(CONFIG)
    assert tracker.warnings == ()
    for message in messages:
        tracker.receive(message)
        tracker.tick(message.receipt_ns)
    assert is_late == any(LINE in line for line in tracker.warnings)
    assert len(tracker.warnings) == is_late


def test_advice_no_longer_calls_a_late_ego_fine(tmp_path) -> None:
    for name, messages in (("late", LATE), ("in_time", IN_TIME)):
        write_stream(tmp_path / f"{name}.jsonl", messages)
        advice = advise(tmp_path / f"{name}.jsonl", CONFIG)
        is_late = name == "late"
        assert is_late == any(LINE in item.text for item in advice.findings)
        assert is_late != any(
            line.startswith("Fine, ego: states: ") for line in advice.fine
        )
        assert sum(LINE in item.text for item in advice.findings) == is_late
