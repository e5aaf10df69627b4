"""Decisions about a recording: each chooses a hypothesis by a test, assumes it, or leaves a question open."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

__all__ = ["Certainty", "Decision"]

Certainty = Literal["tested", "assumed", "open"]
"""`tested`: a test with a number supports the hypothesis; `assumed`: names or usual values; `open`: unknown."""


@dataclass(frozen=True)
class Decision:
    """Chosen hypothesis about one property of a recording, or an open question."""

    about: str
    """Name of the sensor, `ego`, `truth`, or `the recording`."""
    what: str
    """Property: `frame`, `mount`, `velocity`, `time`, `heading`, `unit of the speed`."""
    settings: Mapping[tuple[str, ...], object]
    """Key paths and plain values of the chosen hypothesis; empty if the question is open."""
    certainty: Certainty
    reason: str
    """Reason in words, with the test and its number."""
    question: str | None = None
    """Question in one line with the key to set; given for an open question and for an unobservable assumption."""
    is_provisional: bool = False
    """True if the sensor is used as if an open question had the assumed answer; its settings are not written."""

    def __post_init__(self) -> None:
        is_open = self.certainty == "open"
        has_settings = bool(self.settings) and not self.is_provisional
        if is_open and (has_settings or self.question is None):
            raise ValueError(
                f"{self.about}, {self.what}: an open decision has a question and no settings"
            )

    @property
    def leaves_out(self) -> bool:
        """True if the runs leave the sensor out until the question is answered."""
        return self.certainty == "open" and not self.is_provisional

    @property
    def line(self) -> str:
        """Decision in one line: `radar_front, frame (tested): objects move by 0.2 m between lists`."""
        return f"{self.about}, {self.what} ({self.certainty}): {self.reason}"
