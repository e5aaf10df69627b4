"""What a replay assumes where the configuration does not say it: the sensors of a recording and what they measure."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from io import StringIO
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.types import MEASURABLE, DetectionList, Message
from fgtrack.io.errors import MOST_SENSORS
from fgtrack.io.source import InputSource
from fgtrack.models.sensors import SensorModel
from fgtrack.pipeline.config import Config
from fgtrack.pipeline.list_statistics import ListStatistics
from fgtrack.pipeline.load import plain

__all__ = ["ASSUMED_STD", "Assumed", "Assumption", "assumed", "source_of"]

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
class Assumption:
    """A setting that the user has not given."""

    key: str
    """Key of the configuration, with dots between the names of a path: `sensors.radar.std`."""
    value: object
    """A plain value, as YAML has it."""
    reason: str
    """A short sentence."""

    def __str__(self) -> str:
        value = self.value
        if isinstance(value, Mapping):
            value = ", ".join(f"{name} {one:g}" for name, one in value.items())
        return f"{self.key}: {value} ({self.reason})"


@dataclass(frozen=True)
class Assumed:
    """A configuration with nothing left open, and what of it was assumed."""

    config: Config
    assumptions: tuple[Assumption, ...]

    def to_yaml(self) -> str:
        """YAML text of all settings that differ from the defaults; those that were assumed say why in a comment.

        As `-c` it gives the run of this configuration without assuming anything.
        """
        sensors = {name: _of_sensor(sensor) for name, sensor in self.config.sensors.items()}
        tree = _commented({**_departures(self.config, Config()), "sensors": sensors})
        for one in self.assumptions:
            inner, names = tree, self._path(one.key)
            for name in names[:-1]:
                inner = inner[name]
            if names[-1] in inner:
                inner.yaml_add_eol_comment(f"assumed: {one.reason}", names[-1])
        text = StringIO()
        yaml = YAML()
        yaml.width = 4096
        yaml.dump(tree, text)
        return text.getvalue()

    def _path(self, key: str) -> list[str]:
        """The names of `key`; that of a sensor may hold dots itself."""
        for name in self.config.sensors:
            if key.startswith(start := f"sensors.{name}."):
                return ["sensors", name, *key.removeprefix(start).split(".")]
        return key.split(".")


def assumed(config: Config, source: InputSource) -> Assumed:
    """`config` with what `source` shows where `config` leaves it open; a key that is set stays as it is.

    Where `config` has no sensors they are those of the recording, which measure what their detections hold. A position
    counts once: a detection of x and y is not taken as range and bearing as well. Sensors that only `input` names are
    taken to measure positions.
    """
    if config.sensors:
        return Assumed(config, ())
    measured: dict[str, set[str]] = {}
    lists: dict[str, ListStatistics] = {}
    try:
        for message in source.messages():
            if isinstance(message, DetectionList) and message.sensor not in config.ignore_sensors:
                found = measured.setdefault(message.sensor, set())
                lists.setdefault(message.sensor, ListStatistics()).add(message)
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
    sensors = {name: SensorModel(std=_std(found)) for name, found in sorted(measured.items())}
    reason = "usual of a detector of cars by LiDAR or RADAR"
    assumptions = [Assumption(f"sensors.{name}.std", dict(sensor.std), reason) for name, sensor in sensors.items()]
    for name, statistics in sorted(lists.items()):
        sensors[name], more = _with_lists(name, sensors[name], statistics)
        assumptions += more
    return Assumed(replace(config, sensors=sensors), tuple(assumptions))


def source_of(messages: Callable[[], Iterable[Message]]) -> InputSource:
    """Messages in memory as an input."""
    return InputSource(Path(), "messages", lambda: iter(messages()))


def _with_lists(name: str, sensor: SensorModel, lists: ListStatistics) -> tuple[SensorModel, list[Assumption]]:
    """`sensor` with what its lists show of scans and clutter, where that differs from the defaults."""
    found: dict[str, tuple[Any, str]] = {}
    if not lists.scans:
        found["scan"] = False, "its lists hold one object, and none is empty"
    if lists.largest_clutter_per_m2 < sensor.clutter_per_m2:
        density = float(f"{lists.largest_clutter_per_m2:.2g}")
        found["clutter_per_m2"] = density, "all detections of a list over the area that they cover"
    sensor = replace(sensor, **{key: value for key, (value, _) in found.items()})
    return sensor, [Assumption(f"sensors.{name}.{key}", *each) for key, each in found.items()]


def _std(measured: set[str]) -> dict[str, float]:
    cartesian = {"x_m", "y_m"}
    left = measured - ({"range_m", "bearing_rad"} if cartesian <= measured else cartesian) or cartesian
    return {name: ASSUMED_STD[name] for name in MEASURABLE if name in left}


def _departures(value: object, default: object) -> Any:  # Any: plain values
    """What of a dataclass differs from `default`, with its form (`kind`) where it has one; all of any other value."""
    if not is_dataclass(value) or type(value) is not type(default):
        return plain(value)
    names = [field.name for field in fields(value) if getattr(value, field.name) != getattr(default, field.name)]
    form = ["kind"] if names and hasattr(value, "kind") and "kind" not in names else []
    return {name: _departures(getattr(value, name), getattr(default, name)) for name in [*form, *names]}


def _of_sensor(sensor: SensorModel) -> dict[str, Any]:  # Any: plain values
    return {"std": plain(sensor.std), **_departures(sensor, SensorModel(std=sensor.std))}


def _commented(value: Any) -> Any:  # Any: plain values
    return CommentedMap((name, _commented(item)) for name, item in value.items()) if isinstance(value, dict) else value
