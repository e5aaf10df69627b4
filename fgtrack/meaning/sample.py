"""Beginning of a recording, on which the tests of hypotheses work."""

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from fgtrack.config.settings import Config
from fgtrack.core.errors import FgtrackError
from fgtrack.core.time import nanoseconds
from fgtrack.core.types import DetectionList, Message
from fgtrack.inputs.source import open_input
from fgtrack.meaning.assumption import departures, is_given
from fgtrack.meaning.corrected import corrected_message
from fgtrack.meaning.decision import Decision
from fgtrack.meaning.input_checks import messages_within

__all__ = ["SAMPLE_S", "Sample", "Test", "first_messages"]

#: Duration of the beginning of a recording that the tests read.
SAMPLE_S = 120.0


@dataclass(frozen=True)
class Sample:
    """Beginning of a recording, as it is read with the settings that are decided so far."""

    path: Path
    given: Config
    """Settings of the user."""
    config: Config
    """Settings of the user and settings that are decided so far."""
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
        return first_messages(self.path, config)

    def is_open(self, path: Sequence[str]) -> bool:
        """True if the user has not given the setting at the key path."""
        return not is_given(departures(self.given), path)


Test = Callable[[Sample], Iterable[Decision]]
"""Yields decisions about a recording from its sample."""


def first_messages(path: Path, config: Config) -> list[Message]:
    """Return the messages of the first `SAMPLE_S`, until the recording breaks off; empty if it cannot be read."""
    result: list[Message] = []
    with suppress(FgtrackError):  # the replay reports it
        source = open_input(path, config.input)
        for message in messages_within(source.messages(), nanoseconds(SAMPLE_S)):
            ignored = (
                isinstance(message, DetectionList)
                and message.sensor in config.ignore_sensors
            )
            if not ignored:
                result.append(corrected_message(message, config))
    return result
