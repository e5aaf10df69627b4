"""The ledger of lateness: how much of the error of the present comes from what.

One association is recorded with the replaying EKF; every row repeats the same measurements of the same tracks with
another estimator, noise or order of arrival, so that differences are of estimation alone. Parts are differences of mean
squares of the position error at the same ticks and tracks, so they add up to the difference of their ends.
"""

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from fgtrack.calibration.tune_measurements import Fed, RecordingBank, watched
from fgtrack.core.errors import DataError
from fgtrack.core.linalg import congruence
from fgtrack.core.time import NS_PER_S, nanoseconds
from fgtrack.core.types import BoolArray, FloatArray, IntArray, Message
from fgtrack.estimation.base import Measurement
from fgtrack.estimation.failures import Failures
from fgtrack.estimation.likelihood.series import Observation
from fgtrack.evaluation.intervals import Estimate, within_run
from fgtrack.evaluation.matching import NO_OBJECT, match, track_errors
from fgtrack.evaluation.tables import Column, Table, Tables
from fgtrack.evaluation.truth import true_paths
from fgtrack.io.run import Run, load_run
from fgtrack.io.source import open_input
from fgtrack.pipeline.assumptions.assumed import assumed, source_of
from fgtrack.pipeline.build import build_bank
from fgtrack.pipeline.config import Config
from fgtrack.pipeline.replay import replay_in_memory
from fgtrack.pipeline.shipped import read_config
from fgtrack.tracking.guarded_bank import GuardedBank

REPLAY, SMOOTHER, PUBLISHED, FORGET = "ekf-replay", "smoother-banded", "ekf-backward-forward", "rewind-forget"
POLICIES = ("drop", "as-current", PUBLISHED, FORGET, REPLAY, SMOOTHER)
"""Estimators that the ledger compares."""
WAITS_S = (0.1, 0.3, 1.0)
"""Ages of the states that waiting gives."""
_WAITING = (REPLAY, SMOOTHER)
SUMMARY_S = 60.0
"""A summary is of the beginning of a recording, so long."""
_WAIT_S = 0.3  # in the summary
_IN_TIME = f"{REPLAY}, if no list were late"
_DECISIONS = "other decisions than those of the replaying EKF"
_SETTLE_NS, _STEP_NS = NS_PER_S, NS_PER_S // 20  # a track is judged from an age on, and so often
Arrival = Callable[[Fed], int | None]
"""Gives the time from which on measurements count; None for never."""


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
    config: str | Path | Config | None = None,
    tuned: str | Path | Config | None = None,
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
    fitted = None if tuned is None else read_config(tuned)
    if isinstance(recording, str | Path):
        path = Path(recording)
        if (path / "meta.json").is_file():
            run = load_run(path)
            if config is None:
                settings = read_config(str(run.config_path), set, track_map=map, pit_map=pit_map)
            path = Path((run.meta.get("input") or {}).get("path") or path)
            if not path.exists() or path == Path(recording):
                raise DataError(
                    f"{recording}: its recording is not at {path}, give the recording with -c {run.config_path}"
                )
        recording = open_input(path, settings.input).messages()
    messages = list(recording)
    settings = assumed(settings, source_of(lambda: messages)).config
    right = _with_clocks(settings, fitted)
    books = Books.of(messages, right)
    whole = [] if books.objects is None else [books.published(replay_in_memory(messages, right))]
    if whole and right != settings:
        whole.insert(0, books.published(replay_in_memory(messages, settings)))
    return books.ledger(fitted, whole)


def _with_clocks(config: Config, tuned: Config | None) -> Config:
    """Return `config` with the clock offsets of `tuned`."""
    own = {} if tuned is None else tuned.sensors
    sensors = {
        name: replace(sensor, clock_offset_s=own[name].clock_offset_s) if name in own else sensor
        for name, sensor in config.sensors.items()
    }
    return replace(config, sensors=sensors)


class Books:
    """The association of a run of the replaying EKF, and squared errors of every way to estimate from it."""

    def __init__(self, bank: RecordingBank, run: Run, config: Config, until_s: float = math.inf) -> None:
        now_ns = run.tables["timing"]["now_ns"]
        now_ns = now_ns[: np.searchsorted((now_ns - now_ns[:1]) / NS_PER_S, until_s, side="right")]
        if not len(now_ns) or not bank.fed:
            raise DataError("no track in this recording: `fgtrack advise` gives the reason")
        self._fed = [item for item in bank.fed if item.now_ns <= now_ns[-1]]
        self._run, self._config, self._now_ns = run, config, now_ns
        self._noise = {name: {**sensor.std} for name, sensor in config.sensors.items()}
        grid = np.searchsorted(now_ns, np.arange(now_ns[0], now_ns[-1] + 1, _STEP_NS))
        self._ticks = np.unique(grid[grid < len(now_ns)])
        births = {item.track_ids[0]: item.now_ns for item in self._fed if item.start is not None}
        self._births, self._track_ids = births, list(births)

    @classmethod
    def of(cls, messages: Sequence[Message], config: Config) -> "Books":
        """Return the books of a recording. Raises `DataError` where nothing is tracked."""
        return cls(*watched(messages, replace(config, estimator=REPLAY)), config)

    @cached_property
    def objects(self) -> IntArray | None:
        """Object of each judged tick and track; `NO_OBJECT` without one. None without truth."""
        matching = match(self._run)
        if matching is None:
            return None
        full = np.full((len(self._now_ns), len(self._track_ids)), NO_OBJECT)
        columns = {track_id: column for column, track_id in enumerate(self._track_ids)}
        for row in np.flatnonzero(matching.paired & (matching.tick_index < len(full))).tolist():
            full[matching.tick_index[row], columns[int(matching.tracks["track_id"][row])]] = matching.object_index[row]
        return full[self._ticks]

    def _true_m(self, wait_ns: int) -> FloatArray:
        """True positions at each judged tick, so long ago, (ticks, tracks, 2)."""
        objects, at_ns = self.objects, self._now_ns[self._ticks] - wait_ns
        result = np.full((len(self._ticks), len(self._track_ids), 2), np.nan)
        if objects is not None:
            for index, path in enumerate(true_paths(self._run.tables["truth"])):
                ticks, tracks = np.nonzero(objects == index)
                result[ticks, tracks] = path.at(at_ns[ticks])[:, :2]
        return result

    def squares(
        self, estimator: str, config: Config, arrival: Arrival | None = None, waits_s: Sequence[float] = (0.0,)
    ) -> list[FloatArray]:
        """Squared errors now and so long ago, (judged ticks, tracks) each; `arrival` by default when it came."""
        events = [(at_ns, item) for item in self._fed if (at_ns := (arrival or _when_it_came)(item)) is not None]
        events.sort(key=lambda pair: (np.searchsorted(self._now_ns, pair[0]), pair[1].stamp_ns, not pair[1].start))
        own = replace(config, estimator=estimator)
        failures = Failures()
        bank = GuardedBank(lambda: build_bank(own, failures), failures)
        result = [np.full((len(self._ticks), len(self._track_ids)), np.nan) for _ in waits_s]
        columns = {track_id: column for column, track_id in enumerate(self._track_ids)}
        ends = {track_id: item.now_ns for item in self._fed for track_id in item.track_ids}
        truth, judged, k = [self._true_m(nanoseconds(wait_s)) for wait_s in waits_s], set(self._ticks.tolist()), 0
        for tick, now_ns in enumerate(self._now_ns.tolist()):
            bank.advance(now_ns)
            while k < len(events) and events[k][0] <= now_ns:
                self._feed(bank, events[k][1], config)
                k += 1
            if tick not in judged:
                continue
            row = int(np.searchsorted(self._ticks, tick))
            for track_id in [track_id for track_id in bank.track_ids if ends[track_id] < now_ns]:
                bank.remove(track_id)
            for wait_s, squares, true_m in zip(waits_s, result, truth, strict=True):
                states = bank.states_at(now_ns - nanoseconds(wait_s))
                for track_id, mean, P in zip(states.track_ids, states.means, states.covariances, strict=True):
                    if self._births[track_id] + _SETTLE_NS + nanoseconds(wait_s) <= now_ns <= ends[track_id]:
                        column = columns[track_id]
                        if self.objects is None:
                            squares[row, column] = P[0, 0] + P[1, 1]
                        else:
                            squares[row, column] = float(np.square(mean[:2] - true_m[row, column]).sum())
        return result

    def _feed(self, bank: GuardedBank, item: Fed, config: Config) -> None:
        if item.start is not None:
            bank.birth(item.track_ids[0], item.start)
            return
        alive = set(bank.track_ids)
        chosen = [row for row, track_id in enumerate(item.track_ids) if track_id in alive]
        if chosen:
            measurements = [self._measurement(item.observations[row], config) for row in chosen]
            bank.update(item.stamp_ns, [item.track_ids[row] for row in chosen], measurements)

    def _measurement(self, observation: Observation, config: Config) -> Measurement:
        """Return it with the noise of `config`, of which only the sensor's own standard deviations differ."""
        before, after = self._noise[observation.sensor], config.sensors[observation.sensor].std
        if before == after or not observation.tuned:
            return observation.measurement
        item, T, measured = observation.measurement, observation.axes, list(observation.measured)
        names = [item.model.components[index] for index in measured]
        change = congruence(T, np.diag([after[name] ** 2 - before[name] ** 2 for name in names]))
        R = item.R.copy()
        R[np.ix_(measured, measured)] += change
        return replace(item, R=R)

    def ledger(self, tuned: Config | None, whole: Sequence[FloatArray]) -> Ledger:
        """Return the ledger, see `Ledger`, with the noise of `tuned`.
        `whole` are the squared errors of the runs themselves, see `published`: with the clocks as they are, where they
        are wrong, and with right ones.
        """
        config, best = self._config, self._with_noise(tuned)
        estimator = config.estimator
        causes = ["", "clock offsets"][-len(whole) :] if len(whole) > 1 else [""] * len(whole)
        ways: list[tuple[str, str, FloatArray]] = list(zip(causes, [estimator] * len(whole), whole, strict=True))
        ways.append((_DECISIONS if whole else "", estimator, self.squares(estimator, config)[0]))
        if best != config:
            ways.append(("noise that is not tuned", estimator, self.squares(estimator, best)[0]))
        waits = (0.0, *WAITS_S)
        policies = {name: self.squares(name, best, waits_s=waits) for name in POLICIES}
        if estimator == PUBLISHED:
            ways.append(("its time grid", FORGET, policies[FORGET][0]))
            ways.append(("forgetting what was fused since", REPLAY, policies[REPLAY][0]))
        elif estimator != REPLAY:
            ways.append((f"{estimator} instead of replay", REPLAY, policies[REPLAY][0]))
        policies[_IN_TIME] = self.squares(REPLAY, best, _stamp, waits)
        ways.append(("late arrival, everything kept", REPLAY, policies[_IN_TIME][0]))
        common = _common([*(item for _, _, item in ways), *(item[0] for item in policies.values())])
        waterfall = [Part("", _mean(ways[0][2], common), Estimate(math.nan, math.nan, math.nan, 0))]
        for (_, _, before), (cause, _, after) in itertools.pairwise(ways):
            if cause == _DECISIONS and np.allclose(before[common], after[common], rtol=1e-9):
                continue
            waterfall.append(Part(cause, _mean(after, common), _difference(before, after, common)))
        sensors = self._sensors(best, policies[REPLAY][0], common)
        tables = Tables(
            {
                "waterfall": self._waterfall(waterfall),
                "policies": self._policies(policies, 1 + WAITS_S.index(_WAIT_S)),
                "waiting": self._waiting(policies),
                "sensors": sensors,
            }
        )
        return Ledger(estimator, self.objects is not None, tuple(waterfall), tables, _sentence(waterfall, sensors))

    def summary(self) -> Table:
        """Return the errors of the policies now and 0.3 s ago. Raises `DataError` where nothing can be judged."""
        waits = (0.0, _WAIT_S)
        ways = {name: self.squares(name, self._config, waits_s=waits) for name in POLICIES if name != "as-current"}
        return self._policies(ways | {_IN_TIME: self.squares(REPLAY, self._config, _stamp, waits)})

    def _with_noise(self, tuned: Config | None) -> Config:
        """Return the configuration with the noise of `tuned`."""
        if tuned is None:
            return self._config
        own = {
            name: replace(sensor, std=tuned.sensors[name].std) if name in tuned.sensors else sensor
            for name, sensor in self._config.sensors.items()
        }
        return replace(self._config, motion=tuned.motion, sensors=own)

    def published(self, run: Run) -> FloatArray:
        """Squared errors that `run` itself publishes at the judged ticks, of the same objects; there must be truth."""
        matching = match(run)
        assert matching is not None
        assert self.objects is not None
        paired, squares = np.flatnonzero(matching.paired), np.square(track_errors(matching).values["position_m"])
        by_object = np.full((len(matching.now_ns), len(matching.object_ids) + 1), np.nan)
        by_object[matching.tick_index[paired], matching.object_index[paired]] = squares
        return np.take_along_axis(by_object[self._ticks], self.objects, axis=1)  # NO_OBJECT takes the last column

    def _sensors(self, config: Config, kept: FloatArray, common: BoolArray) -> Table:
        newest, late, late_lists = dict[int, int](), dict[str, list[bool]](), set[int]()
        for item in self._fed:
            for track_id, each in zip(item.track_ids, item.observations, strict=False):
                is_late = item.stamp_ns < newest.get(track_id, item.stamp_ns)
                late.setdefault(each.sensor, []).append(is_late)
                late_lists |= {id(item)} if is_late else set()
            newest |= {i: max(newest.get(i, item.stamp_ns), item.stamp_ns) for i in item.track_ids}
        records = []
        for sensor, flags in late.items():
            mine = {id(item) for item in self._fed if _sensor(item) == sensor}
            out = mine & late_lists
            [prompt] = self.squares(REPLAY, config, lambda item: item.stamp_ns if id(item) in mine else item.now_ns)  # noqa: B023
            [without] = self.squares(REPLAY, config, lambda item: None if id(item) in out else item.now_ns)  # noqa: B023
            here = common & np.isfinite(prompt) & np.isfinite(without)
            cost, worth = _rms_difference(kept, prompt, here), _rms_difference(without, kept, here)
            updates = self._run.tables["updates"]
            own = updates.where(updates["sensor"] == sensor)
            too_old = float((own["disposition"] == "too_old").mean())
            delay_s = float(np.median(own["receipt_ns"] - own["stamp_ns"])) / NS_PER_S
            records.append(
                {"sensor": sensor, "delay_s": delay_s, "late": sum(flags) / len(flags), "too_old": too_old}
                | _named("cost", cost)
                | _named("worth", worth)
            )
        columns = [
            Column("sensor", left=True),
            Column("median\ndelay [ms]", "delay_s", scale=1e3),
            Column("out of\nsequence [%]", "late", scale=100.0),
            Column("too old for\nthe window [%]", "too_old", scale=100.0),
            Column("its lateness costs\n[m] (95 %)", "cost cost_low cost_high", "{} ({} to {})"),
            Column("its late lists are\nworth [m] (95 %)", "worth worth_low worth_high", "{} ({} to {})"),
        ]
        return Table("Sensors", records, columns, ("sensor",), [_UNIT[self.objects is not None]])

    def _waterfall(self, parts: Sequence[Part]) -> Table:
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
            Column("its part\n[m^2] (95 %)", "share share_low share_high", "{} ({} to {})", text=_four),
        ]
        return Table(
            "Where the error of the present comes from", records, columns, ("cause",), [_UNIT[self.objects is not None]]
        )

    def _policies(self, policies: Mapping[str, Sequence[FloatArray]], waited: int = 1) -> Table:
        """Return the errors of policies now and `_WAIT_S` ago, which are at the first and `waited` of their squares."""
        now, then = (_common([squares[index] for squares in policies.values()]) for index in (0, waited))
        records = []
        for name, squares in policies.items():
            record = {"estimator": name, "rms_m": math.sqrt(_mean(squares[0], now))}
            record["waited_m"] = math.sqrt(_mean(squares[waited], then))
            more = {} if name == REPLAY else _named("more", _rms_difference(squares[0], policies[REPLAY][0], now))
            records.append(record | more)
        columns = [
            Column("estimator", left=True),
            Column("position RMSE\nnow [m]", "rms_m"),
            Column("more than ekf-replay\n[m] (95 %)", "more more_low more_high", "{} ({} to {})"),
            Column(f"of {_WAIT_S:g} s ago\n[m]", "waited_m"),
        ]
        title = "Which is better, and when: same measurements, noise and start"
        return Table(title, records, columns, ("estimator",), [_UNIT[self.objects is not None]])

    def _waiting(self, policies: Mapping[str, Sequence[FloatArray]]) -> Table:
        every = [item for name in _WAITING for item in policies[name]]
        common: BoolArray = np.all(np.isfinite(every), axis=0)
        records = []
        for k, wait_s in enumerate((0.0, *WAITS_S)):
            filtered, smoothed = (policies[name][k] for name in _WAITING)
            record = {"wait_s": wait_s, "filter_m": math.nan, "smoother_m": math.nan}
            if common.any():
                record |= {
                    "filter_m": math.sqrt(_mean(filtered, common)),
                    "smoother_m": math.sqrt(_mean(smoothed, common)),
                }
                record |= _named("gain", _rms_difference(filtered, smoothed, common))
            records.append(record)
        columns = [
            Column("state of [s] ago", "wait_s"),
            Column("filtered\nRMSE [m]", "filter_m"),
            Column("smoothed\nRMSE [m]", "smoother_m"),
            Column("smoothing gives\n[m] (95 %)", "gain gain_low gain_high", "{} ({} to {})"),
        ]
        return Table("What waiting buys", records, columns, ("wait_s",))


_UNIT = {
    True: "Errors against the truth, at the same ticks and tracks in every row.",
    False: "No truth: predicted variances of the position, as far as the noise is right.",
}


def _four(value: float | str) -> str:
    return f"{value:.4f}" if isinstance(value, float) and math.isfinite(value) else "-"


def _when_it_came(item: Fed) -> int:
    return item.now_ns


def _stamp(item: Fed) -> int:
    return item.stamp_ns


def _common(squares: Iterable[FloatArray]) -> BoolArray:
    """True where all are known. Raises `DataError` where nothing is."""
    common: BoolArray = np.all(np.isfinite([*squares]), axis=0)
    if not common.any():
        raise DataError("no track can be judged: none lives for a second, where there is truth at a true object")
    return common


def _sensor(item: Fed) -> str | None:
    return item.observations[0].sensor if item.observations else None


def _named(name: str, item: Estimate) -> dict[str, float]:
    return {name: item.mean, f"{name}_low": item.low, f"{name}_high": item.high}


def _mean(squares: FloatArray, common: BoolArray) -> float:
    return float(squares[common].mean())


def _sums(before: FloatArray, after: FloatArray, common: BoolArray) -> FloatArray:
    """Sums over the tracks of each tick: both squares, and how many, shape (ticks, 3)."""
    each = [np.where(common, item, 0.0).sum(axis=1) for item in (before, after)]
    return np.stack([*each, common.sum(axis=1)], axis=-1)


def _difference(before: FloatArray, after: FloatArray, common: BoolArray) -> Estimate:
    return within_run(_sums(before, after, common), lambda S: (S[0] - S[1]) / S[2])


def _rms_difference(before: FloatArray, after: FloatArray, common: BoolArray) -> Estimate:
    return within_run(_sums(before, after, common), lambda S: np.sqrt(S[0] / S[2]) - np.sqrt(S[1] / S[2]))


def _sentence(parts: Sequence[Part], sensors: Table) -> str:
    """Return what counts in one sentence."""
    ends = [math.sqrt(item.mean_square_m2) for item in parts]
    steps = zip(parts[1:], ends, ends[1:], strict=False)
    causes = [f"{item.cause} {before - after:+.2f} m" for item, before, after in steps]
    costs = [f"{row['sensor']} {row['cost']:.2f} m" for row in sensors.records]
    stays = f"{ends[-1]:.2f} m stay. Lateness by sensor: {', '.join(costs)}."
    return f"Error now {ends[0]:.2f} m: {', '.join(causes)}; {stays}"
