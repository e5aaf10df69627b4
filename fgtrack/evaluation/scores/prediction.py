"""Displacement errors of predictions from the published states some seconds ahead (ADE, FDE)."""

from dataclasses import dataclass

import numpy as np

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray
from fgtrack.evaluation.matching import Matching, TrackErrors, confirmed
from fgtrack.evaluation.placement import roads
from fgtrack.evaluation.scores.predictor import arc_positions, rail_positions
from fgtrack.evaluation.scores.statistics import Moments
from fgtrack.evaluation.truth import TRUE_STATE, true_states
from fgtrack.runs import Run

#: Times ahead of the predictions, in s.
HORIZONS_S = (1.0, 2.0, 3.0, 5.0)
STEP_S = 0.1
_PERIOD_NS = NS_PER_S // 10  # of the published node's predictions


@dataclass(frozen=True)
class PredictionErrors:
    """Distances of predicted and true positions, of the predictions whose truth is known up to the horizon."""

    final_m: Moments
    """At the horizon: the mean is the final displacement error, FDE."""
    average_m: Moments
    """For each prediction the mean over every 0.1 s until then: the mean is the average displacement error, ADE."""


def displacements(run: Run, matching: Matching) -> TrackErrors:
    """Distances of predicted from true positions, ten times a second, shape (n, m) for every `STEP_S` ahead.
    By predictor: `arc` and, with a map, `rail`; NaN without truth. Only confirmed tracks paired with an object count.
    """
    _, first = np.unique(matching.now_ns // _PERIOD_NS, return_index=True)
    tracks = matching.tracks
    states = np.stack([tracks[name] for name in TRUE_STATE], axis=-1)
    states[:, 4] = np.nan_to_num(states[:, 4])  # models without a yaw rate
    chosen = (
        matching.paired
        & np.isin(matching.tick_index, first)
        & confirmed(tracks)
        & np.isfinite(states).all(axis=1)
    )
    stamps_ns, objects = tracks["stamp_ns"][chosen], matching.object_index[chosen]
    ahead_s: FloatArray = STEP_S * np.arange(
        1, round(HORIZONS_S[-1] / STEP_S) + 1, dtype=np.float64
    )
    at_ns = stamps_ns[:, None] + np.round(ahead_s * NS_PER_S).astype(np.int64)
    every = true_states(
        run.tables["truth"], np.repeat(objects, len(ahead_s)), at_ns.reshape(-1)
    )
    truth = every[:, :2].reshape(*at_ns.shape, 2)
    road = roads(run)[0].get("track")
    positions_m = {"arc": arc_positions(states[chosen], ahead_s)}
    if road is not None:
        positions_m["rail"] = rail_positions(road, states[chosen], ahead_s)
    distances_m = {
        name: np.asarray(np.linalg.norm(each - truth, axis=-1))
        for name, each in positions_m.items()
    }
    return TrackErrors(stamps_ns, objects, tracks["track_id"][chosen], distances_m)


def prediction_errors(
    run: Run, matching: Matching | None
) -> dict[str, dict[str, PredictionErrors]]:
    """Return means of `displacements` by predictor and horizon, `1s` to `5s`; empty without truth."""
    errors: dict[str, dict[str, PredictionErrors]] = {}
    for name, distances_m in (
        displacements(run, matching).values.items() if matching is not None else ()
    ):
        errors[name] = {}
        for horizon_s in HORIZONS_S:
            until = distances_m[:, : round(horizon_s / STEP_S)]
            until = until[np.isfinite(until).all(axis=1)]
            final_m, average_m = (
                Moments.of(until[:, -1]),
                Moments.of(until.mean(axis=1)),
            )
            errors[name][f"{horizon_s:g}s"] = PredictionErrors(final_m, average_m)
    return errors
