"""Assumptions: settings that the user has not given, with their reasons, as sentences and as YAML."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass
from io import StringIO
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap

from fgtrack.config.settings import Config
from fgtrack.config.yaml_file import plain, validate, with_value
from fgtrack.core.errors import printable

__all__ = ["Assumed", "Assumption", "departures", "is_given"]


def _mounted(value: Mapping[str, float]) -> str:
    axis = (
        f", axis {math.degrees(value['yaw_rad']):.0f} degrees"
        if value["yaw_rad"]
        else ""
    )
    return f"mounted at {value['x_m']:g} m, {value['y_m']:g} m{axis}"


#: Functions that describe the value of a setting, by the last name of its key.
_WORDS: Mapping[str, Callable[[Any], str]] = {  # Any: the key's type
    "std": lambda std: (
        f"standard deviations {', '.join(f'{name} {one:g}' for name, one in std.items())}"
    ),
    "correlation": "{0[share]:.0%} of the variance is correlated over {0[time_s]:g} s".format,
    "detection_probability": "detection probability {:g}".format,
    "clutter_per_m2": "clutter {:g} per m2".format,
    "score": "at score {0[even]:g} as many objects as clutter, e times more for each {0[scale]:g}".format,
    "scan": lambda _: "reports objects one by one",
    "out_of_view_s": "tracks out of view end after {:g} s".format,
    "lag_s": "smoothers keep {:g} s".format,
    "storage_s": "filters keep {:g} s".format,
    "claim_m": "no track begins within {:g} m of another track".format,
    "min_travel_m": "tracks are confirmed after a movement of {:g} m".format,
    "ignore_sensors": lambda names: f"{', '.join(names)} ignored",
    "field_of_view_rad": lambda rad: (
        "field of view all around"
        if rad >= math.tau
        else f"field of view {math.degrees(rad):.0f} degrees"
    ),
    "view_range_m": "range {:g} m".format,
    "max_range_m": "used up to {:g} m, beyond which clutter outnumbers objects".format,
    "max_range_behind_m": "range {:g} m to the rear".format,
    "mount": _mounted,
}


@dataclass(frozen=True)
class Assumption:
    """An assumed value of a setting that the user has not given."""

    path: tuple[str, ...]
    """Names in the path of the configuration key."""
    value: object
    """Plain value, as in YAML."""
    reason: str
    """Reason in a short sentence."""

    @property
    def key(self) -> str:
        """Configuration key, with dots between its names: `sensors.radar.std`."""
        return ".".join(self.path)

    @property
    def text(self) -> str:
        """Setting in words, without its sensor and its reason."""
        words = _WORDS.get(self.path[-1])
        return f"{self.key} {self.value}" if words is None else words(self.value)


@dataclass(frozen=True)
class Assumed:
    """A configuration, and the assumptions that it contains."""

    config: Config
    assumptions: tuple[Assumption, ...] = ()

    def assuming(self, *new: Assumption) -> "Assumed":
        """Return the configuration with further assumptions, which replace earlier assumptions of the same keys."""
        raw = plain(self.config)
        for item in new:
            raw = with_value(raw, item.path, item.value)
        paths = {item.path for item in new}
        kept = [item for item in self.assumptions if item.path not in paths]
        return Assumed(validate(Config, raw, "assumed"), (*kept, *new)) if new else self

    def to_yaml(
        self,
        head: Iterable[str] = (),
        comments: Iterable[tuple[Sequence[str], str]] = (),
    ) -> str:
        """Return all settings that differ from the defaults as YAML; the comment of an assumption is its reason.

        `head` contains comment lines for the beginning, `comments` further comments by
        the path of their key.
        """
        tree = _commented(departures(self.config))
        for path, reason in [
            *((one.path, f"assumed: {one.reason}") for one in self.assumptions),
            *comments,
        ]:
            inner = tree
            for name in path[:-1]:
                inner = inner.get(name, {})
            if path[-1] in inner:
                inner.yaml_add_eol_comment(printable(reason), path[-1])
        text = StringIO()
        yaml = YAML()
        yaml.width = 4096
        yaml.dump(tree, text)
        return "\n".join(
            [*(f"# {printable(line)}".rstrip() for line in head), text.getvalue()]
        )

    def lines(self) -> list[str]:
        """Return the assumptions in words: a line for each sensor, and a line for the other settings."""
        result: dict[str, dict[str, list[str]]] = {}
        for item in self.assumptions:
            about = item.path[1] if item.path[0] == "sensors" else "recording"
            result.setdefault(about, {}).setdefault(item.reason, []).append(item.text)
        lines = []
        for about, reasons in result.items():
            parts = [
                f"{', '.join(texts)} ({reason})" for reason, texts in reasons.items()
            ]
            lines.append(f"assumed, {about}: {'; '.join(parts)}")
        return lines


def departures(value: object) -> Any:  # Any: plain values
    """Return `value` as plain values, without the fields of dataclasses that have their defaults. `kind` is always
    kept.
    """
    if isinstance(value, Mapping):
        return {name: departures(item) for name, item in value.items()}
    if not is_dataclass(value):
        return plain(value)
    given = {entry.name: getattr(value, entry.name) for entry in fields(value)}
    defaults = {entry.name: entry.default for entry in fields(value)}
    defaults |= {
        entry.name: entry.default_factory()
        for entry in fields(value)
        if entry.default_factory is not MISSING
    }
    return {
        name: departures(item)
        for name, item in given.items()
        if name == "kind" or item != defaults[name]
    }


def is_given(given: object, path: Sequence[str]) -> bool:
    """True if `given`, the `departures` of the user's configuration, contains the key path."""
    for name in path:
        if not isinstance(given, Mapping) or name not in given:
            return False
        given = given[name]
    return True


def _commented(value: Any) -> Any:  # Any: plain values
    return (
        CommentedMap((name, _commented(item)) for name, item in value.items())
        if isinstance(value, dict)
        else value
    )
