"""Several objects at once, as the tracker has them: a bank may work on them by other code than on a single one."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import TrackState
from fgtrack.estimation.base import Measurement, Start, TrackBank, UpdateResult
from fgtrack.estimation.dense_joint import Difference, difference
from fgtrack.estimation.object_bank import state_of
from fgtrack.estimation.registry import works_together
from fgtrack.pipeline.certificate import NEAR_TOLERANCE, NOT_FUSED, Check, Subject
from fgtrack.pipeline.verify_models import largest
from fgtrack.pipeline.verify_references import reference
from fgtrack.pipeline.verify_streams import Stream, several

#: More than are held one by one.
NUM_OBJECTS = 8

List = dict[int, Measurement]
"""Measurements of one stamp, by object."""


def born(bank: TrackBank, starts: Sequence[Start]) -> None:
    """Let objects begin, numbered from 0."""
    for number, start in enumerate(starts):
        bank.advance(max(bank.present_ns, start.stamp_ns))
        bank.birth(number, start)


def fed(bank: TrackBank, lists: Sequence[List]) -> list[dict[int, UpdateResult]]:
    """Give `lists` to a bank as the tracker does; what it said of each object."""
    said = []
    for one in lists:
        stamp_ns = next(iter(one.values())).stamp_ns
        bank.advance(max(bank.present_ns, stamp_ns))
        bank.states_at(stamp_ns)
        said.append(dict(zip(one, bank.update(stamp_ns, list(one), list(one.values())), strict=True)))
    return said


def lists_of(objects: Sequence[Sequence[Measurement]]) -> list[List]:
    """Measurements of objects that were sensed together; each object is missing in every fourth list."""
    return [
        {k: one[place] for k, one in enumerate(objects) if (place + k) % 4}
        for place in range(min(len(one) for one in objects))
    ]


def bank_checks(rng: np.random.Generator, name: str, subject: Subject) -> list[Check]:
    """The objects of a bank, each held to the oracle by itself; half way one is removed, and another one begins."""
    if not works_together(subject.factory):
        return []
    objects = several(rng, NUM_OBJECTS)
    checks = []
    for order in ("time", "random") if subject.claims.is_exact else ("time",):
        places = objects[0].orders[order]
        lists = lists_of([[stream.measurements[place] for place in places] for stream in objects])
        checks.append(_check(name, subject, order, objects, lists))
    return checks


def _check(name: str, subject: Subject, order: str, objects: Sequence[Stream], lists: Sequence[List]) -> Check:
    half, gone, new = len(lists) // 2, 2, len(objects)
    later = [{new if k == gone else k: m for k, m in one.items()} for one in lists[half:]]
    bank = subject.start_bank(objects[0])
    born(bank, [stream.prior for stream in objects])
    said = fed(bank, lists[:half])
    bank.remove(gone)
    bank.birth(new, objects[gone].prior)
    said += fed(bank, later)
    known = {k: _fused(objects[gone if k == new else k], k, [*lists[:half], *later]) for k in bank.track_ids}
    newest_ns = max(stream.newest_ns for stream in known.values())
    apart = [
        _apart(bank, k, stream, subject, at)
        for k, stream in known.items()
        for at in (newest_ns, newest_ns + NS_PER_S // 10)
    ]
    refused = sum(result.status in NOT_FUSED for one in said for result in one.values())
    tolerance = subject.oracle_tolerance if subject.claims.solves else None if subject.claims.mixes else NEAR_TOLERANCE
    against = "SciPy" if subject.claims.solves else "SciPy, nearby"
    return Check(objects[0].name, name, order, against, *largest(apart), refused, tolerance)


def _fused(stream: Stream, number: int, lists: Sequence[List]) -> Stream:
    """What was given of the object `number`."""
    given = [id(one[number]) for one in lists if number in one]
    pairs = zip(stream.measurements, stream.sightings, strict=True)
    measurements, sightings = zip(*[(m, seen) for m, seen in pairs if id(m) in given], strict=True)
    return replace(stream, measurements=measurements, sightings=sightings)


def _apart(bank: TrackBank, number: int, stream: Stream, subject: Subject, stamp_ns: int) -> Difference:
    expected = reference(stream, subject.claims.solves or "ekf")
    assert expected is not None
    estimate = expected(stamp_ns)
    assert estimate is not None  # it is ahead
    found = state_of(bank, stream.motion, number, stamp_ns)
    return difference(found, TrackState(stamp_ns, *estimate), stream.motion)
