"""How an update that fails is taken back."""

import numpy as np

from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.banded.nodes import Nodes


class Undo:
    """What an update changes of the nodes of some tracks, but for what is made anew from it."""

    def __init__(self, nodes: Nodes, tracks: IntArray) -> None:
        self._nodes, self._tracks = nodes, tracks
        nodes.reserve(int(nodes.count[tracks].max()))
        self._order = nodes.snapshot(tracks)
        self.first = nodes.first[tracks]
        self._oldest = nodes.at(tracks, self.first)
        self._behind = nodes.at(tracks, np.maximum(self.first - 1, 0))
        self._predicted = nodes.predicted[self._oldest, :, -1]
        self._b_behind = nodes.back[self._behind, :, -1]
        self._moved: tuple[IntArray, FloatArray] | None = None
        self._rings: list[tuple[IntArray, FloatArray, FloatArray]] = []
        self.added: list[int] = []
        """Nodes to which a term was added."""

    def keep_origins(self, numbers: IntArray) -> None:
        """These linearisation points will move."""
        self._moved = numbers, self._nodes.origin[numbers]

    def keep_ring(self, track: int) -> None:
        """What is behind the window of `track` will change."""
        nodes = self._nodes
        numbers = nodes.numbers[track, : nodes.first[track]].copy()
        self._rings.append((numbers, nodes.back[numbers], nodes.C[numbers]))

    def __call__(self) -> None:
        """Take the changes back."""
        nodes = self._nodes
        nodes.restore(self._tracks, self._order)
        for numbers, back, C in self._rings:
            nodes.back[numbers], nodes.C[numbers] = back, C
        if self._moved is not None:
            numbers, origins = self._moved
            nodes.origin[numbers] = origins
        nodes.predicted[self._oldest, :, -1], nodes.back[self._behind, :, -1] = self._predicted, self._b_behind
        for number in self.added:
            nodes.terms[number].pop()
