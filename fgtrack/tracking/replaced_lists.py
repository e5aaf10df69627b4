"""Lists that were replaced, because the ego's pose is known better: what their detections were before."""

from collections.abc import Sequence

import numpy as np

from fgtrack.tracking.decisions.entries import Entry


def tracks_of(entry: Entry, publics: Sequence[int | None]) -> dict[int, int | None]:
    """Return the track of each detection, by its index in the message, from the tracks of the candidates."""
    return {
        index: public
        for leader, public in zip(entry.candidates.leaders, publics, strict=True)
        for index in (leader, *entry.candidates.merged.get(leader, ()))
    }


class Replaced:
    """Differences between lists and the lists that have replaced them."""

    def __init__(self) -> None:
        self.lost: list[tuple[Entry, int, int]] = []
        """Former list, position and track of each candidate whose measurement has changed."""
        self.kept: list[tuple[tuple[int, int], tuple[int, int]]] = []
        """Former and present number of the list and position of each candidate with the same measurement."""
        self.renewed: set[tuple[int, int]] = set()
        """Number of the list and position of each candidate with another measurement."""
        self.restarted: set[int] = set()
        """Numbers of the lists whose first states of new tracks have changed."""
        self.tracks: dict[int, dict[int, int | None]] = {}
        """Former track of each detection of a list, by the number of the list and the index of the detection."""

    @property
    def is_any(self) -> bool:
        """True if a list was replaced."""
        return bool(self.tracks)

    def add(self, before: Entry, publics: Sequence[int | None], after: Entry) -> None:
        """Note that `after` has replaced `before`, whose candidates had the tracks `publics`."""
        self.tracks[after.number] = tracks_of(before, publics)
        if _movement(before) != _movement(after):
            self.restarted.add(after.number)
        former = {leader: p for p, leader in enumerate(before.candidates.leaders)}
        for position, leader in enumerate(after.candidates.leaders):
            own = after.number, position
            old = former.get(leader)
            if old is not None and _is_same(before, old, after, position):
                self.kept.append(((before.number, old), own))
                del former[leader]
            else:
                self.renewed.add(own)
        for old in former.values():
            public = publics[old]
            if public is not None:
                self.lost.append((before, old, public))

    def publics_of(self, entry: Entry) -> list[int | None]:
        """Return the former track of each candidate of a list that has replaced another one, or is new."""
        tracks = self.tracks.get(entry.number, {})
        return [tracks.get(leader) for leader in entry.candidates.leaders]


def _movement(entry: Entry) -> tuple[float, float, bool]:
    """Return speed and acceleration of the ego, and whether it is in the pit lane."""
    ego, in_pit = entry.starts.ego, entry.starts.ego_in_pit
    return (
        (0.0, 0.0, in_pit) if ego is None else (ego.speed_mps, ego.accel_mps2, in_pit)
    )


def _is_same(before: Entry, old: int, after: Entry, new: int) -> bool:
    """True for two candidates with the same measurement."""
    first, second = before.candidates[old], after.candidates[new]
    one, other = first.measurement, second.measurement
    return (
        first.merged == second.merged
        and one.model.components == other.model.components
        and np.array_equal(one.z, other.z)
        and np.array_equal(one.R, other.R)
        and (one.pose == other.pose or not one.model.relative)
    )
