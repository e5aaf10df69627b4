"""Detections whose true time is not known, as factors between the two nodes around them.

The nodes stay where they are; the state at a detection's time is interpolated under the motion model, so it follows
the smoothed path when the time changes. (The flow from a node at the detection's stamp would not: the path also moves
by its process noise.)
"""

import bisect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import gtsam
import numpy as np
from gtsam.noiseModel import Gaussian, Robust, mEstimator

from fgtrack.core.linalg import congruence
from fgtrack.core.time import seconds
from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement
from fgtrack.estimation.initiation import fix_of
from fgtrack.estimation.interpolation import Between, between
from fgtrack.models.motion import MotionModel

#: Rates are differences over twice this.
_STEP_NS = 1_000_000


@dataclass(frozen=True, slots=True)
class ShiftableMeasurement:
    """One detection of a known object."""

    sensor: str
    stamp_ns: int
    """As the sensor reports it."""
    sensed_at: Callable[[int], Measurement]
    """The measurement, which holds a position, had it been sensed at a given time; smooth in the time."""


@dataclass(frozen=True, slots=True)
class Nodes:
    """States of an object at fixed times."""

    stamps_ns: Sequence[int]
    """Ascending, at least two."""
    means: FloatArray
    """Shape (m, n)."""

    def left_of(self, time_ns: int) -> int:
        """Index of the node at or before `time_ns`, of the first or last segment where it is outside."""
        return min(max(bisect.bisect_right(self.stamps_ns, time_ns) - 1, 0), len(self.stamps_ns) - 2)

    def between(self, motion: MotionModel, place: int, time_ns: int) -> Between:
        """The state at `time_ns`, which lies after node `place` and before the next one; else at the nearer one."""
        start_ns, end_ns = self.stamps_ns[place], self.stamps_ns[place + 1]
        inside_ns = min(max(time_ns, start_ns), end_ns)
        left, right = self.means[place], self.means[place + 1]
        return between(motion, left, right, seconds(inside_ns - start_ns), seconds(end_ns - inside_ns))


class PairTerm(NamedTuple):
    """What a measurement says about the two nodes around it, had it been sensed at a given time.

    y + left dx_left + right dx_right + N(0, R) = 0 with y = predicted minus measured, and dx how far the nodes are from
    their present means.
    """

    place: int
    """Index of the left node."""
    y: FloatArray
    """Shape (k,)."""
    left: FloatArray
    """Shape (k, n)."""
    right: FloatArray
    R: FloatArray
    """Of the measurement and the interpolation, shape (k, k)."""

    @property
    def distance(self) -> float:
        """Length of the whitened residual."""
        return float(np.linalg.norm(np.linalg.solve(np.linalg.cholesky(self.R), self.y)))


def pair_term(motion: MotionModel, nodes: Nodes, measurement: ShiftableMeasurement, time_ns: int) -> PairTerm:
    """`measurement` near the means of `nodes`, had it been sensed at `time_ns`."""
    place = nodes.left_of(time_ns)
    state, measured = nodes.between(motion, place, time_ns), measurement.sensed_at(time_ns)
    H = measured.model.jacobian(state.mean, measured.pose)
    R = measured.R + congruence(H, state.Sigma)
    return PairTerm(place, _error(state, measured), H @ state.Lambda, H @ state.Psi, R)


class Rates(NamedTuple):
    """How a term changes with the time at which the measurement was sensed."""

    y: FloatArray
    """Of predicted minus measured, by the second, shape (k,)."""
    velocity_mps: FloatArray
    """Of the object against the frame that it was measured in, shape (2,)."""


def rates(motion: MotionModel, nodes: Nodes, measurement: ShiftableMeasurement, time_ns: int) -> Rates:
    """Central differences by the time at `time_ns`."""
    errors, gaps = [], []
    for moved_ns in (time_ns - _STEP_NS, time_ns + _STEP_NS):
        state = nodes.between(motion, nodes.left_of(moved_ns), moved_ns)
        measured = measurement.sensed_at(moved_ns)
        fix = fix_of(measured, 0.0)
        assert fix is not None, "a measurement holds a position"
        errors.append(_error(state, measured))
        gaps.append(state.mean[:2] - fix.position_m)
    span_s = seconds(2 * _STEP_NS)
    return Rates(measured.model.residual(errors[1], errors[0]) / span_s, (gaps[1] - gaps[0]) / span_s)


def _error(state: Between, measured: Measurement) -> FloatArray:
    return -measured.model.residual(measured.z, measured.model.predict(state.mean, measured.pose))


def pair_factor(keys: Sequence[int], nodes: Nodes, item: PairTerm, huber_width: float | None) -> gtsam.CustomFactor:
    """What `item` says of the two states around it; `keys` are those of `nodes`."""
    left, right = keys[item.place], keys[item.place + 1]
    left_mean, right_mean = nodes.means[item.place], nodes.means[item.place + 1]

    def error(this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None) -> FloatArray:
        if jacobians is not None:
            jacobians[0], jacobians[1] = item.left, item.right
        d_left, d_right = values.atVector(left) - left_mean, values.atVector(right) - right_mean
        return np.asarray(item.y + item.left @ d_left + item.right @ d_right)

    gaussian = Gaussian.Covariance(item.R)
    noise = gaussian if huber_width is None else Robust.Create(mEstimator.Huber.Create(huber_width), gaussian)
    return gtsam.CustomFactor(noise, [left, right], error)
