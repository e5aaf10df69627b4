"""State of a tracker between two ticks."""

from dataclasses import dataclass

from fgtrack.core.state import Snapshot


@dataclass(frozen=True)
class TrackerState:
    """All that changes in a tracker, as arrays and plain values; see `fgtrack.core.state`.

    A tracker of the same configuration goes on from it with the same bits.
    """

    tracks: Snapshot
    """Numbers of tracks and ticks, tracks whose direction is sought, lists that wait, and records of the next tick."""
    bank: Snapshot
    """States and windows of the estimators."""
    lifecycle: Snapshot
    """Counters or probabilities of existence."""
    objects: Snapshot
    """Classes, sizes and identities."""
    ego: Snapshot
    """Ego states, and what is learned of their errors."""
    inbox: Snapshot
    """Lists that were received and not processed, and the memory of repeated ones."""
    watermarks: Snapshot
    """Delays of each source of messages."""
    failures: Snapshot
    """Counts of internal failures."""
    facing: Snapshot | None
    """Beliefs about the fronts of tracks; None where every yaw is taken as it is."""
