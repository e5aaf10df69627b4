"""Backward-forward delay compensation (Karle et al. 2023, section III-G), for all objects together.

Every object's states are stored on one time grid. A delayed measurement corrects the stored state nearest to its
stamp, and the model integrates from there to the present. **What was fused after that stamp is forgotten**: this
is the baseline, and not a replay.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from fgtrack.core.time import nanoseconds, period_ns, seconds
from fgtrack.core.types import FloatArray, SmoothedReport, TrackState
from fgtrack.estimation.base import Measurement, Start, StatesAt, UpdateResult, UpdateStatus, no_states, stacks
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.filters.ekf import correct
from fgtrack.estimation.filters.propagation import ExactPropagator, kinematic_states
from fgtrack.models.motion import MotionModel


class Anchor(NamedTuple):
    """A stored state; all states up to the next anchor are predicted from it."""

    grid: int
    """Grid index of the state."""
    visible_from: int
    """Grid index from which a look-up finds it."""
    mean: FloatArray
    covariance: FloatArray


@dataclass(slots=True)
class _Storage:
    """The stored past of one object."""

    anchors: list[Anchor]
    oldest: int
    """Grid index before which the object is not known."""
    newest_fused_ns: int

    def at(self, grid: int) -> Anchor:
        """The anchor that the state at `grid` is predicted from."""
        for anchor in reversed(self.anchors):
            if anchor.visible_from <= grid:
                return anchor
        return self.anchors[0]

    def trim(self, oldest: int) -> None:
        """Forget what is older than `oldest`."""
        self.oldest = max(self.oldest, oldest)
        while len(self.anchors) > 1 and self.anchors[1].visible_from <= self.oldest:
            del self.anchors[0]


class BackwardForwardBank:
    """EKFs of all objects on a shared time grid, with their stored states (the paper's object storage).

    Between two corrections the stored states are pure prediction, so only corrected states are kept, and a state
    in between is predicted when it is asked for. The storage reaches `storage_steps` of `step_ns` back.
    """

    def __init__(self, propagator: ExactPropagator, step_ns: int, storage_steps: int) -> None:
        self._propagator = propagator
        self._step_ns = step_ns
        self._step_s = seconds(step_ns)
        self._length = storage_steps
        self._now_ns: int | None = None
        self._grid_ns = 0  # stamp of the newest grid state
        self._grid = 0  # its index
        self._objects: dict[int, _Storage] = {}
        self._cached: dict[int, StatesAt] = {}  # by grid index; valid until anything changes

    @property
    def present_ns(self) -> int:
        """See `TrackBank.present_ns`."""
        return self._grid_ns if self._now_ns is None else self._now_ns

    @property
    def window_start_ns(self) -> int:
        """See `TrackBank.window_start_ns`: the storage, and half a step."""
        return self._grid_ns - (self._length - 1) * self._step_ns - self._step_ns // 2

    @property
    def track_ids(self) -> tuple[int, ...]:
        """See `TrackBank.track_ids`."""
        return tuple(self._objects)

    def advance(self, now_ns: int) -> None:
        """Move the present to the last grid stamp that is not after `now_ns`."""
        grid_ns = now_ns // self._step_ns * self._step_ns
        if self._now_ns is None:
            self._grid_ns = grid_ns
        self._now_ns = now_ns
        self._advance_steps((grid_ns - self._grid_ns) // self._step_ns)

    def _advance_steps(self, steps: int) -> None:
        """Move the present by `steps`."""
        if steps > 0:
            self._grid += steps
            self._grid_ns += steps * self._step_ns
            self._cached.clear()
        for storage in self._objects.values():
            storage.trim(self._grid - self._length + 1)

    def _at_grid(self, grid: int) -> StatesAt:
        """States at `grid` of all objects that exist there; at the present they are the filters' own."""
        if grid in self._cached:
            return self._cached[grid]
        n = self._propagator.motion.dim
        rows = {i: each for i, each in self._objects.items() if grid == self._grid or each.oldest <= grid}
        if not rows:
            return no_states(n)
        anchors = [each.anchors[-1] if grid == self._grid else each.at(grid) for each in rows.values()]
        means, covariances = self._propagator.propagate(
            np.concatenate([anchor.mean for anchor in anchors]).reshape(len(anchors), -1),
            np.concatenate([anchor.covariance for anchor in anchors]).reshape(len(anchors), n, n),
            np.array([grid - anchor.grid for anchor in anchors], dtype=np.int64),
            self._step_s,
        )
        self._cached[grid] = states = StatesAt(tuple(rows), means, covariances)
        return states

    def steps_back(self, stamp_ns: int) -> int:
        """Grid steps from the present back to the state nearest to `stamp_ns`; the newer one on a tie."""
        late_ns = self._grid_ns - stamp_ns
        return max(-((self._step_ns - 2 * late_ns) // (2 * self._step_ns)), 0)

    def states_at(self, stamp_ns: int) -> StatesAt:
        """Stored states nearest to `stamp_ns`, of those objects whose storage reaches back so far."""
        return self._at_grid(self._grid - self.steps_back(stamp_ns))

    def update(
        self, stamp_ns: int, track_ids: Sequence[int], measurements: Sequence[Measurement]
    ) -> list[UpdateResult]:
        """Correct the stored states nearest to `stamp_ns`; the present is predicted from them."""
        states = self.states_at(stamp_ns)
        rows = {track_id: row for row, track_id in enumerate(states.track_ids)}
        back, results = self.steps_back(stamp_ns), [UpdateResult(UpdateStatus.FAILED)] * len(track_ids)
        for indices, alike in stacks(measurements):
            chosen = [rows[track_ids[i]] for i in indices]
            x, P = states.means.take(chosen, axis=0), states.covariances.take(chosen, axis=0)
            y, H = alike.model.linearised(alike.z, x, alike.pose, partial(self._propagator.residual, alike.model))
            corrected = correct(x, P, y, H, alike.R, alike.measured, alike.loss)
            wrapped, nis = self._propagator.wrap(corrected.mean), corrected.nis.tolist()
            for k in corrected.fused.nonzero()[0].tolist():
                storage = self._objects[track_ids[indices[k]]]
                anchor = Anchor(self._grid - back, self._visible_from(back), wrapped[k], corrected.covariance[k])
                while storage.anchors and storage.anchors[-1].visible_from >= anchor.visible_from:
                    storage.anchors.pop()  # it replaces all that was stored at and after it
                storage.anchors.append(anchor)
                late = storage.newest_fused_ns > stamp_ns
                storage.newest_fused_ns = max(storage.newest_fused_ns, stamp_ns)
                status = UpdateStatus.OUT_OF_SEQUENCE if late else UpdateStatus.IN_SEQUENCE
                results[indices[k]] = UpdateResult(status, corrected.innovation[k], nis[k])
        self._cached.clear()
        return results

    def _visible_from(self, back: int) -> int:
        """Grid index from which a look-up finds a state corrected `back` steps ago."""
        return self._grid - back

    def birth(self, track_id: int, prior: Start) -> None:
        """Start an object on the grid stamp nearest to its first detection."""
        back = max(round((self._grid_ns - prior.stamp_ns) / self._step_ns), 0)
        start = self._grid - back
        mean, covariance = initial_state(self._propagator.motion, prior)
        anchor = Anchor(start, start, self._propagator.wrap(mean), covariance)
        self._objects[track_id] = _Storage([anchor], start, prior.stamp_ns)
        self._objects[track_id].trim(self._grid - self._length + 1)
        self._cached.clear()

    def remove(self, track_id: int) -> None:
        """See `TrackBank.remove`."""
        del self._objects[track_id]
        self._cached.clear()

    def present(self) -> Sequence[TrackState]:
        """See `TrackBank.present`; the part of a step beyond the newest grid stamp is predicted."""
        states = self._at_grid(self._grid)
        if not states.track_ids:
            return []
        mean, covariance = states.means, states.covariances
        rest_s = seconds(self.present_ns - self._grid_ns)
        if rest_s:
            item = np.ones(len(mean), dtype=np.int64)
            mean, covariance = self._propagator.propagate(mean, covariance, item, rest_s)
        return kinematic_states(self._propagator.motion, self.present_ns, mean, covariance)

    def smoothed(self) -> list[SmoothedReport]:
        """See `TrackBank.smoothed`: none."""
        return []


def backward_forward(motion: MotionModel, lag_s: float, frequency_hz: float = 100.0) -> BackwardForwardBank:
    """Backward-forward delay compensation (Karle et al. 2023): forgets what was fused after a late measurement."""
    step_ns = period_ns(frequency_hz)
    return BackwardForwardBank(ExactPropagator(motion), step_ns, max(nanoseconds(lag_s) // step_ns, 1))


vars(backward_forward)["bank"] = True
