"""How a run is evaluated, as its configuration says."""

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

from fgtrack.core.checks import LARGEST

if TYPE_CHECKING:  # reading a run checks its section by `EvaluationConfig`
    from fgtrack.io.run.reader import Run


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
    gospa_c_m: float | None = None
    """Cut-off distance c of GOSPA; null for `gate_m`."""
    late_switch_s: float = 0.5
    """An identity switch within this time after an out-of-sequence update counts as late."""

    @property
    def gospa_cut_off_m(self) -> float:
        """Cut-off distance c of GOSPA, the gate where none is given."""
        return self.gate_m if self.gospa_c_m is None else self.gospa_c_m

    def __post_init__(self) -> None:
        for name in ("gate_m", "gospa_c_m"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value <= LARGEST:
                raise ValueError(f"{name}: must be positive and at most {LARGEST:g}, is {value}")
        if not 0.0 <= self.late_switch_s <= LARGEST:
            raise ValueError(f"late_switch_s: must not be negative, nor above {LARGEST:g}, is {self.late_switch_s}")


def evaluation_config(run: "Run") -> EvaluationConfig:
    """The section `evaluation` of the run's config.yaml; defaults for what it does not say.

    Raises
    ------
    DataError
        config.yaml is not YAML, or a value is of another type or out of range.
    """
    found = run.config.get("evaluation") or {}
    return EvaluationConfig(
        **{entry.name: found[entry.name] for entry in fields(EvaluationConfig) if entry.name in found}
    )
