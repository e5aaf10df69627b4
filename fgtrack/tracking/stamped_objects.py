"""Class, identity and size of tracks whose detections may be taken back."""

from collections.abc import Iterable, Sequence
from typing import ClassVar

from fgtrack.core.types import Detection, ObjectReport
from fgtrack.tracking.objects import Objects, Seen

Key = tuple[int, str, int]
"""Stamp and sensor of a list, and index of a detection."""


class StampedObjects(Objects):
    """Descriptions of tracks by their detections inside the horizon, and by the older ones, in the order of stamps."""

    STATE: ClassVar[tuple[str, ...]] = (*Objects.STATE, "_open")

    def __init__(self) -> None:
        super().__init__()
        # Detections that describe each track, and may still be taken back.
        self._open: dict[int, dict[Key, Sequence[Detection]]] = {}

    def tell(self, track_id: int, key: Key, detections: Sequence[Detection]) -> None:
        """Note that `detections` describe a track."""
        if self.describes(detections):
            self._open.setdefault(track_id, {})[key] = detections

    def take_back(self, track_id: int, key: Key) -> None:
        """Forget that the detections with this key describe a track."""
        self._open.get(track_id, {}).pop(key, None)

    def settle(self, oldest_ns: int) -> None:
        """Learn classes, sizes and identities from the detections before `oldest_ns`, whose decisions are final."""
        for track_id, own in self._open.items():
            for key in sorted(each for each in own if each[0] < oldest_ns):
                self.learn(track_id, own.pop(key))

    def reports(self, track_ids: Iterable[int]) -> list[ObjectReport | None]:
        """See `Objects.reports`."""
        return [self._report_of(each) for each in track_ids]

    def _report_of(self, track_id: int) -> ObjectReport | None:
        known, own = self._seen.get(track_id), self._open.get(track_id)
        if not own:
            return None if known is None else self._report(known)
        seen = Seen() if known is None else known.copy()
        for key in sorted(own):
            for detection in own[key]:
                seen.add(detection)
        return self._report(seen)

    def forget(self, track_id: int) -> None:
        """See `Objects.forget`."""
        self._open.pop(track_id, None)
        super().forget(track_id)
