"""How good predictions from the published states are: displacement errors some seconds ahead (ADE, FDE)."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.evaluation.matching import Matching, confirmed
from fgtrack.evaluation.roads import roads
from fgtrack.evaluation.statistics import Moments
from fgtrack.evaluation.truth import TRUE_STATE, true_paths
from fgtrack.io.run import Run
from fgtrack.models.predictor import ArcPredictor, Predictor, RailPredictor

#: At which times ahead predictions are judged, in s.
HORIZONS_S = (1.0, 2.0, 3.0, 5.0)

_STEP_S = 0.1
_PERIOD_NS = NS_PER_S // 10  # of the published node's predictions


@dataclass(frozen=True)
class PredictionErrors:
    """Distances of predicted and true positions, of the predictions whose truth is known up to the horizon."""

    final_m: Moments
    """At the horizon: the mean is the final displacement error, FDE."""
    average_m: Moments
    """Of each prediction the mean over every 0.1 s until then: the mean is the average displacement error, ADE."""


@dataclass(frozen=True)
class Displacements:
    """How far predictions are off, ten times a second and for every tenth of a second ahead."""

    stamps_ns: IntArray
    """What is predicted from, shape (n,)."""
    object_index: IntArray
    """Object that is predicted, shape (n,)."""
    distances_m: Mapping[str, FloatArray]
    """By predictor, up to the last of `HORIZONS_S`, shape (n, m); NaN where the truth is not known."""

    def at(self, horizon_s: float, predictor: str = "arc") -> FloatArray:
        """Distances `horizon_s` ahead, shape (n,)."""
        return self.distances_m[predictor][:, round(horizon_s / _STEP_S) - 1]


def displacements(run: Run, matching: Matching) -> Displacements:
    """Distances of what the states of `run` predict from the truth.

    Predictors are `arc` and, where the run has a map, `rail`. Judged are confirmed tracks that are paired with an
    object, against that object, wherever it goes. Raises `DataError` where the map that the run names is no map.
    """
    states, stamps_ns, objects = _starts(matching)
    ahead_s: FloatArray = _STEP_S * np.arange(1, round(HORIZONS_S[-1] / _STEP_S) + 1, dtype=np.float64)
    truth = _truth(run, matching, stamps_ns, objects, ahead_s)
    found = {
        name: np.asarray(np.linalg.norm(predictor.positions(states, ahead_s) - truth, axis=-1))
        for name, predictor in _predictors(run).items()
    }
    return Displacements(stamps_ns, objects, found)


def prediction_errors(run: Run, matching: Matching | None) -> dict[str, dict[str, PredictionErrors]]:
    """Means of `displacements` by predictor and horizon, `1s` to `5s`; empty without truth."""
    found: dict[str, dict[str, PredictionErrors]] = {}
    for name, distances_m in displacements(run, matching).distances_m.items() if matching is not None else ():
        found[name] = {}
        for horizon_s in HORIZONS_S:
            until = distances_m[:, : round(horizon_s / _STEP_S)]
            until = until[np.isfinite(until).all(axis=1)]
            errors = PredictionErrors(Moments.of(until[:, -1]), Moments.of(until.mean(axis=1)))
            found[name][f"{horizon_s:g}s"] = errors
    return found


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
    paths = {path.object_id: path for path in true_paths(run.tables["truth"])}
    for index, object_id in enumerate(matching.object_ids):
        mine = objects == index
        states = paths[object_id].at(asked_ns[mine].reshape(-1))
        positions[mine] = states[:, :2].reshape(-1, len(ahead_s), 2)
    return positions
