"""Settings that a recording carries, so that a replay needs no configuration."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import ConfigDict, TypeAdapter, ValidationError

from fgtrack.config.settings import EgoConfig, MapConfig
from fgtrack.config.yaml_file import plain
from fgtrack.core.errors import DataError
from fgtrack.inputs.source import InputSource
from fgtrack.models.oval import OVAL
from fgtrack.models.sensors import Mount

if TYPE_CHECKING:
    from fgtrack.sim.scenario import Scenario

__all__ = ["Recorded", "RecordedSensor", "recorded", "recorded_of"]

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class RecordedSensor:
    """Recorded settings of a sensor, by the keys of `sensors.NAME`; None if not recorded."""

    mount: Mount | None = None
    field_of_view_rad: float | None = None
    view_range_m: float | None = None
    max_range_behind_m: float | None = None


@dataclass(frozen=True)
class Recorded:
    """Configuration keys that a recording may carry; a key that it does not carry has its default."""

    ego: EgoConfig = field(default_factory=EgoConfig)
    map: MapConfig = field(default_factory=MapConfig)
    sensors: Mapping[str, RecordedSensor] = field(default_factory=dict)


_RECORDED = TypeAdapter(Recorded | None, config=ConfigDict(allow_inf_nan=False))


def recorded(source: InputSource) -> Recorded:
    """Return the settings that `source` carries.

    Invalid settings, and a map file that does not exist, are ignored with a warning.
    """
    try:
        result = (
            _RECORDED.validate_python(source.settings(), extra="ignore") or Recorded()
        )
    except DataError:  # reading the messages reports the error
        return Recorded()
    except ValidationError as error:
        (first, *_) = error.errors(include_url=False)
        where = ".".join(str(part) for part in first["loc"])
        _logger.warning(
            "%s: the recorded settings are ignored, %s: %s",
            source.path,
            where,
            first["msg"],
        )
        return Recorded()
    track = result.map.track_file
    if track is not None and track != OVAL and not Path(track).is_file():
        _logger.warning(
            "%s: the recorded map %s does not exist, give the map with --map",
            source.path,
            track,
        )
        return replace(result, map=MapConfig())
    return result


def recorded_of(scenario: "Scenario") -> dict[str, Any]:  # Any: plain values
    """Return the settings that a recording of `scenario` carries, as plain values."""
    sensors = {
        item.name: RecordedSensor(
            None if item.mount == Mount() else item.mount,
            item.field_of_view_rad,
            item.max_range_m,
            item.max_range_behind_m,
        )
        for item in scenario.sensors
    }
    return {
        "ego": {"detection_origin_x_m": scenario.detection_origin_x_m},
        "map": {"track": scenario.map},
        "sensors": plain(sensors),
    }
