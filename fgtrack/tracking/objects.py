"""Class, identity and size of the objects of tracks: votes of the detections, size by their average."""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from operator import attrgetter

import numpy as np

from fgtrack.core.types import BoolArray, Detection, IntArray, ObjectReport

#: Says which pairs of candidates and tracks, as positions in their lists, both (m,), are not one object, shape (m,).
Apart = Callable[[IntArray, IntArray], BoolArray]
#: Classes that a detector may confuse; any other class is like none.
_ALIKE = (
    ("car", "van", "truck", "bus", "trailer", "vehicle"),
    ("pedestrian", "person", "person_sitting"),
    ("cyclist", "bicycle", "motorcycle", "rider"),
)
_UNKNOWN = 0
_GROUPS = {name: -1 - number for number, group in enumerate(_ALIKE) for name in group}
_SIZES = ("length_m", "width_m", "height_m")
_sizes_m = attrgetter(*_SIZES)
_description = attrgetter("class_name", "id", *_SIZES)
_NO_DESCRIPTION = None, None, None, None, None


@dataclass(slots=True)
class _Seen:
    """Classes and sizes that the detections of one track have reported."""

    classes: Counter[str] = field(default_factory=Counter)
    num_sizes: Counter[str] = field(default_factory=Counter)
    """Number of detections with each of `_SIZES`."""
    sizes_m: dict[str, float] = field(default_factory=dict)
    """Their means."""
    ids: Counter[str] = field(default_factory=Counter)


class Objects:
    """Class and size of each track, and the pairs that they exclude.
    A detection with a class may only belong to a track of its class, which is that of most of its detections, or of
    one like it; one without a class to any.
    """

    def __init__(self) -> None:
        self._seen: dict[int, _Seen] = {}

    def describes(self, detections: Iterable[Detection]) -> bool:
        """True if one of `detections` has a class, size or id."""
        return any(map(_NO_DESCRIPTION.__ne__, map(_description, detections)))

    def learn(self, track_id: int, detections: Iterable[Detection]) -> None:
        """Add detections of the track."""
        for detection in detections:
            if not self.describes([detection]):
                continue
            seen = self._seen.setdefault(track_id, _Seen())
            if detection.class_name is not None:
                seen.classes[detection.class_name] += 1
            if detection.id is not None:
                seen.ids[detection.id] += 1
            for name, value in zip(_SIZES, _sizes_m(detection), strict=True):
                if value is not None:
                    seen.num_sizes[name] += 1
                    mean = seen.sizes_m.get(name, 0.0)
                    seen.sizes_m[name] = mean + 1.0 / seen.num_sizes[name] * (value - mean)

    def apart(self, detections: Iterable[Detection], track_ids: Sequence[int]) -> Apart | None:
        """Return a test of pairs of detections and tracks for different classes; None if no pair is excluded."""
        named = [each.class_name for each in detections] if self._seen else []
        if not any(named):
            return None
        classes = [_most(self._seen[i].classes) if i in self._seen else None for i in track_ids]
        if not any(classes):
            return None
        numbers = dict(_GROUPS)
        theirs, own = (
            np.array([numbers.setdefault(name.lower(), len(numbers) + 1) if name else _UNKNOWN for name in names])
            for names in (named, classes)
        )

        def differ(rows: IntArray, columns: IntArray) -> BoolArray:
            a, b = theirs[rows], own[columns]
            return np.asarray((a != b) & (a != _UNKNOWN) & (b != _UNKNOWN))

        return differ

    def reports(self, track_ids: Iterable[int]) -> list[ObjectReport | None]:
        """Class and size of the object of each track; None if no detection has reported any."""
        return [self._report(self._seen[i]) if i in self._seen else None for i in track_ids]

    def forget(self, track_id: int) -> None:
        """Forget a track that has ended."""
        self._seen.pop(track_id, None)

    def _report(self, seen: _Seen) -> ObjectReport:
        name = _most(seen.classes)
        share = None if name is None else seen.classes[name] / seen.classes.total()
        length_m, width_m, height_m = map(seen.sizes_m.get, _SIZES)
        return ObjectReport(name, share, length_m, width_m, height_m, _most(seen.ids))


def _most(counts: Counter[str]) -> str | None:
    return max(counts, key=counts.__getitem__) if counts else None
