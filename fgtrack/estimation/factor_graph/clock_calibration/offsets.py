"""Constant clock offsets of sensors, from tracks whose association is known.

A sensor whose clock is off reports the stamp t + offset for what it sensed at t. A wrong stamp moves a detection in the
map twice: the object was elsewhere, and so was the ego. With T(t) = map_from_ego and a detection z in the ego frame,

    d/d offset of [p(stamp - offset) - T(stamp - offset) z] = -v_object + dT/dt z:

so an offset is observable through the velocity of the object in the (turning) ego frame and a second sensor.

One sensor alone carries information as well if the process noise is believed: with wrong stamps its objects seem to
move less smoothly. Drivers are no white noise, and this bias is as strong as a weak second sensor. So it is left out:
maximised is p(all | offsets) / product of p(one sensor | its offset), the agreement between sensors.
"""

import bisect
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import gtsam
import numpy as np

from fgtrack.core.checks import positive
from fgtrack.core.linalg import congruence, psd_solve, symmetrise
from fgtrack.core.time import nanoseconds, seconds
from fgtrack.core.types import YAW, BoolArray, FloatArray
from fgtrack.estimation.factor_graph.clock_calibration.levenberg_marquardt import solved
from fgtrack.estimation.factor_graph.clock_calibration.time_shift import (
    Nodes,
    PairTerm,
    ShiftableMeasurement,
    pair_factor,
    pair_term,
    rates,
)
from fgtrack.estimation.factor_graph.factors import motion_factor, prior_factor
from fgtrack.estimation.initiation import along, fix_of, straight_line
from fgtrack.models.motion import MotionModel
from fgtrack.models.robust import weight
from fgtrack.models.sensors import RobustLoss

#: Standard deviations of the first state of an object of which nothing is known.
_WIDE = {
    "x_m": 1e3,
    "y_m": 1e3,
    "yaw_rad": np.pi,
    "speed_mps": 100.0,
    "yaw_rate_radps": 1.0,
    "accel_mps2": 10.0,
    "vx_mps": 100.0,
    "vy_mps": 100.0,
}
_LINE = 12  # measurements that a first guess of a state is a line through
_LARGEST_MOVE_S = 0.1  # of an offset in one round, at first
_SMALLEST_STEP_S, _LARGEST_STEP_S = 2e-4, 5e-3  # of differences by an offset
_NEGLIGIBLE = 0.2  # of a standard deviation: what is left after such a Newton step is far less
_STRETCH_S, _FEWEST_STRETCHES = 5.0, 4
_LOST, _PATIENCE = 0.1, 3  # an offset that is known no better than that share of the prior is let go after some rounds


@dataclass(frozen=True)
class OffsetSettings:
    """Prior, loss and accuracy of `solve_offsets`."""

    prior_std_s: float = 0.5
    """Standard deviation of an offset before anything was seen; its mean is 0."""
    huber_width: float | None = 3.0
    """Huber loss of the detections, in standard deviations: associations are not perfect. Null is the Gaussian."""
    node_s: float = 0.1
    """Time between two nodes of a track."""
    tolerance_s: float = 1e-5
    """An offset is converged when it moves less, or less than a fifth of its standard deviation."""
    max_rounds: int = 10

    def __post_init__(self) -> None:
        for name in ("prior_std_s", "huber_width", "node_s", "tolerance_s"):
            positive(**{name: getattr(self, name)})
        if self.max_rounds < 1:
            raise ValueError(f"max_rounds: must be at least 1, is {self.max_rounds}")

    @property
    def reach_s(self) -> float:
        """No offset is larger."""
        return 2.0 * self.prior_std_s


@dataclass(frozen=True, eq=False)
class OffsetSolution:
    """Offsets of m sensors."""

    sensors: tuple[str, ...]
    offsets_s: FloatArray
    """Shape (m,)."""
    covariance: FloatArray
    """Shape (m, m); never wider than the prior."""
    converged: BoolArray
    """Which of them came to rest, shape (m,); the others may be anywhere."""
    rounds: int
    speeds_mps: Mapping[str, float]
    """RMS velocity of a sensor's objects against the frame that it measured them in."""
    residuals: Mapping[str, float]
    """RMS residual of a sensor in its assumed standard deviations; near 1 where they are right."""
    spread_s: FloatArray
    """Standard deviations by how much stretches of a few seconds disagree, shape (m,): where errors last, or the noise
    is not that assumed, these are larger. NaN of fewer than four stretches."""


def solve_offsets(
    motion: MotionModel,
    tracks: Sequence[Sequence[ShiftableMeasurement]],
    start_s: Mapping[str, float],
    settings: OffsetSettings,
) -> OffsetSolution:
    """The offsets of the sensors in `start_s` with which all sensors agree best; all other sensors have none.

    Newton's method: each step takes the gradient, with the states at their best, on both sides of the offsets. The
    covariance is the inverse curvature, from the same differences: that of Gauss-Newton would take the noise of
    estimated velocities for motion.

    Parameters
    ----------
    tracks
        Sightings of one object each, in any order.
    start_s
        First guess of each offset.

    Raises
    ------
    numpy.linalg.LinAlgError
        A track has no two measurements at different times.
    """
    prior = settings.prior_std_s**-2
    objective = _Agreement(motion, tracks, start_s, settings)
    offsets_s = np.array(list(start_s.values()))
    covariance = np.eye(len(offsets_s)) / prior
    converged = np.zeros(len(offsets_s), dtype=np.bool_)
    limits_s, last_s = np.full(len(offsets_s), _LARGEST_MOVE_S), np.zeros(len(offsets_s))
    for rounds in range(1, settings.max_rounds + 1):
        steps_s = np.clip(np.sqrt(np.diag(covariance)), _SMALLEST_STEP_S, _LARGEST_STEP_S)
        gradient, curvature = objective.derivatives(offsets_s, steps_s)
        eigenvalues, axes = np.linalg.eigh(curvature)
        covariance = np.asarray(axes / (prior + np.maximum(eigenvalues, 0.0)) @ axes.T)
        newton_s = -covariance @ (gradient + prior * offsets_s)
        limits_s = np.where(newton_s * last_s < 0.0, limits_s / 2.0, limits_s)  # back and forth: far out, a Huber loss
        last_s = newton_s  # is nearly straight, and Newton's step leads beyond the other end
        offsets_s = offsets_s + np.clip(newton_s, -limits_s, limits_s)
        offsets_s = np.clip(offsets_s, -settings.reach_s, settings.reach_s)
        std_s = np.sqrt(np.diag(covariance))
        converged = np.abs(newton_s) < np.maximum(settings.tolerance_s, _NEGLIGIBLE * std_s)
        lost = (std_s > _LOST * settings.prior_std_s) & (rounds >= _PATIENCE)
        if (converged | lost).all():
            break
    spread_s = _spread(objective.scores(offsets_s), covariance)
    return OffsetSolution(
        tuple(start_s), offsets_s, covariance, converged, rounds, *objective.summary(offsets_s), spread_s
    )


def _spread(scores: FloatArray, covariance: FloatArray) -> FloatArray:
    """Standard deviations of parameters from the `scores` (b, m) of independent stretches (White 1982, the sandwich).

    covariance * sum of g g' * covariance, with g around their mean and b / (b - 1) for the small number.
    """
    count = len(scores)
    if count < _FEWEST_STRETCHES:
        return np.full(len(covariance), np.nan)
    around = scores - scores.mean(axis=0)
    variances = np.diag(congruence(covariance, around.T @ around)) * count / (count - 1)
    return np.sqrt(np.maximum(variances, 0.0))


class _Path:
    """One object: its measurements, and the states of its nodes with the offsets held."""

    def __init__(
        self, motion: MotionModel, measurements: Sequence[ShiftableMeasurement], nodes: Nodes, huber_width: float | None
    ) -> None:
        self._motion = motion
        self._measurements = measurements
        self._huber_width = huber_width
        self._nodes = nodes
        self._keys = [gtsam.symbol("x", i) for i in range(len(nodes.stamps_ns))]
        wide = np.diag([_WIDE[name] ** 2 for name in motion.state_names])
        self._prior = prior_factor(self._keys[0], nodes.means[0], wide)
        self._step_s = seconds(nodes.stamps_ns[1] - nodes.stamps_ns[0])

    def optimise(self, offsets_s: Mapping[str, float]) -> None:
        """Bring the states to their best for these offsets, near where they are and with the process noise there."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        graph.add(self._prior)
        for (left, right), mean in zip(pairwise(self._keys), self._nodes.means, strict=False):
            graph.add(motion_factor(self._motion, left, right, self._step_s, mean))
        for item in self._measurements:
            found = self.pair_term(item, offsets_s)
            graph.add(pair_factor(self._keys, self._nodes, found, self._huber_width))
        for key, mean in zip(self._keys, self._nodes.means, strict=True):
            values.insert(key, mean)
        values = solved(graph, values, self._keys)
        self._nodes = Nodes(self._nodes.stamps_ns, np.array([values.atVector(key) for key in self._keys]))

    def slopes(self, offsets_s: Mapping[str, float]) -> dict[str, float]:
        """Derivative of -log p by each offset, after `optimise`: the states are optimal, so through the time only.

        sum of -w (dy/dt)' R^-1 y, with the weight w of the loss. That R changes with the time is left out.
        """
        slopes = dict.fromkeys(offsets_s, 0.0)
        for sensor, _, slope in self.each_slope(offsets_s):
            slopes[sensor] += slope
        return slopes

    def each_slope(self, offsets_s: Mapping[str, float]) -> Iterator[tuple[str, int, float]]:
        """Sensor, stamp and share of each measurement in `slopes`."""
        for item in self._measurements:
            if item.sensor in offsets_s:
                found = self.pair_term(item, offsets_s)
                rate = rates(self._motion, self._nodes, item, _sensed_ns(item, offsets_s)).y
                slope = -_weight(found, self._huber_width) * float(rate @ psd_solve(found.R, found.y))
                yield item.sensor, item.stamp_ns, slope

    def pair_term(self, item: ShiftableMeasurement, offsets_s: Mapping[str, float]) -> PairTerm:
        """What `item` says, at the time that the offsets give it."""
        return pair_term(self._motion, self._nodes, item, _sensed_ns(item, offsets_s))

    def squares(self, offsets_s: Mapping[str, float]) -> list[tuple[str, float, float]]:
        """Sensor, squared velocity against its frame, and squared residual per component, of each measurement."""
        found = []
        for item in self._measurements:
            velocity_mps = rates(self._motion, self._nodes, item, _sensed_ns(item, offsets_s)).velocity_mps
            one = self.pair_term(item, offsets_s)
            found.append((item.sensor, float(velocity_mps @ velocity_mps), one.distance**2 / len(one.y)))
        return found


class _Agreement:
    """-log of p(all | offsets) / product of p(one sensor | its offset); keeps the states from one call to the next."""

    def __init__(
        self,
        motion: MotionModel,
        tracks: Sequence[Sequence[ShiftableMeasurement]],
        start_s: Mapping[str, float],
        settings: OffsetSettings,
    ) -> None:
        self._sensors = tuple(start_s)
        self._all: list[_Path] = []
        self._alone: list[_Path] = []
        for measurements in tracks:
            nodes = _first_nodes(motion, measurements, start_s, settings)
            self._all.append(_Path(motion, measurements, nodes, settings.huber_width))
            for sensor in start_s:
                own = [item for item in measurements if item.sensor == sensor]
                if own:
                    self._alone.append(_Path(motion, own, nodes, settings.huber_width))
        self._optimise(start_s)

    def derivatives(self, offsets_s: FloatArray, steps_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Gradient (m,) and curvature (m, m) at `offsets_s`, from differences over `steps_s` (m,) to both sides."""
        self._optimise(self._named(offsets_s))
        gradients = []
        curvature = np.empty((len(offsets_s), len(offsets_s)))
        for j, step_s in enumerate(steps_s):
            shift_s = step_s * np.eye(len(offsets_s))[j]
            ahead, behind = self._gradient(offsets_s + shift_s), self._gradient(offsets_s - shift_s)
            gradients.append((ahead + behind) / 2.0)
            curvature[:, j] = (ahead - behind) / (2.0 * step_s)
        return np.mean(gradients, axis=0), symmetrise(curvature)

    def summary(self, offsets_s: FloatArray) -> tuple[dict[str, float], dict[str, float]]:
        """Speeds and residuals of `OffsetSolution`, with the present states."""
        rows = [row for path in self._all for row in path.squares(self._named(offsets_s))]
        speeds, residuals = {}, {}
        for sensor in dict.fromkeys(name for name, _, _ in rows):
            mean = np.mean([squares for name, *squares in rows if name == sensor], axis=0)
            speeds[sensor], residuals[sensor] = np.sqrt(mean).tolist()
        return speeds, residuals

    def scores(self, offsets_s: FloatArray) -> FloatArray:
        """Gradient of each stretch of `_STRETCH_S` of all tracks, at the states as they are, shape (b, m)."""
        named = self._named(offsets_s)
        self._optimise(named)
        found: dict[int, FloatArray] = {}
        for sign, paths in ((1.0, self._all), (-1.0, self._alone)):
            for path in paths:
                for sensor, stamp_ns, slope in path.each_slope(named):
                    row = found.setdefault(stamp_ns // nanoseconds(_STRETCH_S), np.zeros(len(self._sensors)))
                    row[self._sensors.index(sensor)] += sign * slope
        return np.array(list(found.values())).reshape(len(found), len(self._sensors))

    def _named(self, offsets_s: FloatArray) -> dict[str, float]:
        return dict(zip(self._sensors, offsets_s.tolist(), strict=True))

    def _optimise(self, offsets_s: Mapping[str, float]) -> None:
        for path in (*self._all, *self._alone):
            path.optimise(offsets_s)

    def _gradient(self, offsets_s: FloatArray) -> FloatArray:
        named = self._named(offsets_s)
        self._optimise(named)
        gradient = np.zeros(len(offsets_s))
        for sign, paths in ((1.0, self._all), (-1.0, self._alone)):
            for path in paths:
                gradient += sign * np.array(list(path.slopes(named).values()))
        return gradient


def _first_nodes(
    motion: MotionModel,
    measurements: Sequence[ShiftableMeasurement],
    offsets_s: Mapping[str, float],
    settings: OffsetSettings,
) -> Nodes:
    """Nodes over all times that may have been meant, each on a line through the measurements around it."""
    stamps = [item.stamp_ns for item in measurements]
    reach_ns, step_ns = nanoseconds(settings.reach_s), nanoseconds(settings.node_s)
    stamps_ns = range(min(stamps) - reach_ns, max(stamps) + reach_ns + step_ns, step_ns)
    timed = sorted(((_sensed_ns(item, offsets_s), item) for item in measurements), key=lambda pair: pair[0])
    times_ns = [time_ns for time_ns, _ in timed]
    means = []
    for stamp_ns in stamps_ns:
        first = min(max(bisect.bisect(times_ns, stamp_ns) - _LINE // 2, 0), max(len(timed) - _LINE, 0))
        around = timed[first : first + _LINE]
        fixes = [fix_of(item.sensed_at(time_ns), seconds(time_ns - stamp_ns)) for time_ns, item in around]
        means.append(along(straight_line([fix for fix in fixes if fix is not None]), 0.0, motion.state_names))
    nodes = np.array(means)
    if "yaw_rad" in motion.state_names:
        nodes[:, YAW] = np.unwrap(nodes[:, YAW])
    return Nodes(stamps_ns, nodes)


def _sensed_ns(item: ShiftableMeasurement, offsets_s: Mapping[str, float]) -> int:
    return item.stamp_ns - nanoseconds(offsets_s.get(item.sensor, 0.0))


def _weight(item: PairTerm, huber_width: float | None) -> float:
    """Of the loss, at the residual of `item`."""
    return 1.0 if huber_width is None else weight(RobustLoss("huber", huber_width), item.distance)
