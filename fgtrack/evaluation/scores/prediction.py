"""Displacement errors (ADE, FDE) of predictions a few seconds ahead of the published states."""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray
from fgtrack.evaluation.matching import Matching, TrackErrors, confirmed
from fgtrack.evaluation.placement import roads
from fgtrack.evaluation.scores.predictor import arc_positions, rail_positions
from fgtrack.evaluation.scores.statistics import Moments
from fgtrack.evaluation.truth import TRUE_STATE, states_of
from fgtrack.runs import Run

#: Horizons of the predictions [s].
HORIZONS_S = (1.0, 2.0, 3.0, 5.0)
PREDICTION_STEP_S = 0.1
# Number of states that are predicted together.
_BLOCK_ROWS = 1 << 11
_PERIOD_NS = NS_PER_S // 10  # between two predictions, as in the published node


@dataclass(frozen=True)
class PredictionErrors:
    """Distances between predicted and true positions.

    Only predictions with truth up to the horizon count.
    """

    final_m: Moments
    """Distance at the horizon; its mean is the final displacement error, FDE."""
    average_m: Moments
    """Mean distance over every 0.1 s up to the horizon; its mean is the average displacement error, ADE."""


def displacements(run: Run, matching: Matching) -> Iterator[TrackErrors]:
    """Yield the distances between predicted and true positions, by predictor and in blocks of rows.

    The predictors are `arc` and, with a map, `rail`. Predictions are made ten times a
    second for confirmed tracks with an object. The distances have the shape (n, m),
    with a column for every `PREDICTION_STEP_S` ahead. NaN without truth.
    """
    _, first = np.unique(matching.now_ns // _PERIOD_NS, return_index=True)
    tracks = matching.tracks
    rows = np.flatnonzero(
        matching.paired & np.isin(matching.tick_index, first) & confirmed(tracks)
    )
    states = np.stack([tracks[name][rows] for name in TRUE_STATE], axis=-1)
    states[:, 4] = np.nan_to_num(states[:, 4])  # a model may have no yaw rate
    usable = np.isfinite(states).all(axis=1)
    rows, states = rows[usable], states[usable]
    stamps_ns, ids = tracks["stamp_ns"][rows], tracks["track_id"][rows]
    ahead_s: FloatArray = PREDICTION_STEP_S * np.arange(
        1, round(HORIZONS_S[-1] / PREDICTION_STEP_S) + 1, dtype=np.float64
    )
    road = roads(run)[0].get("track")
    for begin in range(0, max(len(rows), 1), _BLOCK_ROWS):
        block = slice(begin, begin + _BLOCK_ROWS)
        objects = matching.object_index[rows[block]]
        at_ns = stamps_ns[block][:, None] + np.round(ahead_s * NS_PER_S).astype(
            np.int64
        )
        every = states_of(
            matching.paths, np.repeat(objects, len(ahead_s)), at_ns.reshape(-1)
        )
        truth = every[:, :2].reshape(*at_ns.shape, 2)
        positions_m = {"arc": arc_positions(states[block], ahead_s)}
        if road is not None:
            positions_m["rail"] = rail_positions(road, states[block], ahead_s)
        distances_m = {
            name: np.linalg.norm(each - truth, axis=-1)
            for name, each in positions_m.items()
        }
        yield TrackErrors(stamps_ns[block], objects, ids[block], distances_m)


def prediction_errors(
    run: Run, matching: Matching | None
) -> dict[str, dict[str, PredictionErrors]]:
    """Return the displacement errors by predictor and horizon (`1s` to `5s`); empty without truth."""
    final_m: dict[tuple[str, float], list[FloatArray]] = defaultdict(list)
    average_m: dict[tuple[str, float], list[FloatArray]] = defaultdict(list)
    for block in displacements(run, matching) if matching is not None else ():
        for name, distances_m in block.values.items():
            for horizon_s in HORIZONS_S:
                until = distances_m[:, : round(horizon_s / PREDICTION_STEP_S)]
                until = until[np.isfinite(until).all(axis=1)]
                final_m[name, horizon_s].append(until[:, -1].copy())
                average_m[name, horizon_s].append(until.mean(axis=1))
    errors: dict[str, dict[str, PredictionErrors]] = defaultdict(dict)
    for name, horizon_s in final_m:
        errors[name][f"{horizon_s:g}s"] = PredictionErrors(
            final_m=Moments.of(np.concatenate(final_m[name, horizon_s])),
            average_m=Moments.of(np.concatenate(average_m[name, horizon_s])),
        )
    return dict(errors)
