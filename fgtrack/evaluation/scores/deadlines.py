"""Deadlines of a run, by the times of timing.csv."""

import math
from dataclasses import dataclass

from fgtrack.core.time import NS_PER_S, period_ns, seconds
from fgtrack.core.types import IntArray
from fgtrack.io.run import Node, Run, ready_times


@dataclass(frozen=True)
class Deadlines:
    """Missed deadlines and load of a run whose ticks take their time on a node with a single thread.

    Attributes
    ----------
    period_s
        Between ticks; NaN where every message ticks or the configuration has no period: there are no deadlines.
    ticks, misses
        Number of ticks, and of those that were not done when the next one was due, see `Node`.
    load
        Computing time over the length of the run; above 1 it falls behind for good. NaN of fewer than two ticks.
    latest_s
        The longest from the moment at which a tick was due until it was done; NaN without a tick.
    """

    period_s: float
    ticks: int
    misses: int
    load: float
    latest_s: float

    @property
    def are_known(self) -> bool:
        """True if there are deadlines."""
        return math.isfinite(self.period_s)

    @classmethod
    def of(cls, run: Run) -> "Deadlines":
        """Deadlines of `run`."""
        ready_ns, node = ready(run)
        timing = run.tables["timing"]
        now_ns = timing["now_ns"]
        span_ns = int(now_ns[-1] - now_ns[0]) if len(now_ns) else 0
        return cls(
            period_s=math.nan if node.period_ns is None else seconds(node.period_ns),
            ticks=len(now_ns),
            misses=node.misses,
            load=float(timing["process_ns"].sum() / span_ns) if span_ns else math.nan,
            latest_s=float((ready_ns - now_ns).max() / NS_PER_S) if len(now_ns) else math.nan,
        )


def ready(run: Run) -> tuple[IntArray, Node]:
    """Time at which the output of every tick was ready, shape (ticks,), and the node that did them."""
    node_hz = (run.config.get("clock") or {}).get("node_hz")
    node = Node(None if node_hz is None else period_ns(float(node_hz)))
    return ready_times(run.tables["timing"], node), node
