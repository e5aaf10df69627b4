"""How an update that fails is taken back."""

import numpy as np

from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.banded.nodes import Nodes, Place


class Undo:
    """What an update changes of the nodes of some tracks, but for what is made anew from it."""

    def __init__(self, nodes: Nodes, tracks: IntArray) -> None:
        self._nodes, self._tracks = nodes, tracks
        self._order = nodes.snapshot(tracks)
        self.first = nodes.first[tracks].copy()
        self._oldest = nodes.at(tracks, self.first)
        self._behind = nodes.at(tracks, np.maximum(self.first - 1, 0))
        self._predicted, self._b_behind = nodes.predicted[self._oldest], nodes.b[self._behind]
        self._moved: tuple[Place, FloatArray] | None = None
        self._rings: list[tuple[Place, list[FloatArray]]] = []
        self.added: list[tuple[int, int]] = []
        """Track and slot of each term that was added."""

    def keep_origins(self, at: Place) -> None:
        """These linearisation points will move."""
        self._moved = at, self._nodes.origin[at]

    def keep_ring(self, track: int) -> None:
        """What is behind the window of `track` will change."""
        nodes = self._nodes
        at = Place(np.full(nodes.first[track], track), nodes.slots[track, : nodes.first[track]])
        self._rings.append((at, [values[at] for values in (nodes.A, nodes.b, nodes.C)]))

    def __call__(self) -> None:
        """Take the changes back."""
        nodes = self._nodes
        nodes.restore(self._tracks, self._order)
        for at, saved in self._rings:
            for values, old in zip((nodes.A, nodes.b, nodes.C), saved, strict=True):
                values[at] = old
        if self._moved is not None:
            at, origins = self._moved
            nodes.origin[at] = origins
        nodes.predicted[self._oldest], nodes.b[self._behind] = self._predicted, self._b_behind
        for track, slot in self.added:
            nodes.terms[track][slot].pop()
