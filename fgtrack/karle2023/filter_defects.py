"""Defects of the published filter of Karle et al. 2023, each as a separate component.

The published yaw is 0 along +y and jumps from pi to -pi. In REP-103 this jump lies at 3
pi / 2; this module uses that branch.
"""

import numpy as np

from fgtrack.core.geometry import TWO_PI
from fgtrack.core.types import YAW, FloatArray
from fgtrack.estimation.filters.propagation import ExactPropagator
from fgtrack.karle2023.backward_forward import BackwardForwardBank
from fgtrack.karle2023.euler import EulerCtrv
from fgtrack.models.measurement import MeasurementModel

#: The published yaw range in REP-103 is (YAW_LIMIT - 2 pi, YAW_LIMIT].
YAW_LIMIT_RAD = 1.5 * np.pi


def wrapped_once(angle_rad: FloatArray) -> FloatArray:
    """Angle wrapped by at most one turn.

    The result lies in (-pi, pi] only if the input is less than one and a half turns
    from 0.
    """
    return np.asarray(
        angle_rad + TWO_PI * (1.0 * (angle_rad <= -np.pi) - (angle_rad > np.pi))
    )


def published_yaw(yaw_rad: FloatArray) -> FloatArray:
    """Yaw in the published range, wrapped by at most one turn.

    The range is (-pi, pi] from +y, so (-pi/2, 3 pi/2] from +x.
    """
    return wrapped_once(yaw_rad - 0.5 * np.pi) + 0.5 * np.pi


class SaturatedEulerCtrv(EulerCtrv):
    """Euler CTRV whose predicted yaw stays at the upper end of its range (defect Q2).

    Below the lower end the yaw is not limited.
    """

    yaw_limit_rad = YAW_LIMIT_RAD

    def wrap(self, mean: FloatArray) -> FloatArray:
        """Return the means with the yaw in the published range."""
        wrapped = mean.copy()
        wrapped[..., YAW] = published_yaw(mean[..., YAW])
        return wrapped

    def residual(
        self, model: MeasurementModel, z: FloatArray, z_predicted: FloatArray
    ) -> FloatArray:
        """Measured minus predicted; angles are wrapped by one turn only.

        A predicted yaw that is several turns away keeps a residual of whole turns.
        """
        y = np.asarray(z - z_predicted)
        for index, name in enumerate(model.components):
            if name == "yaw_rad":
                y[..., index] = wrapped_once(
                    published_yaw(z[..., index]) - z_predicted[..., index]
                )
            elif index in model.angular:
                y[..., index] = wrapped_once(y[..., index])
        return y


class PublishedStorage(BackwardForwardBank):
    """Object storage of the published implementation.

    With `leads`, the tracking time leads the clock by up to one step and never waits
    (defect Q14). With `is_stale`, an update in sequence does not reach the stored
    present state (defect Q8).
    """

    def __init__(
        self,
        propagator: ExactPropagator,
        step_ns: int,
        storage_steps: int,
        *,
        leads: bool,
        is_stale: bool,
    ) -> None:
        super().__init__(propagator, step_ns, storage_steps)
        self._leads = leads
        self._is_stale = is_stale

    def advance(self, now_ns: int) -> None:
        """See `BackwardForwardBank.advance`.

        With `leads` the grid advances by at least one step, to `now_ns` or beyond.
        """
        if not self._leads:
            super().advance(now_ns)
            return
        if self._now_ns is None:
            self._grid_ns = now_ns
        else:
            elapsed_ns = now_ns - self._grid_ns
            self._advance_steps(max(-(-elapsed_ns // self._step_ns), 1))
        self._now_ns = self._grid_ns

    def _visible_from(self, back: int) -> int:
        return self._grid + 1 if self._is_stale and not back else self._grid - back
