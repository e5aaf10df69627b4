"""Completion times of the ticks of a run, as a tracking node with a single thread would have."""

from dataclasses import dataclass, field

import numpy as np

from fgtrack.core.types import IntArray
from fgtrack.runs.columns import Columns

_END_NS = int(np.iinfo(np.int64).max)


@dataclass
class Node:
    """A node that processes ticks one after the other, and counts missed deadlines.

    A tick begins when it is due, or when the previous tick is done, if that is later:
    `done = max(due, free) + time`. The deadline is the moment at which the next tick is
    due (Liu & Layland, Scheduling algorithms for multiprogramming in a hard-real-time
    environment, Journal of the ACM 20, 1973).
    """

    period_ns: int | None
    """Time between ticks; None means that there are no deadlines."""
    misses: int = field(default=0, init=False)
    _free_ns: int | None = field(default=None, init=False)

    def done_ns(self, due_ns: int, process_ns: int) -> int:
        """Return the completion time of the tick that is due at `due_ns` and takes `process_ns`.

        Ticks must come in the order of time.
        """
        begun_ns = due_ns if self._free_ns is None else max(due_ns, self._free_ns)
        self._free_ns = begun_ns + process_ns
        self.misses += (
            self.period_ns is not None and self._free_ns > due_ns + self.period_ns
        )
        return self._free_ns


def ready_times(timing: Columns, node: Node) -> IntArray:
    """Return the completion times of all ticks, shape (ticks,), with the processing times in timing.csv."""
    ticks = zip(timing["now_ns"].tolist(), timing["process_ns"].tolist(), strict=True)
    return np.array(
        [min(node.done_ns(*tick), _END_NS) for tick in ticks], dtype=np.int64
    )
