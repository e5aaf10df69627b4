"""Backward-forward delay compensation (Karle et al. 2023, section III-G), for all objects together.

The states of all objects are stored on one time grid. A delayed measurement corrects
the stored state nearest to its stamp. The motion model predicts from there to the
present. **Measurements that were fused after that stamp are lost**: the method is a
baseline, and no replay.
"""

from collections.abc import Sequence
from functools import partial
from itertools import compress
from typing import Any, ClassVar

import numpy as np

from fgtrack.core.linalg import kernels
from fgtrack.core.state import Stateful
from fgtrack.core.time import nanoseconds, period_ns, seconds
from fgtrack.core.types import FloatArray, IntArray, SmoothedReport, TrackState
from fgtrack.estimation.base import (
    Measurement,
    Start,
    StatesAt,
    UpdateResult,
    UpdateStatus,
    no_states,
    stacks,
)
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.filters.ekf import Correction, correct
from fgtrack.estimation.filters.propagation import ExactPropagator, kinematic_states
from fgtrack.estimation.object_bank import Outcomes, changing_nothing
from fgtrack.models.motion import MotionModel

_KERNELS = "fgtrack.karle2023.storage_kernels"
#: Update status by the code that the kernels return.
_STATUS = UpdateStatus.FAILED, UpdateStatus.IN_SEQUENCE, UpdateStatus.OUT_OF_SEQUENCE


class BackwardForwardBank(Stateful):
    """EKFs of all objects on a common time grid with their stored states (the paper's object storage).

    The bank stores anchors: states at births and measurements. States between them are
    predicted from the preceding anchor, see `fgtrack.karle2023.storage_kernels`. The
    storage reaches back `storage_steps` steps of `step_ns`.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        "_now_ns",
        "_grid_ns",
        "_grid",
        "_rows",
        "_order",
        "_free",
        "_latest_start",
        "_arrays",
        "_cached",
    )

    def __init__(
        self, propagator: ExactPropagator, step_ns: int, storage_steps: int
    ) -> None:
        self._propagator = propagator
        self._step_ns = step_ns
        self._step_s = seconds(step_ns)
        self._length = storage_steps
        self._now_ns: int | None = None
        # Stamp and index of the newest grid point.
        self._grid_ns = 0
        self._grid = 0
        # Rows of the arrays by track id, in order of birth.
        self._rows: dict[int, int] = {}
        # The same rows as an array; None after a birth or removal.
        self._order: IntArray | None = None
        self._free = list[int]()
        # Largest start index of all tracks so far.
        self._latest_start = 0
        self._arrays = list[Any]()
        self._allocate(1)
        # States by grid index; cleared by every change.
        self._cached: dict[int, StatesAt] = {}

    @property
    def present_ns(self) -> int:
        """See `TrackBank.present_ns`."""
        return self._grid_ns if self._now_ns is None else self._now_ns

    @property
    def window_start_ns(self) -> int:
        """See `TrackBank.window_start_ns`: half a step before the oldest stored grid stamp."""
        return self._grid_ns - (self._length - 1) * self._step_ns - self._step_ns // 2

    @property
    def track_ids(self) -> tuple[int, ...]:
        """See `TrackBank.track_ids`."""
        return tuple(self._rows)

    def advance(self, now_ns: int) -> None:
        """Move the present to `now_ns`, and the grid to the last grid stamp not after it."""
        grid_ns = now_ns // self._step_ns * self._step_ns
        if self._now_ns is None:
            self._grid_ns = grid_ns
        self._now_ns = now_ns
        self._advance_steps((grid_ns - self._grid_ns) // self._step_ns)

    def _advance_steps(self, steps: int) -> None:
        """Move the newest grid point forward by `steps`; does nothing if `steps` is not positive."""
        if steps > 0:
            self._grid += steps
            self._grid_ns += steps * self._step_ns
            self._cached.clear()

    @property
    def _oldest(self) -> int:
        """Index of the oldest stored grid point."""
        return self._grid - self._length + 1

    def _at_grid(self, grid: int) -> StatesAt:
        """Return the states at index `grid` of all objects that are stored there.

        At the newest grid point they are the current filter states.
        """
        if grid in self._cached:
            return self._cached[grid]
        if self._order is None:
            self._order = np.array(list(self._rows.values()), dtype=np.int64)
        rows = self._order
        track_ids = self.track_ids
        is_present = grid == self._grid
        if not is_present and grid < max(self._oldest, self._latest_start):
            known = (self._arrays[2][rows, 1] <= grid) & (grid >= self._oldest)
            rows = rows[known]
            track_ids = tuple(compress(track_ids, known.tolist()))
        if not track_ids:
            return no_states(self._propagator.motion.dim)
        m, n = len(rows), self._propagator.motion.dim
        means = np.empty((m, n))
        covariances = np.empty((m, n, n))
        steps = np.empty(m, dtype=np.int64)
        kernels(_KERNELS).look_up(
            grid, is_present, rows, *self._arrays, means, covariances, steps
        )
        ahead = self._propagator.propagate(means, covariances, steps, self._step_s)
        self._cached[grid] = states = StatesAt(track_ids, *ahead)
        return states

    def steps_back(self, stamp_ns: int) -> int:
        """Number of grid steps from the newest grid point back to the grid point nearest to `stamp_ns`.

        The newer grid point is chosen on a tie. The number is 0 for a later stamp.
        """
        back = (2 * (self._grid_ns - stamp_ns) + self._step_ns - 1) // (
            2 * self._step_ns
        )
        return back if back > 0 else 0

    def states_at(self, stamp_ns: int) -> StatesAt:
        """Return the states at the grid point nearest to `stamp_ns` of all objects stored there."""
        return self._at_grid(self._grid - self.steps_back(stamp_ns))

    def update(
        self,
        stamp_ns: int,
        track_ids: Sequence[int],
        measurements: Sequence[Measurement],
    ) -> list[UpdateResult]:
        """Correct the stored states nearest to `stamp_ns`; the present is predicted from them.

        Returns one result per measurement.
        """
        outcomes = Outcomes()
        for indices, alike in stacks(measurements):
            ids = [track_ids[i] for i in indices]
            outcomes.add(ids, partial(self._update, stamp_ns, ids, alike))
        return outcomes.results(track_ids)

    def _update(
        self, stamp_ns: int, track_ids: Sequence[int], alike: Measurement
    ) -> list[UpdateResult]:
        """Correct the stored states with a stack of similar measurements; return the results."""
        with changing_nothing(track_ids):
            back = self.steps_back(stamp_ns)
            states = self._at_grid(self._grid - back)
            rows = dict(
                zip(states.track_ids, range(len(states.track_ids)), strict=True)
            )
            chosen = [rows[track_id] for track_id in track_ids]
            x = states.means.take(chosen, axis=0)
            P = states.covariances.take(chosen, axis=0)
            y, H = alike.model.linearised(
                alike.z, x, alike.pose, partial(self._propagator.residual, alike.model)
            )
            corrected = correct(x, P, y, H, alike.R, alike.measured, alike.loss)
        codes = self._stored(back, stamp_ns, track_ids, corrected)
        made = map(
            UpdateResult,
            map(_STATUS.__getitem__, codes),
            corrected.innovation,
            corrected.nis.tolist(),
        )
        results = [
            result if code else UpdateResult(UpdateStatus.FAILED)
            for code, result in zip(codes, made, strict=True)
        ]
        self._cached.clear()
        return results

    def _visible_from(self, back: int) -> int:
        """Return the first grid index at which a state that was corrected `back` steps ago is used.

        Look-ups at earlier grid points use the state before.
        """
        return self._grid - back

    def birth(self, track_id: int, prior: Start) -> None:
        """Start an object at the grid point nearest to its first detection."""
        back = max(round((self._grid_ns - prior.stamp_ns) / self._step_ns), 0)
        start = self._grid - back
        if not self._free:
            self._allocate(2 * len(self._rows))
        row = self._free[-1]
        mean, covariance = initial_state(self._propagator.motion, prior)
        anchors, states, windows = self._arrays
        anchors[row, 0] = start
        windows[row] = 1, start, prior.stamp_ns
        states[row, 0, 0] = self._propagator.wrap(mean)
        states[row, 0, 1:] = covariance
        self._rows[track_id] = self._free.pop()
        self._order = None
        self._latest_start = max(start, self._latest_start)
        self._cached.clear()

    def remove(self, track_id: int) -> None:
        """See `TrackBank.remove`."""
        self._free.append(self._rows.pop(track_id))
        self._order = None
        self._cached.clear()

    def _stored(
        self,
        back: int,
        stamp_ns: int,
        track_ids: Sequence[int],
        corrected: Correction[FloatArray],
    ) -> list[int]:
        """Store corrected states at the grid point `back` steps ago; return their status codes."""
        rows = np.array([self._rows[track_id] for track_id in track_ids])
        at = self._oldest, self._grid - back, self._visible_from(back), stamp_ns, rows
        states = self._propagator.wrap(corrected.mean), corrected.covariance
        codes: list[int] = (
            kernels(_KERNELS)
            .store(*at, corrected.fused, *states, *self._arrays)
            .tolist()
        )
        return codes

    def _allocate(self, rows: int) -> None:
        """Allocate arrays for `rows` tracks and copy the present contents.

        Each track has one anchor slot per step and two spare slots.
        """
        slots = self._length + 2
        n = self._propagator.motion.dim
        num = len(self._arrays[0]) if self._arrays else 0
        shapes = (rows, slots, 2), (rows, slots, n + 1, n), (rows, 3)
        arrays = [
            np.zeros(shape, dtype)
            for shape, dtype in zip(
                shapes, (np.int64, np.float64, np.int64), strict=True
            )
        ]
        for new, present in zip(arrays, self._arrays, strict=bool(self._arrays)):
            new[:num] = present
        free = [*self._free, *range(num, rows)]
        self._arrays = arrays
        self._free = free

    def present(self) -> Sequence[TrackState]:
        """See `TrackBank.present`; states are predicted from the newest grid stamp to the present."""
        states = self._at_grid(self._grid)
        if not states.track_ids:
            return []
        mean = states.means
        covariance = states.covariances
        rest_s = seconds(self.present_ns - self._grid_ns)
        if rest_s:
            item = np.ones(len(mean), dtype=np.int64)
            mean, covariance = self._propagator.propagate(
                mean, covariance, item, rest_s
            )
        return kinematic_states(
            self._propagator.motion, self.present_ns, mean, covariance
        )

    def smoothed(self) -> list[SmoothedReport]:
        """See `TrackBank.smoothed`: always empty."""
        return []


def backward_forward(
    motion: MotionModel, lag_s: float, frequency_hz: float = 100.0
) -> BackwardForwardBank:
    """Backward-forward delay compensation (Karle et al. 2023).

    After a late measurement, the measurements fused after its stamp are lost. `lag_s`
    is the length of the storage, and `frequency_hz` the rate of its time grid.
    """
    step_ns = period_ns(frequency_hz)
    return BackwardForwardBank(
        ExactPropagator(motion), step_ns, max(nanoseconds(lag_s) // step_ns, 1)
    )


vars(backward_forward)["bank"] = True
