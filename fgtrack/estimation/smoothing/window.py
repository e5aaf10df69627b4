"""A copy of the window of one object, as plain arrays and as a graph of gtsam."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from fgtrack.core.errors import CallError
from fgtrack.core.time import NS_PER_S, seconds
from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement
from fgtrack.estimation.smoothing.settings import SmootherSettings
from fgtrack.estimation.smoothing.solver import Solver
from fgtrack.estimation.smoothing.terms import MeasurementFactor
from fgtrack.models.measurement import MeasurementModel, measurement_model
from fgtrack.models.motion import MotionModel

if TYPE_CHECKING:
    import gtsam

#: Bits below the letter in a key of gtsam: `gtsam.symbol(letter, index)`.
_INDEX_BITS = 56


class Prior(NamedTuple):
    """Gaussian prior of the oldest state: the start of the object, or everything that has left the window."""

    mean: FloatArray
    """Shape (n,)."""
    covariance: FloatArray
    """Shape (n, n)."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """Differences between a result of gtsam and a window, in standard deviations."""

    state_names: tuple[str, ...]
    stamps_ns: tuple[int, ...]
    estimates: FloatArray
    """Result minus the estimates of the smoother, `Window.states`, shape (m, n)."""
    optimum: FloatArray
    """Result minus the estimates after `converge()`, shape (m, n)."""

    @property
    def largest(self) -> float:
        """Largest absolute difference to the optimum."""
        return float(np.abs(self.optimum).max())

    def __str__(self) -> str:
        return (
            f"differences of {len(self.stamps_ns)} states, in standard deviations, at most\n"
            f"  {self._worst(self.estimates)} to the estimates of the smoother\n"
            f"  {self._worst(self.optimum)} to its estimates after converge()"
        )

    def _worst(self, differences: FloatArray) -> str:
        row, column = np.unravel_index(np.abs(differences).argmax(), differences.shape)
        after_s = seconds(self.stamps_ns[row] - self.stamps_ns[0])
        return (
            f"{abs(differences[row, column]):.2g} ({self.state_names[column]}, "
            f"{after_s:.3f} s after the oldest state)"
        )


@dataclass(frozen=True, eq=False)
class Window:
    """Copy of the window of one object: states, prior and measurements of its factor graph.

    Neighbouring states are linked by the `motion` model. The copy does not change with its smoother.
    """

    motion: MotionModel
    stamps_ns: tuple[int, ...]
    """Stamps of the m states, in ascending order."""
    states: FloatArray
    """Estimates of the smoother, shape (m, n), in the state of `motion`; the yaw is not wrapped."""
    covariances: FloatArray
    """Shape (m, n, n)."""
    prior: Prior
    measurements: tuple[Measurement, ...]
    """Fused measurements that are still in the window, in the order of their states."""
    indices: tuple[int, ...]
    """Index of the state that each measurement belongs to. Stamps up to 1 us apart share a state."""

    def __repr__(self) -> str:
        length_s = seconds(self.stamps_ns[-1] - self.stamps_ns[0])
        return (
            f"<Window of {len(self.stamps_ns)} states over {length_s:.3f} s: "
            f"{type(self.motion).__name__}, {len(self.measurements)} measurements>"
        )

    @cached_property
    def converged(self) -> "Window":
        """This window after `converge()`: linearised at its own estimates until nothing moves."""
        solver = Solver(self.motion, SmootherSettings(lagged_s=(), final=False))
        factors: list[list[MeasurementFactor]] = [[] for _ in self.stamps_ns]
        for measurement, index, ahead_s in self.factors:
            factors[index].append((measurement, ahead_s))
        solver.nodes.load_window(0, self.stamps_ns, self.states, *self.prior, factors)
        solver.converge(0)
        return window_of(solver, 0)

    @property
    def factors(self) -> list[tuple[Measurement, int, float]]:
        """Each measurement, the index of its state, and the time from the state to the measurement in seconds."""
        return [
            (each, index, seconds(each.stamp_ns - self.stamps_ns[index]))
            for each, index in zip(self.measurements, self.indices, strict=True)
        ]

    @cached_property
    def noises(self) -> FloatArray:
        """Covariances of the accumulated process noise between neighbours, shape (m - 1, n, n).

        The noise of some models depends on the state. It is taken at the converged estimates.
        """
        n, dt_s = self.motion.dim, np.diff(self.stamps_ns) / NS_PER_S
        if not len(dt_s):
            return np.empty((0, n, n))
        return self.motion.process_noise(self.converged.states[:-1], dt_s)

    def to_gtsam(
        self, prefix: str = "x"
    ) -> "tuple[gtsam.NonlinearFactorGraph, gtsam.Values, dict[int, int]]":
        """Return the nonlinear factor graph of this window, its values, and the key of the state at each stamp.

        The states have the keys `gtsam.symbol(prefix, index)`. The stamps of measurements that share a state have its
        key. The values are the estimates after `converge()`, which are the optimum of the unchanged graph. The process
        noise is taken there and stays constant.

        Raises `CallError` unless `prefix` is one letter.
        """
        from fgtrack.estimation.smoothing.gtsam.graph import values_of, window_graph

        keys = self._keys(prefix)
        measurements = [
            (keys[index], (measurement, ahead_s))
            for measurement, index, ahead_s in self.factors
        ]
        graph = window_graph(
            self.motion, keys, self.stamps_ns, *self.prior, self.noises, measurements
        )
        key_of = dict(zip(self.stamps_ns, keys, strict=True))
        for key, (measurement, _) in measurements:
            key_of.setdefault(measurement.stamp_ns, key)
        return graph, values_of(keys, self.converged.states), key_of

    def compare(self, result: "gtsam.Values", prefix: str | None = None) -> Comparison:
        """Return the differences between the states in `result` and this window, in standard deviations.

        `prefix` is the prefix of `to_gtsam`. It may be omitted if `result` has the states of one window only.
        Raises `CallError` if `result` lacks the states.
        """
        if prefix is None:
            prefix = self._only_prefix(result)
        found = self._read(result, prefix)
        if found is None:
            raise CallError(
                f"result: lacks {len(self.stamps_ns)} states with the prefix {prefix!r}, "
                "give the prefix of to_gtsam"
            )
        optimum = self.converged
        return Comparison(
            self.motion.state_names,
            self.stamps_ns,
            (found - self.states) / _deviations(self.covariances),
            (found - optimum.states) / _deviations(optimum.covariances),
        )

    def _only_prefix(self, result: "gtsam.Values") -> str:
        """Return the only prefix under which `result` has all states. Raises `CallError` for none or several."""
        letters = sorted({chr(key >> _INDEX_BITS) for key in result.keys()})  # noqa: SIM118
        usable = [
            letter
            for letter in letters
            if letter.isalpha() and self._read(result, letter) is not None
        ]
        if len(usable) != 1:
            raise CallError(
                f"result: has the {len(self.stamps_ns)} states of this window under "
                f"{', '.join(usable) or 'no prefix'}, give the prefix of to_gtsam"
            )
        return usable[0]

    def _keys(self, prefix: str) -> list[int]:
        if not (isinstance(prefix, str) and len(prefix) == 1 and prefix.isascii()):
            raise CallError(f"prefix: must be one letter, is {prefix!r}")
        first = ord(prefix) << _INDEX_BITS
        return [first + index for index in range(len(self.stamps_ns))]

    def _read(self, result: "gtsam.Values", prefix: str) -> FloatArray | None:
        """Return the states in `result`, shape (m, n); None if one is missing."""
        try:
            rows = [result.atVector(key) for key in self._keys(prefix)]
        except RuntimeError:  # there is no such value, or it is not a vector
            return None
        if any(len(row) != self.motion.dim for row in rows):
            return None
        return np.array(rows)


def window_of(solver: Solver, track: int) -> Window:
    """Return a copy of the window of a track of `solver`."""
    nodes = solver.nodes
    stamps_ns = nodes.window_stamps_ns(track)
    numbers = nodes.window(track).tolist()
    prior = nodes.predicted[numbers[0]]
    measurements, indices = list[Measurement](), list[int]()
    for index, number in enumerate(numbers):
        for measurement, _ in nodes.factors(number):
            measurements.append(_in_state_of(solver.motion, measurement))
            indices.append(index)
    states, covariances = solver.states_at(np.full(len(stamps_ns), track), stamps_ns)
    return Window(
        solver.motion,
        tuple(stamps_ns.tolist()),
        states,
        covariances,
        Prior(nodes.origin[numbers[0]] + prior[:, -1], prior[:, :-1].copy()),
        tuple(measurements),
        tuple(indices),
    )


def _in_state_of(motion: MotionModel, measurement: Measurement) -> Measurement:
    """Return `measurement` with a measurement model for the whole state of `motion`, not only for its first entries."""
    model = measurement.model
    if type(model) is not MeasurementModel or model.state_names == motion.state_names:
        return measurement
    return replace(measurement, model=measurement_model(model.components, motion))


def _deviations(covariances: FloatArray) -> FloatArray:
    """Return the standard deviations of states, shape (m, n)."""
    return np.sqrt(np.diagonal(covariances, axis1=-2, axis2=-1))
