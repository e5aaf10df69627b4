"""How an update that fails is taken back."""

import numpy as np

from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.banded.nodes import Nodes


class Undo:
    """What an update changes of the nodes of some tracks, but for what is made anew from it."""

    def __init__(self, nodes: Nodes, tracks: IntArray) -> None:
        self._nodes, self._tracks = nodes, tracks
        self._order = nodes.snapshot(tracks)
        self.first = nodes.first[tracks]
        self._moved: tuple[IntArray, FloatArray, FloatArray] | None = None
        self._behind: tuple[IntArray, FloatArray] | None = None
        self._rings: list[tuple[IntArray, FloatArray, FloatArray]] = []
        self.added: list[int] = []
        """Nodes to which a term was added."""

    def keep_origins(self, tracks: IntArray, numbers: IntArray) -> None:
        """The linearisation points of these nodes will move, and what is relative to them."""
        nodes = self._nodes
        behind = nodes.at(tracks, np.maximum(nodes.first[tracks] - 1, 0))
        self._moved = numbers, nodes.origin[numbers], nodes.predicted[numbers, :, -1]
        self._behind = behind, nodes.back[behind, :, -1]

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
        if self._moved is not None and self._behind is not None:
            numbers, nodes.origin[numbers], nodes.predicted[numbers, :, -1] = self._moved
            numbers, nodes.back[numbers, :, -1] = self._behind
        for number in self.added:
            nodes.terms[number].pop()
