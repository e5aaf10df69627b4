"""Scores of the outputs of a run: the present, states of some time ago, and final states."""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from fgtrack import NS_PER_S, FloatArray, IntArray, Run
from fgtrack.evaluation import (
    Columns,
    clear,
    evaluation_settings,
    match,
    scenes,
    t_gospa,
)

PRESENT, FINAL = "present", "final"
NEAR_M = 0.05
"""Two final states within this distance are the same."""


class Scores(NamedTuple):
    """Scores of one output."""

    mota: float
    switches: int
    rmse_m: float
    t_gospa_m: float


def outputs(run: Run) -> Iterator[tuple[str, Run]]:
    """Yield each output by name, as a run whose table `tracks` has its states."""
    yield PRESENT, run
    lagged = run.tables["lagged"]
    for lag_s in np.unique(lagged["lag_s"]).tolist():
        if lag_s > 0.0:
            yield (
                f"{lag_s:g} s ago",
                _lagged(run, lagged.where(lagged["lag_s"] == lag_s), lag_s),
            )
    if (run.tables["smoothed"]["kind"] == "final").any():
        yield FINAL, _final(run)


def scores(run: Run) -> Scores:
    """Return the scores of the confirmed states in the table `tracks`; NaN without truth."""
    matching = match(run)
    if matching is None:
        return Scores(np.nan, 0, np.nan, np.nan)
    there, gate_m = scenes(run, matching), evaluation_settings(run).gate_m
    counts = clear(there, gate_m)
    apart = matching.tracks.where(matching.paired)
    errors_m = np.hypot(
        *(
            apart[name] - matching.true_states[matching.paired, k]
            for k, name in enumerate(("x_m", "y_m"))
        )
    )
    return Scores(
        100.0 * counts["mota"],
        int(counts["id_switches"]),
        float(np.sqrt(np.mean(np.square(errors_m)))) if len(errors_m) else np.nan,
        t_gospa(there, gate_m)["rms_m"],
    )


def final_states(run: Run, confirmed_only: bool = False) -> dict[int, FloatArray]:
    """Return the final positions (m, 2) of all tracks, or of the confirmed ones, by stamp."""
    final = _final_rows(run)
    if confirmed_only:
        final = final.where(np.isin(final["track_id"], _confirmed(run)))
    order = np.argsort(final["stamp_ns"], kind="stable")
    points = np.stack([final["x_m"], final["y_m"]], axis=-1)[order]
    stamps_ns, firsts = np.unique(final["stamp_ns"][order], return_index=True)
    return (
        dict(zip(stamps_ns.tolist(), np.split(points, firsts[1:]), strict=True))
        if len(points)
        else {}
    )


def share(expected: Mapping[int, FloatArray], found: Mapping[int, FloatArray]) -> float:
    """Return the share of `expected` states with a state of `found` at the same stamp, at most 5 cm away."""
    total = equal = 0
    for stamp_ns, points in expected.items():
        total += len(points)
        others = found.get(stamp_ns)
        if others is not None:
            apart_m = np.linalg.norm(points[:, None] - others[None], axis=2)
            equal += int((apart_m.min(axis=1) <= NEAR_M).sum())
    return equal / total if total else np.nan


def _lagged(run: Run, lagged: Columns, lag_s: float) -> Run:
    """Return the run with the states of `lag_s` ago. A state has the status of its track at the same tick."""
    lag_ns = round(lag_s * NS_PER_S)
    tracks, timing = run.tables["tracks"], run.tables["timing"]
    status = dict(
        zip(
            zip(tracks["tick"].tolist(), tracks["track_id"].tolist(), strict=True),
            tracks["status"].tolist(),
            strict=True,
        )
    )
    keys = zip(lagged["tick"].tolist(), lagged["track_id"].tolist(), strict=True)
    columns = {name: lagged[name] for name in lagged if name != "lag_s"}
    columns["status"] = np.array([status.get(key, "tentative") for key in keys])
    columns["now_ns"] = lagged["now_ns"] - lag_ns
    times = Columns({**timing, "now_ns": timing["now_ns"] - lag_ns})
    return run.with_tables(tracks=Columns(columns), timing=times)


def _final_rows(run: Run) -> Columns:
    smoothed = run.tables["smoothed"]
    return smoothed.where(smoothed["kind"] == "final")


def _confirmed(run: Run) -> IntArray:
    """Return the tracks that were confirmed: in the end if late data changes decisions, otherwise at some tick."""
    ended, tracks = run.tables["final_tracks"], run.tables["tracks"]
    if ended.num_rows:
        return ended["track_id"][ended["is_confirmed"] == 1]
    return np.unique(tracks["track_id"][tracks["status"] != "tentative"])


def _final(run: Run) -> Run:
    """Return the run with final states at the times of its ticks, linearly interpolated between two stamps.

    A node without a clock ticks at the receipts, so the stamps of the truth are its times.
    """
    final, timing = _final_rows(run), run.tables["timing"]
    truth_ns = np.unique(run.tables["truth"]["stamp_ns"])
    if (run.config.get("clock") or {}).get("node_hz") is None and len(truth_ns):
        names = {"tick": np.arange(len(truth_ns)), "now_ns": truth_ns}
        nothing_ns = np.zeros(len(truth_ns), dtype=np.int64)
        timing = Columns({**dict.fromkeys(timing, nothing_ns), **names})
    order = np.lexsort((final["stamp_ns"], final["track_id"]))
    final, now_ns = final.where(order), timing["now_ns"]
    parts: list[tuple[IntArray, IntArray, FloatArray]] = []
    for track_id in _confirmed(run).tolist():
        own = final.where(final["track_id"] == track_id)
        stamps_ns = own["stamp_ns"]
        if not len(stamps_ns):
            continue
        rows = np.flatnonzero((now_ns >= stamps_ns[0]) & (now_ns <= stamps_ns[-1]))
        points = np.stack(
            [np.interp(now_ns[rows], stamps_ns, own[name]) for name in ("x_m", "y_m")],
            axis=-1,
        )
        parts.append((rows, np.full(len(rows), track_id), points))
    rows = np.concatenate([part[0] for part in parts] or [np.zeros(0, dtype=np.int64)])
    ids = np.concatenate([part[1] for part in parts] or [np.zeros(0, dtype=np.int64)])
    points = np.concatenate([part[2] for part in parts] or [np.zeros((0, 2))])
    nothing = np.full(len(rows), np.nan)
    columns = {
        "tick": timing["tick"][rows],
        "now_ns": now_ns[rows],
        "stamp_ns": now_ns[rows],
        "track_id": ids,
        "status": np.full(len(rows), "confirmed"),
        "x_m": points[:, 0],
        "y_m": points[:, 1],
        "yaw_rad": nothing,
        "speed_mps": nothing,
    }
    return run.with_tables(tracks=Columns(columns), timing=timing)
