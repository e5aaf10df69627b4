"""What is easily overlooked in a configuration, as a run has it."""

from dataclasses import asdict, dataclass

from fgtrack.estimation.registry import ESTIMATORS, Claims
from fgtrack.pipeline.config import Config
from fgtrack.tracking.merge import NoMerge

__all__ = ["Effective", "effective"]

#: Estimators that take all settings of `smoother`.
_SMOOTHERS = ("smoother", "smoother-batch", "smoother-banded")


@dataclass(frozen=True)
class Effective:
    """What is easily overlooked in a run, as meta.json has it."""

    detection_origin_m: tuple[float, float]
    """Origin of the ego frame of detections, ahead of the ego reference point and to its left."""
    merge_distance_m: float | None
    """Up to which distance detections become one; None for no merge."""
    lag_key: str
    """Key of the configuration that sets the length of the window."""
    lag_s: float
    """Length of the window."""
    reach_s: float
    """How far back a detection still changes a track."""

    def __str__(self) -> str:
        x_m, y_m = self.detection_origin_m
        merge = "none" if self.merge_distance_m is None else f"up to {self.merge_distance_m:g} m"
        late = "" if self.reach_s == self.lag_s else f", late detections up to {self.reach_s:g} s"
        return f"detection origin {x_m:g} m ahead, {y_m:g} m left of the ego; merge {merge}; lag {self.lag_s:g} s{late}"

    def values(self) -> dict[str, object]:
        """JSON values."""
        return {**asdict(self), "detection_origin_m": list(self.detection_origin_m)}


def effective(config: Config) -> Effective:
    """What `config` comes to."""
    ego, merge = config.ego, config.merge
    key, lag_s, behind_s = "filter.storage_s", config.filter.storage_s, 0.0
    if config.estimator in _SMOOTHERS:
        key, lag_s, behind_s = "smoother.lag_s", config.smoother.lag_s, config.smoother.behind_s
    elif Claims.of(ESTIMATORS.load(config.estimator)).reports:
        key, lag_s = "smoother.lag_s", config.smoother.lag_s
    distance_m = None if isinstance(merge, NoMerge) else merge.distance_m
    return Effective(ego.detection_origin_m, distance_m, key, lag_s, lag_s + behind_s)
