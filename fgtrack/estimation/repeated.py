"""An estimator of one object that fuses an identical measurement only once."""

from typing import Any, ClassVar, Protocol, runtime_checkable

from fgtrack.core.state import Snapshot, Stateful, stateful
from fgtrack.core.types import TrackState
from fgtrack.estimation.base import Estimator, Measurement, UpdateResult, UpdateStatus


@runtime_checkable
class MeasurementKeeper(Estimator, Protocol):
    """An estimator of one object that keeps the measurements of its window."""

    def has_fused(self, measurement: Measurement) -> bool:
        """True if the window contains an identical measurement."""


class FusedOnce(Stateful):
    """Wrapper of an `Estimator` that answers `duplicate` to a measurement identical to a fused measurement.

    A bank fuses both measurements, because two sensors may measure equal values. All other attributes are those of
    the wrapped estimator.
    """

    STATE: ClassVar[tuple[str, ...]] = ("_inner",)

    def __init__(self, inner: MeasurementKeeper) -> None:
        self._inner = inner

    def checkpoint(self) -> Snapshot:
        """See `Stateful.checkpoint`. Raises `CallError` for an estimator that has no checkpoint."""
        stateful(self._inner)
        return super().checkpoint()

    @property
    def window_ns(self) -> tuple[int, int]:
        """See `Estimator.window_ns`."""
        return self._inner.window_ns

    def advance(self, now_ns: int) -> None:
        """See `Estimator.advance`."""
        self._inner.advance(now_ns)

    def update(self, measurement: Measurement) -> UpdateResult:
        """See `Estimator.update`."""
        if self._inner.has_fused(measurement):
            return UpdateResult(UpdateStatus.DUPLICATE)
        return self._inner.update(measurement)

    def state_at(self, stamp_ns: int) -> TrackState:
        """See `Estimator.state_at`."""
        return self._inner.state_at(stamp_ns)

    def __getattr__(self, name: str) -> Any:  # Any: of the wrapped estimator
        if name == "_inner":  # a copy has no attributes yet
            raise AttributeError(name)
        return getattr(self._inner, name)

    def __repr__(self) -> str:
        return repr(self._inner)
