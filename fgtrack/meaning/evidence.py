"""Tests of hypotheses about a recording, in order: each sees the settings that the tests before it have decided."""

from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import replace
from pathlib import Path

from fgtrack.config.settings import Config
from fgtrack.config.yaml_file import plain, validate, with_value
from fgtrack.core.types import DetectionList, Frame, Message
from fgtrack.inputs.geodetic import GEODETIC
from fgtrack.inputs.settings import InputConfig
from fgtrack.meaning.clocks import clock_decisions
from fgtrack.meaning.decision import Decision
from fgtrack.meaning.placement import frame_decisions, mount_decisions
from fgtrack.meaning.sample import Sample, Test, first_messages
from fgtrack.meaning.velocity_test import velocity_decisions

__all__ = ["TESTS", "decided"]

_NO_SENSORS = frozenset(("ego", "truth", "the recording"))
#: Tests in their order: clocks, frames, mounts, velocities.
TESTS: tuple[Test, ...] = (
    clock_decisions,
    frame_decisions,
    mount_decisions,
    velocity_decisions,
)


def decided(
    path: Path,
    given: Config,
    config: Config,
    settled: Set[str] = frozenset(),
    tests: Sequence[Test] | None = None,
) -> tuple[Config, list[Decision]]:
    """Return `config` with the settings that the tests decide, and their decisions.

    Settings in `given`, the user's configuration, stay, and decisions about `settled`
    sensors are dropped. The recording is read again after a test has changed how it is
    read. Later tests do not read a sensor that a decision leaves out.
    """
    decisions: list[Decision] = []
    messages: Sequence[Message] | None = None
    for test in TESTS if tests is None else tests:
        if messages is None:
            messages = first_messages(path, config)
        sample = Sample(path, given, config, messages)
        new = [each for each in test(sample) if each.about not in settled]
        before = config.input
        config = _with(config, new, sample)
        asked = {each.about for each in new if each.leaves_out} - _NO_SENSORS
        changes_times = any(
            path[-1] == "clock_offset_s" for each in new for path in each.settings
        )
        if asked or changes_times or config.input != before:
            ignored = tuple(dict.fromkeys([*config.ignore_sensors, *sorted(asked)]))
            config = replace(config, ignore_sensors=ignored)
            frames = _new_frames(before, config.input)
            if asked or changes_times or frames is None:
                messages = None
            else:
                messages = [_in_frame(each, frames) for each in messages]
        decisions += new
    return config, decisions


def _with(config: Config, decisions: Iterable[Decision], sample: Sample) -> Config:
    raw = plain(config)
    for decision in decisions:
        for path, value in decision.settings.items():
            if sample.is_open(path):
                raw = with_value(raw, path, value, Config())
    return validate(Config, raw, "decided")


def _new_frames(before: InputConfig, after: InputConfig) -> dict[str, Frame] | None:
    """Return the new frames by sensor, if all changes are tables in the frame of the ego or the sensor; None otherwise.

    Both frames have the same numbers, so the tables need not be read again.
    """
    frames: dict[str, Frame] = {}
    tables = dict(after.csv.detections)
    for name, old in before.csv.detections.items():
        new = after.csv.detections.get(name, old)
        is_turned = {old.frame or "ego", new.frame or "ego"} <= {"ego", "sensor"}
        if (
            new.frame != old.frame
            and is_turned
            and GEODETIC[0] not in (new.columns or {})
        ):
            frames[name] = new.frame or "ego"
            tables[name] = replace(new, frame=old.frame)
    csv = replace(after.csv, detections=tables)
    return frames if replace(after, csv=csv) == before else None


def _in_frame(message: Message, frames: Mapping[str, Frame]) -> Message:
    """Return a list of a sensor in `frames` with its new frame, and other messages unchanged."""
    if isinstance(message, DetectionList) and message.sensor in frames:
        return replace(message, frame=frames[message.sensor])
    return message
