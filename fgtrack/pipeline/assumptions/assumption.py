"""Assumptions: settings that the user has not given, with their reasons, in words and as YAML."""

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

__all__ = ["Assumed", "Assumption", "departures"]


def _mounted(value: Mapping[str, float]) -> str:
    axis = (
        f", axis {math.degrees(value['yaw_rad']):.0f} degrees"
        if value["yaw_rad"]
        else ""
    )
    return f"mounted at {value['x_m']:g} m, {value['y_m']:g} m{axis}"


#: Settings in words, by the last name of their keys.
_WORDS: Mapping[str, Callable[[Any], str]] = {  # Any: of the key
    "std": lambda std: (
        f"standard deviations {', '.join(f'{name} {one:g}' for name, one in std.items())}"
    ),
    "correlation": "{0[share]:.0%} of the variance lasts for some {0[time_s]:g} s".format,
    "detection_probability": "detection probability {:g}".format,
    "clutter_per_m2": "clutter {:g} per m2".format,
    "score": "score {0[even]:g} as often of objects as of clutter, e times per {0[scale]:g}".format,
    "scan": lambda _: "reports objects one by one",
    "out_of_view_s": "tracks out of view end after {:g} s".format,
    "lag_s": "smoothers keep {:g} s".format,
    "storage_s": "filters keep {:g} s".format,
    "claim_m": "nothing begins within {:g} m of a track".format,
    "min_travel_m": "nothing is confirmed that has not moved by {:g} m".format,
    "ignore_sensors": lambda names: f"{', '.join(names)} left out",
    "field_of_view_rad": lambda rad: (
        "sees all around"
        if rad >= math.tau
        else f"sees {math.degrees(rad):.0f} degrees"
    ),
    "view_range_m": "up to {:g} m".format,
    "max_range_m": "used up to {:g} m, beyond which clutter outweighs objects".format,
    "max_range_behind_m": "behind it up to {:g} m".format,
    "mount": _mounted,
}


@dataclass(frozen=True)
class Assumption:
    """A setting that the user has not given."""

    path: tuple[str, ...]
    """Names of the path of its key in the configuration."""
    value: object
    """A plain value, as YAML has it."""
    reason: str
    """A short sentence."""

    @property
    def key(self) -> str:
        """Key of the configuration, with dots between the names of its path: `sensors.radar.std`."""
        return ".".join(self.path)

    @property
    def text(self) -> str:
        """The setting in words, without its sensor and its reason."""
        words = _WORDS.get(self.path[-1])
        return f"{self.key} {self.value}" if words is None else words(self.value)


@dataclass(frozen=True)
class Assumed:
    """A configuration, and what of it was assumed."""

    config: Config
    assumptions: tuple[Assumption, ...] = ()

    def assuming(self, *new: Assumption) -> "Assumed":
        """Return it with further assumptions, which replace those of the same keys."""
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
        """YAML, with comments and `head`, of all settings that differ from defaults, assumed ones with a reason."""
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
        text, yaml = StringIO(), YAML()
        yaml.width = 4096
        yaml.dump(tree, text)
        return "\n".join(
            [*(f"# {printable(line)}".rstrip() for line in head), text.getvalue()]
        )

    def lines(self) -> list[str]:
        """Return the assumptions in words: a line for each sensor, and one for the rest."""
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
    """Return plain values; of dataclasses those that are not the defaults, and their forms (`kind`)."""
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


def _commented(value: Any) -> Any:  # Any: plain values
    return (
        CommentedMap((name, _commented(item)) for name, item in value.items())
        if isinstance(value, dict)
        else value
    )
