"""Paired replays: squared errors of different estimators on the measurements of one association.

The association comes from a run of the replaying EKF. Each replay repeats the same
measurements of the same tracks from the same first states. So differences come from the
estimation alone: the estimator, the noise, and the order of arrival.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from fgtrack.config.settings import Config
from fgtrack.core.errors import DataError
from fgtrack.core.linalg import congruence
from fgtrack.core.time import NS_PER_S, nanoseconds
from fgtrack.core.types import FloatArray, IntArray, Message
from fgtrack.estimation.base import Measurement
from fgtrack.estimation.failures import Failures
from fgtrack.evaluation.matching import NO_OBJECT, match, track_errors
from fgtrack.evaluation.truth import true_paths
from fgtrack.noise.likelihood.series import Observation
from fgtrack.noise.measurements import BankCall, RecordingBank, recorded_bank
from fgtrack.pipeline.build import build_bank
from fgtrack.runs import Run
from fgtrack.tracking.guarded_bank import GuardedBank

REPLAY = "ekf-replay"
"""Estimator of the run whose association is repeated."""
# Age from which a track is assessed, and time between two assessed ticks.
_SETTLE_NS = NS_PER_S
_STEP_NS = NS_PER_S // 20
Arrival = Callable[[BankCall], int | None]
"""Function that returns the time at which measurements arrive; None if they never do."""


def as_received(item: BankCall) -> int:
    """Return the tick at which the measurements were first available."""
    return item.now_ns


def at_stamp(item: BankCall) -> int:
    """Return the stamp of the measurements, as if they had no delay."""
    return item.stamp_ns


class PairedReplay:
    """Association of a run of the replaying EKF, and squared errors of other estimators on it."""

    def __init__(
        self, bank: RecordingBank, run: Run, config: Config, until_s: float = math.inf
    ) -> None:
        now_ns = run.tables["timing"]["now_ns"]
        now_ns = now_ns[
            : np.searchsorted((now_ns - now_ns[:1]) / NS_PER_S, until_s, side="right")
        ]
        if not len(now_ns) or not bank.calls:
            raise DataError(
                "no track in this recording; run `fgtrack advise` for the reason"
            )
        self.calls = [item for item in bank.calls if item.now_ns <= now_ns[-1]]
        """Births and measurements of the association, in order of arrival."""
        self.run = run
        self.config = config
        self._now_ns = now_ns
        grid = np.searchsorted(now_ns, np.arange(now_ns[0], now_ns[-1] + 1, _STEP_NS))
        self._ticks = np.unique(grid[grid < len(now_ns)])
        self._births = {
            item.track_ids[0]: item.now_ns
            for item in self.calls
            if item.start is not None
        }
        self._ends = {
            track_id: item.now_ns for item in self.calls for track_id in item.track_ids
        }
        self._columns = {
            track_id: column for column, track_id in enumerate(self._births)
        }

    @classmethod
    def of(cls, messages: Sequence[Message], config: Config) -> "PairedReplay":
        """Replay a recording and return its association.

        Raises `DataError` if nothing is tracked.
        """
        return cls(*recorded_bank(messages, replace(config, estimator=REPLAY)), config)

    @cached_property
    def objects(self) -> IntArray | None:
        """Index of the true object at each assessed tick and track; `NO_OBJECT` if the track is paired with no object.

        None for a recording without truth.
        """
        matching = match(self.run)
        if matching is None:
            return None
        full = np.full((len(self._now_ns), len(self._columns)), NO_OBJECT)
        for row in np.flatnonzero(
            matching.paired & (matching.tick_index < len(full))
        ).tolist():
            column = self._columns[int(matching.tracks["track_id"][row])]
            full[matching.tick_index[row], column] = matching.object_index[row]
        return full[self._ticks]

    def _true_m(self, wait_ns: int) -> FloatArray:
        """True positions `wait_ns` before each assessed tick, shape (ticks, tracks, 2).

        NaN for a track without an object.
        """
        objects = self.objects
        at_ns = self._now_ns[self._ticks] - wait_ns
        result = np.full((len(self._ticks), len(self._columns), 2), np.nan)
        if objects is not None:
            for index, path in enumerate(true_paths(self.run.tables["truth"])):
                ticks, tracks = np.nonzero(objects == index)
                result[ticks, tracks] = path.at(at_ns[ticks])[:, :2]
        return result

    def squares(
        self,
        estimator: str,
        config: Config,
        arrival: Arrival = as_received,
        waits_s: Sequence[float] = (0.0,),
    ) -> list[FloatArray]:
        """Return squared position errors of the states `waits_s` ago, each of shape (ticks, tracks).

        The ticks are the assessed ones. Without truth, predicted variances replace the
        squared errors.
        """
        events = [
            (at_ns, item) for item in self.calls if (at_ns := arrival(item)) is not None
        ]
        events.sort(
            key=lambda pair: (
                np.searchsorted(self._now_ns, pair[0]),
                pair[1].stamp_ns,
                not pair[1].start,
            )
        )
        own = replace(config, estimator=estimator)
        failures = Failures()
        waiting = iter([*events, (0, None)])
        bank = GuardedBank(lambda: build_bank(own, failures), failures)
        waits = [
            (nanoseconds(wait_s), self._true_m(nanoseconds(wait_s)))
            for wait_s in waits_s
        ]
        result = [
            np.full((len(self._ticks), len(self._columns)), np.nan) for _ in waits
        ]
        rows = {tick: row for row, tick in enumerate(self._ticks.tolist())}
        at_ns, item = next(waiting)
        for tick, now_ns in enumerate(self._now_ns.tolist()):
            bank.advance(now_ns)
            while item is not None and at_ns <= now_ns:
                self._feed(bank, item, config)
                at_ns, item = next(waiting)
            if tick not in rows:
                continue
            for track_id in [
                track_id for track_id in bank.track_ids if self._ends[track_id] < now_ns
            ]:
                bank.remove(track_id)
            for squares, (wait_ns, true_m) in zip(result, waits, strict=True):
                states = bank.states_at(now_ns - wait_ns)
                for track_id, mean, P in zip(
                    states.track_ids, states.means, states.covariances, strict=True
                ):
                    if (
                        self._births[track_id] + _SETTLE_NS + wait_ns
                        <= now_ns
                        <= self._ends[track_id]
                    ):
                        at = rows[tick], self._columns[track_id]
                        squares[at] = (
                            P[0, 0] + P[1, 1]
                            if self.objects is None
                            else np.square(mean[:2] - true_m[at]).sum()
                        )
        return result

    def _feed(self, bank: GuardedBank, item: BankCall, config: Config) -> None:
        if item.start is not None:
            bank.birth(item.track_ids[0], item.start)
            return
        alive = set(bank.track_ids)
        chosen = [
            (track_id, self._measurement(each, config))
            for track_id, each in zip(item.track_ids, item.observations, strict=True)
            if track_id in alive
        ]
        if chosen:
            bank.update(item.stamp_ns, *zip(*chosen, strict=True))

    def _measurement(self, observation: Observation, config: Config) -> Measurement:
        """Return the measurement of `observation` with the noise of `config`.

        Only standard deviations of the sensor can differ from the noise of the run.
        """
        before, after = (
            each.sensors[observation.sensor].std for each in (self.config, config)
        )
        if before == after or not observation.tuned:
            return observation.measurement
        item = observation.measurement
        T = observation.axes
        measured = list(observation.measured)
        names = [item.model.components[index] for index in measured]
        R = item.R.copy()
        R[np.ix_(measured, measured)] += congruence(
            T, np.diag([after[name] ** 2 - before[name] ** 2 for name in names])
        )
        return replace(item, R=R)

    def published(self, run: Run) -> FloatArray:
        """Return the squared errors that `run` itself publishes at the assessed ticks, of the same objects.

        The recording must have truth.
        """
        matching = match(run)
        assert matching is not None
        assert self.objects is not None
        paired = np.flatnonzero(matching.paired)
        squares = np.square(track_errors(matching).values["position_m"])
        # NO_OBJECT selects the last column, which is always NaN.
        by_object = np.full(
            (len(matching.now_ns), len(matching.object_ids) + 1), np.nan
        )
        by_object[matching.tick_index[paired], matching.object_index[paired]] = squares
        return np.take_along_axis(by_object[self._ticks], self.objects, axis=1)
