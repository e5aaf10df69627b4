"""Decisions about all lists inside the horizon, in the order of their stamps."""

from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

from fgtrack.core.state import Stateful
from fgtrack.core.types import BoolArray
from fgtrack.models.motion import MotionModel
from fgtrack.tracking.decisions.entries import Entry
from fgtrack.tracking.decisions.nodes import (
    NONE,
    Ended,
    Nodes,
    Step,
    first_step,
    living,
)
from fgtrack.tracking.decisions.rules import Rules
from fgtrack.tracking.decisions.steps import following


@dataclass(frozen=True)
class Explained:
    """A list whose decisions are new or have changed."""

    entry: Entry
    taken: tuple[int, ...]
    """Track of each candidate, by root; `NONE` for clutter."""


@dataclass(frozen=True)
class Settled:
    """Decisions about a list."""

    entry: Entry
    taken: tuple[int, ...]
    """Track of each candidate, by root; `NONE` for clutter."""
    ended: tuple[Ended, ...]
    """Tracks that end with the list."""


class Doubt(NamedTuple):
    """The newest lists make a track improbable."""

    since_ns: int
    """Stamp of the first of these lists."""
    awaited: BoolArray
    """True for each sensor that could show the object, shape (sensors,)."""


class Decisions(Stateful):
    """Keeps the hypotheses after each list, and decides again from the stamp of a late list on.

    A step is never changed, so the step before a late list is its checkpoint.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        "_steps",
        "_first",
        "_published",
        "_next_root",
        "_next_list",
    )

    def __init__(
        self, rules: Rules, num_sensors: int, takes_late_lists: bool = True
    ) -> None:
        self._takes_late_lists = takes_late_lists
        self._rules, self._num_sensors = rules, num_sensors
        self._steps: list[Step] = []
        self._first: Step | None = None
        """Step before the first one that is kept."""
        self._published: list[int] = []
        """Hypothesis of each step that is published."""
        self._next_root = self._next_list = 0

    @property
    def motion(self) -> MotionModel:
        """Motion model of the decisions."""
        return self._rules.motion

    @property
    def newest(self) -> Step | None:
        """The step after the newest list."""
        return self._steps[-1] if self._steps else None

    @property
    def nodes(self) -> Nodes | None:
        """Tracks of the best hypothesis after the newest list."""
        step = self.newest
        return None if step is None else step.nodes.at(step.hypotheses[0].rows)

    @property
    def roots(self) -> set[int]:
        """Tracks of all hypotheses after the newest list."""
        step = self.newest
        return set() if step is None else set(step.nodes.roots.tolist())

    @property
    def open_roots(self) -> set[int]:
        """Tracks of all hypotheses after any list inside the horizon, and before the first one."""
        steps = [*self._steps] if self._first is None else [self._first, *self._steps]
        return {root for step in steps for root in step.nodes.roots.tolist()}

    @property
    def entries(self) -> list[Entry]:
        """All lists inside the horizon, in the order of their stamps."""
        return [step.entry for step in self._steps if step.entry is not None]

    def is_too_old(self, stamp_ns: int) -> bool:
        """True for a stamp before the lists that are decided for good, or late where no late list is taken."""
        if not self._takes_late_lists and self._steps:
            return stamp_ns < self._steps[-1].stamp_ns
        return self._first is not None and (
            self._first.entry is not None and stamp_ns < self._first.stamp_ns
        )

    def add(self, entry: Entry) -> list[Explained]:
        """Decide about a list, and again about all newer ones. Return the lists whose decisions are new or changed,
        the oldest one first.
        """
        return self.replace([], [entry])

    def replace(self, old: Sequence[Entry], new: Sequence[Entry]) -> list[Explained]:
        """Decide as if the lists `new` had been there instead of the lists `old`; see `add`.

        A new list that has numbers of tracks keeps them.
        """
        if not (old or new):
            return []
        for entry in new:
            entry.number, self._next_list = self._next_list, self._next_list + 1
            for _ in range(len(entry.candidates) - len(entry.roots)):
                entry.roots.append(self.next_root())
        if self._first is None:
            first_ns = min(entry.batch.stamp_ns for entry in new)
            self._first = first_step(self._rules.motion, self._num_sensors, first_ns)
        entries = self.entries
        keys = [each.key for each in entries]
        at = min(
            [bisect_right(keys, each.key) for each in new]
            + [entries.index(each) for each in old]
        )
        step = self._steps[at - 1] if at else self._first
        gone = {id(each) for each in old}
        again = [each for each in entries[at:] if id(each) not in gone]
        steps = []
        for each in sorted([*again, *new], key=lambda entry: entry.key):
            step = following(step, each, self._rules)
            steps.append(step)
        self._steps[at:] = steps
        self._published[at:] = [NONE] * len(steps)
        return list(self._changes(at))[::-1]

    def doubt(self, row: int, least: float) -> Doubt:
        """Return since when the track in a `row` of the newest step exists with a probability below `least`."""
        newest = self._steps[-1]
        root = newest.nodes.roots[row]
        since_ns = newest.stamp_ns
        for step, number in zip(
            reversed(self._steps), reversed(self._published), strict=True
        ):
            rows = step.hypotheses[number].rows
            own = rows[step.nodes.roots[rows] == root]
            if not len(own) or step.nodes.present_of(int(own[0])) >= least:
                break
            since_ns = step.stamp_ns
        ego = None if newest.entry is None else newest.entry.scan.ego
        views = self._rules.views.of(newest.nodes.means[row : row + 1, :2], ego)
        return Doubt(since_ns, views[0])

    def next_root(self) -> int:
        """Return the next number of a track, which is not given again."""
        self._next_root += 1
        return self._next_root - 1

    def _changes(self, at: int) -> Iterator[Explained]:
        """Yield the lists whose published hypothesis changes, the newest one first.

        The steps from `at` on are new. The published hypothesis of a step is the ancestor of the best one now.
        """
        hypothesis = 0
        for k in range(len(self._steps) - 1, -1, -1):
            step = self._steps[k]
            if k < at and self._published[k] == hypothesis:
                return
            self._published[k] = hypothesis
            own = step.hypotheses[hypothesis]
            if step.entry is not None:
                yield Explained(step.entry, own.taken)
            hypothesis = own.parent

    def forget(self, oldest_ns: int) -> list[Settled]:
        """Decide for good about the lists before `oldest_ns`; return the decisions, the oldest one first."""
        count = bisect_left(self._steps, oldest_ns, key=lambda step: step.stamp_ns)
        if not count:
            return []
        settled = self._settled(count)
        self._first = self._steps[count - 1]
        del self._steps[:count], self._published[:count]
        return settled

    def _settled(self, count: int) -> list[Settled]:
        """Return the published decisions about the first `count` lists."""
        published = zip(self._steps[:count], self._published[:count], strict=True)
        return [
            Settled(step.entry, own.taken, own.ended)
            for step, number in published
            if step.entry is not None
            for own in [step.hypotheses[number]]
        ]

    def finished(self) -> list[Settled]:
        """Return the decisions about all lists that are not decided for good. The tracks end with the last one."""
        settled = self._settled(len(self._steps))
        if self._steps:
            last = settled[-1]
            ended = (*last.ended, *living(self._steps[-1]))
            settled[-1] = Settled(last.entry, last.taken, ended)
        return settled
