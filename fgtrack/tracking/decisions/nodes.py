"""Tracks of hypotheses, hypotheses, and the steps after each list."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.models.motion import MotionModel
from fgtrack.tracking.decisions.columns import (
    ALIVE,
    BELIEVED,
    COASTS,
    COUNT,
    EXISTED,
    FIRST_X_M,
    FIRST_Y_M,
    HAZARD_HZ,
    HITS,
    IS_CONFIRMED,
    MISSES,
    NUM_NUMBERS,
    NUM_PROBABILITIES,
    OWN,
    ROOT,
    SENSOR,
)
from fgtrack.tracking.decisions.entries import Description, Entry
from fgtrack.tracking.decisions.unseen import Unseen

NONE = -1
"""Track of a candidate that is clutter, and candidate of a track that is missed."""


@dataclass(frozen=True)
class Nodes:
    """Tracks of all hypotheses at the stamp of a list, the youngest first. Arrays have n tracks."""

    means: FloatArray
    covariances: FloatArray
    visible: FloatArray
    """Probability that the object is visible to each sensor, shape (n, sensors)."""
    probabilities: FloatArray
    """Numbers by the columns of `fgtrack.tracking.decisions.columns`, shape (n, 7)."""
    numbers: IntArray
    """Whole numbers by the columns of `fgtrack.tracking.decisions.columns`, shape (n, 8)."""
    descriptions: tuple[Description, ...]

    def __len__(self) -> int:
        return len(self.means)

    @property
    def existed(self) -> FloatArray:
        """Probability that the object has ever existed."""
        return self.probabilities[:, EXISTED]

    @property
    def believed(self) -> FloatArray:
        """Probability that the object has ever existed, if the detections of the track may also be clutter."""
        return self.probabilities[:, BELIEVED]

    @property
    def alive(self) -> FloatArray:
        """Probability that the object still exists, if it has ever existed."""
        return self.probabilities[:, ALIVE]

    @property
    def own(self) -> FloatArray:
        """Probability that the track is no second return of another track."""
        return self.probabilities[:, OWN]

    @property
    def hazards_hz(self) -> FloatArray:
        """Rates at which the probability of existence decays until the next list."""
        return self.probabilities[:, HAZARD_HZ]

    @property
    def first_m(self) -> FloatArray:
        """First positions, shape (n, 2)."""
        return self.probabilities[:, FIRST_X_M : FIRST_Y_M + 1]

    @property
    def roots(self) -> IntArray:
        """Numbers of the tracks: of the detections that started them."""
        return self.numbers[:, ROOT]

    @property
    def hits(self) -> IntArray:
        """Numbers of detections."""
        return self.numbers[:, HITS]

    @property
    def sensors(self) -> IntArray:
        """Numbers of the sensors that started the tracks."""
        return self.numbers[:, SENSOR]

    @property
    def counts(self) -> IntArray:
        """Numbers of detections by `sensors`."""
        return self.numbers[:, COUNT]

    @property
    def misses(self) -> IntArray:
        """Numbers of lists of `sensors` in whose view the object was, without a detection."""
        return self.numbers[:, MISSES]

    @property
    def coasts(self) -> BoolArray:
        """True for each track that was missed by the last list that could show it."""
        return np.asarray(self.numbers[:, COASTS] == 1)

    @property
    def is_confirmed(self) -> BoolArray:
        """True for each confirmed track."""
        return np.asarray(self.numbers[:, IS_CONFIRMED] == 1)

    @property
    def present(self) -> FloatArray:
        """Probability that each track is an object of its own that exists now, shape (n,)."""
        return np.asarray(self.believed * self.alive * self.own)

    def present_of(self, row: int) -> float:
        """Return `present` of one track."""
        own = self.probabilities[row]
        return float(own[BELIEVED] * own[ALIVE] * own[OWN])

    def at(self, rows: IntArray) -> "Nodes":
        """Return a copy of the tracks in `rows`."""
        return Nodes(
            self.means.take(rows, axis=0),
            self.covariances.take(rows, axis=0),
            self.visible.take(rows, axis=0),
            self.probabilities.take(rows, axis=0),
            self.numbers.take(rows, axis=0),
            tuple([self.descriptions[row] for row in rows.tolist()]),
        )


class Ended(NamedTuple):
    """A track that has ended."""

    root: int
    probability: float
    """Probability that the object has ever existed."""
    is_confirmed: bool


@dataclass(frozen=True)
class Hypothesis:
    """One explanation of all detections up to a list."""

    log_weight: float
    rows: IntArray
    """Rows of its tracks that may still exist, which ascend."""
    taken: tuple[int, ...]
    """Track of each candidate of the list, by root; `NONE` for clutter."""
    parent: int
    """Index of the hypothesis of the step before."""
    ended: tuple[Ended, ...] = ()
    """Tracks that end with this list."""


@dataclass(frozen=True)
class Step:
    """Hypotheses after a list, the best one first."""

    stamp_ns: int
    entry: Entry | None
    nodes: Nodes
    hypotheses: tuple[Hypothesis, ...]
    unseen: tuple[Unseen, ...] = ()
    """Objects that no list has shown."""
    apart: Mapping[tuple[int, int], float] = field(default_factory=dict)
    """Evidence that two tracks are two objects; see `fgtrack.tracking.decisions.second_returns`."""


def first_step(motion: MotionModel, num_sensors: int, stamp_ns: int) -> Step:
    """Return the step before the first list, without tracks."""
    n = motion.dim
    nodes = Nodes(
        np.zeros((0, n)),
        np.zeros((0, n, n)),
        np.zeros((0, num_sensors)),
        np.zeros((0, NUM_PROBABILITIES)),
        np.zeros((0, NUM_NUMBERS), dtype=np.int64),
        (),
    )
    return Step(
        stamp_ns, None, nodes, (Hypothesis(0.0, np.zeros(0, dtype=np.int64), (), 0),)
    )


def joined(first: Nodes, second: Nodes) -> Nodes:
    """Return the tracks of both."""
    if not len(second):
        return first
    if not len(first):
        return second
    return Nodes(
        np.concatenate([first.means, second.means]),
        np.concatenate([first.covariances, second.covariances]),
        np.concatenate([first.visible, second.visible]),
        np.concatenate([first.probabilities, second.probabilities]),
        np.concatenate([first.numbers, second.numbers]),
        first.descriptions + second.descriptions,
    )


def ended(nodes: Nodes, row: int) -> Ended:
    """Return a track as one that ends."""
    probability = float(nodes.existed[row] * nodes.own[row])
    return Ended(int(nodes.roots[row]), probability, bool(nodes.is_confirmed[row]))


def living(step: Step) -> list[Ended]:
    """Return the tracks of the best hypothesis as if they ended now."""
    return [ended(step.nodes, row) for row in step.hypotheses[0].rows.tolist()]
