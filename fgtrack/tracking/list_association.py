"""Association of one object list with the tracks: classes, identities, gates, assignment."""

from collections.abc import Sequence
from functools import partial

import numpy as np

from fgtrack.core.time import seconds
from fgtrack.core.types import BoolArray, TrackStatus
from fgtrack.estimation.base import StatesAt
from fgtrack.estimation.filters.ekf import propagated
from fgtrack.tracking.association import Assignment, Likely, Pairs, claimed
from fgtrack.tracking.facing import Facings
from fgtrack.tracking.inbox import Batch
from fgtrack.tracking.lives.existence import after_jumps, explained
from fgtrack.tracking.objects import Apart, Evidence
from fgtrack.tracking.parts import TrackerParts
from fgtrack.tracking.preprocess import Candidates
from fgtrack.tracking.soft_association import joint_probabilities
from fgtrack.tracking.tracks import Tracks

_SELDOM = 1e-3  # probability with which a true pair misses the usual gate


class ListAssociation:
    """Decides which candidates of a list belong to which tracks."""

    def __init__(self, parts: TrackerParts, tracks: Tracks) -> None:
        self._parts, self._tracks = parts, tracks

    def identified(
        self, batch: Batch, candidates: Candidates
    ) -> tuple[StatesAt, Assignment] | None:
        """Return the state of the track with the identity of the only candidate, and the assignment to this track.

        None unless the identity is seldom wrong and belongs to one track, and the candidate lies inside the gate of
        this track. The cost does not depend on the number of tracks.
        """
        parts, message = self._parts, batch.message
        sensor = parts.sensors[message.sensor]
        if sensor.scan or len(candidates) != 1 or sensor.wrong_id_probability > _SELDOM:
            return None
        if parts.joint is not None and parts.joint.joint_from is not None:
            return None
        owner = parts.objects.owner(message.objects[candidates.leaders[0]])
        if owner is None or self._tracks.is_undirected(owner):
            return None
        states = parts.bank.state_of(owner, batch.stamp_ns)
        assignment = parts.association(
            candidates, states, facings=self._facings(batch, states)
        )
        return (states, assignment) if assignment.pairs else None

    def assigned(
        self, batch: Batch, candidates: Candidates, states: StatesAt
    ) -> Assignment:
        """Return the assignment of candidates to tracks of the same class, and by their identities."""
        parts, evidence = self._parts, self._evidence(batch, candidates, states)
        likely = self._likely(batch, candidates, states, evidence)
        result = parts.association(
            candidates, states, evidence, likely, self._facings(batch, states)
        )
        if parts.joint is None or not (parts.joint.claim_m and result.new):
            return result
        statuses, _ = parts.lifecycle.reported(states.track_ids)
        tentative = [each is TrackStatus.TENTATIVE for each in statuses]
        result = claimed(
            result,
            candidates,
            states,
            np.where(tentative, -1.0, parts.joint.claim_m),
            evidence,
        )
        reaches_m = np.where(tentative, -1.0, parts.joint.max_distance_m)
        return after_jumps(
            result, candidates, states, reaches_m, parts.sensors[batch.message.sensor]
        )

    def _likely(
        self,
        batch: Batch,
        candidates: Candidates,
        states: StatesAt,
        evidence: Apart | None,
    ) -> Likely | None:
        """Return the test of pairs against clutter and new objects; None if no pair is tested."""
        weigh, tests = self._parts.weigh_births, list[Likely]()
        if weigh is not None and all(
            group.stack.model.components == ("x_m", "y_m")
            for group in candidates.groups
        ):
            tests.append(
                partial(weigh, batch.message.sensor, batch.stamp_ns, states.track_ids)
            )
        sensor, stamp_ns = batch.message.sensor, batch.stamp_ns
        newborn = self._tracks.newborn_of_others(sensor, stamp_ns, states.track_ids)
        if newborn is not None:
            scene = newborn, batch, candidates, states, evidence
            tests.append(partial(self._explained, *scene))
        if not tests:
            return None
        return lambda pairs: np.all([test(pairs) for test in tests], axis=0)

    def _explained(
        self,
        newborn: BoolArray,
        batch: Batch,
        candidates: Candidates,
        states: StatesAt,
        evidence: Apart | None,
        pairs: Pairs,
    ) -> BoolArray:
        """Return True for each of `pairs` that is kept, shape (m,).

        A pair with one of the `newborn` tracks is not kept if clutter or a new object explains the candidate better.
        """
        result = np.ones(len(pairs.rows), dtype=bool)
        placed = np.array(
            [candidates.placed[row] for row in pairs.rows.tolist()], dtype=bool
        )
        chosen = (newborn[pairs.columns] & placed).nonzero()[0]
        if len(chosen):
            tested, lifecycle = pairs.at(chosen), self._parts.lifecycle
            sensor = self._parts.sensors[batch.message.sensor]
            ids = [states.track_ids[column] for column in tested.columns.tolist()]
            detected = sensor.detection_probability * lifecycle.existing(
                ids, batch.stamp_ns
            )
            odds = detected / (1.0 - detected) if sensor.scan else detected
            others_per_m2 = sensor.clutter_per_m2 / (1.0 - lifecycle.birth_probability)
            more_nis = np.zeros(len(chosen))
            if isinstance(evidence, Evidence):
                more_nis = evidence.nis(tested.rows, tested.columns)
            result[chosen] = explained(
                tested, candidates, states, odds, others_per_m2, more_nis
            )
        return result

    def _evidence(
        self, batch: Batch, candidates: Candidates, states: StatesAt
    ) -> Apart | None:
        described = map(batch.message.objects.__getitem__, candidates.leaders)
        wrong = self._parts.sensors[batch.message.sensor].wrong_id_probability
        return self._parts.objects.evidence(described, states.track_ids, wrong)

    def _facings(self, batch: Batch, states: StatesAt) -> Facings | None:
        """Return the log-odds of the fronts of the tracks, and the shares of wrong yaws; None if every yaw is used
        as it was measured.
        """
        facing = self._parts.facing
        return (
            None
            if facing is None
            else facing.at(batch.message.sensor, states.track_ids)
        )

    def joint(
        self, batch: Batch, candidates: Candidates, states: StatesAt
    ) -> Pairs | None:
        """Return the probabilities that candidates belong to tracks, for tracks with enough detections.

        None if the association is not configured to compute them.
        """
        rule = self._parts.joint
        if rule is None or rule.joint_from is None:
            return None
        evidence = self._evidence(batch, candidates, states)
        pairs = rule.gated(candidates, states, evidence, self._facings(batch, states))
        known = np.array(
            [
                self._tracks.num_measured[track_id] >= rule.joint_from
                for track_id in states.track_ids
            ]
        )
        sensor = self._parts.sensors[batch.message.sensor]
        return joint_probabilities(
            pairs.at(known[pairs.columns]), candidates, states, sensor
        )

    def claimed_by_younger(
        self, batch: Batch, candidates: Candidates, new: Sequence[int], states: StatesAt
    ) -> tuple[StatesAt, Assignment] | None:
        """Return the states of the younger tracks, and the assignment of the `new` candidates to them.

        A younger track was started by a newer detection that arrived before `batch`. A candidate of its object is too
        old for the track, and is no new object. So the present states of the younger tracks are moved back to the
        stamp of `batch` and compared with the candidates. `states` are the states of the older tracks. Returns None
        without younger tracks.
        """
        bank, motion = self._parts.bank, self._parts.motion
        now = bank.states_at(bank.present_ns)
        back_s = seconds(bank.present_ns - batch.stamp_ns)
        now = now.without(self._parts.lifecycle.suspended())
        rows = [
            row
            for row, track_id in enumerate(now.track_ids)
            if track_id not in states.track_ids
        ]
        if not rows:
            return None
        x, F = now.means[rows], motion.jacobian(now.means[rows], -back_s)
        P = propagated(F, now.covariances[rows], motion.process_noise(x, back_s))
        ids = tuple(now.track_ids[row] for row in rows)
        moved = StatesAt(ids, motion.predict(x, -back_s), P)
        younger = self._tracks.in_any_direction(moved, batch.stamp_ns)
        return younger, self.assigned(batch, candidates.at(new), younger)
