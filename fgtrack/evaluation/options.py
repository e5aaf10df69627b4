"""How a run is judged."""

from dataclasses import dataclass, replace
from typing import Any

from fgtrack.evaluation.matching import MatchOptions, run_options
from fgtrack.evaluation.run_config import section
from fgtrack.io.run import Run


@dataclass(frozen=True)
class EvaluationOptions(MatchOptions):
    """How tracks are paired to true objects, and what is asked of them."""

    multi_object: bool = True
    """Whether GOSPA, CLEAR, IDF1 and HOTA are computed."""
    gospa_c_m: float | None = None
    """Cut-off distance c of GOSPA; None for `gate_m`."""
    late_switch_s: float = 0.5
    """An identity switch within this time after an out-of-sequence update counts as late."""


def evaluation_options(run: Run) -> EvaluationOptions:
    """The options that the run's configuration asks for, else the defaults."""
    asked = section(run, "evaluation")
    options = EvaluationOptions(gate_m=run_options(run).gate_m)
    names = ("multi_object", "gospa_c_m", "late_switch_s")
    changes: dict[str, Any] = {name: asked[name] for name in names if asked.get(name) is not None}  # values of YAML
    return replace(options, **changes)
