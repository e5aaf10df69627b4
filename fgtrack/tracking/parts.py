"""Components that a tracker is made of."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from fgtrack.core.errors import DataError, FgtrackError, did_you_mean
from fgtrack.core.types import BoolArray
from fgtrack.estimation.failures import Failure, Failures
from fgtrack.models.motion import MotionModel
from fgtrack.models.road import Road
from fgtrack.models.sensors import SensorModel
from fgtrack.tracking.association import Association, GatedMahalanobis, Pairs
from fgtrack.tracking.birth import Birth
from fgtrack.tracking.decisions.lives import DecidedLives
from fgtrack.tracking.ego.trajectory import EgoTrajectory
from fgtrack.tracking.ego.waiting import PoseWait
from fgtrack.tracking.facing import Facing
from fgtrack.tracking.guarded_bank import GuardedBank
from fgtrack.tracking.inbox import Inbox
from fgtrack.tracking.lives.existence import Lifecycle
from fgtrack.tracking.lives.latency import Watermarks
from fgtrack.tracking.objects import Objects
from fgtrack.tracking.preprocess import Preprocessing


@dataclass(frozen=True)
class TrackerParts:
    """The components that a tracker is made of."""

    sensors: Mapping[str, SensorModel]
    ego: EgoTrajectory
    inbox: Inbox
    preprocess: Preprocessing
    association: Association
    bank: GuardedBank
    motion: MotionModel
    lifecycle: Lifecycle | DecidedLives
    suppress_births_near_newer_tracks: bool
    birth: Birth
    road: Road
    watermarks: Watermarks
    """Learns the usual delays of the sensors and of the `EGO`."""
    objects: Objects = field(default_factory=Objects)
    joint: GatedMahalanobis | None = None
    """Gate of the detections that update a track together, and the distance from confirmed tracks within which no
    detection starts another one; None where each updates one track and any may start one."""
    weigh_births: Callable[[str, int, Sequence[int], Pairs], BoolArray] | None = None
    """See `ExistenceLifecycle.likely`; None if births are not weighed."""
    facing: Facing | None = None
    """Log-odds of the fronts of tracks; None if every yaw is used as it was measured."""
    wait: PoseWait | None = None
    """Decides which lists wait for an ego message; None if no list waits."""
    first_track_id: int = 0
    """Number of the first track."""
    failures: Failures = field(default_factory=Failures)
    """Counts failures of all parts, also of `bank`."""
    propagated_exceptions: tuple[type[Exception], ...] = (FgtrackError, MemoryError)
    """Exceptions that the processing of a batch lets out; after any other one, it ends as failed."""

    def contain(self, error: Exception, failure: Failure) -> None:
        """Count an error of a step, so that the work goes on without the step; raise a propagated exception again."""
        if isinstance(error, self.propagated_exceptions):
            raise error
        self.failures.add(failure)
        self.failures.note(error)


def check_sensor(name: str, sensors: Mapping[str, SensorModel]) -> None:
    """Raise `DataError` for a sensor that has no model."""
    if name not in sensors:
        raise DataError(
            f"sensor {name!r} has no model (the configuration has {', '.join(sensors) or 'none'}"
            f"{did_you_mean(name, sensors)}): "
            f"add it under `sensors`, or to `ignore_sensors`"
        )
