"""Update of the tracks with the candidates of one object list."""

from collections.abc import Iterable, Iterator
from itertools import repeat

import numpy as np

from fgtrack.core.types import IntArray, UpdateRecord
from fgtrack.estimation.base import (
    Measurement,
    Measurements,
    StatesAt,
    UpdateResult,
    UpdateStatus,
)
from fgtrack.estimation.failures import Failure
from fgtrack.tracking.association import Assignment
from fgtrack.tracking.facing import YawsRead, as_read
from fgtrack.tracking.inbox import Batch, FusedRecords
from fgtrack.tracking.list_association import ListAssociation
from fgtrack.tracking.parts import TrackerParts
from fgtrack.tracking.preprocess import Candidates, Group
from fgtrack.tracking.soft_association import equivalent
from fgtrack.tracking.tracks import Tracks


class ListUpdate:
    """Fuses the candidates of a list with the tracks that they belong to."""

    def __init__(
        self, parts: TrackerParts, tracks: Tracks, association: ListAssociation
    ) -> None:
        self._parts, self._tracks, self._association = parts, tracks, association
        self.kept: dict[int, tuple[Measurement, int]] | None = None
        """Stack and row of each measurement of the newest list, by the index of its pair; None if nobody asks."""

    def fuse(
        self,
        batch: Batch,
        candidates: Candidates,
        assignment: Assignment,
        states: StatesAt,
        records: list[Iterable[UpdateRecord]],
    ) -> None:
        """Fuse the matched candidates, group by group. Append their records to `records`, in the order of the
        candidates.

        If a group raises, its candidates have failed. The results of the other groups are recorded in any case.
        """
        outcomes: dict[
            int, tuple[Measurement, UpdateResult]
        ] = {}  # by index of the pair
        chosen, tracks = np.array(assignment.pairs).T
        read: YawsRead | None = None
        try:
            joint = self._association.joint(batch, candidates, states)
            read = self._read(batch, candidates, assignment, states)
            for group, members, here in candidates.split(chosen):
                is_placed = candidates.placed[chosen[here[0]]]  # as all others
                try:
                    for pairs, of, each, ways in _seen(
                        group, members, here, tracks, states, read
                    ):
                        stack = (
                            each
                            if joint is None
                            else equivalent(each, of, group, joint, states, ways)
                        )
                        self._fused(stack, of, states, outcomes, pairs, is_placed)
                except Exception as error:
                    self._parts.contain(error, Failure.LIST_FAILED)
        finally:
            failed, leaders = (
                (None, UpdateResult(UpdateStatus.FAILED)),
                candidates.leaders,
            )
            matched = [
                (leaders[position], states.track_ids[track], *outcomes.get(k, failed))
                for k, (position, track) in enumerate(assignment.pairs)
            ]
            words = [None] * len(matched) if read is None else read.words
            records.append(
                FusedRecords(batch.message, matched, candidates.merged, words)
            )

    def _read(
        self,
        batch: Batch,
        candidates: Candidates,
        assignment: Assignment,
        states: StatesAt,
    ) -> YawsRead | None:
        """Return the readings of the matched candidates; None if every yaw is used as it was measured."""
        facing = self._parts.facing
        if facing is None:
            return None
        pairs, readings = assignment.pairs, assignment.readings
        return facing.read(
            batch.message.sensor, batch.stamp_ns, candidates, pairs, readings, states
        )

    def _fused(
        self,
        stack: Measurement,
        of: IntArray,
        states: StatesAt,
        outcomes: dict[int, tuple[Measurement, UpdateResult]],
        pairs: IntArray,
        is_placed: bool,
    ) -> None:
        """Fuse a stack of measurements of the tracks whose states have the indices `of` (m,).

        The outcomes are noted by the indices `pairs` (m,). `is_placed` is True if the measurements give positions.
        """
        track_ids, measurements = states.track_ids, Measurements(stack)
        ids = list(map(track_ids.__getitem__, of.tolist()))
        results = self._parts.bank.update(stack.stamp_ns, ids, measurements)
        made = zip(repeat(stack), results)
        outcomes.update(zip(pairs.tolist(), made, strict=True))
        if self.kept is not None:
            self.kept.update(
                (pair, (stack, row)) for row, pair in enumerate(pairs.tolist())
            )
        fused = [row for row, each in enumerate(results) if each.innovation is not None]
        for row in fused:
            self._tracks.num_measured[ids[row]] += 1
        if is_placed:
            try:
                self._tracks.placed(ids, fused, measurements, of, states, results)
            except Exception as error:
                self._parts.contain(error, Failure.STEP_FAILED)


def _seen(
    group: Group,
    members: IntArray,
    here: IntArray,
    tracks: IntArray,
    states: StatesAt,
    read: YawsRead | None,
) -> Iterator[tuple[IntArray, IntArray, Measurement, IntArray | None]]:
    """Yield stacks of measurements of the `members` of a group, with the readings in `read`.

    `here` are the indices of their pairs, and `tracks` are the tracks of all pairs. Each stack comes after the indices
    of its pairs and their tracks, and before its readings.
    """
    of = tracks.take(here)
    each = group.seen_at(members, states.means.take(of, axis=0), states.covariances, of)
    if read is None:
        yield here, of, each, None
        return
    ways = read.readings[here]
    for rows, part in as_read(each, ways):
        yield here[rows], of[rows], part, ways[rows]
