"""Assumptions of a replay where the configuration leaves a setting open: what a recording carries and shows."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, dataclass, fields, is_dataclass, replace
from io import StringIO
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap

from fgtrack.core.errors import DataError, printable
from fgtrack.core.types import MEASURABLE, DetectionList, Message
from fgtrack.estimation.smoothing.settings import SmootherSettings
from fgtrack.io.source import InputSource
from fgtrack.models.sensors import Correlation, Mount, Score, SensorModel
from fgtrack.pipeline.assumptions.coverage import Coverage, coverages
from fgtrack.pipeline.assumptions.revisits import ListStatistics, for_slow_revisits
from fgtrack.pipeline.config import Config, FilterConfig
from fgtrack.pipeline.load import plain
from fgtrack.pipeline.recorded import RecordedSensor, recorded
from fgtrack.tracking.association import GatedMahalanobis
from fgtrack.tracking.existence import ExistenceRules

__all__ = ["ASSUMED_STD", "Assumed", "Assumption", "assumed", "departures", "is_open", "source_of"]

#: Standard deviations of a sensor that nothing specifies: a detector of cars by LiDAR or RADAR.
ASSUMED_STD = {
    "x_m": 1.0,
    "y_m": 1.0,
    "yaw_rad": 0.1,
    "speed_mps": 1.0,
    "range_m": 1.0,
    "bearing_rad": 0.02,
    "range_rate_mps": 0.5,
}

_BOX_STD_M = 0.3
"""Standard deviation of the middle of a box: the translation error of LiDAR detectors is 0.25 to 0.5 m (nuScenes)."""
_LISTS_OUT_OF_VIEW = 2.5
"""Periods of the slowest sensor for which a track that is out of view lives on."""
_SILENCES = 1.5
"""Longest silences of a sensor for which a track that it alone sees lives on."""
_LEAST_CLUTTER = 0.05
"""False detections of a list that can never be excluded."""

_TWO_LISTS = "two lists of the slowest sensor"
_LEAST_SHARE, _OFFSET_S = 0.5, 30.0
"""Share of time-correlated errors below which they are not modelled, and their correlation time: the offset of what a
sensor sees of a hull changes with its aspect, within tens of seconds."""

RECORDED, USUAL = "recorded", "usual of a detector of cars by LiDAR or RADAR"
USUAL_BOX = "usual of boxes that a detector fits to cars"
_UNPLACED = "gives no position, and bearings from an unknown mount err by more than the tracks"
"""Reasons."""


def _mounted(value: Mapping[str, float]) -> str:
    axis = f", axis {math.degrees(value['yaw_rad']):.0f} degrees" if value["yaw_rad"] else ""
    return f"mounted at {value['x_m']:g} m, {value['y_m']:g} m{axis}"


#: Settings in words, by the last name of their keys.
_WORDS: Mapping[str, Callable[[Any], str]] = {  # Any: of the key
    "std": lambda std: f"standard deviations {', '.join(f'{name} {one:g}' for name, one in std.items())}",
    "correlation": "{0[share]:.0%} of the variance lasts for some {0[time_s]:g} s".format,
    "detection_probability": "detection probability {:g}".format,
    "clutter_per_m2": "clutter {:g} per m2".format,
    "score": "score {0[even]:g} as often of objects as of clutter, e times per {0[scale]:g}".format,
    "scan": lambda _: "reports objects one by one",
    "out_of_view_s": "tracks out of view end after {:g} s".format,
    "lag_s": "smoothers keep {:g} s".format,
    "storage_s": "filters keep {:g} s".format,
    "claim_m": "nothing begins within {:g} m of a track".format,
    "ignore_sensors": lambda names: f"{', '.join(names)} left out",
    "field_of_view_rad": lambda rad: "sees all around" if rad >= math.tau else f"sees {math.degrees(rad):.0f} degrees",
    "view_range_m": "up to {:g} m".format,
    "max_range_m": "used up to {:g} m, beyond which clutter outweighs objects".format,
    "max_range_behind_m": "behind it up to {:g} m".format,
    "mount": _mounted,
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

    @property
    def text(self) -> str:
        """The setting in words, without its sensor and its reason."""
        words = _WORDS.get(self.key.rpartition(".")[2])
        return f"{self.key} {self.value}" if words is None else words(self.value)


@dataclass(frozen=True)
class Assumed:
    """A configuration with nothing left open, and what of it was assumed."""

    config: Config
    assumptions: tuple[Assumption, ...]

    def to_yaml(self, head: Iterable[str] = (), comments: Iterable[tuple[Sequence[str], str]] = ()) -> str:
        """Return YAML of all settings that differ from the defaults; a comment gives the reason of an assumed one.

        As `-c` it gives the run of this configuration without assuming anything. The lines of `head` are comments, and
        `comments` are those of further keys, by path.
        """
        tree = _commented(departures(self.config))
        reasons = [(self._path(one.key), f"assumed: {one.reason}") for one in self.assumptions]
        for path, reason in [*reasons, *comments]:
            inner = tree
            for name in path[:-1]:
                inner = inner.get(name, {})
            if path[-1] in inner:
                inner.yaml_add_eol_comment(printable(reason), path[-1])
        text = StringIO()
        yaml = YAML()
        yaml.width = 4096
        yaml.dump(tree, text)
        lines = [f"# {printable(line)}".rstrip() for line in head]
        return "\n".join([*lines, text.getvalue()])

    def lines(self) -> list[str]:
        """Return the assumptions in words: a line for each sensor, and one for the rest."""
        found: dict[str, dict[str, list[str]]] = {}
        for one in self.assumptions:
            path = self._path(one.key)
            about = path[1] if path[0] == "sensors" else "recording"
            found.setdefault(about, {}).setdefault(one.reason, []).append(one.text)
        lines = []
        for about, reasons in found.items():
            parts = [f"{', '.join(texts)} ({reason})" for reason, texts in reasons.items()]
            lines.append(f"assumed, {about}: {'; '.join(parts)}")
        return lines

    def _path(self, key: str) -> list[str]:
        """The names of `key`; that of a sensor may hold dots itself."""
        for name in self.config.sensors:
            if key.startswith(start := f"sensors.{name}."):
                return ["sensors", name, *key.removeprefix(start).split(".")]
        return key.split(".")


def assumed(config: Config, source: InputSource) -> Assumed:
    """`config` with nothing left open, and what of it was assumed; a key that is set stays as it is.

    Three sources, the first that gives a key decides:

    - What `source` carries: origin of detections, track, and of each sensor mount, field of view and ranges.
    - What its detections show (`coverages`): the sensors, where `config` has none, with what they measure; field of
      view and range of those of which neither the configuration nor the recording gives any of both. A position counts
      once: a detection of x and y is not taken as range and bearing as well.
    - How often they come back: motion and clock of objects that are measured every few seconds (`for_slow_revisits`).
    - Usual values: standard deviations, and a sensor that looks all around from the origin. Sensors that give bearings
      alone are left out where others give positions, unless the recording carries their mount.
    """
    carried = recorded(source)
    found: list[Assumption] = []
    ego, road = config.ego, config.map
    if ego.detection_origin_x_m is None:
        origin_m = carried.ego.detection_origin_x_m
        if origin_m is not None:
            found.append(Assumption("ego.detection_origin_x_m", origin_m, RECORDED))
        ego = replace(ego, detection_origin_x_m=origin_m or 0.0)
    if road.track is None and carried.map.track is not None:
        found.append(Assumption("map.track", carried.map.track, RECORDED))
        road = replace(road, track=carried.map.track)
    sensors = {
        name: _with_recorded(name, sensor, carried.sensors.get(name, RecordedSensor()), found)
        for name, sensor in config.sensors.items()
    }
    lifecycle = config.lifecycle
    if is_open(replace(config, sensors=sensors)):
        mounts = {name: one.mount for name, one in (sensors or carried.sensors).items() if one.mount is not None}
        covered, lists = _seen(source, config, mounts)
        named = bool(sensors)
        if not named:
            sections, reason = for_slow_revisits(config, lists.values())
            for section, value in sections.items():
                given = departures(value).items()
                found += [Assumption(f"{section}.{key}", item, reason) for key, item in given]
            config = replace(config, **sections)
            for name, one in covered.items():
                std = _std(one)
                found.append(Assumption(f"sensors.{name}.std", std, USUAL_BOX if one.boxes else USUAL))
                sensor, more = _with_lists(name, SensorModel(std=std), one, lists.get(name, ListStatistics()))
                found += more
                sensors[name] = _with_recorded(name, sensor, carried.sensors.get(name, RecordedSensor()), found)
            config = _with_claim(config, covered, found)
            _with_offsets(sensors, covered, found)
            unplaced = [name for name, one in sensors.items() if not one.gives_position and one.mount is None]
            if unplaced and any(one.gives_position for one in sensors.values()):
                config = replace(config, ignore_sensors=(*config.ignore_sensors, *unplaced))
                found.append(Assumption("ignore_sensors", list(config.ignore_sensors), _UNPLACED))
            config = _with_windows(config, covered, found)
        for name, sensor in sensors.items():
            if sensor.scan and not sensor.is_view_given and name in covered:
                seen = replace(covered[name], persistence=None) if named else covered[name]
                sensors[name] = _with_coverage(name, sensor, seen, found)
        gap_s, reason = _out_of_view_s(replace(config, sensors=sensors), covered)
        default_s = ExistenceRules.out_of_view_s
        if isinstance(lifecycle, ExistenceRules) and lifecycle.out_of_view_s == default_s != gap_s:
            lifecycle = replace(lifecycle, out_of_view_s=float(f"{gap_s:.2g}"))
            found.append(Assumption("lifecycle.out_of_view_s", lifecycle.out_of_view_s, reason))
    sensors = {
        name: replace(sensor, field_of_view_rad=sensor.field_of_view_rad or math.tau)
        for name, sensor in sensors.items()
    }
    return Assumed(replace(config, ego=ego, map=road, lifecycle=lifecycle, sensors=sensors), tuple(found))


def is_open(config: Config) -> bool:
    """True if `config` has no sensors, or nothing of where one of them sees: then `assumed` reads the messages."""
    return not config.sensors or not all(sensor.is_view_given for sensor in config.used_sensors.values())


def _with_recorded(name: str, sensor: SensorModel, carried: RecordedSensor, found: list[Assumption]) -> SensorModel:
    """`sensor` with what the recording carries where it is open; each key is appended to `found`."""
    given = {
        one.name: value
        for one in fields(carried)
        if (value := getattr(carried, one.name)) is not None and getattr(sensor, one.name) is None
    }
    found += [Assumption(f"sensors.{name}.{key}", plain(value), RECORDED) for key, value in given.items()]
    return replace(sensor, **given)


def _with_claim(config: Config, seen: Mapping[str, Coverage], found: list[Assumption]) -> Config:
    """`config` in which a track claims what is as near to it as sensors disagree, where that is more than they err."""
    apart_m = max((one.disagreement_m for one in seen.values() if one.disagreement_m is not None), default=0.0)
    rules = config.association
    if apart_m <= ASSUMED_STD["x_m"] or rules != GatedMahalanobis():
        return config
    claim_m = float(round(3.0 * apart_m))
    reason = f"sensors disagree by {apart_m:.2g} m on each axis, as on large hulls"
    found.append(Assumption("association.claim_m", claim_m, reason))
    return replace(config, association=replace(rules, claim_m=claim_m))


def _with_windows(config: Config, covered: Mapping[str, Coverage], found: list[Assumption]) -> Config:
    """`config` with windows that hold two lists of the slowest sensor that takes part."""
    rates_hz = [one.rate_hz for name, one in covered.items() if one.rate_hz and name not in config.ignore_sensors]
    lag_s = float(math.ceil(2.0 / min(rates_hz, default=math.inf)))
    if lag_s <= config.smoother.lag_s or config.smoother != SmootherSettings() or config.filter != FilterConfig():
        return config
    storage_s = lag_s + config.smoother.ring_s
    found.append(Assumption("smoother.lag_s", lag_s, _TWO_LISTS))
    found.append(Assumption("filter.storage_s", storage_s, _TWO_LISTS))
    smoother, storage = replace(config.smoother, lag_s=lag_s), replace(config.filter, storage_s=storage_s)
    return replace(config, smoother=smoother, filter=storage)


def _with_offsets(sensors: dict[str, SensorModel], covered: Mapping[str, Coverage], found: list[Assumption]) -> None:
    """Give `sensors` time-correlated errors where they disagree by more than errors that differ from list to list.

    Of two sensors each has half of the variance, beside its own errors e: s^2 = e^2 + max(d^2 / 2 - e^2, 0).
    """
    for name, one in covered.items():
        sensor = sensors[name]
        if one.disagreement_m is None or one.persistence is None or not {"x_m", "y_m"} <= sensor.std.keys():
            continue
        own_m = max(sensor.std["x_m"], one.persistence.std_m)
        std_m = float(f"{one.disagreement_m / math.sqrt(2.0):.2g}")
        if (1.0 - _LEAST_SHARE) * std_m**2 < own_m**2:
            continue
        share = round(1.0 - (own_m / std_m) ** 2, 2)
        reason = f"it and another sensor disagree by {one.disagreement_m:.2g} m on each axis, as on large hulls"
        sensors[name] = replace(
            sensor, std={**sensor.std, "x_m": std_m, "y_m": std_m}, correlation=Correlation(share, _OFFSET_S)
        )
        found[:] = [each for each in found if each.key != f"sensors.{name}.std"]
        found.append(Assumption(f"sensors.{name}.std", sensors[name].std, reason))
        found.append(Assumption(f"sensors.{name}.correlation", {"share": share, "time_s": _OFFSET_S}, reason))


def _out_of_view_s(config: Config, seen: Mapping[str, Coverage]) -> tuple[float, str]:
    """Return how long a track lives that no sensor can see, and the reason.

    Where one sensor alone gives positions nothing else sees what has left its view: the first list that could not show
    it ends it. Else it may come into the view of another one, and outlives two lists of the slowest sensor, and the
    longest silence of the one that saw it, while others go on.
    """
    periods_s = {name: 1.0 / one.rate_hz for name, one in seen.items() if one.rate_hz}
    placing = [name for name, one in config.used_sensors.items() if one.gives_position]
    if len(placing) == 1 and placing[0] in periods_s:
        return 0.5 * periods_s[placing[0]], "no other sensor gives positions, half its period"
    slow_s = _LISTS_OUT_OF_VIEW * max(periods_s.values(), default=0.0)
    silent_s = _SILENCES * max((seen[name].silence_s for name in placing if name in seen), default=0.0)
    longest_s = max(ExistenceRules.out_of_view_s, slow_s, silent_s)
    return longest_s, _TWO_LISTS if longest_s == slow_s else "beyond the longest silence of a sensor"


def _with_coverage(name: str, sensor: SensorModel, seen: Coverage, found: list[Assumption]) -> SensorModel:
    """`sensor` with the sector and the range in which it detects; each key is appended to `found`."""
    given: dict[str, Any] = {}  # Any: values of different keys
    if seen.axis_rad:
        given["mount"] = Mount(yaw_rad=seen.axis_rad)
    if seen.field_of_view_rad is not None:
        given["field_of_view_rad"] = seen.field_of_view_rad
    if seen.range_m is not None:
        given["view_range_m"] = seen.range_m
    if sensor.score is None and seen.persistence is not None and seen.persistence.max_range_m is not None:
        given["max_range_m"] = float(round(seen.persistence.max_range_m))
    reason = f"where it detects, of {seen}"
    found += [Assumption(f"sensors.{name}.{key}", plain(value), reason) for key, value in given.items()]
    return replace(sensor, **given)


def _seen(
    source: InputSource, config: Config, mounts: Mapping[str, Mount]
) -> tuple[dict[str, Coverage], dict[str, ListStatistics]]:
    """Coverage and lists of the sensors of `source` that are not ignored; coverage of those that only `input` names."""
    lists: dict[str, ListStatistics] = {}

    def readable() -> Iterator[Message]:
        with suppress(DataError):  # the replay ends there, too, and reports it
            for message in source.messages():
                if not isinstance(message, DetectionList):
                    yield message
                elif message.sensor not in config.ignore_sensors:
                    lists.setdefault(message.sensor, ListStatistics()).add(message)
                    yield message

    found = coverages(readable(), mounts)
    for name in (*config.input.detections, *config.input.csv.detections):
        if name not in config.ignore_sensors:
            found.setdefault(name, Coverage(frozenset(), 0, 0, None))
    return dict(sorted(found.items())), lists


def source_of(messages: Callable[[], Iterable[Message]]) -> InputSource:
    """Messages in memory as an input."""
    return InputSource(Path(), "messages", lambda: iter(messages()))


def _with_lists(
    name: str, sensor: SensorModel, seen: Coverage, lists: ListStatistics
) -> tuple[SensorModel, list[Assumption]]:
    """`sensor` with what its lists show of scans, misses, clutter and scores."""
    found: dict[str, tuple[Any, str]] = {}
    if not lists.scans:
        found["scan"] = False, "its lists hold one object, and none is empty"
    if lists.scans and seen.persistence is not None and seen.area_m2:
        reason = f"how its detections persist, of {len(seen.persistence.lines)} in three lists running"
        clutter_per_m2 = max(seen.persistence.clutter_per_list, _LEAST_CLUTTER) / seen.area_m2
        clutter_per_m2 = max(clutter_per_m2, seen.persistence.near_clutter_per_m2 or 0.0)
        found["detection_probability"] = round(seen.persistence.detection_probability, 2), reason
        found["clutter_per_m2"] = float(f"{clutter_per_m2:.2g}"), reason
        if seen.persistence.score is not None:
            score = seen.persistence.score
            found["score"] = Score(float(f"{score.even:.3g}"), float(f"{score.scale:.3g}")), reason
    elif lists.largest_clutter_per_m2 < sensor.clutter_per_m2:
        density = float(f"{lists.largest_clutter_per_m2:.2g}")
        found["clutter_per_m2"] = density, "all detections of a list over the area that they cover"
    sensor = replace(sensor, **{key: value for key, (value, _) in found.items()})
    return sensor, [Assumption(f"sensors.{name}.{key}", plain(value), why) for key, (value, why) in found.items()]


def _std(seen: Coverage) -> dict[str, float]:
    measured, cartesian = seen.measured, {"x_m", "y_m"}
    left = measured - ({"range_m", "bearing_rad"} if cartesian <= measured else cartesian) or cartesian
    usual = ASSUMED_STD | (dict.fromkeys(cartesian, _BOX_STD_M) if seen.boxes else {})
    return {name: usual[name] for name in MEASURABLE if name in left}


def departures(value: object) -> Any:  # Any: plain values
    """Return plain values; of dataclasses those that are not the defaults, and their forms (`kind`)."""
    if isinstance(value, Mapping):
        return {name: departures(item) for name, item in value.items()}
    if not is_dataclass(value):
        return plain(value)
    given = {one.name: getattr(value, one.name) for one in fields(value)}
    defaults = {one.name: one.default for one in fields(value)}
    defaults |= {one.name: one.default_factory() for one in fields(value) if one.default_factory is not MISSING}
    return {name: departures(item) for name, item in given.items() if name == "kind" or item != defaults[name]}


def _commented(value: Any) -> Any:  # Any: plain values
    return CommentedMap((name, _commented(item)) for name, item in value.items()) if isinstance(value, dict) else value
