"""Starts of tracks by the candidates that belong to no track."""

from collections.abc import Iterable

from fgtrack.core.types import Disposition, UpdateRecord
from fgtrack.estimation.base import Start
from fgtrack.estimation.failures import Failure
from fgtrack.tracking.inbox import Batch
from fgtrack.tracking.lives.counters import Scan
from fgtrack.tracking.parts import TrackerParts
from fgtrack.tracking.preprocess import Candidates
from fgtrack.tracking.tracks import Tracks


class TrackStarts:
    """Starts a track with a candidate, if the sensor and the birth rules want one."""

    def __init__(self, parts: TrackerParts, tracks: Tracks) -> None:
        self._parts, self._tracks = parts, tracks

    def give_birth(
        self,
        batch: Batch,
        candidates: Candidates,
        position: int,
        scan: Scan,
        records: list[Iterable[UpdateRecord]],
    ) -> int | None:
        """Start a track and return its number; None if no track starts. `records` get the records of the candidate.

        If the start fails, nothing of the track is kept.
        """
        first, track_id, is_born = len(records), None, False
        try:
            prior = self._prior(candidates, position, scan)
            if prior is None:
                records += candidates.records(batch, [position], Disposition.GATED)
                return None
            track_id = self._tracks.number(scan.objects[candidates.leaders[position]])
            self._parts.bank.birth(track_id, prior)
            if self._parts.bank.holds(track_id):
                self._begin(track_id, batch, candidates, position, scan, prior)
                records += candidates.records(
                    batch, [position], Disposition.BIRTH, track_id
                )
                is_born = True
        except Exception as error:
            self._parts.contain(error, Failure.BIRTH_FAILED)
        finally:
            if len(records) == first:
                records += candidates.records(batch, [position], Disposition.FAILED)
                self._tracks.end([] if track_id is None else [track_id])
        return track_id if is_born else None

    def _prior(self, candidates: Candidates, position: int, scan: Scan) -> Start | None:
        """Return the first state of a track; None if the candidate may not start a track."""
        parts, candidate = self._parts, candidates[position]
        if not parts.sensors[scan.sensor].births:
            return None
        if parts.objects.is_stray(
            scan.objects[candidate.leader], (scan.sensor, scan.stamp_ns)
        ):
            return None
        return parts.birth.prior(
            candidate, parts.road, parts.ego.current, parts.ego.in_pit
        )

    def _begin(
        self,
        track_id: int,
        batch: Batch,
        candidates: Candidates,
        position: int,
        scan: Scan,
        prior: Start,
    ) -> None:
        """Note the data of a track that the bank has started, in all other parts of the tracker."""
        parts, candidate = self._parts, candidates[position]
        self._tracks.begin(track_id, scan.sensor, prior)
        if parts.facing is not None:
            parts.facing.born(track_id, scan.sensor, prior, candidate.measurement)
        parts.lifecycle.born(track_id, scan, candidate)
        parts.objects.learn(track_id, candidates.described(batch, position))
