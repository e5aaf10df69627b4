"""The fixed-lag smoother of one object."""

import math
from collections.abc import Callable, Sequence

import numpy as np

from fgtrack.core.time import nanoseconds
from fgtrack.core.types import FloatArray, TrackState
from fgtrack.estimation.base import Measurement, Start, UpdateResult, UpdateStatus
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.ekf import propagated
from fgtrack.estimation.factor_graph.backends.base import Backend
from fgtrack.estimation.factor_graph.backends.incremental import IncrementalBackend
from fgtrack.estimation.factor_graph.window import Window
from fgtrack.estimation.factor_graph.window_update import Update
from fgtrack.estimation.failures import Failures
from fgtrack.estimation.initiation import DEFAULT, SMOOTHER_ITERATIONS, Search
from fgtrack.estimation.marginalised_past import Prior
from fgtrack.estimation.propagation import track_state
from fgtrack.estimation.smoother_settings import SmootherSettings
from fgtrack.estimation.terms import curved, linearised
from fgtrack.estimation.whitening import whitened
from fgtrack.models.motion import MotionModel

_DEFAULT = SmootherSettings()


class FixedLagSmoother:
    """A sliding window of states at the stamps at which something was measured, smoothed together.

    Measurements may arrive in any order: each becomes a factor of the node at its own stamp. The oldest node is the
    newest one at or before the window's start, so every stamp inside the window has a left neighbour.

    Parameters
    ----------
    motion
        Motion model; its process noise composes, so a late measurement may split a segment.
    prior
        First state; nothing older than it can be fused.
    settings
        Window, late policy, relinearisation and outputs.
    make_backend
        Makes an empty backend: `IncrementalBackend` or `BatchBackend`.
    initiation
        How the direction of travel is found where `prior` gives none, see `Initiation`.
    failures
        Counts how often the graph is built anew and steps are damped.
    """

    def __init__(
        self,
        motion: MotionModel,
        prior: Start,
        settings: SmootherSettings = _DEFAULT,
        make_backend: Callable[[], Backend] = IncrementalBackend,
        initiation: str = DEFAULT,
        failures: Failures | None = None,
    ) -> None:
        self._settings = settings
        self._lag_ns, self._behind_ns = nanoseconds(settings.lag_s), nanoseconds(settings.behind_s)
        self._first_ns = self._clock_ns = self._start_ns = self._reach_ns = prior.stamp_ns
        self.motion = motion
        self.failures = failures or Failures()
        first = Prior(*initial_state(motion, prior))
        self.window = Window(motion, prior.stamp_ns, first, settings, make_backend, self.failures)
        self._search = Search.of(motion, prior, initiation)
        self._final: list[TrackState] = []

    @property
    def window_ns(self) -> tuple[int, int]:
        """See `Estimator.window_ns`."""
        return max(self._reach_ns, self.window.reach_ns), self.window.newest_ns

    def advance(self, now_ns: int) -> None:
        """See `Estimator.advance`; the nodes that leave are marginalised at the next update."""
        self._clock_ns = max(self._clock_ns, now_ns)
        self._move()

    def update(self, measurement: Measurement) -> UpdateResult:
        """See `Estimator.update`."""
        return self.update_all([measurement])[0]

    def update_all(self, measurements: Sequence[Measurement]) -> list[UpdateResult]:
        """Fuse several measurements in one step; innovations are relative to the state before all of them.

        Raises `DataError` for a measurement older than the window where the late policy is `raise`.
        """
        measurements = [measurement.seen_by(self.motion) for measurement in measurements]
        judged = [self._judged(measurement) for measurement in measurements]
        results = [result for result, _ in judged]
        fusible = [place for place, result in enumerate(results) if result.innovation is not None]
        if not fusible:
            return results
        try:
            self.solve(self.prepare([measurements[k] for k in fusible], [judged[k][1] for k in fusible]))
        except RuntimeError:
            return [r if r.innovation is None else UpdateResult(UpdateStatus.FAILED) for r in results]
        self.settle(min(measurements[place].stamp_ns for place in fusible))
        return results

    def prepare(self, measurements: Sequence[Measurement], rows: Sequence[FloatArray | None]) -> Update:
        """The first part of fusing `measurements`; see `Window.prepare`."""
        return self.window.prepare(measurements, self._start_ns, self._reach_ns, rows)

    def solve(self, update: Update) -> None:
        """The second part; see `Window.solve`."""
        self._final += self.window.solve(update)
        self._move()

    def settle(self, oldest_ns: int) -> None:
        """What may follow: a new beginning along another line, damping, iterations.

        `oldest_ns` is the oldest stamp of the measurements.
        """
        if self._search is not None:
            self._search = self._initiated(self._search, oldest_ns)
        self.window.damp()
        self.window.iterate(self._settings.max_iterations - 1)

    def state_at(self, stamp_ns: int) -> TrackState:
        """See `Estimator.state_at`: smoothed in the past, interpolated under the motion model, predicted ahead."""
        return track_state(self.motion, stamp_ns, *self.window.state_at(stamp_ns))

    def take_final(self) -> list[TrackState]:
        """Smoothed states of the nodes that have left the window since the last call, in order."""
        final, self._final = self._final, []
        return [track_state(self.motion, state.stamp_ns, state.mean, state.covariance) for state in final]

    def take_rest(self) -> list[TrackState]:
        """Like `take_final`, and of the nodes that are still inside: for when the track ends."""
        inside = self.window.stamps_ns if self._settings.final else []
        return self.take_final() + [self.state_at(stamp_ns) for stamp_ns in inside]

    def converge(self, max_iterations: int = 50) -> None:
        """Relinearise until nothing moves; for comparisons."""
        self.window.converge(max_iterations)

    def _initiated(self, search: Search, oldest_ns: int) -> Search | None:
        """Begin again from a straight line, where the oldest new stamp asks for it, as long as nothing has left."""
        if not self.window.whole:
            return None
        found = search.next_line(self.window.fixes, oldest_ns)
        if found is None:
            return search
        line, search = found
        self.window.restart(line)
        self.window.iterate(SMOOTHER_ITERATIONS)
        return search

    def _move(self) -> None:
        """Where the window starts, by the clock and the newest stamp, and the oldest stamp that may be fused."""
        newest_ns = max(self._clock_ns, self.window.newest_ns)
        self._start_ns = max(newest_ns - self._lag_ns, self._first_ns)
        self._reach_ns = max(self._start_ns - self._behind_ns, self._first_ns)

    def status_of(self, stamp_ns: int) -> UpdateStatus:
        """What will become of a measurement at `stamp_ns` that can be fused.

        Raises `DataError` where it is older than the window and the late policy is `raise`.
        """
        start_ns = self._start_ns
        self._settings.refuse_older(stamp_ns, start_ns)
        if stamp_ns < self._reach_ns or stamp_ns < self.window.reach_ns:
            return UpdateStatus.TOO_OLD
        if stamp_ns < start_ns:
            return UpdateStatus.BEYOND_WINDOW
        late = stamp_ns < self.window.newest_ns
        return UpdateStatus.OUT_OF_SEQUENCE if late else UpdateStatus.IN_SEQUENCE

    def _judged(self, measurement: Measurement) -> tuple[UpdateResult, FloatArray | None]:
        """What will become of `measurement`, without an innovation where it will not be fused; and its rows, see
        `Window.prepare`.
        """
        status = self.status_of(measurement.stamp_ns)
        if status is UpdateStatus.TOO_OLD:
            return UpdateResult(status), None
        mean, covariance = self.window.state_at(measurement.stamp_ns)
        y, H, R = linearised(measurement, mean)
        S = propagated(H, covariance, R)
        try:
            nis = measurement.nis(y, S)
            rows = None if curved(measurement) else whitened(y, H, R)
        except np.linalg.LinAlgError:
            return UpdateResult(UpdateStatus.FAILED), None
        if not math.isfinite(nis):
            return UpdateResult(UpdateStatus.FAILED), None
        return UpdateResult(status, y, nis, S), rows
