"""Where the ego was at any time: a smooth path through all of its states, for offline work."""

from collections.abc import Iterable

import numpy as np
from scipy.interpolate import make_smoothing_spline

from fgtrack.core.errors import DataError
from fgtrack.core.time import seconds
from fgtrack.core.types import EgoState
from fgtrack.tracking.ego import EgoPose, is_finite

_FEWEST = 5  # states that a smoothing spline needs
_COLUMNS = ("x_m", "y_m", "yaw_rad")


class EgoPath:
    """Smoothing splines through positions and unwrapped yaw; straight on beyond both ends.

    A spline and not the line from state to state: that line moves as fast as its noise, 2 cm at 100 Hz are 3 m/s, and
    an estimator that asks how a pose changes with time would take this for motion. The spline minimises
    sum (y - f)^2 + lam integral f''^2, a low-pass that lets half of a sine of `cutoff_hz` through.

    Parameters
    ----------
    states
        In any order; those that are not finite or repeat a stamp are left out.
    cutoff_hz
        Faster motion is taken for noise.

    Raises
    ------
    DataError
        There are fewer than five states.
    """

    def __init__(self, states: Iterable[EgoState], cutoff_hz: float) -> None:
        by_stamp = {state.stamp_ns: state for state in states if is_finite(state)}
        if len(by_stamp) < _FEWEST:
            raise DataError(f"the ego has {len(by_stamp)} states with different stamps, its path needs {_FEWEST}")
        stamps_ns = sorted(by_stamp)
        self.start_ns, self.end_ns = stamps_ns[0], stamps_ns[-1]
        """Stamps of the first and the last state."""
        times_s = np.array([seconds(stamp_ns - self.start_ns) for stamp_ns in stamps_ns])
        values = np.array([[getattr(by_stamp[stamp_ns], name) for name in _COLUMNS] for stamp_ns in stamps_ns])
        values[:, 2] = np.unwrap(values[:, 2])
        self._end_s = float(times_s[-1])
        density_s = self._end_s / (len(times_s) - 1)
        self._spline = make_smoothing_spline(times_s, values, lam=1.0 / (density_s * (2.0 * np.pi * cutoff_hz) ** 4))
        self._rate = self._spline.derivative()

    def __call__(self, stamp_ns: int) -> EgoPose:
        """The pose at `stamp_ns`; the yaw is not wrapped."""
        time_s = seconds(stamp_ns - self.start_ns)
        inside_s = min(max(time_s, 0.0), self._end_s)
        rate = self._rate(inside_s)
        x_m, y_m, yaw_rad = (self._spline(inside_s) + (time_s - inside_s) * rate).tolist()
        along_mps = float(np.cos(yaw_rad) * rate[0] + np.sin(yaw_rad) * rate[1])
        return EgoPose(x_m, y_m, yaw_rad, along_mps, float(rate[2]))
