"""The wall clock of a replay: how long a tick takes, and waiting until one is due."""

import time
from typing import Protocol


class Clock(Protocol):
    """Tells time that only goes forward."""

    def now_ns(self) -> int:
        """The present time."""

    def wait_until(self, time_ns: int) -> None:
        """Come back at `time_ns`; at once where that has passed."""


class WallClock:
    """The clock of the machine."""

    def now_ns(self) -> int:
        """See `Clock`."""
        return time.perf_counter_ns()

    def wait_until(self, time_ns: int) -> None:
        """See `Clock`."""
        left_ns = time_ns - self.now_ns()
        if left_ns > 0:
            time.sleep(left_ns / 1e9)


class Pace:
    """Lets every tick wait until as much wall time has passed as on the clock of the recording; late ones never wait.

    Parameters
    ----------
    clock
        What waits.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._ahead_ns: int | None = None

    def wait_for(self, now_ns: int) -> None:
        """Come back when the tick at `now_ns` is due; the first one is due at once."""
        if self._ahead_ns is None:
            self._ahead_ns = self._clock.now_ns() - now_ns
        self._clock.wait_until(now_ns + self._ahead_ns)
