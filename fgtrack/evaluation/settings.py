"""Settings of the evaluation of a run."""

from dataclasses import dataclass

from pydantic import TypeAdapter, ValidationError

from fgtrack.core.checks import LARGEST
from fgtrack.core.errors import DataError
from fgtrack.runs import Run


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
            raise ValueError(
                f"gate_m: must be positive and at most {LARGEST:g}, is {self.gate_m}"
            )


def evaluation_settings(run: Run) -> EvaluationConfig:
    """Return the section `evaluation` of the configuration of `run`, with defaults.

    Raises `DataError` for an invalid value, and as `Run.config`.
    """
    try:
        return TypeAdapter(EvaluationConfig).validate_python(
            run.config.get("evaluation") or {}
        )
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, ("evaluation", *first["loc"])))
        raise DataError(f"{run.config_path}: {where}: {first['msg']}") from error
