"""The ledger of lateness: how much of the error of the present comes from what.

Every row is a replay of one association. Parts are differences of mean squares of the position error at the same
ticks and tracks, so they add up to the difference of their ends.
"""

import itertools
import math
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from fgtrack.advice.paired_replay import REPLAY, PairedReplay, at_stamp
from fgtrack.config.reading import ConfigLike, read_config
from fgtrack.config.settings import Config
from fgtrack.core.errors import DataError
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import BoolArray, FloatArray, Message
from fgtrack.evaluation.intervals import UNKNOWN, Estimate, within_run
from fgtrack.evaluation.tables import NO_VALUE, Column, Table, Tables, Value, short
from fgtrack.inputs.source import open_input
from fgtrack.noise.measurements import BankCall
from fgtrack.pipeline.assumptions.assumed import assumed, source_of
from fgtrack.pipeline.replay import replay_in_memory
from fgtrack.runs import load_run

SMOOTHER, PUBLISHED, FORGET = "smoother-banded", "ekf-backward-forward", "rewind-forget"
POLICIES = ("drop", "as-current", PUBLISHED, FORGET, REPLAY, SMOOTHER)
"""Estimators that the ledger compares."""
WAITS_S = (0.0, 0.1, 0.3, 1.0)
"""Ages of the states that are compared: what waiting gives."""
SUMMARY_S = 60.0
"""A summary is of the beginning of a recording, so long."""
_WAITED = 2  # index of the wait of the summary
_IN_TIME = f"{REPLAY}, if no list were late"
_DECISIONS = "association unlike that of ekf-replay"
Squares = Sequence[FloatArray]
"""Squared errors of the states of so long ago."""


@dataclass(frozen=True)
class Part:
    """One line of the waterfall."""

    cause: str
    mean_square_m2: float
    """What is left when it and all before it are taken away."""
    share_m2: Estimate
    """By how much it raises the mean square."""


@dataclass(frozen=True)
class Ledger:
    """Where the error of the present comes from; `str` gives the tables."""

    estimator: str
    with_truth: bool
    """False where predicted variances stand for errors, which the recording does not contain."""
    waterfall: tuple[Part, ...]
    """From the error of the run to that without lateness; the first has no share."""
    tables: Tables = field(repr=False)
    sentence: str

    def __str__(self) -> str:
        return f"{self.tables}\n\n{self.sentence}"


def ledger(
    recording: str | Path | Iterable[Message],
    config: ConfigLike | None = None,
    tuned: ConfigLike | None = None,
    *,
    map: str | Path | None = None,  # noqa: A002 - the name of the option
    pit_map: str | Path | None = None,
    set: Sequence[str] | Mapping[str, object] | None = None,  # noqa: A002 - the name of the option
) -> Ledger:
    """Return the ledger of a recording, given as a path or as its messages.

    A run folder stands for its recording and configuration. `config`, `map`, `pit_map` and `set` are as for
    `fgtrack.replay`; the estimator is the one whose error is explained. Of `tuned`, a configuration as `fgtrack tune`
    and `advise --tune` write it, noise and clock offsets are taken, and the ledger has a line for each that differs.
    Without truth predicted variances stand for errors. Raises `DataError` where nothing can be judged.
    """
    settings = read_config(config, set, track_map=map, pit_map=pit_map)
    if isinstance(recording, str | Path):
        path = Path(recording)
        if (path / "meta.json").is_file():
            run = load_run(path)
            if config is None:
                settings = read_config(
                    str(run.config_path), set, track_map=map, pit_map=pit_map
                )
            path = Path((run.meta.get("input") or {}).get("path") or path)
            if not path.exists() or path == Path(recording):
                raise DataError(
                    f"{recording}: its recording is not at {path}, give the recording with -c {run.config_path}"
                )
        recording = open_input(path, settings.input).messages()
    messages = list(recording)
    settings = assumed(settings, source_of(lambda: messages)).config
    fitted = settings if tuned is None else read_config(tuned)
    corrected = _with_sensors(settings, fitted, "clock_offset_s")
    replays = PairedReplay.of(messages, corrected)
    best = replace(_with_sensors(corrected, fitted, "std"), motion=fitted.motion)
    runs = {"": settings} | (
        {} if corrected == settings else {"clock offsets": corrected}
    )
    if replays.objects is None:
        return _explained(replays, best=best, runs={})
    published = {
        cause: replays.published(replay_in_memory(messages, each))
        for cause, each in runs.items()
    }
    return _explained(replays, best=best, runs=published)


def _with_sensors(config: Config, tuned: Config, name: str) -> Config:
    """Return `config` with the settings `name` of the sensors of `tuned`."""
    own = tuned.sensors
    sensors = {
        key: replace(sensor, **{name: getattr(own[key], name)})
        if key in own
        else sensor
        for key, sensor in config.sensors.items()
    }
    return replace(config, sensors=sensors)


def summary(replays: PairedReplay) -> Table:
    """Return the errors of the policies now and 0.3 s ago. Raises `DataError` where nothing can be judged."""
    names = [name for name in POLICIES if name != "as-current"]
    return _policies(
        replays, _squares(replays, replays.config, names, WAITS_S[: _WAITED + 1])
    )


def _squares(
    replays: PairedReplay,
    config: Config,
    names: Iterable[str],
    waits_s: Sequence[float],
) -> dict[str, Squares]:
    """Return the squared errors of estimators, and of the replaying filter if no list were late."""
    result: dict[str, Squares] = {
        name: replays.squares(name, config, waits_s=waits_s) for name in names
    }
    return result | {_IN_TIME: replays.squares(REPLAY, config, at_stamp, waits_s)}


def _explained(
    replays: PairedReplay, *, best: Config, runs: Mapping[str, FloatArray]
) -> Ledger:
    """Return the ledger, where `best` has tuned noise.
    `runs` are squared errors that runs themselves publish, by the cause that each is without.
    """
    config = replays.config
    estimator, policies = config.estimator, _squares(replays, best, POLICIES, WAITS_S)
    [fitted, *_] = policies.get(estimator) or replays.squares(estimator, best)
    ways = dict(runs)
    ways[_DECISIONS if runs else ""] = (
        fitted if best == config else replays.squares(estimator, config)[0]
    )
    if best != config:
        ways["noise that is not tuned"] = fitted
    if estimator == PUBLISHED:
        ways["time grid of the filter"] = policies[FORGET][0]
        ways["forgetting what was fused since"] = policies[REPLAY][0]
    elif estimator != REPLAY:
        ways[f"{estimator} instead of replay"] = policies[REPLAY][0]
    ways["late arrival, everything kept"] = policies[_IN_TIME][0]
    common = _common([*ways.values(), *(item[0] for item in policies.values())])
    waterfall = [Part("", float(next(iter(ways.values()))[common].mean()), UNKNOWN)]
    for before, (cause, after) in itertools.pairwise(ways.items()):
        if cause != _DECISIONS or not np.allclose(
            before[1][common], after[common], rtol=1e-9
        ):
            share = _difference(before[1], after, common, root=False)
            waterfall.append(Part(cause, float(after[common].mean()), share))
    tables = {
        "waterfall": _waterfall(replays, waterfall),
        "policies": _policies(replays, policies),
        "waiting": _waiting(policies),
        "sensors": _sensors(replays, best, policies[REPLAY][0], common),
    }
    sentence = _sentence(waterfall, tables)
    return Ledger(
        estimator,
        replays.objects is not None,
        tuple(waterfall),
        Tables(tables),
        sentence,
    )


def _sensors(
    replays: PairedReplay, config: Config, kept: FloatArray, common: BoolArray
) -> Table:
    """Return the errors of `kept`, the replaying filter, with each sensor in time, and without its late lists."""
    newest, late, late_lists = dict[int, int](), dict[str, list[bool]](), set[int]()
    for item in replays.calls:
        for track_id, each in zip(item.track_ids, item.observations, strict=False):
            is_late = item.stamp_ns < newest.get(track_id, item.stamp_ns)
            late.setdefault(each.sensor, []).append(is_late)
            late_lists |= {id(item)} if is_late else set()
        newest |= {
            i: max(newest.get(i, item.stamp_ns), item.stamp_ns) for i in item.track_ids
        }
    updates = replays.run.tables["updates"]
    records = []
    for sensor, flags in late.items():
        mine = {
            id(item)
            for item in replays.calls
            if item.observations and item.observations[0].sensor == sensor
        }
        out = mine & late_lists
        [prompt] = replays.squares(REPLAY, config, partial(_at_stamp_of, mine))
        [without] = (
            replays.squares(REPLAY, config, partial(_without, out)) if out else [kept]
        )
        here = common & np.isfinite(prompt) & np.isfinite(without)
        own = updates.where(updates["sensor"] == sensor)
        records.append(
            {
                "sensor": sensor,
                "delay_s": float(np.median(own["receipt_ns"] - own["stamp_ns"]))
                / NS_PER_S,
                "late": sum(flags) / len(flags),
                "too_old": float((own["disposition"] == "too_old").mean()),
            }
            | _named("cost", _difference(kept, prompt, here))
            | _named("worth", _difference(without, kept, here))
        )
    columns = [
        Column("sensor", left=True),
        Column("median\ndelay [ms]", "delay_s", scale=1e3),
        Column("out of\nsequence [%]", "late", scale=100.0),
        Column("too old for\nthe window [%]", "too_old", scale=100.0),
        _interval("its lateness costs\n[m] (95 %)", "cost"),
        _interval("its late lists are\nworth [m] (95 %)", "worth"),
    ]
    return Table("Sensors", records, columns, ("sensor",), [_note(replays)])


def _waterfall(replays: PairedReplay, parts: Sequence[Part]) -> Table:
    records = [
        {
            "cause": item.cause or "as the run has it",
            "rms_m": math.sqrt(item.mean_square_m2),
            "left_m2": item.mean_square_m2,
        }
        | _named("share", item.share_m2)
        for item in parts
    ]
    columns = [
        Column("without, one after the other", "cause", left=True),
        Column("position\nRMSE [m]", "rms_m"),
        Column("mean square\n[m^2]", "left_m2", text=_four),
        _interval("its part\n[m^2] (95 %)", "share", _four),
    ]
    return Table(
        "Where the error of the present comes from",
        records,
        columns,
        ("cause",),
        [_note(replays)],
    )


def _policies(replays: PairedReplay, policies: Mapping[str, Squares]) -> Table:
    """Return the errors of policies now and 0.3 s ago."""
    now, then = (
        _common([squares[index] for squares in policies.values()])
        for index in (0, _WAITED)
    )
    records = [
        {
            "estimator": name,
            "rms_m": _rms(squares[0], now),
            "waited_m": _rms(squares[_WAITED], then),
        }
        | (
            {}
            if name == REPLAY
            else _named("more", _difference(squares[0], policies[REPLAY][0], now))
        )
        for name, squares in policies.items()
    ]
    columns = [
        Column("estimator", left=True),
        Column("position RMSE\nnow [m]", "rms_m"),
        _interval("more than ekf-replay\n[m] (95 %)", "more"),
        Column(f"of {WAITS_S[_WAITED]:g} s ago\n[m]", "waited_m"),
    ]
    title = "Which is better, and when: same measurements, noise and start"
    return Table(title, records, columns, ("estimator",), [_note(replays)])


def _waiting(policies: Mapping[str, Squares]) -> Table:
    filters, smoothers = policies[REPLAY], policies[SMOOTHER]
    common: BoolArray = np.all(np.isfinite([*filters, *smoothers]), axis=0)
    records = [
        {
            "wait_s": wait_s,
            "filter_m": _rms(filtered, common),
            "smoother_m": _rms(smoothed, common),
        }
        | _named("gain", _difference(filtered, smoothed, common))
        for wait_s, filtered, smoothed in zip(WAITS_S, filters, smoothers, strict=True)
        if common.any()
    ]
    columns = [
        Column("state of [s] ago", "wait_s"),
        Column("filtered\nRMSE [m]", "filter_m"),
        Column("smoothed\nRMSE [m]", "smoother_m"),
        _interval("smoothing gives\n[m] (95 %)", "gain"),
    ]
    return Table("What waiting buys", records, columns, ("wait_s",))


def _at_stamp_of(mine: Container[int], item: BankCall) -> int:
    return item.stamp_ns if id(item) in mine else item.now_ns


def _without(left_out: Container[int], item: BankCall) -> int | None:
    return None if id(item) in left_out else item.now_ns


def _note(replays: PairedReplay) -> str:
    if replays.objects is None:
        return "No truth: predicted variances of the position, as far as the noise is right."
    return "Errors against the truth, at the same ticks and tracks in every row."


def _interval(heading: str, name: str, text: Callable[[Value], str] = short) -> Column:
    return Column(heading, f"{name} {name}_low {name}_high", "{} ({} to {})", text=text)


def _named(name: str, item: Estimate) -> dict[str, float]:
    return {name: item.mean, f"{name}_low": item.low, f"{name}_high": item.high}


def _four(value: Value) -> str:
    return (
        f"{value:.4f}"
        if isinstance(value, float) and math.isfinite(value)
        else NO_VALUE
    )


def _common(squares: Iterable[FloatArray]) -> BoolArray:
    """True where all are known. Raises `DataError` where nothing is."""
    common: BoolArray = np.all(np.isfinite([*squares]), axis=0)
    if not common.any():
        raise DataError(
            "no track can be judged: none lives for a second, where there is truth at a true object"
        )
    return common


def _rms(squares: FloatArray, common: BoolArray) -> float:
    return math.sqrt(squares[common].mean())


def _difference(
    before: FloatArray, after: FloatArray, common: BoolArray, *, root: bool = True
) -> Estimate:
    """Return the difference of root mean squares, or of mean squares."""
    sums = [np.where(common, item, 0.0).sum(axis=1) for item in (before, after)]
    of = np.sqrt if root else np.asarray
    return within_run(
        np.stack([*sums, common.sum(axis=1)], axis=-1),
        lambda S: of(S[0] / S[2]) - of(S[1] / S[2]),
    )


def _sentence(parts: Sequence[Part], tables: Mapping[str, Table]) -> str:
    """Return what counts in one sentence."""
    ends = [math.sqrt(item.mean_square_m2) for item in parts]
    steps = zip(parts[1:], ends, ends[1:], strict=False)
    causes = [f"{item.cause} {before - after:+z.2f} m" for item, before, after in steps]
    costs = [
        f"{row['sensor']} {row['cost']:.2f} m" for row in tables["sensors"].records
    ]
    stays = f"{ends[-1]:.2f} m remain. Lateness by sensor: {', '.join(costs)}."
    return f"Error now {ends[0]:.2f} m: {', '.join(causes)}; {stays}"
