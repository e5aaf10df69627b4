"""Replay of one track step by step, where a compiled loop cannot replay the track alone."""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from fgtrack.core.linalg import kernels
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.base import Measurement, UpdateResult, UpdateStatus
from fgtrack.estimation.filters.ekf import Prediction
from fgtrack.estimation.filters.propagation import wrapped
from fgtrack.estimation.filters.track_initiation import TrackInitiation
from fgtrack.estimation.rts import Link, smoothed_back
from fgtrack.models.motion import WhiteNoise
from fgtrack.models.robust import compiled_form

KERNELS = "fgtrack.estimation.kernels.replay"
#: Statuses by the number of the outcome in the compiled loops.
STATUS = (
    UpdateStatus.FAILED,
    UpdateStatus.TOO_OLD,
    UpdateStatus.IN_SEQUENCE,
    UpdateStatus.OUT_OF_SEQUENCE,
)
FUSED, NO_ROOM = STATUS[2:], len(STATUS)
Stack = tuple[IntArray, FloatArray, int, FloatArray, FloatArray]
"""Measurements as compiled loops take them, see `fgtrack.models.measurement_kernels.Stack`."""


class Outside(NamedTuple):
    """A step that compiled loops cannot replay alone."""

    measurement: Measurement | None
    """None for the first step, which is the prior."""
    search: TrackInitiation | None
    """Initiation with all measurements up to this step; None if the direction of travel is known."""

    @property
    def is_plugin(self) -> bool:
        """True if a plug-in models the measurement."""
        return self.measurement is not None and not self.measurement.model.is_compiled


_INSIDE = Outside(None, None)


@dataclass(frozen=True)
class StepwiseReplay:
    """Steps of one track in the arrays of a `ReplayBank`, replayed by a call for each step."""

    motion: WhiteNoise
    arrays: tuple[Any, ...]
    """Arrays of the bank, see `fgtrack.estimation.kernels.replay_arrays`; `fused` changes them."""
    row: int
    """Row of the track in the arrays."""
    steps: dict[int, Outside]
    """Steps of the track that compiled loops cannot replay alone, by slot; new steps are added."""

    def fused(
        self, one: Measurement, lag_ns: int, oldest_ns: int
    ) -> UpdateResult | None:
        """Insert a measurement into the steps and re-filter the later measurements. None if all slots are in use.

        `lag_ns` is the length of the window, and `oldest_ns` the oldest stamp that the clock allows. Raises
        `numpy.linalg.LinAlgError` if a measurement cannot be fused.
        """
        row, steps = self.row, self.steps
        order, _, _, windows, _, _ = self.arrays
        times_ns = lag_ns, oldest_ns, one.stamp_ns
        stack = stack_of(replace(one, z=one.z[None], R=one.R[None]))
        index = kernels(KERNELS).insert(self.arrays, np.array([row]), times_ns, stack)
        if index < 0:
            return None if -index == NO_ROOM else UpdateResult(STATUS[-index])
        last = int(windows[row, 0])
        steps[int(order[row, index])] = Outside(one, None)
        self._replay_step(index)
        y, S, nis = self._expected(index, last, one)
        for later in range(index + 1, last + 1):
            self._replay_step(later)
        is_newest = one.stamp_ns >= windows[row, 2]
        newest_ns = max(int(windows[row, 2]), one.stamp_ns)
        start_ns = max(int(windows[row, 1]), newest_ns - lag_ns)
        windows[row] = last + 1, start_ns, newest_ns
        status = UpdateStatus.IN_SEQUENCE if is_newest else UpdateStatus.OUT_OF_SEQUENCE
        return UpdateResult(status, y, nis, S)

    def _replay_step(self, index: int) -> None:
        """Predict a step and fuse its measurement. While the direction is sought, the state comes from the line
        instead.

        Raises `numpy.linalg.LinAlgError` if the measurement cannot be fused.
        """
        row, steps = self.row, self.steps
        n, (order, labels, states, _, _, _) = self.motion.dim, self.arrays
        before, slot = order[row, index - 1 : index + 1].tolist()
        step, k = steps.get(slot, _INSIDE), int(labels[row, slot, 1])
        y, H = np.empty(k), np.empty((k, n))
        loops, tracks = kernels(KERNELS), np.array([row])
        loops.predict_step(
            self.motion.kind, self.motion.noise, self.arrays, tracks, index
        )
        if step.measurement is not None and step.is_plugin:
            y, H = (
                np.array(each, dtype=np.float64, order="C")
                for each in step.measurement.model.linearised(
                    step.measurement.z, states[row, slot, 0], step.measurement.pose
                )
            )
        if not loops.correct_step(
            self.motion.kind, self.arrays, tracks, index, step.is_plugin, y, H
        ):
            raise np.linalg.LinAlgError("a measurement cannot be fused")
        search = steps.get(before, _INSIDE).search
        if step.measurement is None:
            return
        if search is not None:
            search = search.with_measurement(step.measurement)
        if search is not None and search.line is not None:
            mean, states[row, slot, 1 : n + 1] = search.state()
            states[row, slot, 0] = wrapped(self.motion, mean)
        steps[slot] = Outside(step.measurement, search)

    def _expected(
        self, index: int, last: int, one: Measurement
    ) -> tuple[FloatArray, FloatArray, float]:
        """Return innovation y (k,), its covariance S (k, k) and NIS of the new step at `index`, given all other
        steps.

        Raises `numpy.linalg.LinAlgError` if S is not positive definite.
        """
        n = self.motion.dim
        now = self._retrodicted_along_line(index, last, one.stamp_ns)
        if now is None:
            now = np.empty((n + 1, n))
            if not kernels(KERNELS).retrodict(
                self.motion.kind,
                self.motion.noise,
                self.arrays,
                np.array([self.row]),
                index,
                last,
                now,
            ):
                raise np.linalg.LinAlgError("a prediction has no root")
        y, H = one.model.linearised(one.z, now[0], one.pose)
        S, nis, _ = kernels("fgtrack.estimation.kernels.kalman").innovations(
            np.array(y, ndmin=2),
            np.array(H, dtype=np.float64, order="C", ndmin=3),
            now[None, 1:],
            np.array([0]),
            np.array(one.R, dtype=np.float64, order="C", ndmin=3),
            one.measured,
        )
        if np.isnan(nis[0]):
            raise np.linalg.LinAlgError("innovation covariance not positive definite")
        return y, S[0], float(nis[0])

    def _retrodicted_along_line(
        self, index: int, last: int, stamp_ns: int
    ) -> FloatArray | None:
        """Return the state (n + 1, n) at a stamp given all later steps, if a later step lies along a line; else
        None.
        """
        row, n = self.row, self.motion.dim
        order, labels, states, _, _, _ = self.arrays
        links = list[Link]()
        for slot in reversed(order[row, index + 1 : last + 1].tolist()):
            own = states[row, slot]
            predicted = Prediction(own[n + 1], own[n + 2 : 2 * n + 2], own[2 * n + 2 :])
            stamp_of_slot_ns = int(labels[row, slot, 0])
            links.insert(0, (stamp_of_slot_ns, own[0], own[1 : n + 1], predicted))
            search = self.steps.get(slot, _INSIDE).search
            if search is not None and search.line is not None:
                _, mean, covariance, _ = links[-1]
                mean, covariance = smoothed_back(self.motion, links, mean, covariance)
                return np.vstack(search.retrodicted(stamp_ns, mean, covariance))
        return None


def stack_of(one: Measurement) -> Stack:
    """Return a stack of measurements, z (m, k) and R (m, k, k), as compiled loops take it."""
    loss, width = compiled_form(one.loss, one.z.shape[-1])
    return (
        one.model.codes,
        np.array([*one.pose, width]),
        loss,
        np.ascontiguousarray(one.z, dtype=np.float64),
        np.ascontiguousarray(one.R, dtype=np.float64),
    )
