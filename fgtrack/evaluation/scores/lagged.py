"""Errors of lagged and final states, and those of the present states at the same stamps."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from fgtrack.core.types import FloatArray, IntArray
from fgtrack.evaluation.intervals import UNKNOWN, Estimate, by_stamp, within_run
from fgtrack.evaluation.matching import (
    Matching,
    TrackErrors,
    neighbours,
    position_squares,
    state_errors,
)
from fgtrack.evaluation.scores.statistics import Moments
from fgtrack.evaluation.truth import true_states
from fgtrack.runs import Columns, Run

WINDOW: Literal["window"] = "window"
"""The lag of a final state: the window's length, or less where the track ended before."""


@dataclass(frozen=True)
class LagMetrics:
    """States of one lag, and the present states of the same tracks at the same stamps, against the same truth."""

    lag_s: float | Literal["window"]
    """0 for the present states, `WINDOW` for the final ones."""
    errors: Mapping[str, Moments]
    """State minus truth at the state's own stamp, by name of `ERROR_NAMES`; `position_m` is the distance."""
    position_nees: Moments
    """Normalised error squared of x and y: a consistent estimator has a mean of 2."""
    present_errors: Mapping[str, Moments]
    """Errors of the present states that were published for these stamps."""
    position_reduction: Estimate = UNKNOWN
    """Relative reduction of the position RMSE against the present states, with its interval."""

    @property
    def is_lagged(self) -> bool:
        """True for states of one lag behind the present that have truth."""
        return (
            isinstance(self.lag_s, float)
            and self.lag_s > 0.0
            and self.errors["position_m"].count > 0
        )

    def gain(self, name: str) -> float:
        """Relative reduction of the RMSE of `name` against the present states; NaN where that is 0."""
        present = self.present_errors[name].rmse
        return 1.0 - self.errors[name].rmse / present if present > 0.0 else math.nan


def lag_metrics(run: Run, matching: Matching | None) -> tuple[LagMetrics, ...]:
    """Metrics of the present states, of every lag of lagged.csv by rising lag, and of the final states.
    A lagged state belongs to the object that its track was paired with at the nearest tick. Empty without truth.
    """
    if matching is None:
        return ()
    lagged, smoothed = run.tables["lagged"], run.tables["smoothed"]
    parts: dict[float | Literal["window"], Columns] = {
        lag_s: lagged.where(lagged["lag_s"] == lag_s)
        for lag_s in np.unique(lagged["lag_s"]).tolist()
        if lag_s > 0.0
    }
    if (smoothed["kind"] == "final").any():
        parts[WINDOW] = smoothed.where(smoothed["kind"] == "final")
    present, truth = (
        matching.tracks.where(matching.paired),
        matching.true_states[matching.paired],
    )
    errors = _moments(state_errors(present, truth))
    result = [
        LagMetrics(0.0, errors, Moments.of(position_squares(present, truth)), errors)
    ]
    for lag_s, every in parts.items():
        states, truth, rows = _with_truth(run, matching, every)
        present = matching.tracks.where(rows)
        of_states, of_present = (
            state_errors(states, truth),
            state_errors(present, matching.true_states[rows]),
        )
        squares = np.square(
            np.stack([of_states["position_m"], of_present["position_m"]], axis=-1)
        )
        reduction = within_run(
            by_stamp(states["stamp_ns"], squares), lambda S: 1.0 - np.sqrt(S[0] / S[1])
        )
        nees = Moments.of(position_squares(states, truth))
        result.append(
            LagMetrics(
                lag_s, _moments(of_states), nees, _moments(of_present), reduction
            )
        )
    return tuple(result)


def final_errors(run: Run, matching: Matching) -> TrackErrors:
    """Errors of the final states, each against the object that its track was paired with at that stamp."""
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
    """Return those of `states` that belong to an object, its true states there, shape (n, 5), and their track rows."""
    before, after = neighbours(
        matching.tracks, "stamp_ns", states["stamp_ns"], states["track_id"]
    )
    alive = (before >= 0) & (after >= 0)
    states, before, after = states.where(alive), before[alive], after[alive]
    tracks_ns, stamps_ns = matching.tracks["stamp_ns"], states["stamp_ns"]
    rows = np.where(
        stamps_ns - tracks_ns[before] < tracks_ns[after] - stamps_ns, before, after
    )
    truth = true_states(run.tables["truth"], matching.object_index[rows], stamps_ns)
    known = np.isfinite(truth[:, 0]) & np.isfinite(states["x_m"])
    return states.where(known), truth[known], rows[known]


def _moments(errors: Mapping[str, FloatArray]) -> dict[str, Moments]:
    return {name: Moments.of(values) for name, values in errors.items()}
