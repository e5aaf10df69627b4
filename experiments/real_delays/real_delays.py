"""What is compensation of delays worth in recordings that were late by themselves?

    python experiments/real_delays/real_delays.py DATA -o out/real_delays

DATA has the folders of `RECORDINGS`; what is missing is named and left out. Writes `policies.csv`, `horizon.csv` and
`held_out.csv`, and prints identities. The position of a moving object at a moment is judged by a robust quadratic fit
to all its reports around it, before and after, whenever they came, but for the last one that had been received.
"""

import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import typer
from scipy.optimize import linear_sum_assignment

import fgtrack
from fgtrack import (
    Config,
    Detection,
    DetectionList,
    FloatArray,
    Message,
    TrackStatus,
)
from fgtrack.evaluation import paired
from fgtrack.inputs.errors import UntilBreak
from fgtrack.pipeline.build import build_tracker
from fgtrack.pipeline.replay import delivered

POLICIES = (
    "drop",
    "as-current",
    "reorder-buffer",
    "ekf-backward-forward",
    "ekf-replay",
    "smoother-banded",
)
LAGS_S = 0.0, 1.0, 3.0
HORIZONS_S = 0.5, 2.0, 10.0, 30.0, 60.0
S = 10**9
BLOCK_S, RESAMPLES, MOMENTS, FEWEST, SLOWEST_MPS = 20.0, 1000, 600, 6, 1.0


@dataclass(frozen=True)
class Recording:
    """A recording, its shipped configuration, and how it is judged."""

    path: str
    config: str
    half_s: float
    """Half of the time of the reports that a fit is made to."""
    longest_s: float = np.inf
    settings: Mapping[str, object] = field(default_factory=dict)


AIRPORT = {
    "input.asterix.stations": {
        7: {"latitude_deg": 41.29561833, "longitude_deg": 2.095114167},
        107: {"latitude_deg": 41.29706278, "longitude_deg": 2.07844722},
    }
}
RECORDINGS = {
    "many receivers, one aircraft": Recording("jal516", "adsb", 6.0, 600.0),
    "one station, 74 aircraft": Recording("adsb_alicante", "adsb", 15.0, 300.0),
    "airport, RADAR and multilateration": Recording(
        "lebl_2020", "airport", 5.0, 600.0, AIRPORT
    ),
    "car over 5G": Recording("cicv5g/rural_south_n8_v10_04.txt.gz", "v2x", 0.5),
    "ships": Recording("ais_merrimac/gofree-merrimac.log", "ais", 30.0),
}
CAR = "cicv5g/rural_south_n8_v10_01.txt.gz"


class Judge:
    """Positions of objects by all their reports, of each message of an object once, with its earliest stamp."""

    def __init__(self, messages: Sequence[Message], half_s: float) -> None:
        reports: dict[str, dict[tuple[float, float, int], tuple[float, float]]] = (
            defaultdict(dict)
        )
        for message in messages:
            for item in message.objects if isinstance(message, DetectionList) else ():
                stamp_s, receipt_s = message.stamp_ns / S, message.receipt_ns / S
                if abs(receipt_s - stamp_s) > 60.0:
                    continue
                name = item.id or ("" if message.sensor == "reports" else None)
                if name is not None:
                    key = item.x_m, item.y_m, round(stamp_s / 60.0)
                    known = reports[name].get(key, (stamp_s, receipt_s))
                    reports[name][key] = (
                        min(known[0], stamp_s),
                        min(known[1], receipt_s),
                    )
        self.half_s = half_s
        self.position_m = cache(self._position_m)  # the same for all policies
        self.reports = {
            name: np.array(
                [
                    (stamp, receipt, *key[:2])
                    for key, (stamp, receipt) in sorted(own.items(), key=lambda i: i[1])
                ]
            )
            for name, own in reports.items()
        }

    def _position_m(self, name: str, at_s: float, now_s: float) -> FloatArray | None:
        """Position of an object, shape (2,); None with too few reports around it, and where it stands."""
        own = self.reports[name]
        near = own[
            slice(*np.searchsorted(own[:, 0], [at_s - self.half_s, at_s + self.half_s]))
        ]
        received = np.flatnonzero(near[:, 1] <= now_s)
        if len(received):
            near = np.delete(near, received[np.argmax(near[received, 1])], axis=0)
        t = near[:, 0] - at_s
        if len(t) < FEWEST or min((t < 0).sum(), (t > 0).sum()) < 2:
            return None
        A, weights = np.stack([np.ones_like(t), t, t * t], axis=1), np.ones(len(t))
        for _ in range(10):
            root = np.sqrt(weights)[:, None]
            fit = np.linalg.lstsq(A * root, near[:, 2:] * root, rcond=None)[0]
            off = np.hypot(*(near[:, 2:] - A @ fit).T)
            weights = 1.0 / np.maximum(
                off / max(1.2 * float(np.median(off)), 0.01), 1.0
            )
        return np.asarray(fit[0]) if np.hypot(*fit[1]) >= SLOWEST_MPS else None


def read(recording: Recording, data: Path) -> tuple[list[Message], Config]:
    config = Config.from_yaml(recording.config).replace(recording.settings)
    draft = fgtrack.draft(data / recording.path, config)
    messages: list[Message] = []
    for message in UntilBreak(draft.source.messages()):
        if isinstance(message, DetectionList):
            if (
                messages
                and message.receipt_ns - messages[0].receipt_ns
                > recording.longest_s * S
            ):
                break
            messages.append(message)
    return messages, draft.config


def track(
    messages: Sequence[Message], config: Config, judge: Judge, moments: set[int]
) -> Iterator[dict[str, object]]:
    """Yield a row per moment, object and lag: error of its oldest published track, and how many it has."""
    tracker = build_tracker(config)
    begin, end = {}, {}
    for name, own in judge.reports.items():
        begin[name], end[name] = own[:, 1].min(), own[:, 0].max()
    for tick in delivered(iter(messages), config):
        for message in tick.messages:
            tracker.receive(message)
        report = tracker.tick(tick.now_ns)
        if tick.now_ns not in moments:
            continue
        now_s = tick.now_ns / S
        named = defaultdict(list)
        for each in report.tracks:
            if each.status is not TrackStatus.TENTATIVE:
                named[
                    ""
                    if each.object is None or each.object.id is None
                    else each.object.id
                ].append(each.track_id)
        for lag_s in LAGS_S:
            at = {
                each.track_id: each.state
                for each in tracker.tracks_at(round((now_s - lag_s) * S))
            }
            for name in judge.reports:
                if not begin[name] + 10.0 < now_s < end[name]:
                    continue
                truth = judge.position_m(name, now_s - lag_s, now_s)
                if truth is None:
                    continue
                ids = [i for i in named.get(name, []) if i in at]
                errors = [float(np.hypot(*(at[i].mean[:2] - truth))) for i in ids[:1]]
                row = {
                    "object": name,
                    "now_s": now_s,
                    "lag_s": lag_s,
                    "num_tracks": len(ids),
                }
                yield {**row, "error_m": errors[0] if errors else np.nan}


def ticks_of(messages: Sequence[Message], config: Config) -> set[int]:
    """Moments that are judged: ticks of the recording at equal steps."""
    step_ns = round(S / float(config.clock.node_hz or 1.0))
    first, last = (-(-messages[k].receipt_ns // step_ns) for k in (0, -1))
    return {
        int(k) * step_ns
        for k in np.unique(np.linspace(first, last, MOMENTS).astype(np.int64))
    }


def interval(values: FloatArray, blocks: FloatArray) -> tuple[float, float, float]:
    """Median, and its 95 % interval by resampling blocks of time."""
    if not len(values):
        return np.nan, np.nan, np.nan
    rng, parts = (
        np.random.default_rng(0),
        [values[blocks == block] for block in np.unique(blocks)],
    )
    draws = [
        np.median(
            np.concatenate(
                [parts[k] for k in rng.integers(len(parts), size=len(parts))]
            )
        )
        for _ in range(RESAMPLES)
    ]
    low, high = np.quantile(draws, [0.025, 0.975])
    return float(np.median(values)), float(low), float(high)


def summary(
    rows: pd.DataFrame, dropped: pd.DataFrame, cpu_s: float
) -> dict[str, object]:
    result: dict[str, object] = {}
    both = rows.merge(dropped, on=["object", "now_s", "lag_s"], suffixes=("", "_drop"))
    for lag_s in LAGS_S:
        own = rows[(rows["lag_s"] == lag_s) & rows["error_m"].notna()]
        middle = interval(
            own["error_m"].to_numpy(), (own["now_s"] // BLOCK_S).to_numpy()
        )
        (
            result[f"error_{lag_s:g}s_m"],
            result[f"low_{lag_s:g}s_m"],
            result[f"high_{lag_s:g}s_m"],
        ) = middle
    now = both[
        (both["lag_s"] == 0.0) & both["error_m"].notna() & both["error_m_drop"].notna()
    ]
    gain = (now["error_m_drop"] - now["error_m"]).to_numpy()
    result["less_than_drop_m"], result["less_low_m"], result["less_high_m"] = interval(
        gain, (now["now_s"] // BLOCK_S).to_numpy()
    )
    present = rows[rows["lag_s"] == 0.0]
    result["p95_m"] = float(present["error_m"].quantile(0.95))
    result["gaps"] = float(present["error_m"].isna().mean())
    result["extra_tracks"] = float((present["num_tracks"] - 1).clip(lower=0).mean())
    return {**result, "moments": len(present), "cpu_s": cpu_s}


def policies(
    name: str, recording: Recording, data: Path
) -> Iterator[dict[str, object]]:
    messages, config = read(recording, data)
    judge, moments = Judge(messages, recording.half_s), ticks_of(messages, config)
    dropped = pd.DataFrame()
    for policy in POLICIES:
        began_s = time.process_time()
        rows = pd.DataFrame(
            track(messages, replace(config, estimator=policy), judge, moments)
        )
        dropped = rows if policy == "drop" else dropped
        row = {
            "recording": name,
            "policy": policy,
            **summary(rows, dropped, time.process_time() - began_s),
        }
        print(
            {
                key: round(value, 3) if isinstance(value, float) else value
                for key, value in row.items()
            },
            flush=True,
        )
        yield row


def horizon(data: Path) -> Iterator[dict[str, object]]:
    """Windows of a filter for a car whose reports come in bursts."""
    for horizon_s in HORIZONS_S:
        settings = {"filter.storage_s": horizon_s}
        messages, config = read(Recording(CAR, "v2x", 0.5, settings=settings), data)
        run = fgtrack.replay(data / CAR, config)
        counts = dict(
            zip(
                *np.unique(run.tables["updates"]["disposition"], return_counts=True),
                strict=True,
            )
        )
        rows = pd.DataFrame(
            track(messages, config, Judge(messages, 0.5), ticks_of(messages, config))
        )
        quantiles = {
            f"error_{lag_s:g}s_m": rows["error_m"][rows["lag_s"] == lag_s].median()
            for lag_s in LAGS_S
        }
        yield {
            "horizon_s": horizon_s,
            "received": len(messages),
            **quantiles,
            **{k: int(v) for k, v in counts.items()},
        }


def held_out(data: Path) -> Iterator[dict[str, object]]:
    """Reports of multilateration that the tracker did not get, and its tracks of their addresses at their stamps."""
    messages, config = read(
        replace(RECORDINGS["airport, RADAR and multilateration"], longest_s=600.0), data
    )
    rng, kept, hidden = np.random.default_rng(1), list[Message](), list[DetectionList]()
    for message in messages:
        assert isinstance(message, DetectionList)
        (hidden if message.sensor == "mlat" and rng.random() < 0.5 else kept).append(
            message
        )
    tracker, hidden = build_tracker(config), hidden[::-1]
    for tick in delivered(iter(kept), config):
        for message in tick.messages:
            tracker.receive(message)
        report = tracker.tick(tick.now_ns)
        names = {
            each.track_id: each.object.id
            for each in report.tracks
            if each.object is not None
        }
        while hidden and hidden[-1].stamp_ns <= tick.now_ns:
            message = hidden.pop()
            tracks = tracker.tracks_at(message.stamp_ns)
            for item in message.objects:
                own = [
                    each.state for each in tracks if names.get(each.track_id) == item.id
                ]
                off_m = [
                    float(np.hypot(each.mean[0] - item.x_m, each.mean[1] - item.y_m))
                    for each in own
                ]
                yield {
                    "now_s": tick.now_ns / S,
                    "object": item.id,
                    "error_m": min(off_m, default=np.nan),
                }


def identities(data: Path) -> Iterator[dict[str, object]]:
    """Aircraft with 10 reports or more, how many are tracked for over 95 % of their time, switches, and IDF1."""
    messages, config = read(
        replace(RECORDINGS["one station, 74 aircraft"], longest_s=np.inf), data
    )
    lists = [each for each in messages if isinstance(each, DetectionList)]
    nameless = [
        replace(each, objects=[replace(item, id=None) for item in each.objects])
        for each in lists
    ]
    names = {
        (each.stamp_ns, each.receipt_ns, k): item.id or ""
        for each in lists
        for k, item in enumerate(each.objects)
    }
    for kind, own in (("with addresses", lists), ("without", nameless)):
        tables = fgtrack.replay(own, config).tables
        updates, tracks = tables["updates"], tables["tracks"]
        keys = zip(
            *(updates[name].tolist() for name in ("stamp_ns", "receipt_ns", "index")),
            strict=True,
        )
        rows = pd.DataFrame(
            {
                "name": [names[key] for key in keys],
                "track": updates["track_id"],
                "at": updates["stamp_ns"],
            }
        )
        matched = rows[rows["track"] >= 0]
        counts = pd.crosstab(matched["name"], matched["track"]).to_numpy()
        idtp = counts[linear_sum_assignment(counts, maximize=True)].sum()
        published, ticks = tracks["status"] != "tentative", np.unique(tracks["now_ns"])
        switches, shares = 0, list[float]()
        for name, reports in rows.groupby("name"):
            if len(reports) < 10:
                continue
            ids = matched[matched["name"] == name].sort_values("at")["track"].to_numpy()
            switches += int((ids[1:] != ids[:-1]).sum())
            life = ticks[
                (ticks >= reports["at"].min()) & (ticks <= reports["at"].max())
            ]
            shares.append(
                float(
                    np.isin(
                        life,
                        tracks["now_ns"][published & np.isin(tracks["track_id"], ids)],
                    ).mean()
                )
            )
        idf1 = 2.0 * idtp / (len(rows) + len(matched))
        yield {
            "identities": kind,
            "aircraft": len(shares),
            "tracked": int((np.array(shares) > 0.95).sum()),
            "switches": switches,
            "idf1": idf1,
        }


def along_across(data: Path) -> tuple[tuple[float, float, float], float]:
    """Spread of the stamps of one aircraft [s] with its interval, by errors along its motion, and errors across [m]."""
    recording = RECORDINGS["many receivers, one aircraft"]
    judge = Judge(read(recording, data)[0], recording.half_s)
    name = max(judge.reports, key=lambda each: len(judge.reports[each]))
    late_s, across_m, blocks = list[float](), list[float](), list[float]()
    for stamp_s, _, *z in judge.reports[name].tolist():
        at = [
            judge.position_m(name, stamp_s + shift_s, -np.inf)
            for shift_s in (-0.5, 0.0, 0.5)
        ]
        if at[0] is not None and at[1] is not None and at[2] is not None:
            v, off_m = at[2] - at[0], np.array(z) - at[1]
            late_s.append(1.4826 * abs(float(v @ off_m)) / float(v @ v))
            across_m.append(
                abs(float(v[0] * off_m[1] - v[1] * off_m[0])) / float(np.hypot(*v))
            )
            blocks.append(stamp_s // BLOCK_S)
    return interval(np.array(late_s), np.array(blocks)), 1.4826 * float(
        np.median(across_m)
    )


def simulated(seed: int) -> Iterator[dict[str, object]]:
    """One aircraft of 250 m/s: stamps err by 0.35 s times Student's t (3), delays are 0.56 s in the median."""
    rng = np.random.default_rng(seed)
    sent_s = np.arange(400.0) + rng.uniform(size=400)
    stamps_s = sent_s + 0.35 * rng.standard_t(3, size=400)
    receipts_s = np.maximum(
        sent_s + rng.lognormal(np.log(0.56), 1.16, size=400), stamps_s
    )

    def truth_m(t_s: FloatArray) -> FloatArray:
        return np.stack([250.0 * t_s, 2000.0 * np.sin(t_s / 40.0)], axis=-1)

    z = truth_m(sent_s) + rng.normal(scale=10.0, size=(400, 2))
    messages = [
        DetectionList(
            "adsb",
            round(a * S),
            round(b * S),
            (Detection(x, y, id="A"),),
            "map",
            origin_deg=(40.0, 0.0),
        )
        for b, a, (x, y) in sorted(
            zip(receipts_s.tolist(), stamps_s.tolist(), z.tolist(), strict=True)
        )
    ]
    for std_s, robust in ((0.0, False), (0.5, False), (0.0, True), (0.5, True)):
        for policy in ("drop", "ekf-replay", "smoother-banded"):
            settings = {
                "estimator": policy,
                "sensors.adsb.stamp_std_s": std_s,
                **({} if robust else {"sensors.adsb.loss": None}),
                "sensors.adsb.std": {"x_m": 10.0, "y_m": 10.0},
            }
            run = fgtrack.replay(messages, Config.from_yaml("adsb").replace(settings))
            now_s = run.tables["tracks"]["now_ns"] / S
            own = (now_s > 30.0) & (now_s < 390.0)
            at = np.stack(
                [run.tables["tracks"][name] for name in ("x_m", "y_m")], axis=-1
            )
            off_m = np.hypot(*(at - truth_m(now_s)).T)[own]
            squares = {
                "median_m": float(np.median(off_m)),
                "p95_m": float(np.quantile(off_m, 0.95)),
            }
            yield {
                "seed": seed,
                "policy": policy,
                "stamp_std_s": std_s,
                "robust": robust,
                **squares,
            }


def main(
    data: Annotated[Path, typer.Argument(help="folder of the recordings")],
    out: Annotated[Path, typer.Option("-o")] = Path("out/real_delays"),
    only: Annotated[str, typer.Option(help="part of a recording's name")] = "",
) -> None:
    out.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, object]] = []
    for name, recording in RECORDINGS.items():
        if only not in name:
            continue
        if not (data / recording.path).exists():
            print(f"left out: {data / recording.path} is missing")
            continue
        rows += policies(name, recording, data)
        pd.DataFrame(rows).to_csv(out / "policies.csv", index=False)
    if only in "one station" and (data / "adsb_alicante").exists():
        print(*identities(data), sep="\n")
    if only in "many receivers" and (data / "jal516").exists():
        print("spread of stamps [s], errors across [m]:", along_across(data))
    if only in "simulated":
        table = pd.DataFrame(row for seed in range(10) for row in simulated(seed))
        table.to_csv(out / "simulated.csv", index=False)
        for how, own in table.groupby(["stamp_std_s", "robust"]):
            errors_m = own.pivot(index="seed", columns="policy", values="median_m")
            print(
                how,
                errors_m.mean().to_dict(),
                paired(errors_m["ekf-replay"].tolist(), errors_m["drop"].tolist()),
            )
    if not only and (data / CAR).exists():
        pd.DataFrame(horizon(data)).to_csv(out / "horizon.csv", index=False)
    if not only and (data / "lebl_2020").exists():
        tracks = pd.DataFrame(held_out(data))
        tracks.to_csv(out / "held_out.csv", index=False)
        middle = interval(
            tracks["error_m"].dropna().to_numpy(),
            (tracks["now_s"] // BLOCK_S)[tracks["error_m"].notna()].to_numpy(),
        )
        print(
            "held out:",
            len(tracks),
            "median, interval",
            middle,
            "without track",
            tracks["error_m"].isna().mean(),
        )
        print(
            "median of addresses", tracks.groupby("object")["error_m"].median().median()
        )


if __name__ == "__main__":
    typer.run(main)
