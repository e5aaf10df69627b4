"""Tracks of hypotheses, hypotheses, and the steps after each list."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.models.motion import MotionModel
from fgtrack.tracking.decisions.entries import Description, Entry
from fgtrack.tracking.decisions.unseen import Unseen

NONE = -1
"""Track of a candidate that is clutter, and candidate of a track that is missed."""


@dataclass(frozen=True)
class Nodes:
    """Tracks of all hypotheses at the stamp of a list, the youngest first. Arrays have n tracks."""

    means: FloatArray
    covariances: FloatArray
    existed: FloatArray
    """Probability that the object has ever existed."""
    believed: FloatArray
    """Probability that the object has ever existed, if the detections of the track may also be clutter."""
    alive: FloatArray
    """Probability that the object still exists, if it has ever existed."""
    visible: FloatArray
    """Probability that the object is visible to each sensor, shape (n, sensors)."""
    is_confirmed: BoolArray
    has_travelled: BoolArray
    first_m: FloatArray
    """First positions, shape (n, 2)."""
    roots: IntArray
    """Numbers of the tracks: of the detections that started them."""
    hazards_hz: FloatArray
    """Rates at which the probability of existence decays until the next list."""
    hits: IntArray
    """Numbers of detections."""
    counts: IntArray
    """Numbers of detections by `sensors`."""
    misses: IntArray
    """Numbers of lists of `sensors` in whose view the object was, without a detection."""
    sensors: IntArray
    """Numbers of the sensors that started the tracks."""
    own: FloatArray
    """Probability that the track is no second return of another track."""
    coasts: BoolArray
    """True for each track that was missed by the last list that could show it."""
    descriptions: tuple[Description, ...]

    @property
    def present(self) -> FloatArray:
        """Probability that each track is an object of its own that exists now, shape (n,)."""
        return np.asarray(self.believed * self.alive * self.own)

    def at(self, rows: IntArray) -> "Nodes":
        """Return the tracks in `rows`."""
        return Nodes(
            self.means.take(rows, axis=0),
            self.covariances.take(rows, axis=0),
            self.existed.take(rows),
            self.believed.take(rows),
            self.alive.take(rows),
            self.visible.take(rows, axis=0),
            self.is_confirmed.take(rows),
            self.has_travelled.take(rows),
            self.first_m.take(rows, axis=0),
            self.roots.take(rows),
            self.hazards_hz.take(rows),
            self.hits.take(rows),
            self.counts.take(rows),
            self.misses.take(rows),
            self.sensors.take(rows),
            self.own.take(rows),
            self.coasts.take(rows),
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
    """Rows of its tracks that may still exist."""
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


def first_step(motion: MotionModel, num_sensors: int, stamp_ns: int) -> Step:
    """Return the step before the first list, without tracks."""
    n = motion.dim
    nodes = Nodes(
        np.zeros((0, n)),
        np.zeros((0, n, n)),
        np.zeros(0),
        np.zeros(0),
        np.zeros(0),
        np.zeros((0, num_sensors)),
        np.zeros(0, dtype=bool),
        np.zeros(0, dtype=bool),
        np.zeros((0, 2)),
        np.zeros(0, dtype=np.int64),
        np.zeros(0),
        np.zeros(0, dtype=np.int64),
        np.zeros(0, dtype=np.int64),
        np.zeros(0, dtype=np.int64),
        np.zeros(0, dtype=np.int64),
        np.zeros(0),
        np.zeros(0, dtype=bool),
        (),
    )
    return Step(
        stamp_ns, None, nodes, (Hypothesis(0.0, np.zeros(0, dtype=np.int64), (), 0),)
    )


def joined(first: Nodes, second: Nodes) -> Nodes:
    """Return the tracks of both."""
    if not len(second.roots):
        return first
    if not len(first.roots):
        return second
    arrays = {
        name: np.concatenate([getattr(first, name), getattr(second, name)])
        for name in Nodes.__annotations__
        if name != "descriptions"
    }
    return Nodes(**arrays, descriptions=first.descriptions + second.descriptions)


def ended(nodes: Nodes, row: int) -> Ended:
    """Return a track as one that ends."""
    probability = float(nodes.existed[row] * nodes.own[row])
    return Ended(int(nodes.roots[row]), probability, bool(nodes.is_confirmed[row]))


def living(step: Step) -> list[Ended]:
    """Return the tracks of the best hypothesis as if they ended now."""
    return [ended(step.nodes, row) for row in step.hypotheses[0].rows.tolist()]
