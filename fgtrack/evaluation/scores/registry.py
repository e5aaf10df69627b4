"""Registry of multi-object metrics by name, plug-ins included."""

import math
from collections.abc import Mapping
from typing import Protocol

from fgtrack.core.checks import is_number
from fgtrack.core.errors import CallError
from fgtrack.core.plugins import Registry
from fgtrack.evaluation.near_pairs import Scenes


class Metric(Protocol):
    """Metric of all tracks against all true objects: a function in the plug-in group `fgtrack.metrics`."""

    def __call__(self, scenes: Scenes, gate_m: float, /) -> Mapping[str, float]:
        """Return the values of the metric by name, with units in the names.

        `gate_m` is the largest distance of a pair.
        """


METRICS = Registry(
    "metric",
    {
        "fgtrack.metrics": {
            "ospa": "fgtrack.evaluation.scores.ospa:ospa",
            "t_gospa": "fgtrack.evaluation.scores.t_gospa:t_gospa",
        }
    },
)


def registered_metrics(scenes: Scenes, gate_m: float) -> dict[str, dict[str, float]]:
    """Return the values of every registered metric, by name of the metric.

    Raises `CallError` for a plug-in that fails, or returns anything but numbers by
    name.
    """
    return {
        name: _values(name, metric, scenes, gate_m)
        for name, metric in METRICS.loaded().items()
    }


def _values(
    name: str, metric: Metric, scenes: Scenes, gate_m: float
) -> dict[str, float]:
    with METRICS.plugin_errors(name, "cannot be computed"):
        values = metric(scenes, gate_m)
    if not isinstance(values, Mapping):
        raise CallError(
            f"metric {name!r}: must return numbers by name, returned a {type(values).__name__}"
        )
    for key, value in values.items():
        if not (isinstance(key, str) and _is_value(value)):
            raise CallError(
                f"metric {name!r}: must return numbers by name, returned {value!r} for {key!r}"
            )
    return {key: float(value) for key, value in values.items()}


def _is_value(value: object) -> bool:
    """True for a number, NaN included."""
    return is_number(value) or (isinstance(value, float) and math.isnan(value))
