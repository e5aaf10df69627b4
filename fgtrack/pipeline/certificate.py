"""What is certified of an estimator: checks with their tolerances."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from fgtrack.estimation.base import Estimator, TrackBank, UpdateStatus
from fgtrack.estimation.registry import Claims, Factory, start_bank, start_estimator
from fgtrack.pipeline.verify_streams import Stream

ORDER_TOLERANCE = 1e-9
#: Of a linear model's dense joint, and of the EKF, to the oracle.
ORACLE_TOLERANCE = 1e-7
#: At convergence, where nothing has left the window, and where what has left keeps its linearisation.
WHOLE_TOLERANCE, MARGINALISED_TOLERANCE, SHORT_TOLERANCE = 1e-5, 5e-3, 5e-2
#: Before that, with small thresholds: the graph as it grew, and not as it is built anew to converge.
GROWN_TOLERANCE = 5e-2
#: Of a filter that iterates its updates: where its steps are damped, it ends before they are solved to rounding.
ITERATED_TOLERANCE = 1e-2
#: In standard deviations: good approximations of a mildly nonlinear model.
NEAR_TOLERANCE = 0.7
NOT_FUSED = (UpdateStatus.TOO_OLD, UpdateStatus.FAILED)


@dataclass(frozen=True)
class Subject:
    """An estimator, and what it claims."""

    factory: Factory
    claims: Claims
    options: Mapping[str, Any] = field(default_factory=dict)

    def start(self, stream: Stream) -> Estimator:
        """One for the object of `stream`."""
        name = getattr(self.factory, "__name__", "estimator")
        return start_estimator(name, self.factory, stream.motion, stream.prior, stream.lag_s, self.options)

    def start_bank(self, stream: Stream) -> TrackBank:
        """A bank without any object, as the tracker has it."""
        name = getattr(self.factory, "__name__", "estimator")
        return start_bank(name, self.factory, stream.motion, stream.lag_s, self.options)

    @property
    def oracle_tolerance(self) -> float:
        """Of a filter, to the oracle's solution of the same equations."""
        return ITERATED_TOLERANCE if self.claims.solves in ("iekf", "iplf") else ORACLE_TOLERANCE


@dataclass(frozen=True)
class Check:
    """One estimator on one stream in one order of arrival."""

    stream: str
    estimator: str
    order: str
    against: str
    mean_sigma: float
    """Largest difference of a mean, in standard deviations."""
    covariance: float
    """Largest difference of a covariance, relative to the standard deviations."""
    num_refused: int
    """Measurements that were not fused; each voids the check."""
    tolerance: float | None
    """What both differences must stay below; None where nothing is promised."""

    @property
    def met(self) -> bool:
        """Whether it keeps the promise."""
        if self.tolerance is None:
            return True
        return self.mean_sigma < self.tolerance and self.covariance < self.tolerance and not self.num_refused


@dataclass(frozen=True)
class Certificate:
    """All checks."""

    checks: tuple[Check, ...]

    @property
    def num_promises(self) -> int:
        """Checks with a tolerance."""
        return sum(check.tolerance is not None for check in self.checks)

    @property
    def missed(self) -> tuple[Check, ...]:
        """Checks that miss their tolerance."""
        return tuple(check for check in self.checks if not check.met)

    def as_dict(self) -> dict[str, Any]:
        """JSON values; a number that is not finite is null."""
        return {
            "met": not self.missed,
            "checks": [
                {**{name: _finite(value) for name, value in asdict(check).items()}, "met": check.met}
                for check in self.checks
            ],
        }


def _finite(value: object) -> object:
    return None if isinstance(value, float) and not math.isfinite(value) else value
