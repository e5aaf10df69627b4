"""What is used of the meta.json and config.yaml of a run, and its type; other keys may hold anything."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, TypeAdapter, ValidationError

from fgtrack.core.checks import LARGEST
from fgtrack.core.errors import DataError

__all__ = ["EvaluationConfig", "check_config", "check_meta"]

_Number = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
_Counts = Mapping[str, Mapping[str, int]]


@dataclass(frozen=True)
class EvaluationConfig:
    """How tracks are paired with true objects, and which metrics are computed."""

    gate_m: float = 5.0
    """Largest distance of a track from its true object. The default is the tracker's own association distance, a
    car's length (more for ships): a track farther off is not updated by its object any more. It bounds the errors,
    so compare at one gate."""
    confirmed_only: bool = True
    """Whether tentative tracks are left out: by counting, those measured less than `lifecycle.confirm_count` times."""
    multi_object: bool = True
    """Whether GOSPA, CLEAR, IDF1 and HOTA are computed."""

    def __post_init__(self) -> None:
        if not 0.0 < self.gate_m <= LARGEST:
            raise ValueError(f"gate_m: must be positive and at most {LARGEST:g}, is {self.gate_m}")


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
    counts: _Counts = field(default_factory=dict)
    out_of_bounds: _Counts = field(default_factory=dict)
    left_out: _Counts = field(default_factory=dict)
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
    birth: Mapping[str, Any] | None = None
    clock: _Clock | None = None
    smoother: _Smoother | None = None
    input: Mapping[str, Any] | None = None
    evaluation: EvaluationConfig | None = None


_META, _CONFIG = TypeAdapter(_Meta), TypeAdapter(_Config)


def check_meta(meta: Any, path: Path) -> None:
    """Raise `DataError` where a value of meta.json at `path` has not the type that a run writes."""
    _check(_META, meta, path)


def check_config(config: Any, path: Path) -> None:
    """Raise `DataError` where a value of config.yaml at `path` has not the type that a run writes."""
    _check(_CONFIG, config, path)


def _check(kind: TypeAdapter[Any], value: Any, path: Path) -> None:
    try:
        text = json.dumps(value, default=str, skipkeys=True, ensure_ascii=False)
        kind.validate_json(text.encode("utf-8", "replace"), strict=True)  # names of files need not be UTF-8
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        if first["type"] == "value_error":  # of `EvaluationConfig`, whose message says what is wrong
            raise DataError(f"{path}: {where}: {first['ctx']['error']}") from error
        raise DataError(f"{path}: {where} is not what a run writes there, repeat the run") from error
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path}: is nested without end, repeat the run") from error
