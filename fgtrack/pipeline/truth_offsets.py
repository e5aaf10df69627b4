"""Clock offsets against the truth of a recording, which tells which of two clocks is wrong.

With the truth p(t) and T(t) = map_from_ego, a detection z of the object, stamped s, leaves at the offset d

    r(d) = p(s - d) - T(s - d) z = r(0) + d r'(0) + ...

r' is minus the velocity of the object against the turning ego. d is found by Gauss-Newton, with Huber weights, together
with a constant bias along and across the motion of the object, where the sensor sees another part of it than the truth
means, or of the ego, where the origin of its detections is not the configured one: the one that leaves the smaller
residuals. Where the velocity hardly changes, bias and offset cannot be told apart, and the offset is not known.

The standard deviation of d is that of the jackknife over stretches of time, so it knows of errors that last (Bell,
McCaffrey, Survey Methodology 28, 2002). Few stretches tell the two apart, those with a bend or an overtaking: it is
uncertain, and d over it follows Student's t with one degree of freedom less than stretches count, the larger ones more
(Carter, Schnepel, Steigerwald, Review of Economics and Statistics 99, 2017).
"""

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fgtrack.core.checks import LARGEST
from fgtrack.core.linalg import psd_solve
from fgtrack.core.time import nanoseconds
from fgtrack.core.types import EGO_ID, DetectionList, EgoState, FloatArray, IntArray, Message, TruthState
from fgtrack.estimation.factor_graph.clock_calibration.time_shift import ShiftableMeasurement
from fgtrack.estimation.initiation import fix_of
from fgtrack.pipeline.clock import Delivered, corrected
from fgtrack.pipeline.clock_offsets import (
    Bias,
    OffsetReport,
    OffsetRules,
    Replayed,
    SensorOffset,
    ego_path_of,
    least_delays_s,
    unrefused,
)
from fgtrack.pipeline.config import Config
from fgtrack.pipeline.ego_path import EgoPath
from fgtrack.pipeline.offset_measurements import Remeasure, measurements_by_track
from fgtrack.pipeline.replay import replay_in_memory

__all__ = ["TRUTH", "truth_offsets"]

TRUTH = "truth"
"""Name of the reference."""
_NEAR_M = 20.0  # a track is of the object that it is nearer to than this, in the median
_GAP_S = 3.0  # truth is not known in longer gaps
_STEP_S = 0.01  # of differences
_STRETCH_S, _FEWEST_STRETCHES = 5.0, 4
_MOST = 2000  # detections of a sensor
_ROUNDS = 8
_HUBER = 1.5
_LARGEST_STEP_S = 0.2
_BIAS_STDS, _SMALLEST_BIAS_M = 4.0, 0.2  # a bias that is no chance, and that a calibration would find


@dataclass(frozen=True)
class _Path:
    """The truth of one object."""

    stamps_ns: IntArray
    positions_m: FloatArray
    """Shape (n, 2)."""

    def at(self, times_ns: IntArray) -> FloatArray:
        """Positions, shape (m, 2); NaN where they are not known."""
        first_ns = self.stamps_ns[0]
        asked, known = (times_ns - first_ns).astype(np.float64), (self.stamps_ns - first_ns).astype(np.float64)
        found = np.stack([np.interp(asked, known, column) for column in self.positions_m.T], axis=-1)
        place = np.clip(np.searchsorted(known, asked), 1, len(known) - 1)
        outside = (asked < known[0]) | (asked > known[-1])
        outside |= known[place] - known[place - 1] > nanoseconds(_GAP_S)
        found[outside] = np.nan
        return found


class _Pair(NamedTuple):
    """A measurement, and the true path of its object."""

    item: ShiftableMeasurement
    path: _Path


class _Fit(NamedTuple):
    """The offset and the bias that leave the smallest residuals."""

    offset_s: float
    std_s: float
    dof: float
    bias_m: tuple[float, float]
    """Detections minus truth, ahead and to the left."""
    bias_std_m: tuple[float, float]
    cost: float
    """Robust sum of squared residuals that is left."""


def truth_offsets(
    messages: Sequence[Message], config: Config, rules: OffsetRules | None = None, replayed: Replayed = replay_in_memory
) -> OffsetReport | None:
    """Return the clock offset and the bias of each sensor against the truth among `messages`; None without truth.

    `std_s` is that of stretches of 5 s, see the module. Raises as `estimate_offsets`.
    """
    paths = _paths(messages)
    if not paths:
        return None
    rules = rules or OffsetRules()
    heard: list[Delivered] = [
        corrected(message, config.sensors) if isinstance(message, DetectionList) else message
        for message in messages
        if isinstance(message, (EgoState, DetectionList))
        and getattr(message, "sensor", "") not in config.ignore_sensors
    ]
    config = unrefused(config)
    run, broken = replayed(heard, config)
    raw = [one for one in heard if isinstance(one, DetectionList)]
    ego = ego_path_of(heard, raw, rules)
    tracks = measurements_by_track(run, raw, raw, config.sensors, Remeasure(config, ego))
    found: dict[str, list[_Pair]] = defaultdict(list)
    num_tracks = 0
    for track in tracks:
        nearest = _nearest(track, paths)
        if nearest is not None:
            num_tracks += 1
            for item in track:
                found[item.sensor].append(_Pair(item, nearest))
    sensors = {one.sensor for one in raw}
    rows = tuple(_row(name, found.get(name, []), ego, rules) for name in config.sensors if name in sensors)
    return OffsetReport(TRUTH, rows, num_tracks, sum(row.num_detections for row in rows), broken, least_delays_s(raw))


def _paths(messages: Iterable[Message]) -> list[_Path]:
    states: dict[int, dict[int, tuple[float, float]]] = defaultdict(dict)
    for message in messages:
        if not isinstance(message, TruthState) or message.ignored or message.object_id == EGO_ID:
            continue
        if abs(message.x_m) <= LARGEST and abs(message.y_m) <= LARGEST:  # what is compared with: detections
            states[message.object_id][message.stamp_ns] = (message.x_m, message.y_m)
    return [
        _Path(np.array(sorted(each)), np.array([each[stamp_ns] for stamp_ns in sorted(each)]))
        for each in states.values()
        if len(each) > 1
    ]


def _positions(items: Iterable[ShiftableMeasurement], times_ns: Iterable[int]) -> FloatArray:
    """Where `items` were in the map, had they been sensed at these times, shape (n, 2); NaN where nothing says so."""
    fixes = [fix_of(item.sensed_at(time_ns), 0.0) for item, time_ns in zip(items, times_ns, strict=True)]
    return np.array([[np.nan, np.nan] if fix is None else fix.position_m for fix in fixes]).reshape(-1, 2)


def _nearest(track: Sequence[ShiftableMeasurement], paths: Sequence[_Path]) -> _Path | None:
    """The object that a track is of."""
    some = track[:: max(len(track) // 30, 1)]
    stamps_ns = np.array([item.stamp_ns for item in some])
    places_m = _positions(some, stamps_ns.tolist())
    best, best_m = None, _NEAR_M
    for path in paths:
        gaps_m = np.hypot(*(path.at(stamps_ns) - places_m).T)
        if np.isfinite(gaps_m).sum() > len(some) / 2 and float(np.nanmedian(gaps_m)) < best_m:
            best, best_m = path, float(np.nanmedian(gaps_m))
    return best


def _row(name: str, found: Sequence[_Pair], ego: EgoPath | None, rules: OffsetRules) -> SensorOffset:
    some = found[:: math.ceil(len(found) / _MOST) or 1]
    true_m = _true_m(some, np.array([item.stamp_ns for item, _ in some], dtype=np.int64))
    pairs = [some[row] for row in np.flatnonzero(np.isfinite(true_m).all(axis=1)).tolist()]
    if len(pairs) < 3 * rules.min_detections:
        return SensorOffset(name, None, None, len(pairs), False, "too few detections of objects whose truth is known")
    stamps_ns = np.array([item.stamp_ns for item, _ in pairs])
    offset_s, step_s = 0.0, math.inf
    for _ in range(_ROUNDS):
        r, g, ways = _residuals(pairs, stamps_ns - nanoseconds(offset_s))
        about, fit = Bias.VEHICLE, _solved(r, g, ways, stamps_ns)
        if ego is not None:
            headings = np.array([ego(stamp_ns).yaw_rad for stamp_ns in stamps_ns.tolist()])
            other = _solved(r, g, np.stack([np.cos(headings), np.sin(headings)], axis=-1), stamps_ns)
            about, fit = (Bias.EGO, other) if other.cost <= fit.cost else (about, fit)
        step_s = float(np.clip(fit.offset_s, -_LARGEST_STEP_S, _LARGEST_STEP_S))
        offset_s += step_s
        if abs(step_s) < 1e-4:
            break
    speed_mps = math.sqrt(float(np.nanmean(np.square(g).sum(axis=1))))
    converged = abs(step_s) < max(0.2 * fit.std_s, 1e-3) and abs(offset_s) < rules.solver.reach_s
    known_s = converged and fit.std_s < rules.needed_std_s
    why = f"objects move {speed_mps:.2g} m/s (rms) in its frame, against the truth"
    biases = [_sure(*one) for one in zip(fit.bias_m, fit.bias_std_m, strict=True)]
    bias = Bias(about, *biases) if any(biases) else None
    return SensorOffset(name, offset_s, fit.std_s, len(pairs), known_s, why, dof=fit.dof, bias=bias)


def _sure(bias_m: float, std_m: float) -> float:
    """`bias_m`, or 0 where it may be chance or does not matter."""
    return bias_m if abs(bias_m) > max(_BIAS_STDS * std_m, _SMALLEST_BIAS_M) else 0.0


def _true_m(pairs: Sequence[_Pair], times_ns: IntArray) -> FloatArray:
    """True positions of the objects of `pairs` at these times, shape (n, 2)."""
    found_m = np.empty((len(pairs), 2))
    paths = {id(path): path for _, path in pairs}
    for key, path in paths.items():
        mine = np.array([id(one.path) == key for one in pairs])
        found_m[mine] = path.at(times_ns[mine])
    return found_m


def _residuals(pairs: Sequence[_Pair], times_ns: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residuals at these times, their derivatives by the offset, and the directions of travel, (n, 2) each."""
    step_ns = nanoseconds(_STEP_S)
    items = [item for item, _ in pairs]
    true_m = [_true_m(pairs, times_ns + shift) for shift in (-step_ns, 0, step_ns)]
    sides = [
        true - _positions(items, (times_ns + shift).tolist())
        for true, shift in zip(true_m, (-step_ns, 0, step_ns), strict=True)
    ]
    moves = true_m[2] - true_m[0]
    length = np.hypot(*moves.T)[:, None]
    ways = np.divide(moves, length, out=np.zeros_like(moves), where=length > 0.0)
    return sides[1], (sides[0] - sides[2]) / (2.0 * _STEP_S), ways


def _solved(r: FloatArray, g: FloatArray, ways: FloatArray, stamps_ns: IntArray) -> _Fit:
    """Return the step of the offset beside a constant bias along and across `ways`, by a robust fit."""
    known = np.isfinite(r).all(axis=1) & np.isfinite(g).all(axis=1)
    r, g, ways, stamps_ns = r[known], g[known], ways[known], stamps_ns[known]
    across = np.stack([-ways[:, 1], ways[:, 0]], axis=-1)
    A = np.stack([g, ways, across], axis=-1)  # r + A x = 0
    x, weights = np.zeros(3), np.ones(len(r))
    for _ in range(5):
        H = np.einsum("n,nij,nik->jk", weights, A, A) + 1e-9 * np.eye(3)
        x = -psd_solve(H, np.einsum("n,nij,ni->j", weights, A, r))
        left_m = np.hypot(*(r + A @ x).T)
        scale_m = max(float(np.median(left_m)), 1e-6)
        weights = np.minimum(1.0, _HUBER * scale_m / np.maximum(left_m, 1e-9))
    names, stretches = np.unique(stamps_ns // nanoseconds(_STRETCH_S), return_inverse=True)
    left_m = np.hypot(*(r + A @ x).T)
    cost = float(np.minimum(left_m, _HUBER * scale_m) @ (2.0 * left_m - np.minimum(left_m, _HUBER * scale_m)))
    bias_m = float(x[1]), float(x[2])
    if len(names) < _FEWEST_STRETCHES:
        return _Fit(float(x[0]), math.inf, 0.0, bias_m, (math.inf, math.inf), cost)
    parts, scores = np.zeros((len(names), 3, 3)), np.zeros((len(names), 3))
    np.add.at(parts, stretches, np.einsum("n,nij,nik->njk", weights, A, A))
    np.add.at(scores, stretches, np.einsum("n,nij,ni->nj", weights, A, r + A @ x))
    without = psd_solve(H - parts, scores[:, :, None])[:, :, 0]  # how far the solution moves without each
    std = np.sqrt((1.0 - 1.0 / len(names)) * np.square(without).sum(axis=0)).tolist()
    column = psd_solve(H, np.array([1.0, 0.0, 0.0]))
    shares = np.einsum("j,njk,k->n", column, parts, column) / column[0]  # of what is known of the offset
    return _Fit(float(x[0]), std[0], 1.0 / float(shares @ shares) - 1.0, bias_m, (std[1], std[2]), cost)
