"""A bank that stands in front of another one."""

from collections.abc import Sequence

from fgtrack.core.types import SmoothedReport, TrackState
from fgtrack.estimation.base import Measurement, Start, StatesAt, TrackBank, UpdateResult

__all__ = ["ForwardingBank", "has"]


class ForwardingBank:
    """Does what another `TrackBank` does; subclasses do some of it otherwise.

    Parameters
    ----------
    bank
        The other one.
    """

    def __init__(self, bank: TrackBank) -> None:
        self._bank = bank

    @property
    def present_ns(self) -> int:
        """See `TrackBank.present_ns`."""
        return self._bank.present_ns

    @property
    def window_start_ns(self) -> int:
        """See `TrackBank.window_start_ns`."""
        return self._bank.window_start_ns

    @property
    def track_ids(self) -> tuple[int, ...]:
        """See `TrackBank.track_ids`."""
        return self._bank.track_ids

    def has(self, track_id: int) -> bool:
        """Whether there is such a track: without a list of all."""
        return has(self._bank, track_id)

    def advance(self, now_ns: int) -> None:
        """See `TrackBank.advance`."""
        self._bank.advance(now_ns)

    def states_at(self, stamp_ns: int) -> StatesAt:
        """See `TrackBank.states_at`."""
        return self._bank.states_at(stamp_ns)

    def update(
        self, stamp_ns: int, track_ids: Sequence[int], measurements: Sequence[Measurement]
    ) -> list[UpdateResult]:
        """See `TrackBank.update`."""
        return self._bank.update(stamp_ns, track_ids, measurements)

    def birth(self, track_id: int, prior: Start) -> None:
        """See `TrackBank.birth`."""
        self._bank.birth(track_id, prior)

    def remove(self, track_id: int) -> None:
        """See `TrackBank.remove`."""
        self._bank.remove(track_id)

    def present(self) -> list[TrackState]:
        """See `TrackBank.present`."""
        return self._bank.present()

    def smoothed(self) -> list[SmoothedReport]:
        """See `TrackBank.smoothed`."""
        return self._bank.smoothed()


def has(bank: TrackBank, track_id: int) -> bool:
    """Whether `bank` has the track."""
    return bank.has(track_id) if isinstance(bank, ForwardingBank) else track_id in bank.track_ids
