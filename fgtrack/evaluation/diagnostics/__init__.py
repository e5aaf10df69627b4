"""Diagnostics of a run: what was received, what became of the detections, noise, tracks."""

from fgtrack.core.diagnostic import Diagnostic
from fgtrack.evaluation.diagnostics.ego import ego_diagnostics, map_diagnostics
from fgtrack.evaluation.diagnostics.noise import (
    CORRELATED,
    FAR_OFF,
    FEWEST,
    inconsistent_sensors,
    is_far_off,
    noise_diagnostics,
)
from fgtrack.evaluation.diagnostics.outcomes import (
    FAILED_SHARE,
    USED,
    excluded_lines,
    failed_diagnostics,
    failed_shares,
    late_diagnostics,
    unused,
    unused_diagnostics,
)
from fgtrack.evaluation.diagnostics.reception import (
    angles,
    mapped_nothing,
    received_nothing,
    repeated,
    silences,
)
from fgtrack.evaluation.diagnostics.tracks import (
    DEAD_SHARE,
    MOST_BREAKS_PER_MINUTE,
    failures,
    fragmentation,
    identities,
    lifetimes_and_breaks,
    yaws,
)
from fgtrack.runs import Run

__all__ = [
    "CORRELATED",
    "DEAD_SHARE",
    "FAILED_SHARE",
    "FAR_OFF",
    "FEWEST",
    "MOST_BREAKS_PER_MINUTE",
    "USED",
    "diagnostics",
    "excluded_lines",
    "failed_shares",
    "inconsistent_sensors",
    "is_far_off",
    "lifetimes_and_breaks",
    "noise_diagnostics",
    "received_nothing",
    "repeated",
    "unused",
]

_KINDS = (
    mapped_nothing,
    silences,
    angles,
    ego_diagnostics,
    map_diagnostics,
    unused_diagnostics,
    failed_diagnostics,
    late_diagnostics,
    failures,
    fragmentation,
    identities,
    yaws,
)


def diagnostics(run: Run) -> list[Diagnostic]:
    """Return the defects of `run` that its files show.

    A repeated recording is returned alone, because it causes other defects.
    """
    loop = repeated(run)
    if loop is not None:
        return [loop]
    return [diagnostic for kind in _KINDS for diagnostic in kind(run)]
