"""The replaying EKFs of all objects in arrays."""

import bisect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fgtrack.core.checks import LARGEST_NS
from fgtrack.core.linalg import kernels
from fgtrack.core.types import FloatArray, TrackState
from fgtrack.estimation.base import Measurement, Start, StatesAt, UpdateResult, UpdateStatus
from fgtrack.estimation.filters.ekf import Prediction
from fgtrack.estimation.filters.replay import ReplayEkf, Step, insertion
from fgtrack.estimation.object_bank import ObjectBank
from fgtrack.estimation.present import PresentStates
from fgtrack.models.measurement import MeasurementModel
from fgtrack.models.motion import WhiteNoise


@dataclass(slots=True)
class _Chain:
    """The steps of a filter in the arrays of `ReplayBank`, whose row they are in."""

    row: int
    stamps_ns: list[int]
    measurements: list[Measurement | None]
    filter: ReplayEkf


class ReplayBank(ObjectBank[ReplayEkf]):
    """`ReplayEkf` of all objects, whose steps lie in arrays: a compiled loop replays all that a list concerns.

    Filters of their own remain where a direction of travel is sought, and where a window has a measurement with a
    robust loss or of what is not an entry of the state. See `ObjectBank` and `fgtrack.estimation.kernels.replay`.

    Parameters
    ----------
    motion
        A shipped motion model.
    start, lag_s
        See `ObjectBank`.
    """

    def __init__(self, motion: WhiteNoise, start: Callable[[Start], ReplayEkf], lag_s: float) -> None:
        super().__init__(motion, start, lag_s)
        self._kernels = kernels("fgtrack.estimation.kernels.replay")
        self._kind, self._density = motion.kind, motion.density
        self._start_ns = -int(LARGEST_NS)  # of all windows, by the clock
        self._chains: dict[int, _Chain] = {}
        self._free: list[int] = []
        self._arrays = list[Any]()
        self._allocate(8, 64, 4)

    def _allocate(self, rows: int, slots: int, k: int) -> None:
        """Make arrays for so many tracks, steps and components with the present contents (see the kernels)."""
        n = self._motion.dim
        arrays = [
            np.tile(np.arange(slots), (rows, 1)),
            np.zeros((rows, slots, 2 + k), dtype=np.int64),
            np.zeros((rows, slots, 3 * n + 2, n)),
            np.zeros((rows, slots, k + 1, k)),
        ]
        self._free += range(len(self._arrays[0]) if self._arrays else 0, rows)
        for new, present in zip(arrays, self._arrays, strict=bool(self._arrays)):
            new[tuple(map(slice, present.shape))] = present
        self._arrays = arrays

    def advance(self, now_ns: int) -> None:
        """See `TrackBank.advance`."""
        self._now_ns = now_ns
        self._start_ns = max(self._start_ns, now_ns - self._lag_ns)
        if len(self._chains) < len(self._estimators):
            self._ask(lambda _, one: one.advance(now_ns), [i for i in self._estimators if i not in self._chains])

    def states_at(self, stamp_ns: int) -> StatesAt:
        """See `TrackBank.states_at`."""
        known = self._estimators if stamp_ns >= self._start_ns else self._estimators.keys() - self._chains.keys()
        inside = [i for i, one in self._estimators.items() if i in known and one.window_ns[0] <= stamp_ns]
        return StatesAt(tuple(inside), *self._ahead(inside, [stamp_ns] * len(inside)))

    def present(self) -> list[TrackState]:
        """See `TrackBank.present`; of an object whose first stamp lies ahead of the clock, that first state."""
        stamps_ns = [max(self._now_ns, one.window_ns[0]) for one in self._estimators.values()]
        return PresentStates(self._motion, self._now_ns, *self._ahead(list(self._estimators), stamps_ns))

    def update(
        self, stamp_ns: int, track_ids: Sequence[int], measurements: Sequence[Measurement]
    ) -> list[UpdateResult]:
        """See `TrackBank.update`."""
        seen = [one.seen_by(self._motion) for one in measurements]
        found = dict[int, UpdateResult]()
        alike: dict[tuple[int, tuple[str, ...]], list[int]] = {}
        for place, track_id in enumerate(track_ids):
            in_chain = track_id in self._chains
            if stamp_ns < self._estimators[track_id].window_ns[0] or (in_chain and stamp_ns < self._start_ns):
                found[track_id] = UpdateResult(UpdateStatus.TOO_OLD)
            elif in_chain and _is_plain(seen[place]):
                alike.setdefault((id(seen[place].model), seen[place].assumed), []).append(place)
        for places in alike.values():
            found |= self._fused(stamp_ns, [track_ids[place] for place in places], [seen[place] for place in places])
        rest = [place for place, track_id in enumerate(track_ids) if track_id not in found]
        for place in rest:
            self._take_out(track_ids[place])
        if rest:
            ids = [track_ids[place] for place in rest]
            found |= zip(ids, super().update(stamp_ns, ids, [seen[place] for place in rest]), strict=True)
            for track_id in ids:
                self._put_in(track_id)
        return [found[track_id] for track_id in track_ids]

    def birth(self, track_id: int, prior: Start) -> None:
        """See `TrackBank.birth`."""
        super().birth(track_id, prior)
        self._put_in(track_id)

    def remove(self, track_id: int) -> None:
        """See `TrackBank.remove`."""
        if track_id in self._chains:
            self._free.append(self._chains.pop(track_id).row)
        super().remove(track_id)

    def _fused(self, stamp_ns: int, track_ids: Sequence[int], seen: Sequence[Measurement]) -> dict[int, UpdateResult]:
        """Outcomes, by track, of measurements of the same that could be fused."""
        chains, one = [self._chains[track_id] for track_id in track_ids], seen[0]
        m, k = len(chains), len(one.z)
        for chain in chains:
            self._make_room(chain, k)
        indices = [insertion(own.stamps_ns, own.measurements, each) for own, each in zip(chains, seen, strict=True)]
        at = [(own.row, index, len(own.stamps_ns)) for own, index in zip(chains, indices, strict=True)]
        rows = np.arange(k) if one.measured is None else np.array(one.measured)
        new, label = np.empty((m, k + 1, k)), np.array([stamp_ns, k, *one.model.selected])
        new[:, 0], new[:, 1:] = [each.z for each in seen], [each.R for each in seen]
        y, S, nis, fused = np.empty((m, k)), np.empty((m, k, k)), np.empty(m), np.empty(m, dtype=bool)
        self._kernels.fuse(self._kind, self._density, *self._arrays, np.array(at), label, new, rows, y, S, nis, fused)
        found, numbers = dict[int, UpdateResult](), nis.tolist()
        for i in fused.nonzero()[0].tolist():
            chain = chains[i]
            chain.stamps_ns.insert(indices[i], stamp_ns)
            chain.measurements.insert(indices[i], seen[i])
            found[track_ids[i]] = UpdateResult(chain.filter.moved_on(stamp_ns), y[i], numbers[i], S[i])
        return found

    def _make_room(self, chain: _Chain, k: int) -> None:
        """Let there be a free slot for a measurement of `k` components."""
        order = self._arrays[0]
        rows, slots = order.shape
        if len(chain.stamps_ns) == slots:
            start_ns = max(self._start_ns, chain.filter.window_ns[0])
            gone = max(bisect.bisect_left(chain.stamps_ns, start_ns) - 1, 0)
            del chain.stamps_ns[:gone], chain.measurements[:gone]
            order[chain.row] = np.roll(order[chain.row], -gone)
        largest, is_full = self._arrays[3].shape[-1], len(chain.stamps_ns) == slots
        if k > largest or is_full:
            self._allocate(rows, slots * (1 + is_full), max(k, largest))

    def _ahead(self, track_ids: Sequence[int], stamps_ns: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        """Means (m, n) and covariances (m, n, n) of tracks, each at its stamp, with the yaw in (-pi, pi]."""
        chosen, others = list[tuple[int, int, int]](), dict[int, TrackState]()
        for i, (track_id, stamp_ns) in enumerate(zip(track_ids, stamps_ns, strict=True)):
            chain = self._chains.get(track_id)
            if chain is None:
                others[i] = self._estimators[track_id].state_at(stamp_ns)
            else:
                place = max(bisect.bisect_right(chain.stamps_ns, stamp_ns) - 1, 0)
                chosen.append((chain.row, place, stamp_ns))
        at = np.array(chosen, dtype=np.int64).reshape(-1, 3)
        n = self._motion.dim
        predicted = np.empty((len(at), 2 * n + 1, n))
        self._kernels.ahead(self._kind, self._density, *self._arrays[:3], at, predicted)
        found = predicted[:, 0].copy(), predicted[:, 1 : n + 1].copy()
        if not others:
            return found
        states = iter(zip(*found, strict=True))
        rest = [(others[i].mean, others[i].covariance) if i in others else next(states) for i in range(len(track_ids))]
        mean, covariance = zip(*rest, strict=True)
        return np.array(mean), np.array(covariance)

    def _put_in(self, track_id: int) -> None:
        """Move the steps of a filter into the arrays, where these can hold them."""
        one = self._estimators[track_id]
        if not all(each.search is None and _is_plain(each.measurement) for each in one.steps):
            return
        k = max((len(each.measurement.z) for each in one.steps if each.measurement is not None), default=0)
        if not self._free:
            self._allocate(2 * len(self._arrays[0]), self._arrays[0].shape[1], self._arrays[3].shape[-1])
        chain = _Chain(self._free.pop(), [], [], one)
        for each in one.steps:
            self._make_room(chain, k)
            order, labels, steps, measured = (array[chain.row] for array in self._arrays)
            slot, own = order[len(chain.stamps_ns)], each.measurement
            steps[slot] = np.vstack([each.mean, each.covariance, *each.predicted])
            labels[slot, 0] = each.stamp_ns
            if own is not None:
                d = len(own.z)
                labels[slot, 1 : d + 2] = d, *own.model.selected
                measured[slot, 0, :d], measured[slot, 1 : d + 1, :d] = own.z, own.R
            chain.stamps_ns.append(each.stamp_ns)
            chain.measurements.append(own)
        one.steps = []
        self._chains[track_id] = chain

    def _take_out(self, track_id: int) -> None:
        """Move the steps of a filter out of the arrays, if they are there."""
        chain = self._chains.pop(track_id, None)
        if chain is None:
            return
        self._free.append(chain.row)
        order, _, steps, _ = (array[chain.row] for array in self._arrays)
        n = self._motion.dim
        for slot, stamp_ns, measurement in zip(order, chain.stamps_ns, chain.measurements, strict=False):
            own = steps[slot].copy()
            predicted = Prediction(own[n + 1], own[n + 2 : 2 * n + 2], own[2 * n + 2 :])
            chain.filter.steps.append(Step(stamp_ns, measurement, own[0], own[1 : n + 1], predicted))
        chain.filter.advance(self._start_ns + self._lag_ns)


def _is_plain(measurement: Measurement | None) -> bool:
    """True if a measurement, or what is none, is of entries of the state, without a loss."""
    if measurement is None:
        return True
    return measurement.loss is None and type(measurement.model) is MeasurementModel and measurement.model.linear
