"""Noise from recordings: process and measurement noise by maximum likelihood of the innovations, without truth."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, pairwise
from pathlib import Path

import numpy as np

from fgtrack.calibration.tune_measurements import recorded
from fgtrack.calibration.tune_space import (
    ConfigNoise,
    HeldOut,
    InnovationFit,
    Known,
    SensorNoise,
    TunedParameter,
    TuneReport,
    TuneRules,
    for_tuning,
    widened,
)
from fgtrack.core.errors import CallError, DataError
from fgtrack.core.types import BoolArray, FloatArray, Message
from fgtrack.estimation.likelihood.contaminated import outlier_share
from fgtrack.estimation.likelihood.fit import Likelihood, Problem
from fgtrack.estimation.likelihood.mixed import without_mixed
from fgtrack.estimation.likelihood.reference import filtered
from fgtrack.estimation.likelihood.series import Series
from fgtrack.io.errors import UntilBreak
from fgtrack.io.run import Run
from fgtrack.io.source import InputSource, open_input
from fgtrack.pipeline.assumptions.assumed import assumed
from fgtrack.pipeline.config import Config
from fgtrack.pipeline.replay import located
from fgtrack.pipeline.shipped import read_config

_LASTING = "an error that lasts looks like motion: only the part that does not is fitted, by the share"
_ENDLESS = "no maximum: the likelihood still rises 10^4 times away, as where all errors are 0"


@dataclass(frozen=True)
class _Recording:
    """Messages in memory, and how they ended."""

    name: str
    messages: tuple[Message, ...]
    broken: str | None

    @classmethod
    def read(cls, name: str, messages: Iterable[Message]) -> "_Recording":
        readable = UntilBreak(messages)
        kept = tuple(readable)
        if not kept:
            readable.raise_error()
        return cls(name, kept, None if readable.error is None else str(readable.error))


def tune(
    recordings: str | Path | Sequence[str | Path],
    config: str | Path | Config | None = None,
    *,
    map: str | Path | None = None,  # noqa: A002 - the name of the option
    pit_map: str | Path | None = None,
    set: Mapping[str, object] | None = None,  # noqa: A002 - the name of the option
    keep: Sequence[str] = (),
) -> TuneReport:
    """Fit process and measurement noise to recordings; `report.config` is the tuned configuration.

    Parameters
    ----------
    recordings
        Path of anything that fgtrack reads, or several of them.
    config
        Name of a shipped configuration, path of a YAML file, or a `Config`; None for the defaults.
    map, pit_map
        CSV files of the track and of the pit lane, or `oval`; instead of those of the configuration.
    set
        Values of single settings: `{"motion.kind": "ctra"}`.
    keep
        Keys that stay as configured: `["motion.std_per_s.speed"]`.

    Raises
    ------
    CallError
        The configuration does not fit.
    DataError
        A recording cannot be read, a sensor of it has no model, or nothing can be fitted to it.
    """
    resolved = read_config(config, set, track_map=map, pit_map=pit_map)
    if not isinstance(recordings, (str, Path, Sequence)):
        raise CallError(f"recordings: must be a path or several, is a {type(recordings).__name__}")
    paths = [recordings] if isinstance(recordings, (str, Path)) else list(recordings)
    return tuned({str(path): open_input(path, resolved.input) for path in paths}, resolved, TuneRules(keep=tuple(keep)))


def tuned(
    sources: Mapping[str, InputSource],
    config: Config,
    rules: TuneRules | None = None,
    on_step: Callable[[str], None] = lambda text: None,
) -> TuneReport:
    """`tune` of messages in receipt order, by name of their recording; `on_step` gets the name of each step."""
    rules = rules or TuneRules()
    recordings = [_Recording.read(name, source.messages()) for name, source in sources.items()]
    together = replace(
        next(iter(sources.values())), messages=lambda: chain.from_iterable(one.messages for one in recordings)
    )
    config = assumed(config, together).config
    return _Tuning(ConfigNoise(for_tuning(config, rules)), recordings, rules, on_step).report(config)


@dataclass(frozen=True)
class _Found:
    """Parameters and what is known of them."""

    values: FloatArray
    log_std: FloatArray
    """Standard errors of their logarithms; NaN where they are not known."""
    known: tuple[Known, ...]
    why: tuple[str, ...]
    likelihood: Likelihood


class _Tuning:
    """The steps of `tuned`."""

    def __init__(
        self,
        noise: ConfigNoise,
        recordings: Sequence[_Recording],
        rules: TuneRules,
        on_step: Callable[[str], None],
    ) -> None:
        self._noise = noise
        self._space = noise.space
        self._configured = noise.values
        # A lasting error looks like motion: the likelihood knows the part that is new, which the share gives.
        self._lasting = np.array(
            [name not in ("", "share") and one in self._space.lasting for one, name in self._space.names]
        )
        self._kept = np.isin(noise.keys, rules.keep)
        self._endless = np.zeros(len(self._kept), dtype=np.bool_)
        for key in rules.keep:
            if key not in noise.keys:
                raise CallError(
                    f"keep {key}: is no noise of the configuration, which has {', '.join(filter(None, noise.keys))}"
                )
        self._recordings = recordings
        self._rules = rules
        self._on_step = on_step

    def report(self, config: Config) -> TuneReport:
        """Rounds of association and fit to the first part, the judgement of the rest, and the fit to everything."""
        series, runs_before = self._associated(self._configured)
        splits = [self._split_ns(tracks) for tracks in series] if self._rules.train_share < 1.0 else None
        values, optima, rounds, settled = self._configured, 0, 0, False
        while not settled and rounds < self._rules.max_rounds:
            if rounds:
                self._on_step(f"association {rounds + 1}")
                series, _ = self._associated(values)
                series = [[without_mixed(one, self._space, values) for one in tracks] for tracks in series]
            rounds += 1
            problem = self._problem(_all(series) if splits is None else _until(series, splits))
            if rounds == 1:
                values, optima = self._best_start(problem)
            self._on_step(f"fit {rounds}")
            before = values
            values, likelihood, free = self._maximum(problem, values)
            moved = np.abs(np.log(values[free] / before[free]))
            still = (moved <= self._rules.settled * likelihood.spread(np.log(values[free]))).all()
            settled = rounds > 1 and bool(still)  # with the configured noise one cannot tell what is mixed
        found, held_out = self._found(problem, values), None
        if splits is not None:
            held_out = self._held_out(found.values, series, splits, runs_before)
            self._on_step("fit to everything")
            problem = self._problem(_all(series))
            found = self._found(problem, found.values)
        return self._made(config, problem, found, held_out, rounds, optima, settled)

    def _associated(self, values: FloatArray) -> tuple[list[list[Series]], list[Run]]:
        """The series of long tracks and the run of each recording, with the noise of `values`."""
        config = widened(self._noise.config_with(values), self._rules)
        all_series, runs = [], []
        for recording in self._recordings:
            series, run = recorded(recording.messages, config, recording.name, self._rules.gate_stds)
            long = [one for one in series if len(one.observations) >= self._rules.min_observations]
            all_series.append(
                [replace(one, observations=one.observations[: self._rules.max_observations]) for one in long]
            )
            runs.append(run)
        return all_series, runs

    def _split_ns(self, tracks: Sequence[Series]) -> int:
        """The stamp at which the held-out part of a recording begins."""
        stamps_ns = [one.measurement.stamp_ns for track in tracks for one in track.observations]
        if not stamps_ns:
            return 0
        return min(stamps_ns) + round(self._rules.train_share * (max(stamps_ns) - min(stamps_ns)))

    def _problem(self, series: Sequence[Series]) -> Problem:
        problem = Problem(series, self._space, self._configured, self._rules.fit)
        if not problem.counts()[: self._space.num_motion].any():
            raise self._nothing(
                f"no track has {self._rules.min_observations} measurements; look at `fgtrack info` for sensors without "
                "a model, and at the gate"
            )
        return problem

    def _maximum(self, problem: Problem, start: FloatArray) -> tuple[FloatArray, Likelihood, BoolArray]:
        """Parameters at the maximum, the likelihood, and which are free; what has no maximum is as configured."""
        while True:
            free = self._free(problem)
            values, likelihood = problem.maximum(start, free)
            endless = free & problem.endless(values)
            if not endless.any():
                return values, likelihood, free
            self._endless |= endless
            start = np.where(endless, self._configured, values)

    def _free(self, problem: Problem) -> BoolArray:
        """Which parameters have enough measurements, a maximum, and can be distinguished from others."""
        often = problem.counts() >= self._rules.min_count
        free = np.asarray(often & ~self._lasting & ~self._kept & ~self._endless)
        if not free[[bool(name) for _, name in self._space.names]].any():
            raise self._nothing(
                f"no parameter that may be fitted has {self._rules.min_count} measurements on tracks that have settled;"
                " take a longer recording, of objects that move, or look at the gate"
            )
        return free

    def _nothing(self, why: str) -> DataError:
        names = ", ".join(recording.name for recording in self._recordings)
        if self._endless.any():
            keys = ", ".join(np.array(self._noise.keys)[self._endless])
            why = f"the errors behind {keys} are 0, or nearly so: was it simulated without noise?"
        return DataError(f"{names}: nothing to fit noise to: {why}")

    def _best_start(self, problem: Problem) -> tuple[FloatArray, int]:
        """The start, of three, from which the highest maximum is reached on a part of the data; how many there are."""
        self._on_step("starts")
        longest = sorted(problem.series, key=lambda one: -len(one.observations))[: self._rules.start_tracks]
        some = [replace(one, observations=one.observations[: self._rules.start_observations]) for one in longest]
        part = replace(problem, series=some)
        free = self._free(problem) & (part.counts() >= self._rules.min_count)
        if not free.any():  # too little in the part to choose a start by
            return self._configured.copy(), 1
        moving = np.flatnonzero(free[: self._space.num_motion])
        reached: list[tuple[float, FloatArray]] = []
        for factor in (1.0, self._rules.start_factor, 1.0 / self._rules.start_factor):
            start = self._configured.copy()
            start[moving] *= factor
            values, likelihood = part.maximum(start, free)
            reached.append((-likelihood.objective(np.log(values[free])), values))
        reached.sort(key=lambda one: -one[0])
        heights = [height for height, _ in reached]
        optima = 1 + sum(upper - lower > 1.0 for upper, lower in pairwise(heights))
        return reached[0][1], optima

    def _found(self, problem: Problem, start: FloatArray) -> _Found:
        """The maximum; instead of what is not known there, what is configured, or what is nearest to it.

        The rest is not fitted again: it would make up for what was put there, and with the yaw's noise too large the
        yaw rate's comes out too small. Nor would its standard errors hold, which are those of all parameters together.
        """
        count = len(start)
        known: list[Known] = ["no"] * count
        maximum, likelihood, free = self._maximum(problem, start)
        why = np.full(count, f"fewer than {self._rules.min_count} measurements on tracks", dtype=object)
        why[self._endless], why[self._lasting], why[self._kept] = _ENDLESS, _LASTING, "kept as asked"
        values = maximum.copy()
        log_std = np.full(count, math.nan)
        log_std[free] = likelihood.log_std(np.log(values[free]))
        errors = np.array(self._noise.shown(values, log_std)[1])
        fitted = [place for place in np.flatnonzero(free).tolist() if self._space.names[place][1]]
        for place in sorted(fitted, key=lambda one: -errors[one]):
            why[place] = ""
            if errors[place] <= self._rules.rough_std_error:
                known[place] = "yes" if errors[place] <= self._rules.known_std_error else "roughly"
                continue
            limit = self._limit(likelihood, values, place)
            kept = limit == self._configured[place]
            known[place] = "no" if kept else "limit"
            why[place] = (
                f"flat: standard error {100.0 * errors[place]:.0f} %"
                if kept
                else f"only bounded: {'below' if values[place] < limit else 'above'} {limit:.3g} at 95 %"
            )
            values[place], log_std[place] = limit, math.nan
        if not {"yes", "roughly"} & set(known):
            raise self._nothing("no parameter is identifiable in so few measurements; take a longer recording")
        return _Found(values, log_std, tuple(known), tuple(why), likelihood)

    def _limit(self, likelihood: Likelihood, values: FloatArray, place: int) -> float:
        """The value nearest to the configured one that the data do not reject, the other parameters given."""
        shares = np.linspace(0.0, 1.0, 41)
        rows = np.broadcast_to(values, (len(shares), len(values))).copy()
        rows[:, place] = values[place] * (self._configured[place] / values[place]) ** shares
        heights = likelihood.totals(rows)
        rejected = np.flatnonzero(heights < heights[0] - self._rules.rejected)
        if not len(rejected):
            return float(self._configured[place])
        return float(rows[max(int(rejected[0]) - 1, 0), place])

    def _held_out(
        self,
        trained: FloatArray,
        series: Sequence[Sequence[Series]],
        splits: Sequence[int],
        runs_before: Sequence[Run],
    ) -> HeldOut | None:
        """Return the performance in the rest of noise fitted to the first part; None where nothing counts there."""
        rest = [replace(one, from_ns=at_ns) for tracks, at_ns in zip(series, splits, strict=True) for one in tracks]
        before = trained.copy()  # shares of outliers are not configured: they are the same in both
        configured = np.array([bool(name) for _, name in self._space.names])
        before[configured] = self._configured[configured]
        judged = [self._judged(rest, values) for values in (before, trained)]
        count = len(judged[0][0])
        if not count:
            return None
        squares_before, squares_after = (squares for _, squares in judged)
        innovations = tuple(
            InnovationFit(
                sensor,
                component,
                len(squares),
                float(np.mean(squares)),
                float(np.mean(squares_after[sensor, component])),
                1.96 * math.sqrt(2.0 / len(squares)),
            )
            for (sensor, component), squares in sorted(squares_before.items())
        )
        self._on_step("held-out time")
        _, runs_after = self._associated(trained)
        return HeldOut(
            1.0 - self._rules.train_share,
            count,
            float(np.mean(judged[0][0])),
            float(np.mean(judged[1][0])),
            innovations,
            tuple(splits),
            tuple(runs_before),
            tuple(runs_after),
        )

    def _judged(
        self, series: Sequence[Series], values: FloatArray
    ) -> tuple[list[float], dict[tuple[str, str], list[float]]]:
        """Log-likelihoods of the innovations that count, and squares over variances by sensor and component."""
        terms: list[float] = []
        squares: dict[tuple[str, str], list[float]] = {}
        for one in series:
            for place, step in enumerate(filtered(one, self._space, values)):
                if self._rules.fit.counts(one, place):
                    terms.append(step.log_likelihood)
                    observation = step.observation
                    names = [observation.measurement.model.components[i] for i in observation.measured]
                    for name, square in zip(names, np.square(step.y) / np.diag(step.S), strict=True):
                        squares.setdefault((observation.sensor, name), []).append(float(square))
        return terms, squares

    def _made(
        self,
        config: Config,
        problem: Problem,
        found: _Found,
        held_out: HeldOut | None,
        rounds: int,
        optima: int,
        settled: bool,
    ) -> TuneReport:
        tuned_config = ConfigNoise(config).config_with(found.values)
        was, _ = self._noise.shown(self._configured, found.log_std)
        now, errors = self._noise.shown(ConfigNoise(tuned_config).values, found.log_std)
        columns = self._noise.keys, was, now, errors, found.known
        parameters = tuple(
            TunedParameter(key, was, value, None if math.isnan(error) else error, one, why)
            for key, was, value, error, one, why in zip(*columns, found.why, strict=True)
            if key
        )
        total = float(found.likelihood.totals(found.values[None])[0])
        count = int(problem.counts()[self._space.num_motion :][-len(self._space.sensors) :].sum())
        return TuneReport(
            tuned_config,
            parameters,
            tuple(self._sensor(name, problem, found) for name in self._space.sensors),
            held_out,
            total / count,
            count,
            len(problem.series),
            sum(len(one.mixed) for one in problem.series),
            rounds,
            optima,
            settled,
            {one.name: located(one.broken, one.name) for one in self._recordings if one.broken is not None},
        )

    def _sensor(self, name: str, problem: Problem, found: _Found) -> SensorNoise:
        places = {parameter: place for place, parameter in enumerate(self._space.names)}
        count = int(problem.counts()[places[name, ""]])
        own = sum(
            observation.sensor == name and not observation.tuned
            for one in problem.series
            for observation in one.observations
        )
        share = float(outlier_share(found.values[places[name, ""]])) if count else None
        return SensorNoise(name, count, own, share)


def _all(series: Sequence[Sequence[Series]]) -> list[Series]:
    return [one for tracks in series for one in tracks]


def _until(series: Sequence[Sequence[Series]], splits: Sequence[int]) -> list[Series]:
    return [replace(one, until_ns=at_ns) for tracks, at_ns in zip(series, splits, strict=True) for one in tracks]
