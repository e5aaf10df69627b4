"""Results of methods with several objects: metrics, sentences, ranks and tables."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fgtrack.core.types import FloatArray
from fgtrack.evaluation.intervals import average
from fgtrack.evaluation.near_pairs import Scenes
from fgtrack.evaluation.scores.multi_object import multi_object_metrics
from fgtrack.evaluation.scores.t_gospa import t_gospa
from fgtrack.evaluation.tables import Column, Table
from fgtrack.ranking.crowds import CROWD_LAGS_S, CROWDS, CrowdProblem, Positions
from fgtrack.ranking.ranks import WithInterval, interval, positive, ranked

_PARTS = ("localisation_m2", "missed_m2", "false_m2", "switches_m2")
_MS = 1e3


@dataclass(frozen=True)
class CrowdResult:
    """Tracks of a method in a scenario of several objects, compared with the truth."""

    method: str
    scenario: str
    t_gospa_m: FloatArray
    """T-GOSPA by run and lag, shape (runs, lags)."""
    parts_m2: FloatArray
    """Squared parts of the present T-GOSPA by run: localisation, missed, false, switches; shape (runs, 4)."""
    idf1: FloatArray
    """IDF1 of the present tracks by run, shape (runs,)."""
    switches: FloatArray
    """Number of identity switches by run, shape (runs,)."""
    seconds: float
    """Time for one scan."""
    problem: str | None = None
    """Reason why the method has no tracks; None if it has."""
    takes_part: bool = True
    """False if the method is not made for the scenario."""

    @classmethod
    def without_tracks(
        cls, method: str, scenario: str, problem: str, takes_part: bool = True
    ) -> "CrowdResult":
        """Return the result of a method that has no tracks."""
        empty = np.zeros((0, len(CROWD_LAGS_S)))
        parts = np.zeros((0, len(_PARTS)))
        return cls(
            method,
            scenario,
            empty,
            parts,
            np.zeros(0),
            np.zeros(0),
            math.nan,
            problem,
            takes_part,
        )

    @classmethod
    def of(
        cls,
        method: str,
        scenario: str,
        problems: Sequence[CrowdProblem],
        found: Sequence[Sequence[Positions]],
        seconds: float,
    ) -> "CrowdResult":
        """Return the result of tracks: for each problem the positions at its queries."""
        gate_m = CROWDS[scenario].gate_m
        rms_m, parts, idf1, switches = [], [], [], []
        for problem, positions in zip(problems, found, strict=True):
            scenes = [_scenes(problem, positions, lag_s) for lag_s in CROWD_LAGS_S]
            scores = [t_gospa(each, gate_m) for each in scenes]
            rms_m.append([each["rms_m"] for each in scores])
            parts.append([scores[0][name] for name in _PARTS])
            metrics = multi_object_metrics(scenes[0], gate_m)
            idf1.append(metrics.identity["idf1"])
            switches.append(metrics.clear["id_switches"])
        return cls(
            method,
            scenario,
            np.array(rms_m),
            np.array(parts),
            np.array(idf1),
            np.array(switches, dtype=np.float64),
            seconds,
        )

    @property
    def error(self) -> FloatArray:
        """Present T-GOSPA by run, which ranks the methods."""
        return self.t_gospa_m[:, 0]

    @property
    def is_complete(self) -> bool:
        """True if the method has tracks; no track is an answer, too."""
        return self.problem is None

    @property
    def sentence(self) -> str:
        """Errors of the tracks in words."""
        if not self.takes_part:
            return f"{self.scenario}: takes no part: {self.problem}"
        if self.problem is not None:
            return f"{self.scenario}: no result: {self.problem}"
        shares = self.parts_m2.mean(axis=0)
        shares = 100.0 * shares / max(float(shares.sum()), 1e-12)
        names = ("localisation", "missed objects", "false tracks", "switches")
        parts = ", ".join(
            f"{name} {share:.0f} %" for name, share in zip(names, shares, strict=True)
        )
        now, past = positive(self.error), average(self.t_gospa_m[:, 1]).mean
        return (
            f"{self.scenario}: T-GOSPA {f'{now:.3g}' if now.is_known else f'{now.mean:.3g}'} m now, "
            f"{past:.3g} m 1 s ago; "
            f"of its square now: {parts}; IDF1 {average(self.idf1).mean:.3g}; "
            f"{average(self.switches).mean:.3g} switches a run"
        )


def _scenes(
    problem: CrowdProblem, positions: Sequence[Positions], lag_s: float
) -> Scenes:
    """Return tracks and truth at the queries with a lag."""
    asked = [n for n, query in enumerate(problem.queries) if query.lag_s == lag_s]
    ids = sorted({object_id for n in asked for object_id in problem.truth[n]})
    true_m = np.full((len(asked), len(ids), 2), np.inf)
    for tick, n in enumerate(asked):
        for object_id, point_m in problem.truth[n].items():
            true_m[tick, ids.index(object_id)] = point_m
    rows = [
        (tick, track_id, *positions[n][track_id].tolist())
        for tick, n in enumerate(asked)
        for track_id in sorted(positions[n])
    ]
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)
    ticks = table[:, 0].astype(np.int64)
    present = np.isfinite(true_m[:, :, 0])
    return Scenes.of(
        ticks,
        table[:, 1].astype(np.int64),
        np.linalg.norm(true_m[ticks] - table[:, None, 2:], axis=-1),
        present,
        present,
    )


def crowd_table(scenario: str, results: Sequence[CrowdResult], num_runs: int) -> Table:
    """Return the table of a scenario, the best method first."""
    notes = [
        f"{CROWDS[scenario].about}; {num_runs} runs; brackets: 95 % intervals over the runs",
        "rank: methods whose T-GOSPA now does not differ significantly from the best one of the rank share it",
        f"T-GOSPA: cut-off distance {CROWDS[scenario].gate_m:g} m; "
        "localisation, missed, false and switches are its squared parts",
        "time: processor time for a scan",
    ]
    records = [{**_record(each), "rank": rank} for each, rank in ranked(results)]
    return Table(scenario, records, _COLUMNS, ("method",), notes)


def _record(result: CrowdResult) -> dict[str, object]:
    if result.problem is not None:
        return {"method": result.method, "problem": result.problem}
    parts = dict(zip(_PARTS, result.parts_m2.mean(axis=0).tolist(), strict=True))
    return {
        "method": result.method,
        **interval("t_gospa", positive(result.error), "_m"),
        "t_gospa_past_m": average(result.t_gospa_m[:, 1]).mean,
        **parts,
        **interval("idf1", average(result.idf1), ""),
        "switches": average(result.switches).mean,
        "seconds": result.seconds,
    }


_COLUMNS = (
    Column("method", left=True),
    Column("rank"),
    WithInterval(
        "T-GOSPA now\n[m]", "t_gospa_m t_gospa_low_m t_gospa_high_m", "{} ({} to {})"
    ),
    Column("1 s ago\n[m]", "t_gospa_past_m"),
    Column("local.\n[m2]", "localisation_m2"),
    Column("missed\n[m2]", "missed_m2"),
    Column("false\n[m2]", "false_m2"),
    Column("switches\n[m2]", "switches_m2"),
    WithInterval("IDF1", "idf1 idf1_low idf1_high", "{} ({} to {})"),
    Column("switches\na run", "switches"),
    Column("time\n[ms]", "seconds", scale=_MS),
)
