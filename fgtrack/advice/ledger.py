"""The ledger of lateness: the contribution of each cause to the present position error.

Every row is a replay of one association. A contribution is a difference of mean squared
position errors over the same ticks and tracks. So the contributions add up to the whole
difference.
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
from fgtrack.meaning.assumed import assumed, source_of
from fgtrack.meaning.draft import opened
from fgtrack.noise.measurements import BankCall
from fgtrack.pipeline.replay import replay_in_memory
from fgtrack.runs import load_run

SMOOTHER, PUBLISHED, FORGET = "smoother-banded", "ekf-backward-forward", "rewind-forget"
POLICIES = ("drop", "as-current", PUBLISHED, FORGET, REPLAY, SMOOTHER)
"""Estimators that the ledger compares."""
RTS = "ekf-rts"
"""Estimator that adds a smoothing pass to the replaying EKF: the opponent of the smoother for states of the past."""
WAITS_S = (0.0, 0.1, 0.3, 1.0)
"""Ages of the compared states: the benefit of waiting."""
SUMMARY_S = 60.0
"""Length of the first part of a recording that a summary uses."""
_WAITED = 2  # index in WAITS_S of the waiting time in the summary
_IN_TIME = f"{REPLAY}, if no list were late"
_DECISIONS = "association unlike that of ekf-replay"
Squares = Sequence[FloatArray]
"""Squared errors for each waiting time."""


@dataclass(frozen=True)
class Contribution:
    """A line of the waterfall."""

    cause: str
    """Cause of an error; empty for the run itself."""
    mean_square_m2: float
    """Mean squared error without this cause and all causes before it."""
    share_m2: Estimate
    """Contribution of the cause to the mean square."""


@dataclass(frozen=True)
class Ledger:
    """Contributions of causes to the present error; `str` shows the tables."""

    estimator: str
    with_truth: bool
    """False if the recording has no truth. Then predicted variances replace squared errors."""
    waterfall: tuple[Contribution, ...]
    """Lines from the error of the run down to the error without lateness; the first has no cause."""
    tables: Tables = field(repr=False)
    sentence: str
    """Summary of the contributions."""
    problem: str | None = None
    """Line on open questions about the recording, whose sensors are left out; None without such questions."""

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

    A path may be a run folder: then its recording and configuration are used. `config`,
    `map`, `pit_map` and `set` are as in `fgtrack.replay`. The configured estimator is
    the one whose error is explained. `tuned` is a configuration from `fgtrack tune` or
    `advise --tune`. Its noise and clock offsets are used, and each difference gets a
    line in the ledger.

    Without truth, predicted variances replace squared errors. Raises `DataError` if no
    track can be assessed.
    """
    settings = read_config(config, set, track_map=map, pit_map=pit_map)
    problem = None
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
                    f"{recording}: its recording is not at {path}; give the recording's path with -c {run.config_path}"
                )
        draft = opened(path, settings)
        problem = draft.problem
        settings = draft.config
        recording = draft.source.messages()
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
        return replace(_explained(replays, best=best, runs={}), problem=problem)
    published = {
        cause: replays.published(replay_in_memory(messages, each))
        for cause, each in runs.items()
    }
    return replace(_explained(replays, best=best, runs=published), problem=problem)


def _with_sensors(config: Config, tuned: Config, name: str) -> Config:
    """Return `config` with the setting `name` of each sensor taken from `tuned`."""
    own = tuned.sensors
    sensors = {
        key: replace(sensor, **{name: getattr(own[key], name)})
        if key in own
        else sensor
        for key, sensor in config.sensors.items()
    }
    return replace(config, sensors=sensors)


def summary(replays: PairedReplay) -> Table:
    """Return the table of the errors of the policies, at present and 0.3 s ago.

    Raises `DataError` if no track can be assessed.
    """
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
    """Return the squared errors of the estimators `names`, and of the replaying EKF without delays."""
    result: dict[str, Squares] = {
        name: replays.squares(name, config, waits_s=waits_s) for name in names
    }
    return result | {_IN_TIME: replays.squares(REPLAY, config, at_stamp, waits_s)}


def _explained(
    replays: PairedReplay, *, best: Config, runs: Mapping[str, FloatArray]
) -> Ledger:
    """Return the ledger.

    `best` is the configuration with tuned noise. `runs` are the squared errors that
    runs themselves publish, by the cause that each one lacks.
    """
    config = replays.config
    estimator = config.estimator
    policies = _squares(replays, best, POLICIES, WAITS_S)
    [fitted, *_] = policies.get(estimator) or replays.squares(estimator, best)
    # Squared errors by cause; each replay lacks its cause and all causes before it.
    squares = dict(runs)
    squares[_DECISIONS if runs else ""] = (
        fitted if best == config else replays.squares(estimator, config)[0]
    )
    if best != config:
        squares["noise that is not tuned"] = fitted
    if estimator == PUBLISHED:
        squares["time grid of the filter"] = policies[FORGET][0]
        squares["forgetting what was fused since"] = policies[REPLAY][0]
    elif estimator != REPLAY:
        squares[f"{estimator} instead of replay"] = policies[REPLAY][0]
    squares["late arrival, everything kept"] = policies[_IN_TIME][0]
    common = _common([*squares.values(), *(item[0] for item in policies.values())])
    first = next(iter(squares.values()))
    waterfall = [Contribution("", float(first[common].mean()), UNKNOWN)]
    for before, (cause, after) in itertools.pairwise(squares.items()):
        if cause != _DECISIONS or not np.allclose(
            before[1][common], after[common], rtol=1e-9
        ):
            share = _difference(before[1], after, common, root=False)
            waterfall.append(Contribution(cause, float(after[common].mean()), share))
    tables = {
        "waterfall": _waterfall(replays, waterfall),
        "policies": _policies(replays, policies),
        "waiting": _waiting(
            replays, policies, replays.squares(RTS, best, waits_s=WAITS_S)
        ),
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
    """Return the table of the cost of each sensor's delays, and of the worth of its late lists.

    `kept` are the squared errors of the replaying EKF. They are compared with a replay
    without delays of the sensor, and with one without its late lists.
    """
    newest = dict[int, int]()
    late = dict[str, list[bool]]()
    late_lists = set[int]()
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
        dropped = mine & late_lists
        [prompt] = replays.squares(REPLAY, config, partial(_at_stamp_of, mine))
        without = kept
        if dropped:
            [without] = replays.squares(REPLAY, config, partial(_without, dropped))
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


def _waterfall(replays: PairedReplay, parts: Sequence[Contribution]) -> Table:
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
        Column(f"{_word(replays)}position\nRMSE [m]", "rms_m"),
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
    """Return the table of the errors of the policies, at present and 0.3 s ago."""
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
        Column(f"{_word(replays)}position RMSE\nnow [m]", "rms_m"),
        _interval("more than ekf-replay\n[m] (95 %)", "more"),
        Column(f"of {WAITS_S[_WAITED]:g} s ago\n[m]", "waited_m"),
    ]
    title = "Which is better, and when: same measurements, noise and start"
    return Table(title, records, columns, ("estimator",), [_note(replays)])


def _waiting(
    replays: PairedReplay, policies: Mapping[str, Squares], passes: Squares
) -> Table:
    """Return the table of the errors of past states: filtered, with a smoothing pass (`passes`), and smoothed."""
    filters = policies[REPLAY]
    smoothers = policies[SMOOTHER]
    common: BoolArray = np.all(np.isfinite([*filters, *passes, *smoothers]), axis=0)
    records = [
        {
            "wait_s": wait_s,
            "filter_m": _rms(filtered, common),
            "rts_m": _rms(passed, common),
            "smoother_m": _rms(smoothed, common),
        }
        | _named("gain", _difference(filtered, passed, common))
        | _named("graph_gain", _difference(passed, smoothed, common))
        for wait_s, filtered, passed, smoothed in zip(
            WAITS_S, filters, passes, smoothers, strict=True
        )
        if common.any()
    ]
    word = _word(replays)
    columns = [
        Column("state of [s] ago", "wait_s"),
        Column(f"{word}{REPLAY}\nRMSE [m]", "filter_m"),
        Column(f"{word}{RTS}\nRMSE [m]", "rts_m"),
        Column(f"{word}smoother\nRMSE [m]", "smoother_m"),
        _interval("smoothing pass gives\n[m] (95 %)", "gain"),
        _interval("factor graph adds\n[m] (95 %)", "graph_gain"),
    ]
    return Table("What waiting buys", records, columns, ("wait_s",), [_note(replays)])


def _at_stamp_of(mine: Container[int], item: BankCall) -> int:
    return item.stamp_ns if id(item) in mine else item.now_ns


def _without(left_out: Container[int], item: BankCall) -> int | None:
    return None if id(item) in left_out else item.now_ns


def _word(replays: PairedReplay) -> str:
    """First word of a heading of errors: without truth they are predicted."""
    return "" if replays.objects is not None else "predicted\n"


def _note(replays: PairedReplay) -> str:
    if replays.objects is None:
        return "No truth: predicted position variances, which are valid only for consistent noise."
    return "Errors against the truth, over the same ticks and tracks in every row."


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
    """Mask of the ticks and tracks with a finite error in all `squares`.

    Raises `DataError` if there are none.
    """
    common: BoolArray = np.all(np.isfinite([*squares]), axis=0)
    if not common.any():
        raise DataError(
            "no track can be assessed: none lives for a second, or with truth, none is paired with a true object"
        )
    return common


def _rms(squares: FloatArray, common: BoolArray) -> float:
    return math.sqrt(squares[common].mean())


def _difference(
    before: FloatArray, after: FloatArray, common: BoolArray, *, root: bool = True
) -> Estimate:
    """Return the difference of the root mean squares, or of the mean squares unless `root`."""
    sums = [np.where(common, item, 0.0).sum(axis=1) for item in (before, after)]
    transform = np.sqrt if root else np.asarray
    return within_run(
        np.stack([*sums, common.sum(axis=1)], axis=-1),
        lambda S: transform(S[0] / S[2]) - transform(S[1] / S[2]),
    )


def _sentence(parts: Sequence[Contribution], tables: Mapping[str, Table]) -> str:
    """Return a summary sentence of the contributions."""
    ends = [math.sqrt(item.mean_square_m2) for item in parts]
    steps = zip(parts[1:], ends, ends[1:], strict=False)
    causes = [f"{item.cause} {before - after:+z.2f} m" for item, before, after in steps]
    costs = [
        f"{row['sensor']} {row['cost']:.2f} m" for row in tables["sensors"].records
    ]
    stays = f"{ends[-1]:.2f} m remain. Lateness by sensor: {', '.join(costs)}."
    return f"Error now {ends[0]:.2f} m: {', '.join(causes)}; {stays}"
