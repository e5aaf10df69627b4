"""Clocks of sensors and of the ego that differ by a known constant are corrected, and loops are named."""

from pathlib import Path

import numpy as np
import pytest

from fgtrack.core.types import Detection, DetectionList, EgoState, Message
from fgtrack.inputs.recording import write_recording
from fgtrack.meaning.draft import Draft, opened
from fgtrack.pipeline.replay import replay_in_memory

NS = 1_000_000_000
T0_NS = 1_700_000_000 * NS


def recorded(
    path: Path, offset_s: dict[str, float], loop_s: float | None = None
) -> Draft:
    """An ego and two sensors for 15 s, whose stamps are ahead by `offset_s`."""
    rng = np.random.default_rng(1)
    messages: list[Message] = []
    for k in range(600):
        t = 0.025 * k
        receipt_ns = T0_NS + k * NS // 40
        back = t if loop_s is None else t % loop_s

        def stamp_ns(name: str, back: float = back) -> int:
            return T0_NS + round((back + offset_s.get(name, 0.0)) * NS)

        messages.append(
            EgoState(stamp_ns("ego"), receipt_ns + NS // 500, 15.0 * t, 0.0, 0.0, 15.0)
        )
        if k % 4 == 0:
            for name, late_ns in (("lidar", NS // 16), ("radar", NS // 20)):
                objects = [
                    Detection(x_m=x + (v - 15.0) * t + rng.normal(0.0, 0.2), y_m=y)
                    for x, y, v in ((30.0, 0.0, 17.0), (50.0, 3.5, 12.0))
                ]
                messages.append(
                    DetectionList(name, stamp_ns(name), receipt_ns + late_ns, objects)
                )
    messages.sort(key=lambda each: each.receipt_ns)
    write_recording(path, messages)
    return opened(path)


@pytest.mark.parametrize("offset_s", [37.0, -37.0, 18.0, 3600.0, -7200.0])
def test_a_sensor_with_another_clock_is_corrected_and_tracked(
    tmp_path: Path, offset_s: float
) -> None:
    draft = recorded(tmp_path / "a", {"lidar": offset_s})
    [decision] = [each for each in draft.decisions if each.what == "time"]
    assert decision.settings == {("sensors", "lidar", "clock_offset_s"): offset_s}
    assert decision.certainty == "tested"
    run = replay_in_memory(draft.source.messages(), draft.config)
    updates = run.tables["updates"]
    fused = updates["disposition"][updates["sensor"] == "lidar"]
    assert np.isin(fused, ["in_sequence", "out_of_sequence", "birth"]).mean() > 0.95


def test_a_constant_of_all_clocks_is_assumed_and_the_ego_is_corrected(
    tmp_path: Path,
) -> None:
    offsets = dict.fromkeys(("ego", "lidar", "radar"), 18.0)
    draft = recorded(tmp_path / "a", offsets)
    decisions = [each for each in draft.decisions if each.what == "time"]
    assert {each.about for each in decisions} == {"ego", "lidar", "radar"}
    assert {each.certainty for each in decisions} == {"assumed"}
    assert draft.config.ego.clock_offset_s == 18.0
    run = replay_in_memory(draft.source.messages(), draft.config)
    assert run.meta["ego_refused"] == {}


@pytest.mark.parametrize("offset_s", [0.0, -2.5, -6.0, 0.2])
def test_a_delay_is_not_corrected(tmp_path: Path, offset_s: float) -> None:
    draft = recorded(tmp_path / "a", {"lidar": offset_s})
    assert [each for each in draft.decisions if each.what == "time"] == []


def test_a_loop_is_a_question(tmp_path: Path) -> None:
    draft = recorded(tmp_path / "a", {}, loop_s=6.0)
    [decision] = [each for each in draft.decisions if each.what == "time"]
    assert (decision.about, decision.certainty) == ("the recording", "open")
    assert draft.problem is not None
    assert "loop" in decision.reason
