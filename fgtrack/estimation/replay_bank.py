"""The replaying EKFs of all objects together, in arrays."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fgtrack.core.time import NS_PER_S, nanoseconds
from fgtrack.core.types import FloatArray, IntArray, SmoothedReport, TrackState
from fgtrack.estimation.base import Measurement, Start, StatesAt, UpdateResult, UpdateStatus
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.ekf import Prediction, predict_across
from fgtrack.estimation.initiation import DEFAULT, checked_initiation, sought
from fgtrack.estimation.present import PresentStates
from fgtrack.estimation.propagation import wrapped
from fgtrack.estimation.replay import ReplayEkf
from fgtrack.estimation.replayed_steps import LaterSteps, ReplayedSteps, Said
from fgtrack.estimation.rts import rts_step
from fgtrack.models.motion import MotionModel

#: Steps that nobody needs are forgotten when there are so many of a track.
_MANY = 16
#: So many tracks are faster one by one than as arrays.
_FEW = 5


class _Known(NamedTuple):
    """What is known at one stamp of the tracks that exist there."""

    track_ids: tuple[int, ...]
    rows: dict[int, int]
    """Where each of them is."""
    predicted: Prediction
    """Of all of them, stacked; the cross-covariance of tracks that are by themselves is 0."""


#: Numbers of steps, the states after their measurements, and those before.
_Done = tuple[IntArray, FloatArray, FloatArray, Prediction]


class ReplayBank:
    """`ReplayEkf` of all objects: the same states, innovations and outcomes, to rounding.

    All that is done to the tracks of an object list is done at once: prediction to its stamp, correction, and the
    replay of what came after it, newest steps last. While there are few tracks, each is a `ReplayEkf` by itself; so is
    one whose direction of travel is sought, until its window no longer reaches back to the search.

    Parameters
    ----------
    motion, lag_s
        See `WindowedFilter`.
    initiation
        See `ReplayingFilter`.
    """

    def __init__(self, motion: MotionModel, lag_s: float, initiation: str = DEFAULT) -> None:
        self._motion = motion
        self._lag_s, self._lag_ns = lag_s, nanoseconds(lag_s)
        self._initiation = checked_initiation(initiation)
        self._steps = ReplayedSteps(motion.dim)
        self._numbers: dict[int, int | None] = {}
        """Where the arrays hold each track, in order of birth; None of one that is by itself."""
        self._single: dict[int, ReplayEkf] = {}
        self._free: list[int] = []
        self._now_ns = 0
        self._start_ns: IntArray = np.zeros(0, dtype=np.int64)
        self._newest_ns: IntArray = np.zeros(0, dtype=np.int64)
        self._known: dict[int, _Known] = {}  # by stamp, until anything changes

    # --- what a `TrackBank` says

    @property
    def present_ns(self) -> int:
        """See `TrackBank.present_ns`."""
        return self._now_ns

    @property
    def window_start_ns(self) -> int:
        """See `TrackBank.window_start_ns`."""
        return self._now_ns - self._lag_ns

    @property
    def track_ids(self) -> tuple[int, ...]:
        """See `TrackBank.track_ids`."""
        return tuple(self._numbers)

    def advance(self, now_ns: int) -> None:
        """See `TrackBank.advance`."""
        self._now_ns = now_ns
        np.maximum(self._start_ns, now_ns - self._lag_ns, out=self._start_ns)
        for estimator in self._single.values():
            estimator.advance(now_ns)
        self._known.clear()

    def states_at(self, stamp_ns: int) -> StatesAt:
        """See `TrackBank.states_at`."""
        known = self._known_at(stamp_ns)
        return StatesAt(known.track_ids, known.predicted.mean, known.predicted.covariance)

    def update(
        self, stamp_ns: int, track_ids: Sequence[int], measurements: Sequence[Measurement]
    ) -> list[UpdateResult]:
        """See `TrackBank.update`."""
        results: dict[int, UpdateResult] = {}
        together, tracks = list[int](), list[int]()
        for position, track_id in enumerate(track_ids):
            track = self._numbers[track_id]
            if track is None:
                results[position] = self._update_single(track_id, measurements[position])
            else:
                together.append(position)
                tracks.append(track)
        if together:
            chosen = [measurements[position].seen_by(self._motion) for position in together]
            ids = [track_ids[position] for position in together]
            results.update(zip(together, self._update(stamp_ns, ids, np.array(tracks), chosen), strict=True))
        self._known.clear()
        return [results[position] for position in range(len(track_ids))]

    def birth(self, track_id: int, prior: Start) -> None:
        """See `TrackBank.birth`."""
        self._known.clear()
        if len(self._numbers) < _FEW or sought(self._motion, prior, self._initiation):
            self._numbers[track_id] = None
            self._single[track_id] = ReplayEkf(self._motion, prior, self._lag_s, self._initiation)
            return
        self._begin(track_id, prior.stamp_ns, prior.stamp_ns, *initial_state(self._motion, prior))

    def remove(self, track_id: int) -> None:
        """See `TrackBank.remove`."""
        track = self._numbers.pop(track_id)
        if track is None:
            del self._single[track_id]
        else:
            self._free.append(track)
        self._known.clear()

    def present(self) -> list[TrackState]:
        """See `TrackBank.present`; of an object whose first stamp lies ahead of the clock, that first state."""
        if not self._numbers:
            return []
        known = self._predicted(tuple(self._numbers), self._now_ns)
        return PresentStates(self._motion, self._now_ns, known.mean, known.covariance)

    def smoothed(self) -> list[SmoothedReport]:
        """See `TrackBank.smoothed`: none."""
        return []

    # --- tracks

    def _begin(self, track_id: int, stamp_ns: int, newest_ns: int, mean: FloatArray, covariance: FloatArray) -> int:
        """Let a track begin with a state at `stamp_ns`; where the arrays hold it."""
        if not self._free:
            size = len(self._start_ns)
            self._free = list(range(max(2 * size, 1) - 1, size - 1, -1))
            more = np.zeros(len(self._free), dtype=np.int64)
            self._start_ns, self._newest_ns = (
                np.concatenate([values, more]) for values in (self._start_ns, self._newest_ns)
            )
        track = self._free.pop()
        self._start_ns[track], self._newest_ns[track] = stamp_ns, newest_ns
        self._steps.begin(track, stamp_ns, mean, covariance)
        self._numbers[track_id] = track
        return track

    def _update_single(self, track_id: int, measurement: Measurement) -> UpdateResult:
        """Update a track by itself, and put it into the arrays where nothing speaks against it."""
        estimator = self._single[track_id]
        result = estimator.update(measurement)
        if estimator.settled and len(self._numbers) > _FEW:
            del self._single[track_id]
            first, *later = estimator.steps
            start_ns, newest_ns = estimator.window_ns
            track = self._begin(track_id, first.order[0], newest_ns, first.mean, first.covariance)
            self._start_ns[track] = start_ns
            for place, step in enumerate(later, start=1):
                assert step.measurement is not None  # of the first step alone
                tracks = np.array([track])
                numbers = self._steps.reserve(tracks, [step.measurement])
                self._steps.put(numbers, step.mean, step.covariance, step.predicted)
                self._steps.order.insert(tracks, np.array([place]), step.order[0])
        return result

    # --- states

    def _known_at(self, stamp_ns: int) -> _Known:
        found = self._known.get(stamp_ns)
        if found is None:
            track_ids = tuple(i for i, inside in zip(self._numbers, self._reach(stamp_ns), strict=True) if inside)
            rows = {track_id: row for row, track_id in enumerate(track_ids)}
            found = self._known[stamp_ns] = _Known(track_ids, rows, self._predicted(track_ids, stamp_ns))
        return found

    def _reach(self, stamp_ns: int) -> list[bool]:
        """Of every track, whether its window reaches back to `stamp_ns`."""
        inside = (self._start_ns <= stamp_ns).tolist()
        return [
            self._single[i].window_ns[0] <= stamp_ns if track is None else inside[track]
            for i, track in self._numbers.items()
        ]

    def _predicted(self, track_ids: tuple[int, ...], stamp_ns: int) -> Prediction:
        """States of tracks at `stamp_ns`, or at the start of their window where that is later."""
        tracks = [self._numbers[track_id] for track_id in track_ids]
        here = np.array([track for track in tracks if track is not None], dtype=np.int64)
        found = self._predicted_together(here, np.maximum(stamp_ns, self._start_ns[here])) if len(here) else None
        if found is not None and len(here) == len(tracks):
            return found
        n = self._motion.dim
        mean, covariance, cross = np.zeros((len(tracks), n)), *np.zeros((2, len(tracks), n, n))
        if found is not None:
            rows = [row for row, track in enumerate(tracks) if track is not None]
            mean[rows], covariance[rows], cross[rows] = found
        for row, (track_id, track) in enumerate(zip(track_ids, tracks, strict=True)):
            if track is None:
                one = self._single[track_id]
                state = one.state_at(max(stamp_ns, one.window_ns[0]))
                mean[row], covariance[row] = state.mean, state.covariance
        return Prediction(mean, covariance, cross)

    def _predicted_together(self, tracks: IntArray, stamps_ns: IntArray) -> Prediction:
        return self._from(tracks, self._steps.order.place_before(tracks, stamps_ns), stamps_ns)

    def _from(self, tracks: IntArray, places: IntArray, stamps_ns: IntArray | int) -> Prediction:
        """States at `stamps_ns`, predicted from the steps at `places`."""
        order = self._steps.order
        before = order.at(tracks, places)
        dt_s = (stamps_ns - order.stamps_ns[tracks, places]) / NS_PER_S
        return predict_across(self._steps.mean[before], self._steps.covariance[before], self._motion, dt_s)

    # --- updates

    def _update(
        self, stamp_ns: int, track_ids: Sequence[int], tracks: IntArray, measurements: Sequence[Measurement]
    ) -> list[UpdateResult]:
        young = np.flatnonzero(self._start_ns[tracks] <= stamp_ns)
        results = [UpdateResult(UpdateStatus.TOO_OLD)] * len(tracks)
        if not young.size:
            return results
        known = self._known_at(stamp_ns)
        rows = young.tolist()
        at = [known.rows[track_ids[row]] for row in rows]
        predicted = known.predicted.at(np.array(at))
        found = self._fused_all(stamp_ns, tracks[young], [measurements[row] for row in rows], predicted)
        for row, result in zip(rows, found, strict=True):
            results[row] = result
        return results

    def _fused_all(
        self, stamp_ns: int, tracks: IntArray, measurements: Sequence[Measurement], predicted: Prediction
    ) -> list[UpdateResult]:
        """Fuse one measurement of each of `tracks`; one that cannot be fused fails alone."""
        try:
            return self._fused(stamp_ns, tracks, measurements, predicted)
        except np.linalg.LinAlgError:
            if len(tracks) == 1:
                return [UpdateResult(UpdateStatus.FAILED)]
            return [
                self._fused_all(stamp_ns, tracks[k : k + 1], [one], predicted.at(slice(k, k + 1)))[0]
                for k, one in enumerate(measurements)
            ]

    def _fused(
        self, stamp_ns: int, tracks: IntArray, measurements: Sequence[Measurement], predicted: Prediction
    ) -> list[UpdateResult]:
        """Fuse measurements, all or none; raises `numpy.linalg.LinAlgError` where a state is not finite."""
        order = self._steps.order
        newest = order.place_before(tracks, np.full(len(tracks), stamp_ns)) + 1
        places = self._places(stamp_ns, tracks, measurements, newest)
        many = order.count[tracks] - places
        if many.any() and (many[1:] > many[:-1]).any():  # those with the most to replay first
            turn = np.argsort(-many, kind="stable")
            turned = [measurements[row] for row in turn.tolist()]
            results = self._fused(stamp_ns, tracks[turn], turned, predicted.at(turn))
            return [results[place] for place in np.argsort(turn).tolist()]
        between = np.flatnonzero(places < newest)
        if between.size:  # not after all of the same stamp
            predicted = Prediction(*map(np.copy, predicted))
            for values, right in zip(
                predicted, self._from(tracks[between], places[between] - 1, stamp_ns), strict=True
            ):
                values[between] = right
        numbers = self._steps.reserve(tracks, measurements)
        mean, covariance, said = self._corrected(numbers, predicted)
        done = [(numbers, mean, covariance, predicted)]
        late = int(np.count_nonzero(many))
        if late:
            later = LaterSteps.of(order, tracks[:late], places[:late], many[:late], stamp_ns)
            blank = predicted.at(slice(late))
            means = np.concatenate([blank.mean, mean[:late]])
            covariances = np.concatenate([blank.covariance, covariance[:late]])
            both = predict_across(means, covariances, self._motion, np.tile(later.after_s[0], 2))
            unaware, ahead = both.at(slice(late)), both.at(slice(late, None))
            found = self._retrodicted(blank, unaware, later)
            said += self._steps.innovations(numbers[:late], *found)
            done += self._replayed(ahead, later)
        for step in done:
            self._steps.put(*step)
        order.insert(tracks, places, stamp_ns)
        return self._results(stamp_ns, tracks, said)

    def _results(self, stamp_ns: int, tracks: IntArray, said: Sequence[Said]) -> list[UpdateResult]:
        """Outcomes of measurements that are fused; what was `said` later counts."""
        out = (stamp_ns < self._newest_ns[tracks]).tolist()
        statuses = [UpdateStatus.OUT_OF_SEQUENCE if old else UpdateStatus.IN_SEQUENCE for old in out]
        self._newest_ns[tracks] = np.maximum(self._newest_ns[tracks], stamp_ns)
        self._start_ns[tracks] = np.maximum(self._start_ns[tracks], self._newest_ns[tracks] - self._lag_ns)
        self._forget(tracks)
        found: list[UpdateResult] = [UpdateResult(UpdateStatus.FAILED)] * len(tracks)
        for rows, innovation, nis, S in said:
            which = range(len(nis)) if isinstance(rows, slice) else rows.tolist()
            for row, *each in zip(which, innovation, nis.tolist(), S, strict=True):
                found[row] = UpdateResult(statuses[row], *each)
        return found

    def _corrected(self, numbers: IntArray, predicted: Prediction) -> tuple[FloatArray, FloatArray, list[Said]]:
        mean, covariance, said = self._steps.corrected(numbers, predicted.mean, predicted.covariance)
        return wrapped(self._motion, mean), covariance, said

    def _replayed(self, ahead: Prediction, later: LaterSteps) -> list[_Done]:
        """The measurements of `later` steps applied again; `ahead` are the states predicted to the first of them."""
        done = list[_Done]()
        for numbers, after_s in zip(later.numbers, later.after_s, strict=True):
            m = len(numbers)
            if done:
                _, mean, covariance, _ = done[-1]
                ahead = predict_across(mean[:m], covariance[:m], self._motion, after_s)
            mean, covariance, _ = self._corrected(numbers, ahead)
            done.append((numbers, mean, covariance, ahead))
        return done

    def _retrodicted(self, blank: Prediction, unaware: Prediction, later: LaterSteps) -> tuple[FloatArray, FloatArray]:
        """The states that measurements find, given all that was fused, the `later` steps included.

        See `ReplayingFilter`: from the newest step back, each as it was when the measurement was unknown. `blank` are
        the states before the measurements, `unaware` those predicted from there to the first later step.
        """
        steps = self._steps
        mean, covariance = steps.mean[later.newest], steps.covariance[later.newest]
        for place in range(len(later.numbers) - 1, -1, -1):
            numbers, m = later.numbers[place], len(later.numbers[place])
            predicted = unaware
            before = blank.at(slice(m))
            if place:
                predicted = steps.predicted(numbers)
                earlier = later.numbers[place - 1][:m]
                before = before._replace(mean=steps.mean[earlier], covariance=steps.covariance[earlier])
            shift = wrapped(self._motion, mean[:m] - predicted.mean)
            found = rts_step(before.mean, before.covariance, predicted, shift, covariance[:m])
            moved = later.after_s[place] > 0.0  # else it is the same state
            mean[:m][moved], covariance[:m][moved] = found.mean[moved], found.covariance[moved]
        return mean, covariance

    def _places(
        self, stamp_ns: int, tracks: IntArray, measurements: Sequence[Measurement], newest: IntArray
    ) -> IntArray:
        """Where the measurements belong: at `newest`, behind all older ones and those of the same stamp, but among the
        latter by content; never before the first step, which is a prior or older than the window."""
        order, places = self._steps.order, newest.copy()
        for row in np.flatnonzero(order.stamps_ns[tracks, places - 1] == stamp_ns).tolist():
            track, own = tracks[row], measurements[row].content
            while places[row] > 1 and order.stamps_ns[track, places[row] - 1] == stamp_ns:
                if self._steps.content_of(int(order.numbers[track, places[row] - 1])) <= own:
                    break
                places[row] -= 1
        return places

    def _forget(self, tracks: IntArray) -> None:
        """Drop what is not needed for the windows; what is measured right at their starts may still come."""
        many = self._steps.order.place_before(tracks, self._start_ns[tracks] - 1)
        old = many >= _MANY
        if old.any():
            self._steps.order.drop(tracks[old], many[old])
