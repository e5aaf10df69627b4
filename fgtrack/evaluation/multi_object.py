"""All tracks of a run against all true objects."""

from dataclasses import dataclass

from fgtrack.evaluation.clear import Clear
from fgtrack.evaluation.gospa import Gospa, gospa
from fgtrack.evaluation.identity import Frames, Hota, Identity
from fgtrack.evaluation.matching import Matching
from fgtrack.evaluation.options import EvaluationOptions
from fgtrack.evaluation.scenes import scenes
from fgtrack.io.run import Run


@dataclass(frozen=True)
class MultiObjectMetrics:
    """Scores over the ticks at which truth is recorded."""

    gospa: Gospa
    clear: Clear
    identity: Identity
    hota: Hota


def multi_object_metrics(run: Run, matching: Matching | None, options: EvaluationOptions) -> MultiObjectMetrics | None:
    """Scores of the judged rows of `run`; None without truth, and where `options` do not ask for them."""
    if matching is None or not options.multi_object:
        return None
    there = scenes(run, matching)
    c_m = options.gate_m if options.gospa_c_m is None else options.gospa_c_m
    frames = Frames.of(there, options.gate_m)
    return MultiObjectMetrics(
        Gospa.of(gospa(there, c_m), c_m), Clear.of(there, options.gate_m), Identity.of(frames), Hota.of(frames)
    )
