"""Clock offsets of sensors, against the truth of a recording or against a reference sensor.

Let p(t) be the path of an object in the map, and T(t) = map_from_ego. A detection z of
the object has the stamp s. At the offset d the residual is

    r(d) = p(s - d) - T(s - d) z = r(0) + d r'(0) + ...

r' is the negative velocity of the object relative to the ego frame. Gauss-Newton with
Huber weights estimates d. The path is the truth, or a smoothing spline through the
detections of the reference sensor.

With truth, a constant bias is estimated too. Its axes are along and across the motion,
either of the object or of the ego. The axes with the smaller residuals are used. Where
the velocity hardly changes, bias and offset cannot be separated, and the offset stays
unknown.

The standard deviation of d is a jackknife over stretches of time
(`fgtrack.core.jackknife`). So it includes time-correlated errors.
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
from fgtrack.core.jackknife import Information, jackknife
from fgtrack.core.linalg import psd_solve
from fgtrack.core.time import nanoseconds, seconds
from fgtrack.core.types import DetectionList, EgoState, FloatArray, IntArray, Message
from fgtrack.meaning.corrected import corrected
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
"""Name of the reference for offsets against the truth."""
# Least and largest number of detections of a sensor in an estimate.
_FEWEST = 30
_MOST = 2000
# Largest median distance between a track and the path of its object.
_NEAR_M = 20.0
# Time step of numerical derivatives.
_STEP_S = 0.01
# Length and number of the stretches of the jackknife.
_STRETCH_S = 5.0
_STRETCHES = 12
_FEWEST_STRETCHES = 4
_SHORTEST_STRETCH_S = 1.0
# Iterations of Gauss-Newton, their largest step, and the largest offset.
_ROUNDS = 10
_LARGEST_STEP_S = 0.2
_REACH_S = 1.0
# Information of a prior, which makes the equations regular.
_PRIOR = 1e-9
# Huber width in units of the median residual.
_HUBER = 1.5
# A bias is reported if it is significant, and large enough for a calibration.
_BIAS_STDS = 4.0
_SMALLEST_BIAS_M = 0.2
# An offset is accepted if the 99 % interval of Student's t excludes 0.
_SURE = 0.995
SMALLEST_OFFSET_S = 0.01
"""A smaller offset does not matter."""
# An offset with a wider half interval is unknown.
_LARGEST_HALF_S = 0.05
RECEIPT_S = 1e-5
"""A stamp within this time of its receipt is the receipt."""

_Pair = tuple[MeasuredPositions, ObjectPath]


class Bias(NamedTuple):
    """Constant position error of a sensor, detections minus truth; 0 along an axis without a significant error."""

    frame: Literal["ego", "vehicle"]
    """Frame of the error: of the ego, or of the observed vehicle."""
    ahead_m: float
    left_m: float


@dataclass(frozen=True)
class SensorOffset:
    """Clock offset of one sensor: reported stamp = time of measurement + offset."""

    sensor: str
    offset_s: float | None
    """Estimated offset; None if it cannot be estimated."""
    std_s: float | None
    """Standard deviation of the offset; None without an offset."""
    num_detections: int
    """Number of detections in the estimate."""
    why: str
    """A line on the data behind the estimate, or the reason why there is no estimate."""
    dof: float | None = None
    """Degrees of freedom of `std_s`."""
    bias: Bias | None = None
    """Position bias against the truth; None without a significant bias, or without truth."""

    @property
    def half_s(self) -> float | None:
        """Half-width of the 95 % interval of the offset; None without an offset, or with a very wide interval."""
        half_s = self._times_std_s(0.975)
        return half_s if half_s < 2.0 * _LARGEST_HALF_S else None

    @property
    def is_known(self) -> bool:
        """True if the offset is known. A known offset may be 0."""
        return self.is_off or (
            self.half_s is not None and self.half_s < _LARGEST_HALF_S
        )

    @property
    def is_off(self) -> bool:
        """True if the offset is significant (99 %) and large enough to matter."""
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
    """Clock offsets of all sensors, against the truth or against a reference sensor."""

    reference: str
    """Name of the reference sensor, or `truth`."""
    sensors: tuple[SensorOffset, ...]
    least_delays_s: Mapping[str, float]
    """Shortest delay from stamp to receipt of each sensor, by name.

    No list is received before it was measured. So the stamps of a sensor are too early by at most this time.
    """

    @property
    def others(self) -> list[SensorOffset]:
        """The sensors except the reference."""
        return [item for item in self.sensors if item.sensor != self.reference]

    def surely_late_s(self, one: SensorOffset) -> float | None:
        """Return the time by which the stamps of the sensor of `one`, or of the reference, are late for certain.

        Positive if the stamps of the sensor of `one` are late, negative if the stamps of the reference are. None if
        either clock may be wrong, or if the offset is not significant.
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
    """Solution x = (offset, bias ahead, bias left) of r + A x = 0.

    Without truth x contains the offset alone.
    """

    x: FloatArray
    std: FloatArray
    """Standard deviations of x; infinite where the data do not determine x."""
    dof: float
    """Degrees of freedom of the standard deviation of the offset."""
    cost: float
    """Robust sum of squared residuals."""


def estimate_offsets(
    messages: Sequence[Message],
    config: Config,
    reference: str | None = None,
    doubtful: Container[str] = (),
    run: Run | None = None,
) -> OffsetReport:
    """Return the clock offsets of the sensors, estimated from the tracks of the tracker of `config`.

    With truth, and without a given `reference`, an offset is the error of the clock. Otherwise it is the difference
    from the clock of the reference sensor. The default reference is the sensor with the most detections, the
    `doubtful` sensors excluded. If its delays prove that the stamps of the reference are late, another sensor becomes
    the reference.

    No message is refused for its delay, because a wrong stamp looks like a delay. `run` is a run of `messages` in which
    none was refused. Without it the messages are replayed.

    Raises `CallError` for an unknown reference. Raises `DataError` without detections, or with fewer than five ego
    states.
    """
    corrected_messages = [
        corrected(item, config.sensors) if isinstance(item, DetectionList) else item
        for item in messages
    ]
    # The stamps are already corrected, and no message is too late.
    unrefused = {
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
        for item in corrected_messages
        if isinstance(item, DetectionList) and item.sensor in config.used_sensors
    ]
    arrivals = arrivals_of(lists)
    counts = {name: int(item.counts.sum()) for name, item in arrivals.items()}
    least_s = {name: float(item.delays_s.min()) for name, item in arrivals.items()}
    if not counts:
        raise DataError(
            "no detections of a configured sensor; see `fgtrack info` for the sensors of the input"
        )
    if reference is not None and reference not in counts:
        hint = did_you_mean(reference, sorted(counts))
        raise CallError(
            f"reference {reference!r}: not a sensor of the input, use {', '.join(sorted(counts))}{hint}"
        )
    needs_ego = any(item.frame != "map" for item in lists)
    run = replay_in_memory(corrected_messages, config) if run is None else run
    poses = run.tables["ego"]  # the ego poses that the tracker used
    states = zip(*(poses[name].tolist() for name in COLUMNS["ego"]), strict=True)
    ego = EgoPath(itertools.starmap(EgoState, states)) if needs_ego else None
    seen = measured_positions(run, lists, config, ego)
    sensors = [name for name in config.sensors if name in counts]

    def offsets_against(name: str, paths: Sequence[ObjectPath]) -> OffsetReport:
        rows = []
        for sensor in sensors:
            # The path is taken from the sensor with more detections, as it is smoother.
            is_swapped = name != TRUTH and counts[sensor] > counts[name]
            fixed = _paths(seen, sensor) if is_swapped else paths
            moved = name if is_swapped else sensor
            row = _sensor_offset(
                sensor, _paired(seen.get(moved, {}), fixed), name, len(sensors)
            )
            rows.append(
                replace(row, offset_s=-row.offset_s)
                if is_swapped and row.offset_s is not None
                else row
            )
        return OffsetReport(name, tuple(rows), least_s)

    if reference is None and (paths := true_paths(messages)):
        return offsets_against(TRUTH, paths)
    if reference is not None:
        return offsets_against(reference, _paths(seen, reference))
    placing = [
        name for name in sensors if config.sensors[name].gives_position and counts[name]
    ]
    trusted = [name for name in placing if name not in doubtful] or placing or sensors
    reference = max(sorted(trusted), key=counts.__getitem__)
    report = offsets_against(reference, _paths(seen, reference))
    late = [
        item for item in report.sensors if (report.surely_late_s(item) or 0.0) < 0.0
    ]
    if not late or len(trusted) < len(placing):
        return report
    reference = max(late, key=lambda item: item.num_detections).sensor
    return offsets_against(reference, _paths(seen, reference))


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
    """Return each track that is near a path, paired with the nearest path."""
    pairs = []
    for item in tracks.values():
        positions_m = item.at(item.stamps_ns)
        best = None
        best_m = _NEAR_M
        for path in paths:
            gaps_m = np.hypot(*(path(item.stamps_ns) - positions_m).T)
            if (
                np.isfinite(gaps_m).sum() > len(gaps_m) / 2
                and float(np.nanmedian(gaps_m)) < best_m
            ):
                best = path
                best_m = float(np.nanmedian(gaps_m))
        if best is not None:
            pairs.append((item.chosen(np.isfinite(best(item.stamps_ns)[:, 0])), best))
    return pairs


def _sensor_offset(
    name: str, pairs: Sequence[_Pair], reference: str, num_sensors: int
) -> SensorOffset:
    if num_sensors == 1 and reference != TRUTH:
        return SensorOffset(
            name, None, None, 0, "the only sensor: no other clock to compare with"
        )
    if name == reference:
        return SensorOffset(
            name, 0.0, 0.0, 0, "the reference: its clock is assumed to be right"
        )
    count = sum(len(item.stamps_ns) for item, _ in pairs)
    if count < _FEWEST:
        why = f"fewer than {_FEWEST} detections of objects whose path is known from {reference}"
        return SensorOffset(name, None, None, count, why)
    step = math.ceil(count / _MOST)
    pairs = [(item.chosen(slice(None, None, step)), path) for item, path in pairs]
    stamps_ns = np.concatenate([item.stamps_ns for item, _ in pairs])
    offset_s = 0.0
    move_s = math.inf
    for _ in range(_ROUNDS):
        r, g, frames = _residuals(pairs, offset_s)
        if reference != TRUTH:
            frames = {"vehicle": np.empty((len(r), 2, 0))}
        fits = {
            frame: _solved(r, np.concatenate([g[:, :, None], axes], axis=2), stamps_ns)
            for frame, axes in frames.items()
        }
        frame, fit = min(fits.items(), key=lambda item: round(item[1].cost, 6))
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
    # A bias that is not significant, or too small to matter, is 0.
    biases = [
        bias_m if abs(bias_m) > max(_BIAS_STDS * std_m, _SMALLEST_BIAS_M) else 0.0
        for bias_m, std_m in zip(fit.x[1:].tolist(), fit.std[1:].tolist(), strict=True)
    ]
    bias = Bias(frame, *biases) if any(biases) else None
    return SensorOffset(
        name, offset_s, float(fit.std[0]), len(stamps_ns), why, fit.dof, bias
    )


_Frames = dict[Literal["ego", "vehicle"], FloatArray]


def _residuals(
    pairs: Sequence[_Pair], offset_s: float
) -> tuple[FloatArray, FloatArray, _Frames]:
    """Return residuals at `offset_s` (n, 2), their derivatives by the offset (n, 2), and the axes of a bias by frame.

    A residual is the position on the path minus the measured position, in the map. The axes (n, 2, 2) have the
    directions ahead and left as columns, for the frames `ego` and `vehicle`.
    """
    step_ns = nanoseconds(_STEP_S)
    rows = []
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
    # The ego frame comes first: it is chosen if both fit equally well.
    frames: _Frames = {}
    if np.isfinite(ego_rad).any():
        frames["ego"] = rotations(ego_rad)
    frames["vehicle"] = rotations(vehicle_rad)
    return r, g, frames


def _solved(r: FloatArray, A: FloatArray, stamps_ns: IntArray) -> _Fit:
    """Return the robust solution x of r + A x = 0.

    `r` are residuals (n, 2), and `A` their derivatives (n, 2, k) at `stamps_ns` (n,).
    """
    known = np.isfinite(r).all(axis=1) & np.isfinite(A).all(axis=(1, 2))
    r, A, stamps_ns = r[known], A[known], stamps_ns[known]
    size = A.shape[2]
    unknown = np.full(size, math.inf)
    if len(r) < _FEWEST:
        return _Fit(np.zeros(size), unknown, 0.0, math.inf)
    x = np.zeros(size)
    H = np.eye(size)
    weights = np.ones(len(r))
    scale_m = 1.0
    for _ in range(5):
        H = np.einsum("n,nij,nik->jk", weights, A, A) + _PRIOR * np.eye(size)
        x = -psd_solve(H, np.einsum("n,nij,ni->j", weights, A, r))
        residual_m = np.hypot(*(r + A @ x).T)
        scale_m = max(float(np.median(residual_m)), 1e-6)
        weights = np.minimum(1.0, _HUBER * scale_m / np.maximum(residual_m, 1e-9))
    residual_m = np.hypot(*(r + A @ x).T)
    inner_m = np.minimum(residual_m, _HUBER * scale_m)
    cost = float(inner_m @ (2.0 * residual_m - inner_m))
    length_s = seconds(int(np.ptp(stamps_ns)))
    stretch_s = min(_STRETCH_S, max(length_s / _STRETCHES, _SHORTEST_STRETCH_S))
    names, stretches = np.unique(
        stamps_ns // nanoseconds(stretch_s), return_inverse=True
    )
    if len(names) < _FEWEST_STRETCHES:
        return _Fit(x, unknown, 0.0, cost)
    data = Information(
        np.einsum("n,nij,nik->njk", weights, A, A),
        np.einsum("n,nij,ni->nj", weights, A, r + A @ x),
        np.full(size, _PRIOR),
    )
    std, dof = jackknife(data, stretches, np.eye(size))
    return _Fit(x, std, float(dof[0]), cost)
