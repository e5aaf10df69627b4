"""Tests of hypotheses about a recording, in order: each sees the settings that the tests before it have decided."""

from collections.abc import Iterable, Sequence, Set
from dataclasses import replace
from pathlib import Path

from fgtrack.config.settings import Config
from fgtrack.config.yaml_file import plain, validate, with_value
from fgtrack.core.types import Message
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
    read. Later tests do not read a sensor with an open question.
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
        asked = {each.about for each in new if each.certainty == "open"} - _NO_SENSORS
        changes_times = any(
            path[-1] == "clock_offset_s" for each in new for path in each.settings
        )
        if asked or changes_times or config.input != before:
            ignored = tuple(dict.fromkeys([*config.ignore_sensors, *sorted(asked)]))
            config = replace(config, ignore_sensors=ignored)
            messages = None
        decisions += new
    return config, decisions


def _with(config: Config, decisions: Iterable[Decision], sample: Sample) -> Config:
    raw = plain(config)
    for decision in decisions:
        for path, value in decision.settings.items():
            if sample.is_open(path):
                raw = with_value(raw, path, value, Config())
    return validate(Config, raw, "decided")
