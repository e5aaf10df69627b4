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
    """A kind of failure, or of what was done about one."""

    NOT_FINITE = "not finite"
    """A state that was to be published was not, or was beyond any vehicle on Earth, see `faults`."""
    NOT_DEFINITE = "not positive definite"
    """A covariance that was to be published was not."""
    UPDATE_FAILED = "update failed"
    """A measurement could not be fused; its disposition is `failed`."""
    ESTIMATOR_RAISED = "estimator raised"
    """An estimator raised an exception when it was asked for states, or given the clock."""
    GRAPH_REBUILT = "graph rebuilt"
    """A factor graph could not be solved with a new measurement, and was rebuilt without it."""
    STEP_DAMPED = "step damped"
    """A smoother's step went too far and was repeated with a line search."""
    BIRTH_FAILED = "birth failed"
    """A detection could not start a track; its disposition is `failed`."""
    LIST_FAILED = "list failed"
    """The processing of an object list, or of a part, raised an exception; its remaining detections are `failed`."""
    STEP_FAILED = "step failed"
    """A step beside the estimate, as the count of the life of a track, raised an exception and was left out."""
    TRACK_ENDED = "track ended"
    """A track that failed ended."""


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
        """What was raised, by track."""
        self.answers = answers
        """Results of the other tracks."""
        self.unchanged = frozenset(unchanged)
        """Those of the `causes` whose states are as they were before the call; the states of the rest are unknown."""


@dataclass
class Failures(Stateful):
    """Counts by kind, shared by all that may fail in one tracker."""

    STATE: ClassVar[tuple[str, ...]] = (
        "counts",
        "ended",
        "first",
        "last",
    )

    counts: Counter[Failure] = field(default_factory=Counter)
    ended: list[dict[str, int | str]] = field(default_factory=list)
    """Tracks that failures have ended, the first hundred, as in meta.json."""
    first: str | None = None
    """Message of the first failure, in a line."""
    last: str | None = None
    """Traceback, or line, of the newest one."""

    def add(self, failure: Failure, count: int = 1) -> None:
        """Count a failure."""
        self.counts[failure] += count

    def end(self, track_id: int, now_ns: int, failure: Failure) -> None:
        """Count a track that ends."""
        self.add(Failure.TRACK_ENDED)
        if len(self.ended) < 100:
            self.ended.append(
                {"track_id": track_id, "now_ns": now_ns, "failure": failure.value}
            )

    def note(self, what: str | BaseException) -> None:
        """Remember the message of a failure, or its exception."""
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
        """Counts as in meta.json: every kind, zeros included."""
        return {
            "failures": {failure.value: self.counts[failure] for failure in Failure},
            "first_failure": self.first,
            "ended_by_failure": list(self.ended),
        }
