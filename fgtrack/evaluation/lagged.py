"""Errors of lagged and final states, and those of the present states at the same stamps."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from fgtrack.core.types import FloatArray, IntArray
from fgtrack.evaluation.consistency import normalised_squares
from fgtrack.evaluation.matching import Matching, TrackErrors, state_errors
from fgtrack.evaluation.paired import UNKNOWN, Estimate, by_stamp, within_run
from fgtrack.evaluation.statistics import Moments
from fgtrack.evaluation.truth import TRUE_STATE, TruePath, true_paths
from fgtrack.io.run import Run, Table

WINDOW: Literal["window"] = "window"
"""The lag of a final state: the window's length, or less where the track ended before."""

_NO_ROW = -1
_SEED = 1  # of the bootstrap: the same run gives the same interval


@dataclass(frozen=True)
class LagMetrics:
    """The states of one lag, and the present states of the same tracks at the same stamps.

    Both are compared with the same truth, so their difference is the gain of waiting.
    """

    lag_s: float | Literal["window"]
    """0 for the present states, `WINDOW` for the final ones."""
    errors: Mapping[str, Moments]
    """State minus truth at the state's own stamp, by name of `ERROR_NAMES`; `position_m` is the distance."""
    position_nees: Moments
    """Normalised error squared of x and y: a consistent estimator has a mean of 2."""
    present_errors: Mapping[str, Moments]
    """Those of the present states that were published for these stamps."""
    position_reduction: Estimate = UNKNOWN
    """Relative reduction of the position RMSE against the present states, with its interval."""

    @property
    def is_lagged(self) -> bool:
        """Whether these are judged states of one lag behind the present."""
        return isinstance(self.lag_s, float) and self.lag_s > 0.0 and self.errors["position_m"].count > 0

    def gain(self, name: str) -> float:
        """Relative reduction of the RMSE of `name` against the present states; NaN where there is none."""
        present = self.present_errors[name].rmse
        return 1.0 - self.errors[name].rmse / present if present > 0.0 else math.nan


def lag_metrics(run: Run, matching: Matching | None) -> tuple[LagMetrics, ...]:
    """Metrics of the present states, of every lag of lagged.csv by rising lag, and of the final states.

    A lagged state belongs to the object that its track was paired with at the tick of the same stamp; where no tick
    has this stamp, at the one nearest to it. What has no such pair is not judged. Empty for a run without truth.
    """
    if matching is None:
        return ()
    parts: list[tuple[float | Literal["window"], Table]] = [
        (lag_s, run.tables["lagged"].where(run.tables["lagged"]["lag_s"] == lag_s))
        for lag_s in np.unique(run.tables["lagged"]["lag_s"]).tolist()
        if lag_s > 0.0
    ]
    final = run.tables["smoothed"].where(run.tables["smoothed"]["kind"] == "final")
    if final.num_rows:
        parts.append((WINDOW, final))
    paths = true_paths(run.tables["truth"])
    return (_present(matching), *(_judged(matching, paths, lag_s, states) for lag_s, states in parts))


def _present(matching: Matching) -> LagMetrics:
    tracks, truth = matching.tracks.where(matching.paired), matching.true_states[matching.paired]
    errors = _moments(state_errors(tracks, truth))
    return LagMetrics(0.0, errors, Moments.of(_position_nees(tracks, truth)), errors)


def _judged(
    matching: Matching, paths: Sequence[TruePath], lag_s: float | Literal["window"], states: Table
) -> LagMetrics:
    states, truth, rows = _with_truth(matching, paths, states)
    present = Table({name: column[rows] for name, column in matching.tracks.items()})
    errors, present_errors = state_errors(states, truth), state_errors(present, matching.true_states[rows])
    return LagMetrics(
        lag_s,
        _moments(errors),
        Moments.of(_position_nees(states, truth)),
        _moments(present_errors),
        _reduction(states["stamp_ns"], errors["position_m"], present_errors["position_m"]),
    )


def final_errors(run: Run, matching: Matching) -> TrackErrors:
    """Errors of the final states, each against the object that its track was paired with at that stamp."""
    final = run.tables["smoothed"].where(run.tables["smoothed"]["kind"] == "final")
    states, truth, rows = _with_truth(matching, true_paths(run.tables["truth"]), final)
    index = matching.object_index[rows]
    return TrackErrors(states["stamp_ns"], index, states["track_id"], state_errors(states, truth))


def _with_truth(matching: Matching, paths: Sequence[TruePath], states: Table) -> tuple[Table, FloatArray, IntArray]:
    """Return those of `states` that belong to an object, its true states there, shape (n, 5), and their judged rows."""
    rows = _rows_at(matching, states)
    alive = rows != _NO_ROW
    states, rows = states.where(alive), rows[alive]
    truth = np.full((len(rows), len(TRUE_STATE)), np.nan)
    for index, path in enumerate(paths):
        mine = matching.object_index[rows] == index
        truth[mine] = path.at(states["stamp_ns"][mine])
    known = np.isfinite(truth[:, 0]) & np.isfinite(states["x_m"])  # no truth is known of a row without a pair
    return states.where(known), truth[known], rows[known]


def _reduction(stamps_ns: IntArray, errors: FloatArray, present_errors: FloatArray) -> Estimate:
    """Relative reduction of the root mean square of `errors` against `present_errors`, shape (n,) each."""
    ticks = by_stamp(stamps_ns, np.square(np.stack([errors, present_errors], axis=-1)))
    return within_run(ticks, lambda S: 1.0 - np.sqrt(S[0] / S[1]), np.random.default_rng(_SEED))


def _rows_at(matching: Matching, states: Table) -> IntArray:
    """The judged row of each state's track that is nearest in stamp, shape (n,); `_NO_ROW` outside of its life."""
    found = np.full(states.num_rows, _NO_ROW)
    tracks, track_ids = matching.tracks, states["track_id"]
    order = np.lexsort((tracks["stamp_ns"], tracks["track_id"]))
    ids = tracks["track_id"][order]
    for track_id in np.unique(track_ids).tolist():
        start, end = np.searchsorted(ids, (track_id, track_id + 1)).tolist()
        if start == end:
            continue
        rows, mine = order[start:end], np.flatnonzero(track_ids == track_id)
        stamps_ns, wanted_ns = tracks["stamp_ns"][rows], states["stamp_ns"][mine]
        right = np.searchsorted(stamps_ns, wanted_ns).clip(max=len(rows) - 1)
        left = (right - 1).clip(min=0)
        nearest = np.where(wanted_ns - stamps_ns[left] < stamps_ns[right] - wanted_ns, left, right)
        alive = (wanted_ns >= stamps_ns[0]) & (wanted_ns <= stamps_ns[-1])
        found[mine[alive]] = rows[nearest[alive]]
    return found


def _moments(errors: Mapping[str, FloatArray]) -> dict[str, Moments]:
    return {name: Moments.of(values) for name, values in errors.items()}


def _position_nees(states: Table, truth: FloatArray) -> FloatArray:
    """Normalised error squared of x and y, shape (n,); NaN where the covariance is not positive definite."""
    return normalised_squares(states, np.stack([states["x_m"], states["y_m"]], axis=-1) - truth[:, :2])
