"""The replaying EKF with a smoothing pass over its window."""

import bisect
from collections.abc import Sequence

from fgtrack.core.types import TrackState
from fgtrack.estimation.base import TrackBank, asked_stamp
from fgtrack.estimation.filters.initiation import DEFAULT
from fgtrack.estimation.filters.propagation import track_state
from fgtrack.estimation.filters.replay import ReplayEkf, Step, by_stamp
from fgtrack.estimation.object_bank import ObjectBank, checked_lags
from fgtrack.models.motion import MotionModel


class EkfRts(ReplayEkf):
    """EKF with replay, and the smoothing pass of Rauch, Tung and Striebel for its past.

    Its newest state is the state of `ekf-replay`. A state of the past is given all measurements of the window. The
    pass uses the linearisations of the filter, at its predictions. A fixed-lag smoother linearises at its estimates.
    """

    smooths = True

    def state_at(self, stamp_ns: int) -> TrackState:
        """See `Estimator.state_at`: the state, given all measurements of the window."""
        stamp_ns = asked_stamp(stamp_ns, self.steps[0].stamp_ns)
        index = bisect.bisect_right(self.steps, stamp_ns, key=by_stamp)
        predicted = self._ahead(self.steps[max(index - 1, 0)], stamp_ns)
        mean, covariance, _ = predicted
        if later := self.steps[index:]:
            asked = Step(stamp_ns, None, mean, covariance, predicted)
            mean, covariance = self._retrodicted(asked, later)
        return track_state(self._motion, stamp_ns, mean, covariance)


def ekf_rts(
    motion: MotionModel,
    lag_s: float,
    initiation: str = DEFAULT,
    lagged_s: Sequence[float] | float = (0.3,),
) -> TrackBank:
    """Return the bank of EKFs with replay, and a smoothing pass (Rauch, Tung, Striebel) for states of the past.

    The pass runs back over the window of the filter, so late measurements count as well. `initiation`: see
    `Initiation`. `lagged_s` are the lags of the lagged output.
    """
    return ObjectBank(
        motion,
        lambda start: EkfRts(motion, start, lag_s, initiation),
        lag_s,
        checked_lags(lag_s, lagged_s),
    )


ekf_rts.bank = True  # type: ignore[attr-defined]  # claims, see `fgtrack.estimation.registry.Claims`
for _claim in ("exact", "retrodicts", "initiates", "smooths"):
    setattr(ekf_rts, _claim, getattr(EkfRts, _claim))
