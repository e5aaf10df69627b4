"""Clock offsets of sensors: against the truth of a recording, else against one of them.

With the path p(t) of an object in the map and T(t) = map_from_ego, a detection z of the object, stamped s, leaves at
the offset d

    r(d) = p(s - d) - T(s - d) z = r(0) + d r'(0) + ...

r' is minus the velocity of the object against the turning ego. d is estimated by Gauss-Newton, with Huber weights. The
path is that of the truth, or a smoothing spline through the detections of a reference sensor. With truth a constant
bias is estimated, too, along and across the motion of the object or of the ego, the one with the smaller residuals.
Where the velocity hardly changes, bias and offset cannot be distinguished, and the offset is not known.

The standard deviation of d is that of the jackknife over stretches of time, so it includes time-correlated errors
(Bell, McCaffrey, Survey Methodology 28, 2002). d over it follows Student's t with one degree of freedom less than
stretches count, the larger ones more (Carter, Schnepel, Steigerwald, Review of Economics and Statistics 99, 2017).
"""

import itertools
import math
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from scipy.special import stdtrit

from fgtrack.clocks.arrivals import arrivals_of
from fgtrack.clocks.paths import (
    EgoPath,
    MeasuredPositions,
    ObjectPath,
    measured_positions,
    true_paths,
)
from fgtrack.config.settings import Config
from fgtrack.core.errors import CallError, DataError, did_you_mean
from fgtrack.core.geometry import rotations
from fgtrack.core.linalg import psd_solve
from fgtrack.core.time import nanoseconds, seconds
from fgtrack.core.types import DetectionList, EgoState, FloatArray, IntArray, Message
from fgtrack.pipeline.clock import corrected
from fgtrack.pipeline.replay import replay_in_memory
from fgtrack.runs import COLUMNS, Run

__all__ = [
    "RECEIPT_S",
    "TRUTH",
    "Bias",
    "OffsetReport",
    "SensorOffset",
    "estimate_offsets",
]

TRUTH = "truth"
"""Name of the reference where offsets are those against the truth."""
_FEWEST, _MOST = 30, 2000  # detections of a sensor
_NEAR_M = (
    20.0  # a track is of the object whose path it is nearer to than this, in the median
)
_STEP_S = 0.01  # of differences
_STRETCH_S, _STRETCHES, _FEWEST_STRETCHES = 5.0, 12, 4
_SHORTEST_STRETCH_S = 1.0
_ROUNDS = 10
_HUBER = 1.5
_LARGEST_STEP_S, _REACH_S = 0.2, 1.0
_BIAS_STDS, _SMALLEST_BIAS_M = (
    4.0,
    0.2,
)  # a bias that is no chance, and that a calibration would find
_SURE = 0.995  # an offset is accepted where 0 is outside of the 99 % interval of Student's t, if it matters
SMALLEST_OFFSET_S = 0.01
"""A smaller offset does not matter."""
_LARGEST_HALF_S = 0.05  # an interval that is wider leaves an offset unknown
RECEIPT_S = 1e-5
"""Stamps that are nearer to the receipt are the receipt."""

_Pair = tuple[MeasuredPositions, ObjectPath]


class Bias(NamedTuple):
    """Constant error of the positions of a sensor, detections minus truth; 0 in a direction without one."""

    of: Literal["ego", "vehicle"]
    """Whose directions are meant."""
    ahead_m: float
    left_m: float


@dataclass(frozen=True)
class SensorOffset:
    """Clock of one sensor: reported stamp = time at which it measured + offset."""

    sensor: str
    offset_s: float | None
    """None where nothing could be estimated."""
    std_s: float | None
    num_detections: int
    """Used in the estimate."""
    why: str
    """A line on what the estimate rests on, or why there is none."""
    dof: float | None = None
    """Degrees of freedom of `std_s`."""
    bias: Bias | None = None
    """Of its positions against the truth; None where there is none, or no truth."""

    @property
    def half_s(self) -> float | None:
        """Half of the 95 % interval of the offset; None where there is none, or it is wider than the offset matters."""
        half_s = self._times_std_s(0.975)
        return half_s if half_s < 2.0 * _LARGEST_HALF_S else None

    @property
    def is_known(self) -> bool:
        """True if the offset, which may be 0, is known."""
        return self.is_off or (
            self.half_s is not None and self.half_s < _LARGEST_HALF_S
        )

    @property
    def is_off(self) -> bool:
        """True if the offset is no chance, and matters."""
        least_s = max(self._times_std_s(_SURE), SMALLEST_OFFSET_S)
        return (
            self.half_s is not None
            and self.offset_s is not None
            and abs(self.offset_s) >= least_s
        )

    @property
    def agrees(self) -> bool:
        """True if the clock is known and its 95 % interval contains 0."""
        return self.is_known and not self.is_off and self._is_within(self.half_s)

    @property
    def is_small(self) -> bool:
        """True if the 95 % interval excludes 0, but the offset is too small to matter."""
        is_outside = (
            self.is_known and not self.is_off and not self._is_within(self.half_s)
        )
        return is_outside and self._is_within(SMALLEST_OFFSET_S)

    def _is_within(self, limit_s: float | None) -> bool:
        return (
            limit_s is not None
            and self.offset_s is not None
            and abs(self.offset_s) <= limit_s
        )

    def _times_std_s(self, share: float) -> float:
        if self.offset_s is None or not self.std_s or self.dof is None:
            return math.inf
        return self.std_s * float(stdtrit(self.dof, share))


@dataclass(frozen=True)
class OffsetReport:
    """Offsets of all sensors against the truth, or against the clock of one of them."""

    reference: str
    """Name of that sensor, or `truth`."""
    sensors: tuple[SensorOffset, ...]
    least_delays_s: Mapping[str, float]
    """Shortest delay of each sensor: its stamps are not earlier than the truth by more than that."""

    @property
    def others(self) -> list[SensorOffset]:
        """The sensors but the reference."""
        return [item for item in self.sensors if item.sensor != self.reference]

    def surely_late_s(self, one: SensorOffset) -> float | None:
        """Return by how much the later one of two clocks is late at least; negative where it is that of the reference.
        None where either clock may be wrong.
        """
        if not one.is_off or one.offset_s is None or one.half_s is None:
            return None
        least_s = self.least_delays_s.get(
            self.reference if one.offset_s > 0.0 else one.sensor, 0.0
        )
        surely_s = abs(one.offset_s) - least_s
        return (
            math.copysign(surely_s, one.offset_s)
            if least_s > RECEIPT_S and surely_s > one.half_s
            else None
        )


class _Fit(NamedTuple):
    """Solution of r + A x = 0, x = (offset, bias ahead and to the left)."""

    x: FloatArray
    std: FloatArray
    """Standard deviations of x; infinite where nothing determines them."""
    dof: float
    """Degrees of freedom of that of the offset."""
    cost: float
    """Robust sum of squared residuals."""


def estimate_offsets(
    messages: Sequence[Message],
    config: Config,
    reference: str | None = None,
    doubtful: Container[str] = (),
    run: Run | None = None,
) -> OffsetReport:
    """Return the clock offsets of the sensors, from tracks that the tracker of `config` makes.

    Without truth, or where `reference` is named, offsets are differences of two clocks. The reference is then the
    sensor with most detections, but for those that are `doubtful` and those with a clock that must be wrong: nothing is
    received before it was measured. Nothing is refused for its delay: a wrong stamp looks like one. `run` is one of
    `messages` in which nothing was refused; without it they are replayed.

    Raises `CallError` for an unknown reference, and `DataError` without detections or with fewer than five ego states.
    """
    heard = [
        corrected(item, config.sensors) if isinstance(item, DetectionList) else item
        for item in messages
    ]
    unrefused = {  # corrected stamps are taken as they are, and none is too late
        name: replace(
            item,
            max_delay_s=None,
            clock_offset_s=0.0,
            stamp_from="message" if item.stamp_from == "receipt" else item.stamp_from,
        )
        for name, item in config.sensors.items()
    }
    config = replace(config, estimator="ekf-replay", sensors=unrefused)
    lists = [
        item
        for item in heard
        if isinstance(item, DetectionList) and item.sensor in config.used_sensors
    ]
    arrivals = arrivals_of(lists)
    counts = {name: int(item.counts.sum()) for name, item in arrivals.items()}
    least_s = {name: float(item.delays_s.min()) for name, item in arrivals.items()}
    if not counts:
        raise DataError(
            "there are no detections of a sensor that the configuration names (sensors)"
        )
    if reference is not None and reference not in counts:
        hint = did_you_mean(reference, sorted(counts))
        raise CallError(
            f"reference {reference!r} is no sensor of the input, which has {', '.join(sorted(counts))}{hint}"
        )
    needs_ego = any(item.frame != "map" for item in lists)
    run = replay_in_memory(heard, config) if run is None else run
    poses = run.tables["ego"]  # where the tracker has the ego, as its tracks
    states = zip(*(poses[name].tolist() for name in COLUMNS["ego"]), strict=True)
    ego = EgoPath(itertools.starmap(EgoState, states)) if needs_ego else None
    seen = measured_positions(run, lists, config, ego)
    sensors = [name for name in config.sensors if name in counts]

    def against(name: str, paths: Sequence[ObjectPath]) -> OffsetReport:
        rows = []
        for sensor in sensors:
            is_swapped = (
                name != TRUTH and counts[sensor] > counts[name]
            )  # the path of the better sensor is smoother
            fixed, moved = (
                (_paths(seen, sensor), name) if is_swapped else (paths, sensor)
            )
            row = _row(sensor, _paired(seen.get(moved, {}), fixed), name, len(sensors))
            rows.append(
                replace(row, offset_s=-row.offset_s)
                if is_swapped and row.offset_s is not None
                else row
            )
        return OffsetReport(name, tuple(rows), least_s)

    if reference is None and (paths := true_paths(messages)):
        return against(TRUTH, paths)
    if reference is not None:
        return against(reference, _paths(seen, reference))
    placing = [
        name for name in sensors if config.sensors[name].gives_position and counts[name]
    ]
    trusted = [name for name in placing if name not in doubtful] or placing or sensors
    reference = max(sorted(trusted), key=counts.__getitem__)
    report = against(reference, _paths(seen, reference))
    late = [
        item for item in report.sensors if (report.surely_late_s(item) or 0.0) < 0.0
    ]
    if not late or len(trusted) < len(placing):
        return report
    reference = max(late, key=lambda item: item.num_detections).sensor
    return against(reference, _paths(seen, reference))


def _paths(
    seen: Mapping[str, Mapping[int, MeasuredPositions]], reference: str
) -> list[ObjectPath]:
    paths = [
        ObjectPath.through(item.stamps_ns, item.at(item.stamps_ns))
        for item in seen.get(reference, {}).values()
    ]
    return [item for item in paths if item is not None]


def _paired(
    tracks: Mapping[int, MeasuredPositions], paths: Sequence[ObjectPath]
) -> list[_Pair]:
    """Return each track that is near a path with the one that it is nearest to."""
    pairs = []
    for item in tracks.values():
        positions_m = item.at(item.stamps_ns)
        best, best_m = None, _NEAR_M
        for path in paths:
            gaps_m = np.hypot(*(path(item.stamps_ns) - positions_m).T)
            if (
                np.isfinite(gaps_m).sum() > len(gaps_m) / 2
                and float(np.nanmedian(gaps_m)) < best_m
            ):
                best, best_m = path, float(np.nanmedian(gaps_m))
        if best is not None:
            pairs.append((item.chosen(np.isfinite(best(item.stamps_ns)[:, 0])), best))
    return pairs


def _row(
    name: str, pairs: Sequence[_Pair], reference: str, num_sensors: int
) -> SensorOffset:
    if num_sensors == 1 and reference != TRUTH:
        return SensorOffset(
            name, None, None, 0, "the only modality: nothing to compare it with"
        )
    if name == reference:
        return SensorOffset(
            name, 0.0, 0.0, 0, "the reference: its clock is taken for that of the ego"
        )
    count = sum(len(item.stamps_ns) for item, _ in pairs)
    if count < _FEWEST:
        why = f"fewer than {_FEWEST} detections of objects whose path is known from {reference}"
        return SensorOffset(name, None, None, count, why)
    step = math.ceil(count / _MOST)
    pairs = [(item.chosen(slice(None, None, step)), path) for item, path in pairs]
    stamps_ns = np.concatenate([item.stamps_ns for item, _ in pairs])
    offset_s, move_s = 0.0, math.inf
    for _ in range(_ROUNDS):
        r, g, frames = _residuals(pairs, offset_s)
        if reference != TRUTH:
            frames = {"vehicle": np.empty((len(r), 2, 0))}
        fits = {
            of: _solved(r, np.concatenate([g[:, :, None], axes], axis=2), stamps_ns)
            for of, axes in frames.items()
        }
        of, fit = min(fits.items(), key=lambda item: round(item[1].cost, 6))
        move_s = float(np.clip(fit.x[0], -_LARGEST_STEP_S, _LARGEST_STEP_S))
        offset_s += move_s
        if abs(move_s) < 1e-4:
            break
    squared = np.square(g).sum(axis=1)
    speed_mps = (
        math.sqrt(float(np.mean(squared[np.isfinite(squared)])))
        if np.isfinite(squared).any()
        else 0.0
    )
    why = f"objects move {speed_mps:.2g} m/s (rms) in its frame, against {reference}"
    if (
        not abs(move_s) <= max(0.2 * fit.std[0], 1e-3)
        or abs(offset_s) > _REACH_S
        or math.isinf(fit.std[0])
    ):
        return SensorOffset(name, None, None, len(stamps_ns), why)
    biases = [  # 0 where it may be chance or does not matter
        bias_m if abs(bias_m) > max(_BIAS_STDS * std_m, _SMALLEST_BIAS_M) else 0.0
        for bias_m, std_m in zip(fit.x[1:].tolist(), fit.std[1:].tolist(), strict=True)
    ]
    bias = Bias(of, *biases) if any(biases) else None
    return SensorOffset(
        name, offset_s, float(fit.std[0]), len(stamps_ns), why, fit.dof, bias
    )


_Frames = dict[Literal["ego", "vehicle"], FloatArray]


def _residuals(
    pairs: Sequence[_Pair], offset_s: float
) -> tuple[FloatArray, FloatArray, _Frames]:
    """Return residuals at `offset_s`, their derivatives by it, (n, 2), and (n, 2, 2) axes in which a bias may stay."""
    step_ns, rows = nanoseconds(_STEP_S), []
    for item, path in pairs:
        times_ns = item.stamps_ns - nanoseconds(offset_s)
        true_m = [path(times_ns + shift_ns) for shift_ns in (-step_ns, 0, step_ns)]
        sides_m = [
            true - item.at(times_ns + k * step_ns)
            for k, true in zip((-1, 0, 1), true_m, strict=True)
        ]
        moves_m = true_m[2] - true_m[0]
        yaws_rad = np.arctan2(moves_m[:, 1], moves_m[:, 0])
        ego_rad = (
            np.full(len(yaws_rad), np.nan)
            if item.ego is None
            else item.ego(item.stamps_ns)[:, 2]
        )
        rows.append(
            (sides_m[1], (sides_m[0] - sides_m[2]) / (2.0 * _STEP_S), yaws_rad, ego_rad)
        )
    r, g, vehicle_rad, ego_rad = (
        np.concatenate(column) for column in zip(*rows, strict=True)
    )
    frames: _Frames = (
        {"ego": rotations(ego_rad)} if np.isfinite(ego_rad).any() else {}
    )  # taken where both agree
    return r, g, {**frames, "vehicle": rotations(vehicle_rad)}


def _solved(r: FloatArray, A: FloatArray, stamps_ns: IntArray) -> _Fit:
    """Return the robust solution of r + A x = 0, of residuals (n, 2) with derivatives (n, 2, k)."""
    known = np.isfinite(r).all(axis=1) & np.isfinite(A).all(axis=(1, 2))
    r, A, stamps_ns = r[known], A[known], stamps_ns[known]
    size = A.shape[2]
    unknown = np.full(size, math.inf)
    if len(r) < _FEWEST:
        return _Fit(np.zeros(size), unknown, 0.0, math.inf)
    x, H, weights, scale_m = np.zeros(size), np.eye(size), np.ones(len(r)), 1.0
    for _ in range(5):
        H = np.einsum("n,nij,nik->jk", weights, A, A) + 1e-9 * np.eye(size)
        x = -psd_solve(H, np.einsum("n,nij,ni->j", weights, A, r))
        left_m = np.hypot(*(r + A @ x).T)
        scale_m = max(float(np.median(left_m)), 1e-6)
        weights = np.minimum(1.0, _HUBER * scale_m / np.maximum(left_m, 1e-9))
    left_m = np.hypot(*(r + A @ x).T)
    inner_m = np.minimum(left_m, _HUBER * scale_m)
    cost = float(inner_m @ (2.0 * left_m - inner_m))
    length_s = seconds(int(np.ptp(stamps_ns)))
    stretch_s = min(_STRETCH_S, max(length_s / _STRETCHES, _SHORTEST_STRETCH_S))
    names, stretches = np.unique(
        stamps_ns // nanoseconds(stretch_s), return_inverse=True
    )
    if len(names) < _FEWEST_STRETCHES:
        return _Fit(x, unknown, 0.0, cost)
    parts, scores = np.zeros((len(names), size, size)), np.zeros((len(names), size))
    np.add.at(parts, stretches, np.einsum("n,nij,nik->njk", weights, A, A))
    np.add.at(scores, stretches, np.einsum("n,nij,ni->nj", weights, A, r + A @ x))
    without = psd_solve(H - parts, scores[:, :, None])[
        :, :, 0
    ]  # how far the solution moves without each
    std = np.sqrt((1.0 - 1.0 / len(names)) * np.square(without).sum(axis=0))
    column = psd_solve(H, np.eye(size)[0])
    shares = (
        np.einsum("j,njk,k->n", column, parts, column) / column[0]
    )  # of what is known of the offset
    if not shares.any():  # nothing moves
        return _Fit(x, unknown, 0.0, cost)
    return _Fit(x, std, 1.0 / float(shares @ shares) - 1.0, cost)
