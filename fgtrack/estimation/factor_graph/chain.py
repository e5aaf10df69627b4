"""The order of the nodes in the window, and the graph slots of the segments between them."""

import bisect
from collections.abc import Container
from dataclasses import dataclass, field

import numpy as np

from fgtrack.core.types import FloatArray
from fgtrack.estimation.terms import NEAR_NS, MeasurementTerm


@dataclass(slots=True)
class Node:
    """One distinct stamp of the window."""

    stamp_ns: int
    key: int
    """The variable's number in the graph."""
    origin: FloatArray
    """Linearisation point, shape (n,); that of the noise of the motion factor to the next node as well."""
    terms: list[MeasurementTerm] = field(default_factory=list)
    """What is measured there."""
    term_slots: list[int] = field(default_factory=list)
    """Graph slots of their factors."""
    slot: int | None = None
    """Graph slot of the motion factor to the next node; None of the newest node."""


class Chain:
    """Nodes in the order of their stamps. It never becomes empty."""

    def __init__(self, first: Node) -> None:
        self._nodes = [first]
        self._stamps_ns = [first.stamp_ns]
        self._keys = [first.key]
        self._next_key = first.key + 1
        self._rows = np.array([first.origin])  # origins from row `_start` on, and room for more
        self._start = 0

    @property
    def nodes(self) -> list[Node]:
        """All nodes, oldest first."""
        return self._nodes

    @property
    def keys(self) -> list[int]:
        """Their keys."""
        return self._keys

    @property
    def origins(self) -> FloatArray:
        """Their linearisation points, shape (nodes, n)."""
        return self._rows[self._start : self._start + len(self._nodes)]

    @property
    def oldest(self) -> Node:
        """The anchor: no stamp before it can be inserted."""
        return self._nodes[0]

    @property
    def newest(self) -> Node:
        """The node with the newest stamp."""
        return self._nodes[-1]

    def place(self, stamp_ns: int) -> int:
        """Index of the newest node at or before `stamp_ns`; -1 where all are after it."""
        return bisect.bisect_right(self._stamps_ns, stamp_ns) - 1

    def near(self, stamp_ns: int) -> Node | None:
        """The node at `stamp_ns`, or else the nearest one at most `NEAR_NS` away."""
        place = self.place(stamp_ns)
        around = self._nodes[max(place, 0) : place + 2]
        node = min(around, key=lambda node: abs(node.stamp_ns - stamp_ns))
        return node if abs(node.stamp_ns - stamp_ns) <= NEAR_NS else None

    def insert(self, stamp_ns: int, origin: FloatArray) -> Node:
        """A new node at `stamp_ns`; the slot of the segment that it splits stays with its left neighbour."""
        node = Node(stamp_ns, self._next_key, origin)
        self._next_key += 1
        place = self.place(stamp_ns) + 1
        self._nodes.insert(place, node)
        self._stamps_ns.insert(place, stamp_ns)
        self._keys.insert(place, node.key)
        if self._start + len(self._nodes) > len(self._rows):
            origins = self.origins
            self._rows, self._start = np.concatenate([origins, np.empty_like(origins)]), 0
        origins = self.origins
        origins[place + 1 :] = origins[place:-1]
        origins[place] = origin
        return node

    def move(self, place: int, origin: FloatArray) -> None:
        """The node at index `place` is linearised elsewhere."""
        self._nodes[place].origin = self.origins[place] = origin

    def remove(self, keys: Container[int]) -> None:
        """Take back the insertion of the nodes with `keys`."""
        self._nodes = [node for node in self._nodes if node.key not in keys]
        self._stamps_ns = [node.stamp_ns for node in self._nodes]
        self._keys = [node.key for node in self._nodes]
        self._rows, self._start = np.array([node.origin for node in self._nodes]), 0

    def drop(self, count: int) -> None:
        """Forget the oldest `count` nodes."""
        del self._nodes[:count], self._stamps_ns[:count], self._keys[:count]
        self._start += count
