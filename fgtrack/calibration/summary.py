"""The summary of a study: about five sentences that an engineer can act on."""

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from fgtrack.calibration.page import Advice
from fgtrack.core.time import NS_PER_S
from fgtrack.evaluation.diagnostics import USED, diagnostics
from fgtrack.evaluation.runs import EvaluatedRun
from fgtrack.evaluation.tables import Tables, short

_PERCENT, _MS = 100.0, 1e3
_IMPORTANT = 60.0  # weight of a finding without a setting that has to be dealt with first


def summary(runs: Sequence[EvaluatedRun], tables: Tables, advice: Advice | None) -> tuple[str, ...]:
    """Return sentences: the recording, its tracks, the verdict of the comparison, and what to do."""
    return (_recording(runs[0]), _tracks(runs[0]), *tables.verdict, _to_do(runs, tables, advice))


def _recording(one: EvaluatedRun) -> str:
    updates, now_ns = one.run.tables["updates"], one.run.tables["timing"]["now_ns"]
    length_s = (int(now_ns[-1]) - int(now_ns[0])) / NS_PER_S if len(now_ns) else 0.0
    sensors = []
    for sensor in np.unique(updates["sensor"]).tolist():
        mine = updates["sensor"] == sensor
        delays_s = (updates["receipt_ns"][mine] - updates["stamp_ns"][mine]) / NS_PER_S
        middle_ms, most_ms = _MS * float(np.median(delays_s)), _MS * float(delays_s.max())
        sensors.append(f"{sensor} ({len(delays_s)} detections, {middle_ms:.0f} ms late, at most {most_ms:.0f})")
    fates = updates["disposition"]
    late, used = _percent(fates == "out_of_sequence"), _percent(np.isin(fates, USED))
    many = f"; {late} arrived after newer ones had been fused, {used} were used" if len(fates) else ""
    return f"In {length_s:.0f} s detections came from {' and '.join(sensors) or 'no sensor'}{many}."


def _tracks(one: EvaluatedRun) -> str:
    truth = one.metrics.truth
    if truth is not None:
        of, share = truth.overall, _PERCENT * truth.overall.tracked_share_in_sight
        return (
            f"{one.label} tracks the objects {share:.1f} % of the time that a sensor could see them: "
            f"{_several(of.breaks, 'break')}, {_several(of.id_switches, 'identity switch', 'es')}, "
            f"{_several(truth.false_tracks, 'false track')}."
        )
    tracks = one.run.tables["tracks"]
    confirmed = tracks["status"] != "tentative"
    ids, first = np.unique(tracks["track_id"][confirmed], return_index=True)
    if not len(ids):
        return f"{one.label} confirms no track."
    now_ns = tracks["now_ns"][confirmed]
    last = np.array([now_ns[tracks["track_id"][confirmed] == track].max() for track in ids])
    lives_s = (last - now_ns[first]) / NS_PER_S
    return f"{one.label} confirms {_several(len(ids), 'track')}, half of them for {np.median(lives_s):.1f} s or longer."


def _to_do(runs: Sequence[EvaluatedRun], tables: Tables, advice: Advice | None) -> str:
    """What comes first: a defect of the recording or its settings, else the choice of a method."""
    open_findings = [] if advice is None else [one for one in advice.findings if not one.settings]
    found = [str(one) for one in open_findings if one.weight >= _IMPORTANT] or [
        str(one) for one in diagnostics(runs[0].run)
    ]
    if found:
        return f"First: {found[0]}"
    return f"Take {'; '.join(_choices(tables))}."


def _choices(tables: Tables) -> Iterator[str]:
    """The fastest of the best for the present state, and the best where the output may wait."""
    rows = tables.tables["differences"].records
    ranked = [row for row in rows if row["quantity"] == "position_rmse_m"]
    best = {row["run"] for row in ranked if row["standing"] != "worse"}
    of_runs = tables.tables["tracking"].records
    times = {row["run"]: row["time_per_tick_p50_s"] for row in of_runs}
    fastest = min(best or times, key=lambda run: (times[run], run))
    because = "as accurate as the best" if best else "errors are unknown without truth"
    yield f"{fastest} for the present state ({short(_MS * times[fastest])} ms per tick, {because})"
    lags = tables.tables["lag"].records
    lagged = [row for row in lags if (row["lag_s"] or 0.0) > 0.0 and math.isfinite(row["position_reduction"])]
    if lagged:
        row = lagged[0]
        share = _PERCENT * row["position_reduction"]
        yield f"{row['run']} where the output may wait {row['lag']} s ({share:.0f} % less error than now)"
    elif not best:
        yield "smoother where the output may wait"


def _percent(mask: Any) -> str:  # Any: an array of bool
    return f"{_PERCENT * float(np.mean(mask)):.0f} %" if len(mask) else "none"


def _several(count: int, what: str, ending: str = "s") -> str:
    return f"{count or 'no'} {what}{'' if count == 1 else ending}"
