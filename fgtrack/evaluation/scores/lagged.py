"""Errors of lagged and final states, compared with the present states at the same stamps."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from fgtrack.core.types import FloatArray, IntArray
from fgtrack.evaluation.intervals import UNKNOWN, Estimate, sums_by_stamp, within_run
from fgtrack.evaluation.matching import (
    Matching,
    TrackErrors,
    neighbours,
    position_squares,
    state_errors,
)
from fgtrack.evaluation.scores.statistics import Moments
from fgtrack.evaluation.truth import states_of
from fgtrack.runs import Columns, Run

WINDOW: Literal["window"] = "window"
"""Lag of a final state: the length of the window, or less if the track ended before."""


@dataclass(frozen=True)
class LagMetrics:
    """Errors of states with one lag, and of the present states at equal tracks and stamps."""

    lag_s: float | Literal["window"]
    """0 for the present states, `WINDOW` for the final states."""
    errors: Mapping[str, Moments]
    """State minus truth at the state's own stamp, by name of `ERROR_NAMES`; `position_m` is the distance."""
    position_nees: Moments
    """Normalised squared error of x and y. Its mean is 2 for a consistent estimator."""
    present_errors: Mapping[str, Moments]
    """Errors of the present states that were published for the same stamps."""
    position_reduction: Estimate = UNKNOWN
    """Relative reduction of the position RMSE compared with the present states, with its interval."""

    @property
    def is_lagged(self) -> bool:
        """True for lagged states, not final ones, with truth."""
        return (
            isinstance(self.lag_s, float)
            and self.lag_s > 0.0
            and self.errors["position_m"].count > 0
        )

    def gain(self, name: str) -> float:
        """Relative reduction of the RMSE of `name` compared with the present states; NaN if that RMSE is 0."""
        present = self.present_errors[name].rmse
        return 1.0 - self.errors[name].rmse / present if present > 0.0 else math.nan


def lag_metrics(run: Run, matching: Matching | None) -> tuple[LagMetrics, ...]:
    """Return the metrics of the present states, of each lag in ascending order, and of the final states.

    A lagged state belongs to the object of its track at the nearest tick. Empty without
    truth.
    """
    if matching is None:
        return ()
    lagged = run.tables["lagged"]
    smoothed = run.tables["smoothed"]
    parts: dict[float | Literal["window"], Columns] = {
        lag_s: lagged.where(lagged["lag_s"] == lag_s)
        for lag_s in np.unique(lagged["lag_s"]).tolist()
        if lag_s > 0.0
    }
    if (smoothed["kind"] == "final").any():
        parts[WINDOW] = smoothed.where(smoothed["kind"] == "final")
    present = matching.tracks.where(matching.paired)
    truth = matching.truth_of(matching.paired)
    errors = _moments(state_errors(present, truth))
    result = [
        LagMetrics(0.0, errors, Moments.of(position_squares(present, truth)), errors)
    ]
    for lag_s, every in parts.items():
        states, truth, rows = _with_truth(run, matching, every)
        present = matching.tracks.where(rows)
        lagged_errors = state_errors(states, truth)
        present_errors = state_errors(present, matching.truth_of(rows))
        squares = np.square(
            np.stack(
                [lagged_errors["position_m"], present_errors["position_m"]], axis=-1
            )
        )
        reduction = within_run(
            sums_by_stamp(states["stamp_ns"], squares),
            lambda S: 1.0 - np.sqrt(S[0] / S[1]),
        )
        nees = Moments.of(position_squares(states, truth))
        result.append(
            LagMetrics(
                lag_s,
                _moments(lagged_errors),
                nees,
                _moments(present_errors),
                reduction,
            )
        )
    return tuple(result)


def final_errors(run: Run, matching: Matching) -> TrackErrors:
    """Return the errors of the final states. The truth is the object that was paired with the track at the stamp."""
    smoothed = run.tables["smoothed"]
    states, truth, rows = _with_truth(
        run, matching, smoothed.where(smoothed["kind"] == "final")
    )
    errors = state_errors(states, truth)
    return TrackErrors(
        states["stamp_ns"], matching.object_index[rows], states["track_id"], errors
    )


def _with_truth(
    run: Run, matching: Matching, states: Columns
) -> tuple[Columns, FloatArray, IntArray]:
    """Return the `states` with truth, their true states (n, 5), and the nearest rows of their tracks."""
    before, after = neighbours(
        matching.tracks, "stamp_ns", states["stamp_ns"], states["track_id"]
    )
    alive = (before >= 0) & (after >= 0)
    states = states.where(alive)
    before = before[alive]
    after = after[alive]
    tracks_ns = matching.tracks["stamp_ns"]
    stamps_ns = states["stamp_ns"]
    rows = np.where(
        stamps_ns - tracks_ns[before] < tracks_ns[after] - stamps_ns, before, after
    )
    truth = states_of(matching.paths, matching.object_index[rows], stamps_ns)
    known = np.isfinite(truth[:, 0]) & np.isfinite(states["x_m"])
    return states.where(known), truth[known], rows[known]


def _moments(errors: Mapping[str, FloatArray]) -> dict[str, Moments]:
    return {name: Moments.of(values) for name, values in errors.items()}
