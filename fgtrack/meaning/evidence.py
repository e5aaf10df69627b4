"""Tests of hypotheses about a recording, in order: each sees the settings that the tests before it have decided."""

from collections.abc import Callable, Iterable, Sequence, Set
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from fgtrack.config.settings import Config
from fgtrack.config.yaml_file import plain, validate, with_value
from fgtrack.core.errors import FgtrackError
from fgtrack.core.time import nanoseconds
from fgtrack.core.types import DetectionList, Message
from fgtrack.inputs.source import open_input
from fgtrack.meaning.assumption import departures, is_given
from fgtrack.meaning.decision import Decision
from fgtrack.meaning.input_checks import messages_within

__all__ = ["SAMPLE_S", "TESTS", "Sample", "Test", "decided"]

#: Duration of the beginning of a recording that the tests read.
SAMPLE_S = 120.0


@dataclass(frozen=True)
class Sample:
    """Beginning of a recording, as it is read with the settings that are decided so far."""

    path: Path
    given: Config
    """Settings of the user."""
    config: Config
    """Settings of the user, with those that are decided so far."""
    messages: Sequence[Message]
    """Messages of the first `SAMPLE_S`, in the order of receipt; without ignored sensors."""

    def input_path(self, name: str) -> tuple[str, ...] | None:
        """Return the key path of the topic or the table of a sensor, `ego` or `truth`; None if it has no mapping."""
        section: tuple[str, ...] = ("input",)
        for inputs in (self.config.input, self.config.input.csv):
            if name in ("ego", "truth") and getattr(inputs, name) is not None:
                return (*section, name)
            if name in inputs.detections:
                return (*section, "detections", name)
            section = ("input", "csv")
        return None

    def read(self, config: Config) -> list[Message]:
        """Return the messages of the first `SAMPLE_S`, read with another configuration."""
        return _first(self.path, config)

    def is_open(self, path: Sequence[str]) -> bool:
        """True if the user has not given the setting at the key path."""
        return not is_given(departures(self.given), path)


Test = Callable[[Sample], Iterable[Decision]]
"""Yields decisions about a recording from its sample."""

#: Tests in their order: frames, mounts, velocities, times, orientations.
TESTS: tuple[Test, ...] = ()


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
            messages = _first(path, config)
        sample = Sample(path, given, config, messages)
        new = [each for each in test(sample) if each.about not in settled]
        before = config.input
        config = _with(config, new, sample)
        asked = {each.about for each in new if each.certainty == "open"}
        if asked or config.input != before:
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


def _first(path: Path, config: Config) -> list[Message]:
    """Return the messages of the first `SAMPLE_S` up to a break; empty if the recording cannot be read."""
    result: list[Message] = []
    with suppress(FgtrackError):  # the replay reports it
        source = open_input(path, config.input)
        for message in messages_within(source.messages(), nanoseconds(SAMPLE_S)):
            ignored = (
                isinstance(message, DetectionList)
                and message.sensor in config.ignore_sensors
            )
            if not ignored:
                result.append(message)
    return result
