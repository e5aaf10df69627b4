"""An update of a window, between its preparation and its solution."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from fgtrack.core.types import FloatArray, TrackState
from fgtrack.estimation.factor_graph.chain import Node
from fgtrack.estimation.factor_graph.rows import Factor
from fgtrack.estimation.marginalised_past import MarginalisedPast
from fgtrack.estimation.terms import MeasurementTerm


@dataclass(slots=True)
class Update:
    """What an update changes, once it is solved."""

    leaving: list[Node]
    past: MarginalisedPast
    """What is behind the window after it."""
    reach_ns: int
    left: list[TrackState] = field(default_factory=list)
    """States of the nodes that leave."""
    new: dict[int, FloatArray] = field(default_factory=dict)
    """First estimates of new nodes, by key."""
    stamps_s: dict[int, float] = field(default_factory=dict)
    """Their stamps, in seconds since the first one."""
    factors: list[Factor] = field(default_factory=list)
    removed: list[int] = field(default_factory=list)
    """Slots of the factors that they replace."""
    _owners: list[tuple[Node, int | MeasurementTerm | None]] = field(default_factory=list)

    def replace(self, factor: Factor, node: Node, slot: int | None, place: int | None = None) -> None:
        """A factor in place of that in `slot`: the segment behind `node`, or that of its term at `place`."""
        self.factors.append(factor)
        self._owners.append((node, place))
        if slot is not None:
            self.removed.append(slot)

    def add(self, factor: Factor, node: Node, term: MeasurementTerm) -> None:
        """The factor of a new term of `node`."""
        self.factors.append(factor)
        self._owners.append((node, term))

    def place(self, slots: Sequence[int]) -> None:
        """The factors are in the graph, in `slots`: note it at their nodes."""
        for (node, what), slot in zip(self._owners, slots, strict=True):
            if what is None:
                node.slot = slot
            elif isinstance(what, int):
                node.term_slots[what] = slot
            else:
                node.terms.append(what)
                node.term_slots.append(slot)
