"""Clock offsets against the truth of a recording, which tells which of two clocks is wrong.

With the truth p(t) and T(t) = map_from_ego, a detection z of the object, stamped s, leaves at the offset d

    r(d) = p(s - d) - T(s - d) z = r(0) + d r'(0) + ...

r' is minus the velocity of the object against the turning ego. d is found by Gauss-Newton, with Huber weights, together
with a constant bias along and across the motion of the object: the sensor sees another part of it than the truth means.
Where the velocity hardly changes, the bias and the offset cannot be told apart, and the offset is not known.

The standard deviation of d is that of the jackknife over stretches of time, so it knows of errors that last (Bell,
McCaffrey, Survey Methodology 28, 2002). Few stretches tell the two apart, those with a bend or an overtaking: it is
uncertain, and d over it follows Student's t with one degree of freedom less than stretches count, the larger ones more
(Carter, Schnepel, Steigerwald, Review of Economics and Statistics 99, 2017).
"""

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from fgtrack.core.checks import LARGEST
from fgtrack.core.linalg import psd_solve
from fgtrack.core.time import nanoseconds
from fgtrack.core.types import EGO_ID, DetectionList, EgoState, FloatArray, IntArray, Message, TruthState
from fgtrack.estimation.factor_graph.clock_calibration.time_shift import ShiftableMeasurement
from fgtrack.estimation.initiation import fix_of
from fgtrack.pipeline.clock import Delivered
from fgtrack.pipeline.clock_offsets import OffsetReport, OffsetRules, SensorOffset, ego_path_of, unrefused
from fgtrack.pipeline.config import Config
from fgtrack.pipeline.offset_measurements import Remeasure, measurements_by_track
from fgtrack.pipeline.replay import replay_in_memory
from fgtrack.pipeline.stamping import mended

__all__ = ["TRUTH", "truth_offsets"]

TRUTH = "truth"
"""Name of the reference."""
_NEAR_M = 20.0  # a track is of the object that it is nearer to than this, in the median
_GAP_S = 3.0  # truth is not known in longer gaps
_STEP_S = 0.01  # of differences
_STRETCH_S, _FEWEST_STRETCHES = 5.0, 4
_MOST = 3000  # detections of a sensor
_ROUNDS = 8
_HUBER = 1.5
_LARGEST_STEP_S = 0.2


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


def truth_offsets(messages: Sequence[Message], config: Config, rules: OffsetRules | None = None) -> OffsetReport | None:
    """The clock offset of each sensor against the truth among `messages`; None where there is none.

    `std_s` is that of stretches of 5 s, see the module. Raises as `estimate_offsets`.
    """
    paths = _paths(messages)
    if not paths:
        return None
    rules = rules or OffsetRules()
    heard: list[Delivered] = [
        mended(message, config.sensors) if isinstance(message, DetectionList) else message
        for message in messages
        if isinstance(message, (EgoState, DetectionList))
        and getattr(message, "sensor", "") not in config.ignore_sensors
    ]
    config = unrefused(config)
    run, broken = replay_in_memory(heard, config)
    raw = [one for one in heard if isinstance(one, DetectionList)]
    tracks = measurements_by_track(run, raw, raw, config.sensors, Remeasure(config, ego_path_of(heard, raw, rules)))
    found: dict[str, list[tuple[ShiftableMeasurement, _Path]]] = defaultdict(list)
    num_tracks = 0
    for track in tracks:
        nearest = _nearest(track, paths)
        if nearest is not None:
            num_tracks += 1
            for item in track:
                found[item.sensor].append((item, nearest))
    rows = tuple(
        _row(name, found.get(name, []), rules) for name in config.sensors if any(o.sensor == name for o in raw)
    )
    return OffsetReport(TRUTH, rows, num_tracks, sum(row.num_detections for row in rows), broken)


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


def _row(name: str, pairs: Sequence[tuple[ShiftableMeasurement, _Path]], rules: OffsetRules) -> SensorOffset:
    some = pairs[:: math.ceil(len(pairs) / _MOST) or 1]
    pairs = [(item, path) for item, path in some if np.isfinite(path.at(np.array([item.stamp_ns]))).all()]
    if len(pairs) < 3 * rules.min_detections:
        return SensorOffset(name, None, None, len(pairs), False, "too few detections of objects whose truth is known")
    stamps_ns = np.array([item.stamp_ns for item, _ in pairs])
    offset_s, step_s = 0.0, math.inf
    for _ in range(_ROUNDS):
        r, g, ways = _residuals(pairs, stamps_ns - nanoseconds(offset_s))
        x, std_s, dof = _solved(r, g, ways, stamps_ns)
        step_s = float(np.clip(x, -_LARGEST_STEP_S, _LARGEST_STEP_S))
        offset_s += step_s
        if abs(step_s) < 1e-4:
            break
    speed_mps = math.sqrt(float(np.nanmean(np.square(g).sum(axis=1))))
    converged = abs(step_s) < max(0.2 * std_s, 1e-3) and abs(offset_s) < rules.solver.reach_s
    known = converged and std_s < rules.needed_std_s
    why = f"objects move {speed_mps:.2g} m/s (rms) in its frame, against the truth"
    return SensorOffset(name, offset_s, std_s, len(pairs), known, why, dof=dof)


def _residuals(
    pairs: Sequence[tuple[ShiftableMeasurement, _Path]], times_ns: IntArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residuals at these times, their derivatives by the offset, and the directions of travel, (n, 2) each."""
    step_ns = nanoseconds(_STEP_S)
    sides = [
        np.array([path.at(np.array([at]))[0] for (_, path), at in zip(pairs, (times_ns + shift).tolist(), strict=True)])
        - _positions([item for item, _ in pairs], (times_ns + shift).tolist())
        for shift in (-step_ns, 0, step_ns)
    ]
    moves = np.array(
        [
            np.diff(path.at(np.array([at - step_ns, at + step_ns])), axis=0)[0]
            for (_, path), at in zip(pairs, times_ns.tolist(), strict=True)
        ]
    )
    length = np.hypot(*moves.T)[:, None]
    ways = np.divide(moves, length, out=np.zeros_like(moves), where=length > 0.0)
    return sides[1], (sides[0] - sides[2]) / (2.0 * _STEP_S), ways


def _solved(r: FloatArray, g: FloatArray, ways: FloatArray, stamps_ns: IntArray) -> tuple[float, float, float]:
    """The step of the offset beside a bias along and across, its standard deviation, and degrees of freedom."""
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
    if len(names) < _FEWEST_STRETCHES:
        return float(x[0]), math.inf, 0.0
    parts, scores = np.zeros((len(names), 3, 3)), np.zeros((len(names), 3))
    np.add.at(parts, stretches, np.einsum("n,nij,nik->njk", weights, A, A))
    np.add.at(scores, stretches, np.einsum("n,nij,ni->nj", weights, A, r + A @ x))
    without = psd_solve(H - parts, scores[:, :, None])[:, 0, 0]  # how far the offset moves without each
    std_s = math.sqrt((1.0 - 1.0 / len(names)) * float(without @ without))
    column = psd_solve(H, np.array([1.0, 0.0, 0.0]))
    shares = np.einsum("j,njk,k->n", column, parts, column) / column[0]  # of what is known of the offset
    return float(x[0]), std_s, 1.0 / float(shares @ shares) - 1.0
