"""Two tracks of one object."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from scipy.spatial import KDTree

from fgtrack.core.time import nanoseconds
from fgtrack.core.types import FloatArray
from fgtrack.tracking.lifecycle import Life


@dataclass(frozen=True)
class DuplicateRules:
    """What is done against two tracks of one object; nothing by default, as in the paper."""

    distance_m: float | None = None
    """Tracks closer together than two objects can be; null: never."""
    after_s: float = 0.5
    """They must have been that close for so long."""
    claim_overtaken: bool = False
    """Whether a track claims a detection that the newer one which started it has overtaken. As in the paper it does
    not, and the detection starts a second track: with a fast and a slow sensor nearly every new object gets two."""

    def __post_init__(self) -> None:
        if self.distance_m is not None and not self.distance_m > 0.0:
            raise ValueError(f"distance_m: must be positive, is {self.distance_m}")
        if not self.after_s >= 0.0:
            raise ValueError(f"after_s: must not be negative, is {self.after_s}")


class Duplicates:
    """Finds tracks that follow the same object: a first detection that was far off starts one, a good one the next.

    Each takes detections from the other, by turns. The one with fewer of them ends, the younger of two with as many.
    """

    def __init__(self, distance_m: float, after_s: float) -> None:
        self._distance_m = distance_m
        self._after_ns = nanoseconds(after_s)
        self._since_ns: dict[tuple[int, int], int] = {}

    def ended(
        self, now_ns: int, track_ids: Sequence[int], positions_m: FloatArray, lives: Mapping[int, Life]
    ) -> list[int]:
        """Ids of the tracks that end at `now_ns`; `positions_m` (n, 2) are those of `track_ids` now."""
        close = KDTree(positions_m).query_pairs(self._distance_m) if len(track_ids) > 1 else ()
        pairs = sorted((track_ids[min(pair)], track_ids[max(pair)]) for pair in close)
        self._since_ns = {pair: self._since_ns.get(pair, now_ns) for pair in pairs}
        ended: list[int] = []
        for pair, since_ns in self._since_ns.items():
            if now_ns - since_ns >= self._after_ns and not set(pair).intersection(ended):
                ended.append(min(pair, key=lambda track_id: (lives[track_id].num_measured, -track_id)))
        return ended
