"""Class, identity and size of the objects of tracks: votes of the detections, size by their average."""

import math
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from typing import ClassVar

import numpy as np

from fgtrack.core.state import Stateful
from fgtrack.core.types import BoolArray, Detection, FloatArray, IntArray, ObjectReport

#: Selects pairs of candidates and tracks, as positions in their lists, both (m,), are not one object, shape (m,).
Apart = Callable[[IntArray, IntArray], BoolArray]
#: Classes that a detector may confuse; any other class is like none.
_ALIKE = (
    ("car", "van", "truck", "bus", "trailer", "vehicle"),
    ("pedestrian", "person", "person_sitting"),
    ("cyclist", "bicycle", "motorcycle", "rider"),
)
_UNKNOWN, _OTHER = 0, -1
_MOST_STRAYS = 3  # where one in ten is an outlier, four in a row are as improbable as a wrong identity (1e-4)
_MOST_FORMER = 10_000  # ended tracks that are remembered, the last ones
_GROUPS = {name: -1 - number for number, group in enumerate(_ALIKE) for name in group}
_SIZES = ("length_m", "width_m", "height_m")


def differ(first: str | None, second: str | None) -> bool:
    """Return True for two classes that a detector does not confuse; None is an unknown class."""
    if first is None or second is None:
        return False
    a, b = first.lower(), second.lower()
    return _GROUPS.get(a, a) != _GROUPS.get(b, b)


_sizes_m = attrgetter(*_SIZES)
_description = attrgetter("class_name", "id", *_SIZES)
_NO_DESCRIPTION = None, None, None, None, None


@dataclass(slots=True)
class Seen:
    """Classes and sizes that the detections of one track have reported."""

    classes: Counter[str] = field(default_factory=Counter)
    num_sizes: Counter[str] = field(default_factory=Counter)
    """Number of detections with each of `_SIZES`."""
    sizes_m: dict[str, float] = field(default_factory=dict)
    """Their means."""
    ids: Counter[str] = field(default_factory=Counter)

    def copy(self) -> "Seen":
        """Return a copy."""
        return Seen(
            self.classes.copy(),
            self.num_sizes.copy(),
            self.sizes_m.copy(),
            self.ids.copy(),
        )

    def add(self, detection: Detection) -> None:
        """Add class, size and identity of a detection."""
        if detection.class_name is not None:
            self.classes[detection.class_name] += 1
        if detection.id is not None:
            self.ids[detection.id] += 1
        for name, value in zip(_SIZES, _sizes_m(detection), strict=True):
            if value is not None:
                self.num_sizes[name] += 1
                mean = self.sizes_m.get(name, 0.0)
                share = 1.0 / self.num_sizes[name]
                self.sizes_m[name] = mean + share * (value - mean)


class Evidence:
    """Evidence of class and identity on pairs of detections and tracks."""

    def __init__(
        self,
        classes: Apart | None,
        theirs: IntArray,
        own: IntArray,
        wrong_id_probability: float,
    ) -> None:
        """Collect the evidence.

        `classes` is a test of pairs for different classes; None if all classes agree. `theirs` (detections,) and `own`
        (tracks,) are the numbers of the identities; 0 is a missing identity. `wrong_id_probability` is the probability
        that an identity is wrong.
        """
        self._classes, self._theirs, self._own = classes, theirs, own
        self.weight = 2.0 * math.log(
            (1.0 - wrong_id_probability) / wrong_id_probability
        )
        """Twice the log-likelihood ratio of equal against different identities."""

    def __call__(self, rows: IntArray, columns: IntArray) -> BoolArray:
        """Return True for each pair that differs in class or identity, shape (m,)."""
        return self.differ(rows, columns) | (self.nis(rows, columns) > 0.0)

    def differ(self, rows: IntArray, columns: IntArray) -> BoolArray:
        """Return True for each pair that differs in class, shape (m,)."""
        return (
            np.zeros(len(rows), dtype=bool)
            if self._classes is None
            else self._classes(rows, columns)
        )

    def nis(self, rows: IntArray, columns: IntArray) -> FloatArray:
        """Return the addition to the NIS of each pair, shape (m,).

        It is `weight` for different identities, -`weight` for equal identities, and 0 if an identity is missing.
        """
        a, b = self._theirs[rows], self._own[columns]
        return np.where(
            (a == _UNKNOWN) | (b == _UNKNOWN),
            0.0,
            np.where(a == b, -self.weight, self.weight),
        )


class Objects(Stateful):
    """Class, identity and size of each track, and the pairs of detections and tracks that they exclude.

    The class of a track is the class of most of its detections. A detection with a class may belong to a track of the
    same or a similar class. A detection without a class may belong to any track. Identities are evidence, see
    `Evidence`.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        "_seen",
        "_ids",
        "_owners",
        "_former",
        "_strays",
        "id_conflicts",
    )

    def __init__(self) -> None:
        self._seen: dict[int, Seen] = {}
        self._ids: dict[int, str] = {}  # of most detections, by track
        self._owners: dict[
            str, set[int]
        ] = {}  # tracks of an identity, of most of their detections
        self._former: dict[str, int] = {}  # tracks that have ended, by identity
        self._strays: dict[
            str, tuple[int, Hashable]
        ] = {}  # by identity, see `is_stray`: their number, newest list
        self.id_conflicts: Counter[str] = Counter()
        """Identities that were `reused`: a track began with that of another one; or `changed`: a track fused another
        identity than most of its detections have."""

    def describes(self, detections: Iterable[Detection]) -> bool:
        """True if one of `detections` has a class, size or id."""
        return any(map(_NO_DESCRIPTION.__ne__, map(_description, detections)))

    def learn(self, track_id: int, detections: Iterable[Detection]) -> None:
        """Learn class, size and identity of the track from `detections`."""
        for detection in detections:
            if not self.describes([detection]):
                continue
            seen = self._seen.setdefault(track_id, Seen())
            known, is_first = self._ids.get(track_id), not seen.ids
            seen.add(detection)
            if detection.id is not None:
                if is_first and detection.id in self._owners:
                    self.id_conflicts["reused"] += 1
                if known not in (None, detection.id):
                    self.id_conflicts["changed"] += 1
                self._strays.pop(detection.id, None)
                if detection.id != known and seen.ids[detection.id] > seen.ids.get(
                    known or "", 0
                ):
                    self._disown(track_id)
                    self._ids[track_id] = detection.id
                    self._owners.setdefault(detection.id, set()).add(track_id)

    def owner(self, detection: Detection) -> int | None:
        """Return the only track with the identity of `detection`.

        None if no track or several tracks have the identity. None also for a detection with a class, because the class
        decides.
        """
        if detection.id is None or detection.class_name is not None:
            return None
        tracks = self._owners.get(detection.id, ())
        return next(iter(tracks)) if len(tracks) == 1 else None

    def evidence(
        self,
        detections: Iterable[Detection],
        track_ids: Sequence[int],
        wrong_id_probability: float,
    ) -> Apart | None:
        """Return the evidence of classes and identities on pairs of detections and tracks; None without evidence."""
        if not self._seen:
            return None
        detections = list(detections)
        classes, ids = (
            self.apart(detections, track_ids),
            [each.id for each in detections],
        )
        if not any(ids):
            return classes
        numbers: dict[str | None, int] = {
            name: number for number, name in enumerate(dict.fromkeys(ids), 1) if name
        }
        theirs = np.array([numbers.get(name, _UNKNOWN) for name in ids])
        own = np.array(
            [
                numbers.get(self._ids[i], _OTHER) if i in self._ids else _UNKNOWN
                for i in track_ids
            ]
        )
        return Evidence(classes, theirs, own, wrong_id_probability)

    def is_stray(self, detection: Detection, of: Hashable) -> bool:
        """True if `detection` is an outlier: a track that does not match it has its identity.

        False if three lists had outliers with this identity just before. The list `of` the detection counts once: of
        several detections with the same identity in a list, most must be wrong.
        """
        if detection.id is None or detection.id not in self._owners:
            return False
        count, newest = self._strays.get(detection.id, (0, None))
        if newest != of:
            count += 1
        self._strays[detection.id] = count, of
        return count <= _MOST_STRAYS

    def former(self, detection: Detection) -> int | None:
        """Return the ended or lost track with the identity of `detection`; None if there is no such track.

        A new track takes its number, because an identity belongs to one object. After a gap, or at another position,
        the identity still means the same object.
        """
        lost = min(self._owners.get(detection.id or "", ()), default=None)
        return self._former.pop(detection.id or "", None) if lost is None else lost

    def apart(
        self, detections: Iterable[Detection], track_ids: Sequence[int]
    ) -> Apart | None:
        """Return a test of pairs of detections and tracks: True if their classes differ. None if no pair is
        excluded.
        """
        named = [each.class_name for each in detections]
        if not any(named):
            return None
        classes = [
            _most(self._seen[i].classes) if i in self._seen else None for i in track_ids
        ]
        if not any(classes):
            return None
        numbers = dict(_GROUPS)
        theirs, own = (
            np.array(
                [
                    numbers.setdefault(name.lower(), len(numbers) + 1)
                    if name
                    else _UNKNOWN
                    for name in names
                ]
            )
            for names in (named, classes)
        )

        def differ(rows: IntArray, columns: IntArray) -> BoolArray:
            a, b = theirs[rows], own[columns]
            return np.asarray((a != b) & (a != _UNKNOWN) & (b != _UNKNOWN))

        return differ

    def reports(self, track_ids: Iterable[int]) -> list[ObjectReport | None]:
        """Return class and size of the object of each track; None if no detection has reported them."""
        return [
            self._report(self._seen[i]) if i in self._seen else None for i in track_ids
        ]

    def forget(self, track_id: int) -> None:
        """Forget a track that has ended."""
        self._seen.pop(track_id, None)
        if identity := self._disown(track_id):
            self._former[identity] = track_id
            if len(self._former) > _MOST_FORMER:
                del self._former[next(iter(self._former))]

    def _disown(self, track_id: int) -> str | None:
        """Remove the identity of a track, and return it."""
        identity = self._ids.pop(track_id, None)
        if identity is not None:
            self._owners[identity].discard(track_id)
            if not self._owners[identity]:
                del self._owners[identity]
        return identity

    def _report(self, seen: Seen) -> ObjectReport:
        name = _most(seen.classes)
        share = None if name is None else seen.classes[name] / seen.classes.total()
        length_m, width_m, height_m = map(seen.sizes_m.get, _SIZES)
        return ObjectReport(name, share, length_m, width_m, height_m, _most(seen.ids))


def _most(counts: Counter[str]) -> str | None:
    return max(counts, key=counts.__getitem__) if counts else None
