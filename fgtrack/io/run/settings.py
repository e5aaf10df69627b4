"""Keys of the meta.json and config.yaml of a run that are used, and their types; other keys may hold anything."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, Field, ValidationError, create_model

from fgtrack.core.checks import LARGEST
from fgtrack.core.errors import DataError

__all__ = ["CONFIG", "META", "EvaluationConfig", "check_values"]

_Number = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
_Counts = Mapping[str, Mapping[str, int]]


@dataclass(frozen=True)
class EvaluationConfig:
    """Pairing of tracks with true objects, and the metrics that are computed."""

    gate_m: float = 5.0
    """Largest distance of a track from its true object. The default is the tracker's own association distance, a
    car's length (more for ships): a track farther off is not updated by its object any more. It bounds the errors,
    so compare at one gate."""
    confirmed_only: bool = True
    """True to leave out tentative tracks: by counting, those measured less than `lifecycle.confirm_count` times."""
    multi_object: bool = True
    """True to compute GOSPA, CLEAR, IDF1 and HOTA."""

    def __post_init__(self) -> None:
        if not 0.0 < self.gate_m <= LARGEST:
            raise ValueError(f"gate_m: must be positive and at most {LARGEST:g}, is {self.gate_m}")


def _model(**kinds: Any) -> type[BaseModel]:  # Any: types, also generic ones
    """Model of a mapping that may hold these keys with values of these types, and any others."""
    fields: dict[str, Any] = {key: (kind, None) for key, kind in kinds.items()}
    return create_model("Mapping", **fields)


META = _model(
    input=_model(path=str, kind=str),
    effective=_model(lag_key=str, lag_s=_Number) | None,
    estimator=str,
    versions=Mapping[str, str],
    complete=bool,
    digest=str,
    detections_received=int,
    messages_received=int,
    counts=_Counts,
    out_of_bounds=_Counts,
    left_out=_Counts,
    ego_refused=Mapping[str, int],
    ego_jumps=int,
    failures=Mapping[str, int],
    first_failure=str | None,
    broken_off=str | None,
)
_OF_SENSORS: Any = Mapping  # the type checker takes no model that is made by a call
CONFIG = _model(
    sensors=_OF_SENSORS[str, _model(mount=Mapping[str, _Number] | None, max_delay_s=_Number | None) | None] | None,
    ego=_model(detection_origin_x_m=_Number, detection_origin_y_m=_Number) | None,
    map=_model(track=str | None, pit=str | None) | None,
    birth=_model(ego_speed_factor=_Number | None) | None,
    clock=_model(node_hz=Annotated[float, Field(gt=0.0, le=LARGEST)] | None) | None,
    smoother=_model(lag_s=Annotated[float, Field(ge=0.0, le=LARGEST)]) | None,
    input=Mapping[str, Any] | None,
    evaluation=EvaluationConfig | None,
)


def check_values(model: type[BaseModel], value: Any, path: Path) -> None:
    """Raise `DataError` where a value of the file `path` has not the type that a run writes, by `META` or `CONFIG`."""
    try:
        text = json.dumps(value, default=str, skipkeys=True, ensure_ascii=False)
        model.model_validate_json(text.encode("utf-8", "replace"), strict=True)  # names of files need not be UTF-8
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        if first["type"] == "value_error":  # of `EvaluationConfig`, whose message says what is wrong
            raise DataError(f"{path}: {where}: {first['ctx']['error']}") from error
        raise DataError(f"{path}: {where} is not what a run writes there, repeat the run") from error
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path}: is nested without end, repeat the run") from error
