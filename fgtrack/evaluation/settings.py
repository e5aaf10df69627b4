"""Settings of the evaluation of a run."""

from dataclasses import dataclass

from pydantic import TypeAdapter, ValidationError

from fgtrack.core.checks import LARGEST
from fgtrack.core.errors import DataError
from fgtrack.runs import Run


@dataclass(frozen=True)
class EvaluationConfig:
    """Settings of the matching of tracks with true objects, and of the metrics."""

    gate_m: float = 5.0
    """Largest distance between a track and its true object.

    The default is the tracker's own association distance, a car's length (more for
    ships). A track farther away gets no detections of this object. The gate limits the
    errors, so compare runs with equal gates.
    """
    confirmed_only: bool = True
    """True to exclude tentative tracks: with counting, those with fewer than `lifecycle.confirm_count` detections."""
    multi_object: bool = True
    """True to compute GOSPA, CLEAR, IDF1 and HOTA."""

    def __post_init__(self) -> None:
        if not 0.0 < self.gate_m <= LARGEST:
            raise ValueError(
                f"gate_m: must be positive and at most {LARGEST:g}, is {self.gate_m}"
            )


def evaluation_settings(run: Run) -> EvaluationConfig:
    """Return the section `evaluation` of the configuration of `run`, with defaults.

    Raises `DataError` for an invalid value, and like `Run.config`.
    """
    try:
        return TypeAdapter(EvaluationConfig).validate_python(
            run.config.get("evaluation") or {}
        )
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, ("evaluation", *first["loc"])))
        raise DataError(f"{run.config_path}: {where}: {first['msg']}") from error
