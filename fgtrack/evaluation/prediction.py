"""How good predictions from the published states are: displacement errors some seconds ahead (ADE, FDE)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.evaluation.matching import Matching, confirmed
from fgtrack.evaluation.runs import JudgedRun
from fgtrack.evaluation.statistics import Moments
from fgtrack.evaluation.tables import Column, Table
from fgtrack.evaluation.truth import TRUE_STATE, true_paths
from fgtrack.evaluation.viewer.surroundings import roads
from fgtrack.io.run import Run
from fgtrack.models.predictor import ArcPredictor, Predictor, RailPredictor

#: At which times ahead predictions are judged, in s.
HORIZONS_S = (1.0, 2.0, 3.0, 5.0)

_Row = tuple[str, str, Sequence["PredictionErrors"]]

_STEP_S = 0.1
_PERIOD_NS = NS_PER_S // 10  # of the published node's predictions


@dataclass(frozen=True)
class PredictionErrors:
    """Distances of predicted and true positions, of the predictions whose truth is known up to the horizon."""

    predictor: str
    horizon_s: float
    final_m: Moments
    """At the horizon: the mean is the final displacement error, FDE."""
    average_m: Moments
    """Of each prediction the mean over every 0.1 s until then: the mean is the average displacement error, ADE."""


def prediction_errors(run: Run, matching: Matching | None) -> tuple[PredictionErrors, ...]:
    """Errors of what the states of `run` predict, ten times a second, by predictor and horizon; none without truth.

    Predictors are `arc` and, where the run has a map, `rail`. Judged are confirmed tracks that are paired with an
    object, against that object, wherever it goes. Raises `DataError` where the map that the run names is no map.
    """
    if matching is None:
        return ()
    states, stamps_ns, objects = _starts(matching)
    ahead_s: FloatArray = _STEP_S * np.arange(1, round(HORIZONS_S[-1] / _STEP_S) + 1, dtype=np.float64)
    truth = _truth(run, matching, stamps_ns, objects, ahead_s)
    found = []
    for name, predictor in _predictors(run).items():
        distances_m = np.linalg.norm(predictor.positions(states, ahead_s) - truth, axis=-1)
        for horizon_s in HORIZONS_S:
            until = distances_m[:, : round(horizon_s / _STEP_S)]
            until = until[np.isfinite(until).all(axis=1)]
            found.append(PredictionErrors(name, horizon_s, Moments.of(until[:, -1]), Moments.of(until.mean(axis=1))))
    return tuple(found)


def predictions_table(runs: Sequence[JudgedRun]) -> Table:
    """A row for each run and predictor: FDE and ADE at every horizon."""
    rows: list[_Row] = []
    for one in runs:
        by_predictor: dict[str, list[PredictionErrors]] = {}
        for errors in prediction_errors(one.run, one.matching):
            by_predictor.setdefault(errors.predictor, []).append(errors)
        rows += [(one.label, name, errors) for name, errors in by_predictor.items()]

    def displacement(k: int) -> Callable[[_Row], tuple[float, float]]:
        return lambda row: (row[2][k].final_m.mean, row[2][k].average_m.mean)

    columns: list[Column[_Row]] = [
        Column("run", ("run",), lambda row: (row[0],), left=True),
        Column("along", ("predictor",), lambda row: (row[1],), left=True),
        Column("predic-\ntions", ("count",), lambda row: (row[2][0].final_m.count,)),
    ]
    for k, horizon_s in enumerate(HORIZONS_S):
        names = (f"fde_{horizon_s:g}s_m", f"ade_{horizon_s:g}s_m")
        columns.append(Column(f"{horizon_s:g} s [m]\nFDE/ADE", names, displacement(k), "{}/{}"))
    notes = [
        "FDE: mean distance from the truth at that time ahead; ADE: the same, averaged up to it",
        "arc: constant turn rate and speed; rail: the same for 0.2 s, then along the track",
    ]
    return Table(
        "Predictions from the published states", columns, rows, row_keys=("run", "predictor"), notes=notes, detail=True
    )


def _predictors(run: Run) -> dict[str, Predictor]:
    track = roads(run)[0].get("track")
    return {"arc": ArcPredictor(), **({} if track is None else {"rail": RailPredictor(track)})}


def _starts(matching: Matching) -> tuple[FloatArray, IntArray, IntArray]:
    """States, shape (n, 5), stamps and object indices, shape (n,), of what is predicted from."""
    _, first = np.unique(matching.now_ns // _PERIOD_NS, return_index=True)
    tracks = matching.tracks
    chosen = matching.paired & np.isin(matching.tick_index, first)
    chosen &= confirmed(tracks)
    states = np.stack([tracks[name][chosen] for name in TRUE_STATE], axis=-1)
    states[np.isnan(states[:, 4]), 4] = 0.0  # models without a yaw rate
    known = np.isfinite(states).all(axis=1)
    return states[known], tracks["stamp_ns"][chosen][known], matching.object_index[chosen][known]


def _truth(run: Run, matching: Matching, stamps_ns: IntArray, objects: IntArray, ahead_s: FloatArray) -> FloatArray:
    """True positions, shape (n, m, 2), `ahead_s`, shape (m,), of the stamps, shape (n,); NaN where not known."""
    asked_ns = stamps_ns[:, None] + np.round(ahead_s * NS_PER_S).astype(np.int64)
    positions = np.full((*asked_ns.shape, 2), np.nan)
    paths = {path.object_id: path for path in true_paths(run.truth)}
    for index, object_id in enumerate(matching.object_ids):
        mine = objects == index
        states = paths[object_id].at(asked_ns[mine].reshape(-1))
        positions[mine] = states[:, :2].reshape(-1, len(ahead_s), 2)
    return positions
