"""The steps of the replaying filters of many tracks: measurements, and the states before and after each, in arrays."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from fgtrack.core.grouping import equal_ones
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.base import NOTHING, Content, Measurement
from fgtrack.estimation.ekf import Prediction, correct, innovations
from fgtrack.estimation.histories import Histories
from fgtrack.models.sensors import RobustLoss

_FEW_COMPONENTS = 4

_Kind = tuple[int, int, tuple[str, ...]]


class Said(NamedTuple):
    """What measurements alike say that was not expected."""

    rows: IntArray | slice
    """Which measurements these are."""
    innovation: FloatArray
    """Shape (m, k)."""
    nis: FloatArray
    """Shape (m,)."""
    S: FloatArray
    """Covariances of the innovations, shape (m, k, k)."""


class _Alike(NamedTuple):
    """Measurements that share a model, a sensor pose and what is assumed."""

    z: FloatArray
    """Shape (m, k)."""
    R: FloatArray
    """Shape (m, k, k)."""
    one: Measurement
    """Any of them."""
    losses: list[RobustLoss | None]


class LaterSteps(NamedTuple):
    """The steps after a new one, of tracks with at least one, those with the most first."""

    numbers: list[IntArray]
    """Of the first later step of each track, then of the second of those that have one, and so on."""
    after_s: list[FloatArray]
    """How long each is after the step before it."""
    newest: IntArray
    """Numbers of the newest steps."""

    @classmethod
    def of(cls, order: Histories, tracks: IntArray, places: IntArray, many: IntArray, stamp_ns: int) -> "LaterSteps":
        """Those from `places` on, `many` of each of `tracks`, one at least and the most first."""
        numbers, after_s = [], []
        before_ns = np.full(len(tracks), stamp_ns)
        for step in range(int(many[0])):
            m = int(np.count_nonzero(many > step))
            stamps_ns = order.stamps_ns[tracks[:m], places[:m] + step]
            numbers.append(order.at(tracks[:m], places[:m] + step))
            after_s.append((stamps_ns - before_ns[:m]) / NS_PER_S)
            before_ns = stamps_ns
        return cls(numbers, after_s, order.at(tracks, places + many - 1))


class ReplayedSteps:
    """What is kept of each step, under its number in `order`.

    Parameters
    ----------
    n
        Length of a state.
    """

    _VALUES = ("mean", "covariance", "before", "covariance_before", "cross", "z", "R")

    def __init__(self, n: int) -> None:
        self.order = Histories()
        size, k = self.order.size, _FEW_COMPONENTS
        self.mean, self.before = np.zeros((size, n)), np.zeros((size, n))
        """Means after and before the measurement."""
        self.covariance, self.covariance_before, self.cross = (np.zeros((size, n, n)) for _ in range(3))
        """Covariances after and before it, and of the state before it with that after the step before."""
        self.z, self.R = np.zeros((size, k)), np.zeros((size, k, k))
        self.measurements: list[Measurement | None] = [None] * size
        """None of a prior."""
        self._kinds: list[_Kind] = [(0, 0, ())] * size

    def begin(self, track: int, stamp_ns: int, mean: FloatArray, covariance: FloatArray) -> None:
        """The first step of a new track, its prior."""
        number = self.order.begin(track, stamp_ns)
        self._fit()
        self.measurements[number] = None
        self.put(np.array([number]), mean, covariance, Prediction(mean, covariance, covariance))

    def reserve(self, tracks: IntArray, measurements: Sequence[Measurement]) -> IntArray:
        """Numbers for a further step of each of `tracks`, not yet in order, with these measurements."""
        numbers = self.order.reserve(tracks)
        self._fit()
        for number, measurement in zip(numbers.tolist(), measurements, strict=True):
            model = measurement.model
            self.measurements[number] = measurement
            self._kinds[number] = id(model), 0 if model.linear else id(measurement.pose), measurement.assumed
        for rows in equal_ones([len(measurement.z) for measurement in measurements]):
            chosen = [measurements[row] for row in rows]
            k = len(chosen[0].z)
            while k > self.z.shape[1]:
                self._widen()
            at = numbers[rows]
            self.z[at, :k] = [measurement.z for measurement in chosen]
            self.R[at, :k, :k] = [measurement.R for measurement in chosen]
        return numbers

    def put(self, numbers: IntArray, mean: FloatArray, covariance: FloatArray, predicted: Prediction) -> None:
        """Keep the states of steps."""
        self.mean[numbers], self.covariance[numbers] = mean, covariance
        self.before[numbers], self.covariance_before[numbers], self.cross[numbers] = predicted

    def corrected(
        self, numbers: IntArray, mean: FloatArray, covariance: FloatArray
    ) -> tuple[FloatArray, FloatArray, list[Said]]:
        """The states (m, n), (m, n, n) after the measurements of m steps; angles are not wrapped; and what these said.

        Raises `numpy.linalg.LinAlgError` for one that cannot be fused, or leaves what is not finite.
        """
        after, P, said = mean, covariance, list[Said]()
        for rows, alike in self._alike(numbers):
            args = mean[rows], covariance[rows], *alike[:2], alike.one.model, alike.one.pose
            found = correct(*args, None, alike.one.measured, alike.losses)
            said.append(Said(rows, found.innovation, found.nis, found.S))
            if isinstance(rows, slice):
                after, P = found.mean, found.covariance
                break
            if after is mean:
                after, P = np.empty(mean.shape), np.empty(covariance.shape)
            after[rows], P[rows] = found.mean, found.covariance
        flat = P.reshape(len(P), -1)
        if not np.isfinite(np.vecdot(after, after).sum() + np.vecdot(flat, flat).sum()):
            raise np.linalg.LinAlgError("posterior is not finite")
        return after, P, said

    def innovations(self, numbers: IntArray, mean: FloatArray, covariance: FloatArray) -> list[Said]:
        """What `corrected` says of the innovations."""
        said = []
        for rows, alike in self._alike(numbers):
            one = alike.one
            found = innovations(mean[rows], covariance[rows], *alike[:2], one.model, one.pose, one.measured)
            said.append(Said(rows, *found))
        return said

    def _alike(self, numbers: IntArray) -> Iterator[tuple[IntArray | slice, _Alike]]:
        """The measurements of steps, those alike together, and which they are."""
        numbered = numbers.tolist()
        groups = equal_ones([self._kinds[number] for number in numbered])
        for group in groups:
            rows = slice(None) if len(groups) == 1 else np.array(group)
            measurements = [each for row in group if (each := self.measurements[numbered[row]]) is not None]
            one, at = measurements[0], numbers[rows]
            k = len(one.z)
            losses = [measurement.loss for measurement in measurements]
            yield rows, _Alike(self.z[at, :k], self.R[at, :k, :k], one, losses)

    def predicted(self, numbers: IntArray) -> Prediction:
        """The states before measurements."""
        return Prediction(self.before[numbers], self.covariance_before[numbers], self.cross[numbers])

    def content_of(self, number: int) -> Content:
        """Place of a step among those of one stamp: by content."""
        measurement = self.measurements[number]
        return NOTHING if measurement is None else measurement.content

    def _fit(self) -> None:
        """As many values as there are numbers."""
        more = self.order.size - len(self.measurements)
        if more:
            for name in self._VALUES:
                setattr(self, name, self.order.fitted(getattr(self, name)))
            self.measurements += [None] * more
            self._kinds += [(0, 0, ())] * more

    def _widen(self) -> None:
        """Room for measurements of more components."""
        k = self.z.shape[1]
        self.z = np.pad(self.z, ((0, 0), (0, k)))
        self.R = np.pad(self.R, ((0, 0), (0, k), (0, k)))
