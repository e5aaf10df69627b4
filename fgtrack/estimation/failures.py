"""Counters of failures inside estimators and of their treatment."""

from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from traceback import format_exception
from typing import Any, ClassVar

from fgtrack.core.state import Stateful

__all__ = ["EstimatorError", "Failure", "Failures"]


class Failure(StrEnum):
    """Kind of a failure in an estimator or in the tracker, or of the response to a failure."""

    NOT_FINITE = "not finite"
    """A state that was to be published was not finite, or was beyond any vehicle on Earth, see `faults`."""
    NOT_DEFINITE = "not positive definite"
    """A covariance that was to be published was not positive definite."""
    UPDATE_FAILED = "update failed"
    """A measurement could not be fused; its disposition is `failed`."""
    ESTIMATOR_RAISED = "estimator raised"
    """An estimator raised an exception when the tracker asked for its states or advanced its clock."""
    GRAPH_REBUILT = "graph rebuilt"
    """A factor graph could not be solved with a new measurement, and was rebuilt without it."""
    STEP_DAMPED = "step damped"
    """A step of a smoother overshot, and was repeated with a line search."""
    BIRTH_FAILED = "birth failed"
    """A detection could not start a track; its disposition is `failed`."""
    LIST_FAILED = "list failed"
    """The processing of an object list, or of a part, raised an exception; its remaining detections are `failed`."""
    STEP_FAILED = "step failed"
    """A step that does not change estimates, such as the lifecycle of a track, raised an exception and was skipped."""
    TRACK_ENDED = "track ended"
    """A track ended because of a failure."""


class EstimatorError(Exception):
    """The estimators of some tracks raised; the other estimators returned results."""

    def __init__(
        self,
        causes: Mapping[int, Exception],
        answers: Mapping[int, Any],  # Any: depends on the call
        unchanged: Collection[int] = (),
    ) -> None:
        super().__init__(
            f"estimators of the tracks {', '.join(map(str, causes))} raised"
        )
        self.causes = causes
        """Exceptions by track id."""
        self.answers = answers
        """Results of the other tracks, by track id."""
        self.unchanged = frozenset(unchanged)
        """Tracks among `causes` whose states are as before the call. The states of the other failed tracks are
        unknown.
        """


@dataclass
class Failures(Stateful):
    """Counts of failures by kind. All parts of one tracker share this object."""

    STATE: ClassVar[tuple[str, ...]] = (
        "counts",
        "ended",
        "first",
        "last",
    )

    counts: Counter[Failure] = field(default_factory=Counter)
    ended: list[dict[str, int | str]] = field(default_factory=list)
    """The first hundred tracks that failures have ended, as in meta.json."""
    first: str | None = None
    """Message of the first failure, on one line."""
    last: str | None = None
    """Traceback or message of the newest failure."""

    def add(self, failure: Failure, count: int = 1) -> None:
        """Count a failure."""
        self.counts[failure] += count

    def end(self, track_id: int, now_ns: int, failure: Failure) -> None:
        """Count a track that a failure has ended."""
        self.add(Failure.TRACK_ENDED)
        if len(self.ended) < 100:
            self.ended.append(
                {"track_id": track_id, "now_ns": now_ns, "failure": failure.value}
            )

    def note(self, what: str | BaseException) -> None:
        """Keep a message or an exception as the newest failure, and as the first failure if there was none before."""
        if isinstance(what, BaseException):
            name = (
                "not enough memory"
                if isinstance(what, MemoryError)
                else type(what).__name__
            )
            line, self.last = f"{name}: {what}", "".join(format_exception(what))
        else:
            line = self.last = what
        self.first = self.first or " ".join(line.split())

    def as_meta(self) -> dict[str, object]:
        """Return the counts of all kinds, zeros included, as in meta.json."""
        return {
            "failures": {failure.value: self.counts[failure] for failure in Failure},
            "first_failure": self.first,
            "ended_by_failure": list(self.ended),
        }
