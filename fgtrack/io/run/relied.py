"""What is relied on in the meta.json and config.yaml of a run; other keys may hold anything."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, TypeAdapter, ValidationError

from fgtrack.core.checks import LARGEST
from fgtrack.core.errors import DataError
from fgtrack.io.run.judging import EvaluationConfig

__all__ = ["check_config", "check_meta"]

_Number = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]


@dataclass(frozen=True)
class _Input:
    path: str = ""
    kind: str = ""


@dataclass(frozen=True)
class _Effective:
    lag_key: str
    lag_s: _Number


@dataclass(frozen=True)
class _Meta:
    input: _Input = field(default_factory=_Input)
    effective: _Effective | None = None
    estimator: str = ""
    versions: Mapping[str, str] = field(default_factory=dict)
    complete: bool = False
    digest: str = ""
    detections_received: int = 0
    messages_received: int = 0
    counts: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
    out_of_bounds: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
    left_out: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
    ego_refused: Mapping[str, int] = field(default_factory=dict)
    ego_jumps: int = 0
    failures: Mapping[str, int] = field(default_factory=dict)
    first_failure: str | None = None
    broken_off: str | None = None


@dataclass(frozen=True)
class _Sensor:
    mount: Mapping[str, _Number] | None = None
    max_delay_s: _Number | None = None


@dataclass(frozen=True)
class _Ego:
    detection_origin_x_m: _Number = 0.0
    detection_origin_y_m: _Number = 0.0


@dataclass(frozen=True)
class _Map:
    track: str | None = None
    pit: str | None = None
    excluded: Sequence[str] | None = None


@dataclass(frozen=True)
class _Birth:
    ego_speed_factor: _Number | None = None


@dataclass(frozen=True)
class _Clock:
    node_hz: Annotated[float, Field(gt=0.0, le=LARGEST)] | None = None


@dataclass(frozen=True)
class _Smoother:
    lag_s: Annotated[float, Field(ge=0.0, le=LARGEST)] = 0.0


@dataclass(frozen=True)
class _Config:
    sensors: Mapping[str, _Sensor | None] | None = None
    ego: _Ego | None = None
    map: _Map | None = None
    birth: _Birth | None = None
    clock: _Clock | None = None
    smoother: _Smoother | None = None
    input: Mapping[str, Any] | None = None
    evaluation: EvaluationConfig | None = None


_META, _CONFIG = TypeAdapter(_Meta), TypeAdapter(_Config)


def check_meta(meta: Any, path: Path) -> None:
    """Raise `DataError` where a value of meta.json at `path` is of another kind than what a run writes."""
    _check(_META, meta, path)


def check_config(config: Any, path: Path) -> None:
    """Raise `DataError` where a value of config.yaml at `path` is of another kind than what a run writes."""
    _check(_CONFIG, config, path)


def _check(kind: TypeAdapter[Any], value: Any, path: Path) -> None:
    try:
        text = json.dumps(value, default=str, skipkeys=True, ensure_ascii=False)
        kind.validate_json(text.encode("utf-8", "replace"), strict=True)  # names of files need not be UTF-8
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        if first["type"] == "value_error":  # of a rule that says what is wrong
            raise DataError(f"{path}: {where}: {first['ctx']['error']}") from error
        raise DataError(f"{path}: {where} is not what a run writes there, repeat the run") from error
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path}: is nested without end, repeat the run") from error
