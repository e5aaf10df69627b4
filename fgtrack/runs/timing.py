"""When the ticks of a run were done: one after the other, as a node with a single thread does them."""

from dataclasses import dataclass, field

import numpy as np

from fgtrack.core.types import IntArray
from fgtrack.runs.reader import Columns

_END_NS = int(np.iinfo(np.int64).max)


@dataclass
class Node:
    """Does ticks one after the other; counts those that miss their deadline, the moment at which the next one is due.
    A tick begins when it is due, or when the one before it is done, if that is later: `done = max(due, free) + time`.
    The deadline is that of Liu & Layland (Scheduling algorithms for multiprogramming in a hard-real-time environment,
    Journal of the ACM 20, 1973).
    """

    period_ns: int | None
    """Between ticks; without one there are no deadlines."""
    misses: int = field(default=0, init=False)
    _free_ns: int | None = field(default=None, init=False)

    def done_ns(self, due_ns: int, process_ns: int) -> int:
        """When the tick that is due at `due_ns` and takes `process_ns` is done; ticks come in the order of time."""
        begun_ns = due_ns if self._free_ns is None else max(due_ns, self._free_ns)
        self._free_ns = begun_ns + process_ns
        self.misses += (
            self.period_ns is not None and self._free_ns > due_ns + self.period_ns
        )
        return self._free_ns


def ready_times(timing: Columns, node: Node) -> IntArray:
    """When the output of every tick of timing.csv was ready, shape (ticks,), with the times measured there."""
    ticks = zip(timing["now_ns"].tolist(), timing["process_ns"].tolist(), strict=True)
    return np.array(
        [min(node.done_ns(*tick), _END_NS) for tick in ticks], dtype=np.int64
    )
