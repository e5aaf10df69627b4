"""Backward-forward delay compensation (Karle et al. 2023, section III-G), for all objects together.

Every object's states are stored on one time grid. A delayed measurement corrects the stored state nearest to its
stamp, and the model integrates from there to the present. **What was fused after that stamp is forgotten**: this
is the baseline, and not a replay.
"""

from collections.abc import Sequence

import numpy as np

from fgtrack.core.time import seconds
from fgtrack.core.types import FloatArray, IntArray, TrackState
from fgtrack.estimation.base import (
    BirthPrior,
    Measurement,
    StatesAt,
    UpdateResult,
    UpdateStatus,
    no_states,
)
from fgtrack.estimation.birth import birth_state
from fgtrack.estimation.ekf import Correction, correct
from fgtrack.estimation.propagation import Propagator, wrapped_yaw


class BackwardForwardBank:
    """EKFs of all objects with a shared grid of stored states (the paper's object storage).

    Parameters
    ----------
    propagator
        Motion model in steps.
    step_ns
        Grid step, the inverse of the filter frequency.
    storage_steps
        Number of grid states kept for each object.
    """

    def __init__(self, propagator: Propagator, step_ns: int, storage_steps: int) -> None:
        self._propagator = propagator
        self._step_ns = step_ns
        self._step_s = seconds(step_ns)
        self._length = storage_steps
        self._dim = propagator.motion.dim
        self._now_ns: int | None = None
        self._grid_ns = 0  # stamp of the newest grid state
        self._grid = 0  # its index
        self._rows: dict[int, int] = {}
        self._reserve(4)

    def _reserve(self, capacity: int) -> None:
        n, length = self._dim, self._length
        self._mean = np.zeros((capacity, n))
        self._covariance = np.zeros((capacity, n, n))
        self._stored_mean = np.zeros((length, capacity, n))
        self._stored_covariance = np.zeros((length, capacity, n, n))
        self._oldest = np.zeros(capacity, dtype=np.int64)  # grid index of the oldest stored state
        self._newest_fused_ns = np.zeros(capacity, dtype=np.int64)

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
        return tuple(self._rows)

    def advance(self, now_ns: int) -> None:
        """Predict every object, grid step by grid step, up to the last grid stamp not after `now_ns`."""
        grid_ns = now_ns // self._step_ns * self._step_ns
        if self._now_ns is None:
            self._grid_ns = grid_ns
        self._now_ns = now_ns
        self._advance_steps((grid_ns - self._grid_ns) // self._step_ns)

    def _advance_steps(self, steps: int) -> None:
        rows = self._all_rows()
        if not len(rows):
            self._grid += max(steps, 0)
            self._grid_ns += max(steps, 0) * self._step_ns
            return
        for done in range(0, max(steps, 0), self._length):
            part = min(self._length, steps - done)
            self._grid += part
            self._grid_ns += part * self._step_ns
            self._integrate(rows, part)
        np.maximum(self._oldest, self._grid - self._length + 1, out=self._oldest)

    def _integrate(self, rows: IntArray, steps: int) -> None:
        """Predict `rows` by `steps` that end at the newest grid stamp, and store every state on the way."""
        means, covariances = self._propagator.propagate(self._mean[rows], self._covariance[rows], steps, self._step_s)
        slots = np.arange(self._grid - steps + 1, self._grid + 1) % self._length
        self._stored_mean[slots[:, None], rows] = means
        self._stored_covariance[slots[:, None], rows] = covariances
        self._mean[rows] = means[-1]
        self._covariance[rows] = covariances[-1]

    def _all_rows(self) -> IntArray:
        return np.fromiter(self._rows.values(), dtype=np.int64, count=len(self._rows))

    def steps_back(self, stamp_ns: int) -> int:
        """Grid steps from the newest stored state back to the one nearest to `stamp_ns`; the newer one on a tie."""
        late_ns = self._grid_ns - stamp_ns
        return max(-((self._step_ns - 2 * late_ns) // (2 * self._step_ns)), 0)

    def states_at(self, stamp_ns: int) -> StatesAt:
        """Stored states nearest to `stamp_ns`, of those objects whose storage reaches back so far."""
        back = self.steps_back(stamp_ns)
        if back == 0:
            rows = self._all_rows()
            return StatesAt(self.track_ids, self._mean[rows], self._covariance[rows])
        ids = tuple(track_id for track_id, row in self._rows.items() if self._oldest[row] <= self._grid - back)
        if not ids:
            return no_states(self._dim)
        rows = self._rows_of(ids)
        slot = (self._grid - back) % self._length
        return StatesAt(ids, self._stored_mean[slot, rows], self._stored_covariance[slot, rows])

    def _rows_of(self, track_ids: Sequence[int]) -> IntArray:
        return np.array([self._rows[track_id] for track_id in track_ids], dtype=np.int64)

    def update(
        self, stamp_ns: int, track_ids: Sequence[int], measurements: Sequence[Measurement]
    ) -> list[UpdateResult]:
        """Correct the stored states nearest to `stamp_ns` and integrate them forward to the present."""
        groups: dict[tuple[int, int], list[int]] = {}
        for position, measurement in enumerate(measurements):
            groups.setdefault((id(measurement.model), id(measurement.pose)), []).append(position)
        results: dict[int, UpdateResult] = {}
        for positions in groups.values():
            part = self._update_alike(stamp_ns, [track_ids[i] for i in positions], [measurements[i] for i in positions])
            results.update(zip(positions, part, strict=True))
        return [results[position] for position in range(len(measurements))]

    def _update_alike(
        self, stamp_ns: int, track_ids: Sequence[int], measurements: Sequence[Measurement]
    ) -> list[UpdateResult]:
        """Update with measurements that share a model and a sensor pose."""
        back = self.steps_back(stamp_ns)
        rows = self._rows_of(track_ids)
        slot = (self._grid - back) % self._length
        if back:
            mean, covariance = self._stored_mean[slot, rows], self._stored_covariance[slot, rows]
        else:
            mean, covariance = self._mean[rows], self._covariance[rows]
        corrected = self._correct(mean, covariance, measurements)
        if corrected is None:
            if len(measurements) == 1:
                return [UpdateResult(UpdateStatus.FAILED)]
            each = zip(track_ids, measurements, strict=True)
            return [self._update_alike(stamp_ns, [track_id], [one])[0] for track_id, one in each]
        self._mean[rows] = self._propagator.settle(corrected.mean)
        self._covariance[rows] = corrected.covariance
        self._store(back, slot, rows)
        if back:
            self._integrate(rows, back)
        late = self._newest_fused_ns[rows] > stamp_ns
        np.maximum.at(self._newest_fused_ns, rows, stamp_ns)
        return [
            UpdateResult(
                UpdateStatus.OUT_OF_SEQUENCE if late[i] else UpdateStatus.IN_SEQUENCE,
                corrected.innovation[i],
                float(corrected.nis[i]),
            )
            for i in range(len(measurements))
        ]

    def _correct(
        self, mean: FloatArray, covariance: FloatArray, measurements: Sequence[Measurement]
    ) -> Correction | None:
        """Posteriors; None where one of the measurements cannot be fused."""
        z = np.array([measurement.z for measurement in measurements])
        R = np.array([measurement.R for measurement in measurements])
        try:
            corrected = correct(mean, covariance, z, R, measurements[0].model, measurements[0].pose)
        except np.linalg.LinAlgError:  # a singular innovation covariance
            return None
        sound = np.isfinite(corrected.mean).all() and np.isfinite(corrected.covariance).all()
        return corrected if sound else None

    def _store(self, back: int, slot: int, rows: IntArray) -> None:
        """Let the corrected states replace the stored ones."""
        self._stored_mean[slot, rows] = self._mean[rows]
        self._stored_covariance[slot, rows] = self._covariance[rows]

    def birth(self, track_id: int, prior: BirthPrior) -> None:
        """Start an object on the grid stamp nearest to its first detection and integrate it to the present."""
        if len(self._rows) == len(self._mean):
            self._grow()
        used = set(self._rows.values())
        row = next(row for row in range(len(self._mean)) if row not in used)
        back = max(round((self._grid_ns - prior.stamp_ns) / self._step_ns), 0)
        self._rows[track_id] = row
        rows = np.array([row], dtype=np.int64)
        mean, self._covariance[row] = birth_state(self._propagator.motion, prior)
        self._mean[row] = self._propagator.settle(mean)
        self._newest_fused_ns[row] = prior.stamp_ns
        self._oldest[row] = max(self._grid - back, self._grid - self._length + 1)
        slot = (self._grid - back) % self._length
        self._stored_mean[slot, row] = self._mean[row]
        self._stored_covariance[slot, row] = self._covariance[row]
        if back:
            self._integrate(rows, back)

    def _grow(self) -> None:
        old = (self._mean, self._covariance, self._stored_mean, self._stored_covariance)
        ages = (self._oldest, self._newest_fused_ns)
        count = len(self._mean)
        self._reserve(2 * count)
        self._mean[:count], self._covariance[:count] = old[0], old[1]
        self._stored_mean[:, :count], self._stored_covariance[:, :count] = old[2], old[3]
        self._oldest[:count], self._newest_fused_ns[:count] = ages

    def remove(self, track_id: int) -> None:
        """See `TrackBank.remove`."""
        del self._rows[track_id]

    def present(self) -> list[TrackState]:
        """See `TrackBank.present`; the part of a step beyond the newest grid stamp is predicted."""
        rows = self._all_rows()
        if not len(rows):
            return []
        mean, covariance = self._mean[rows], self._covariance[rows]
        rest_s = seconds(self.present_ns - self._grid_ns)
        if rest_s:
            means, covariances = self._propagator.propagate(mean, covariance, 1, rest_s)
            mean, covariance = means[0], covariances[0]
        mean, covariance = self._propagator.motion.kinematic(mean, covariance)
        mean = wrapped_yaw(mean)
        return [TrackState(self.present_ns, m, P) for m, P in zip(mean, covariance, strict=True)]
