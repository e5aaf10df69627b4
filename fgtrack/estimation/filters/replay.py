"""Filters that roll back to a late measurement and filter the later ones again, for one object or many together."""

import bisect
from collections.abc import Sequence

import numpy as np

from fgtrack.core.types import FloatArray, TrackState
from fgtrack.estimation.base import (
    NOTHING,
    Content,
    Measurement,
    Start,
    StatesAt,
    UpdateResult,
    UpdateStatus,
    no_states,
)
from fgtrack.estimation.filters.ekf import OneCorrection, Prediction
from fgtrack.estimation.filters.initiation import DEFAULT, checked_initiation
from fgtrack.estimation.filters.propagation import track_state, wrapped
from fgtrack.estimation.filters.recursion import EkfRecursion, Step
from fgtrack.estimation.filters.windowed import WindowedFilter
from fgtrack.estimation.object_bank import ObjectBank
from fgtrack.estimation.present import PresentStates
from fgtrack.estimation.rts import rts_step
from fgtrack.models.motion import MotionModel


class ReplayingFilter(WindowedFilter):
    """A filter that keeps the measurements of a window; its estimates do not depend on the order of arrival.

    Rewind and replay, as in robot_localization; see docs/baseline.md.

    Parameters
    ----------
    motion, prior, lag_s
        See `WindowedFilter`.
    recursion
        How states are predicted and corrected.
    initiation
        How the direction of travel is found where `prior` gives none, see `Initiation`.
    """

    exact = "any lag, any number"
    retrodicts = True
    initiates = True

    def __init__(
        self, motion: MotionModel, prior: Start, lag_s: float, recursion: EkfRecursion, initiation: str = DEFAULT
    ) -> None:
        super().__init__(motion, prior, lag_s)
        self.recursion = recursion
        self.steps = [recursion.first(prior, checked_initiation(initiation))]
        """The steps of the window and the one that it is replayed from, by stamp and content."""

    def state_at(self, stamp_ns: int) -> TrackState:
        """See `Estimator.state_at`: the filter's state, from the measurements up to that stamp."""
        mean, covariance, _ = self.recursion.ahead([self.step_before(stamp_ns)], [stamp_ns])
        return track_state(self._motion, stamp_ns, mean[0], covariance[0])

    def step_before(self, stamp_ns: int) -> Step:
        """The newest step at or before `stamp_ns`; the first one where there is none."""
        return self.steps[max(bisect.bisect_right(self.steps, stamp_ns, key=_stamp) - 1, 0)]

    def place_of(self, measurement: Measurement) -> int:
        """Index of `measurement` among the steps: by stamp, and at one stamp by content; never before the first."""
        place = max(bisect.bisect_right(self.steps, measurement.stamp_ns, key=_stamp), 1)
        while place > 1 and self.steps[place - 1].stamp_ns == measurement.stamp_ns:
            if _content(self.steps[place - 1]) <= measurement.content:
                break
            place -= 1
        return place

    def _forget_before(self, stamp_ns: int) -> None:
        # what is measured at that very stamp may still come, and belongs behind the first step
        del self.steps[: max(bisect.bisect_left(self.steps, stamp_ns, key=_stamp) - 1, 0)]

    def _fuse(self, measurement: Measurement) -> OneCorrection:
        [found] = fuse([self], [measurement])
        if found is None:
            raise np.linalg.LinAlgError("the measurement cannot be fused")
        return found


def fuse(filters: Sequence[ReplayingFilter], measurements: Sequence[Measurement]) -> list[OneCorrection | None]:
    """Give each filter of one kind a measurement; None, and all as it was, where it cannot be fused.

    All filters roll back, correct and filter later measurements again side by side, step by step.
    """
    recursion, retrodicts = filters[0].recursion, filters[0].retrodicts
    places = [each.place_of(one) for each, one in zip(filters, measurements, strict=True)]
    later = [each.steps[place:] for each, place in zip(filters, places, strict=True)]
    begun = recursion.fused([each.steps[k - 1] for each, k in zip(filters, places, strict=True)], measurements)
    found = [None if each is None else each[1] for each in begun]
    chains = [[] if each is None else [each[0]] for each in begun]
    rows = [row for row, steps in enumerate(later) if steps and found[row] is not None]
    if rows and retrodicts:
        states = _retrodicted(recursion, [chains[row][0] for row in rows], [later[row] for row in rows])
        innovations = recursion.correct(*states, [measurements[row] for row in rows])
        for row, expected in zip(rows, innovations, strict=True):
            own = found[row]
            if own is None or expected is None:
                found[row] = None
            else:
                found[row] = own._replace(innovation=expected.innovation, nis=expected.nis, S=expected.S)
    depth = 0
    while rows := [row for row in rows if found[row] is not None and len(later[row]) > depth]:
        again = [(row, one) for row in rows if (one := later[row][depth].measurement) is not None]
        replayed = recursion.fused([chains[row][-1] for row, _ in again], [one for _, one in again])
        for (row, _), each in zip(again, replayed, strict=True):
            if each is None:
                found[row] = None
            else:
                chains[row].append(each[0])
        depth += 1
    for row, correction in enumerate(found):
        if correction is not None:
            filters[row].steps[places[row] :] = chains[row]
    return found


def _retrodicted(
    recursion: EkfRecursion, new: Sequence[Step], later: Sequence[Sequence[Step]]
) -> tuple[FloatArray, FloatArray]:
    """States (m, n), (m, n, n) that the `new` measurements find, given all that was fused, also the `later` steps.

    From the newest step back (see `rts_step`), each as it was when the new measurement was unknown.
    """
    without = [Step(step.stamp_ns, None, *step.predicted[:2], step.predicted) for step in new]
    first = recursion.ahead(without, [steps[0].stamp_ns for steps in later])
    mean, covariance = (np.array([getattr(steps[-1], name) for steps in later]) for name in ("mean", "covariance"))
    sought = list(range(len(new)))  # those whose state does not come from a line through all that was measured
    for place in range(max(map(len, later)) - 1, -1, -1):
        chosen = list[int]()
        for row in [row for row in sought if len(later[row]) > place]:
            after, before = later[row][place], later[row][place - 1] if place else without[row]
            if after.along and after.search is not None:
                mean[row], covariance[row] = after.search.retrodicted(new[row].stamp_ns, mean[row], covariance[row])
                sought.remove(row)
            elif before.stamp_ns != after.stamp_ns:  # else it is the same state
                chosen.append(row)
        if not chosen:
            continue
        befores = [later[row][place - 1] if place else without[row] for row in chosen]
        predicted = (
            Prediction(*(part[chosen] for part in first))
            if not place
            else Prediction(*map(np.array, zip(*(later[row][place].predicted for row in chosen), strict=True)))
        )
        shift = wrapped(recursion.motion, mean[chosen] - predicted.mean)
        x, P = np.array([step.mean for step in befores]), np.array([step.covariance for step in befores])
        mean[chosen], covariance[chosen], _ = rts_step(x, P, predicted, shift, covariance[chosen])
    return mean, covariance


class ReplayEkf(ReplayingFilter):
    """An EKF that keeps the measurements of a window; its estimates do not depend on the order of arrival.

    Rewind and replay, as in robot_localization; see docs/baseline.md.

    Parameters
    ----------
    motion, prior, lag_s
        See `WindowedFilter`.
    initiation
        See `ReplayingFilter`.
    """

    def __init__(self, motion: MotionModel, prior: Start, lag_s: float, initiation: str = DEFAULT) -> None:
        super().__init__(motion, prior, lag_s, EkfRecursion(motion), initiation)


class ReplayBank(ObjectBank[ReplayingFilter]):
    """Replaying filters of all objects, of one kind: their states are calculated together. See `ObjectBank`."""

    def states_at(self, stamp_ns: int) -> StatesAt:
        """See `TrackBank.states_at`."""
        inside = {i: each for i, each in self._estimators.items() if each.window_ns[0] <= stamp_ns}
        if not inside:
            return no_states(self._motion.dim)
        mean, covariance = self._ahead(list(inside.values()), [stamp_ns] * len(inside))
        return StatesAt(tuple(inside), mean, covariance)

    def present(self) -> list[TrackState]:
        """See `TrackBank.present`; of an object whose first stamp lies ahead of the clock, that first state."""
        filters = list(self._estimators.values())
        if not filters:
            return []
        stamps_ns = [max(self._now_ns, each.window_ns[0]) for each in filters]
        return PresentStates(self._motion, self._now_ns, *self._ahead(filters, stamps_ns))

    def update(
        self, stamp_ns: int, track_ids: Sequence[int], measurements: Sequence[Measurement]
    ) -> list[UpdateResult]:
        """See `TrackBank.update`."""
        results = [UpdateResult(UpdateStatus.TOO_OLD)] * len(track_ids)
        filters = [self._estimators[track_id] for track_id in track_ids]
        rows = [row for row, each in enumerate(filters) if each.window_ns[0] <= stamp_ns]
        if rows:
            chosen, seen = [filters[row] for row in rows], [measurements[row].seen_by(self._motion) for row in rows]
            try:
                found = fuse(chosen, seen)
            except np.linalg.LinAlgError:  # of one of them
                outcomes = [each.update(one) for each, one in zip(chosen, seen, strict=True)]
            else:
                outcomes = [each.outcome(stamp_ns, one) for each, one in zip(chosen, found, strict=True)]
            for row, outcome in zip(rows, outcomes, strict=True):
                results[row] = outcome
        return results

    def _ahead(self, filters: Sequence[ReplayingFilter], stamps_ns: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        steps = [each.step_before(stamp_ns) for each, stamp_ns in zip(filters, stamps_ns, strict=True)]
        mean, covariance, _ = filters[0].recursion.ahead(steps, stamps_ns)
        return wrapped(self._motion, mean), covariance


def _content(step: Step) -> Content:
    return NOTHING if step.measurement is None else step.measurement.content


def _stamp(step: Step) -> int:
    return step.stamp_ns
