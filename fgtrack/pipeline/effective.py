"""What a configuration comes to in a run: what is easily overlooked, and the sensors where it names none."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, replace

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.types import MEASURABLE, DetectionList, Message
from fgtrack.estimation.registry import ESTIMATORS, Claims
from fgtrack.io.errors import MOST_SENSORS
from fgtrack.models.sensors import SensorModel
from fgtrack.pipeline.config import Config
from fgtrack.tracking.merge import NoMerge

__all__ = ["ASSUMED_STD", "Effective", "effective", "told_std", "with_sensors"]

#: Estimators that take all settings of `smoother`.
_SMOOTHERS = ("smoother", "smoother-batch", "smoother-banded")

#: Standard deviations of a sensor of which nothing is known: a detector of cars by LiDAR or RADAR.
ASSUMED_STD = {
    "x_m": 1.0,
    "y_m": 1.0,
    "yaw_rad": 0.1,
    "speed_mps": 1.0,
    "range_m": 1.0,
    "bearing_rad": 0.02,
    "range_rate_mps": 0.5,
}


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
    return Effective((ego.detection_origin_x_m, ego.detection_origin_y_m), distance_m, key, lag_s, lag_s + behind_s)


def with_sensors(config: Config, messages: Callable[[], Iterable[Message]]) -> Config:
    """`config`; where it names no sensors, with those of `messages`, which measure what their detections hold.

    A position counts once: a detection of x and y is not taken as range and bearing as well. Sensors that only `input`
    names are taken to measure positions.
    """
    if config.sensors:
        return config
    measured: dict[str, set[str]] = {}
    try:
        for message in messages():
            if isinstance(message, DetectionList) and message.sensor not in config.ignore_sensors:
                found = measured.setdefault(message.sensor, set())
                for detection in message.objects:
                    found.update(detection.measured)
    except DataError:  # the replay ends there, too, and says so
        pass
    for name in (*config.input.detections, *config.input.csv.detections):
        if name not in config.ignore_sensors:
            measured.setdefault(name, set())
    if len(measured) > MOST_SENSORS:
        raise CallError(
            f"input: {len(measured)} sensors with those of the recording, at most {MOST_SENSORS} can be used"
        )
    return replace(config, sensors={name: _assumed(found) for name, found in sorted(measured.items())})


def told_std(std: Mapping[str, Mapping[str, float]]) -> str:
    """Standard deviations by sensor and component in words."""
    listed = {name: ", ".join(f"{key} {value:g}" for key, value in one.items()) for name, one in std.items()}
    return "; ".join(f"{name}: {text}" for name, text in listed.items())


def _assumed(measured: set[str]) -> SensorModel:
    cartesian = {"x_m", "y_m"}
    left = measured - ({"range_m", "bearing_rad"} if cartesian <= measured else cartesian) or cartesian
    return SensorModel(std={name: ASSUMED_STD[name] for name in MEASURABLE if name in left})
