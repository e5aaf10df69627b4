"""Fit of process and measurement noise to recordings without truth, by maximum likelihood of the innovations."""

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import chain, compress
from pathlib import Path

import numpy as np

from fgtrack.config.reading import ConfigLike, read_config
from fgtrack.config.settings import Config
from fgtrack.core.errors import CallError, DataError
from fgtrack.core.types import BoolArray, FloatArray, Message
from fgtrack.inputs.errors import UntilBreak
from fgtrack.inputs.source import InputSource
from fgtrack.meaning.assumed import assumed
from fgtrack.meaning.draft import opened_together
from fgtrack.noise.likelihood.contaminated import outlier_share
from fgtrack.noise.likelihood.fit import Likelihood, Problem
from fgtrack.noise.likelihood.reference import filtered, with_mixed_marked
from fgtrack.noise.likelihood.series import Series
from fgtrack.noise.measurements import recorded_series
from fgtrack.noise.parameters import (
    ConfigNoise,
    HeldOut,
    InnovationFit,
    Known,
    SensorNoise,
    TunedParameter,
    TuneReport,
    TuneRules,
    stamp_key,
)
from fgtrack.noise.stamps import StampFit, fitted_stamps, stamp_rates, with_stamps
from fgtrack.pipeline.replay import with_origin
from fgtrack.runs import Run

# Least number of observations of a track. Most shorter tracks are clutter.
_MIN_OBSERVATIONS = 20
# Least number of measured components for a parameter.
_MIN_COUNT = 30
# The rounds end when no parameter moves by more than this share of its standard deviation.
_SETTLED = 0.2
# Largest standard errors, as shares of the value.
_KNOWN = 0.05
_ROUGHLY_KNOWN = 0.5
# Drop of the log-likelihood at the border of a 95 % interval.
_REJECTED = 1.92
# Least gate in standard deviations. Errors that a narrow gate cuts off would be missing in the noise.
_GATE_STDS = 4.0
# Factor on the motion noise in two further starts of the search, which multiply and divide by it.
_START_FACTOR = 5.0
# Number of tracks, and of observations of each, on which the starts are compared.
_START_TRACKS = 3
_START_OBSERVATIONS = 200
_NO_MAXIMUM = "no maximum: the likelihood still rises after a factor of 10^4, as for errors of exactly 0"
_KEPT = "kept as configured (keep)"


def tune(
    recordings: str | Path | Sequence[str | Path],
    config: ConfigLike | None = None,
    *,
    map: str | Path | None = None,  # noqa: A002 - the name of the option
    pit_map: str | Path | None = None,
    set: Mapping[str, object] | None = None,  # noqa: A002 - the name of the option
    keep: Sequence[str] = (),
) -> TuneReport:
    """Fit process and measurement noise to recordings; `report.config` is the tuned configuration.

    `recordings` is the path of a recording in any format that fgtrack reads, or several
    paths. `config`, `map`, `pit_map` and `set` are as in `fgtrack.replay`. Keys in
    `keep` stay as configured: `["motion.std_per_s.speed"]`.

    Raises `CallError` for an invalid configuration. Raises `DataError` if a recording
    cannot be read, a sensor has no model, or nothing can be fitted. Warns of sensors
    with an open question, which are left out.
    """
    resolved = read_config(config, set, track_map=map, pit_map=pit_map)
    paths: Sequence[str | Path] = [recordings]  # type: ignore[list-item]  # `opened` reports an invalid path
    if isinstance(recordings, Sequence) and not isinstance(recordings, str):
        paths = recordings
    sources, resolved, problems = opened_together(paths, resolved)
    for line in problems:
        warnings.warn(line, stacklevel=2)
    return tune_sources(sources, resolved, TuneRules(keep=tuple(keep)))


def tune_sources(
    sources: Mapping[str, InputSource],
    config: Config,
    rules: TuneRules | None = None,
    on_step: Callable[[str], None] = lambda text: None,
) -> TuneReport:
    """Fit noise to recordings that are open already; see `tune`.

    `sources` maps the name of each recording to its source, which yields messages in receipt order. `on_step` is called
    with the name of each step.
    """
    messages: dict[str, list[Message]] = {}
    broken: dict[str, str] = {}
    for name, source in sources.items():
        readable = UntilBreak(source.messages())
        messages[name] = list(readable)
        if readable.error is not None:
            broken[name] = with_origin(str(readable.error), name)
            if not messages[name]:
                readable.raise_error()
    together = replace(
        next(iter(sources.values())),
        messages=lambda: chain.from_iterable(messages.values()),
    )
    config = assumed(config, together).config
    return _Tuning(ConfigNoise(config), messages, rules or TuneRules(), on_step).report(
        broken
    )


class _Tuning:
    """Steps of a fit: association, start values, stamps, maximum, validation."""

    def __init__(
        self,
        noise: ConfigNoise,
        recordings: Mapping[str, Sequence[Message]],
        rules: TuneRules,
        on_step: Callable[[str], None],
    ) -> None:
        self._noise = noise
        self._recordings = recordings
        self._rules = rules
        self._on_step = on_step
        self._space = noise.space
        self._configured = noise.values
        self._kept = np.isin(noise.keys, rules.keep)
        # True for standard deviations, False for shares of outliers.
        self._is_std = np.array([bool(name) for _, name in noise.space.names])
        self._unbounded = np.zeros(len(self._kept), dtype=np.bool_)
        self._configured_stamps = noise.stamp_stds
        self._stamps = list[TunedParameter]()
        for key in rules.keep:
            if key not in (*noise.keys, *map(stamp_key, self._configured_stamps)):
                raise CallError(
                    f"keep {key}: not a noise parameter of the configuration, use {', '.join(filter(None, noise.keys))}"
                )

    def report(self, broken: Mapping[str, str]) -> TuneReport:
        """Run rounds of association and fit; return the tuned noise with its validation.

        Each round fits to the first part of the recordings. The held-out rest validates
        the last one. The final fit uses everything.
        """
        series, runs = self._associated(self._configured)
        splits_ns = [self._split_ns(tracks) for tracks in series]
        values = self._configured
        rounds = 0
        settled = False
        while not settled and rounds < self._rules.max_rounds:
            if rounds:
                self._on_step(f"association {rounds + 1}")
                series, runs = self._associated(values)
                series = [
                    [with_mixed_marked(item, self._space, values) for item in tracks]
                    for tracks in series
                ]
            rounds += 1
            parts = zip(series, splits_ns, strict=True)
            first = [
                replace(item, until_ns=end_ns)
                for tracks, end_ns in parts
                for item in tracks
            ]
            problem = self._fit_stamps(
                Problem(first, self._space, self._configured), values
            )
            if rounds == 1:
                values = self._best_start(problem)
            self._on_step(f"fit {rounds}")
            before = values
            values, likelihood, free = self._maximum(problem, values)
            change = np.abs(np.log(values[free] / before[free]))
            still = (change <= _SETTLED * likelihood.spread(np.log(values[free]))).all()
            # The first round cannot be the last: it does not mark mixed observations.
            settled = rounds > 1 and bool(still)
        values, likelihood, parameters = self._fitted(problem, values)
        held_out = None
        if self._rules.train_share < 1.0:
            held_out = self._held_out(values, series, splits_ns)
            self._on_step("fit to everything")
            problem = replace(problem, series=list(chain.from_iterable(series)))
            values, likelihood, parameters = self._fitted(problem, values)
        sensors = tuple(
            self._sensor(name, problem, values) for name in self._space.sensors
        )
        count = sum(item.count for item in sensors)
        return TuneReport(
            config=self._noise.config_with(values),
            parameters=(*parameters, *self._stamps),
            sensors=sensors,
            held_out=held_out,
            log_likelihood=float(likelihood.totals(values[None])[0]) / count,
            count=count,
            num_tracks=len(problem.series),
            num_mixed=sum(len(item.mixed) for item in problem.series),
            rounds=rounds,
            settled=settled,
            broken=broken,
            runs=tuple(runs),
        )

    def _fit_stamps(self, problem: Problem, values: FloatArray) -> Problem:
        """Fit the configured standard deviations of stamps; return `problem` with them.

        They are fitted before all other noise. Otherwise the standard deviation along
        the line of sight would absorb the stamp errors of objects that move along it.
        """
        self._stamps = []
        rates = stamp_rates(problem, values) if self._configured_stamps else []
        for name, was_s in self._configured_stamps.items():
            used_s = self._noise.stamp_stds[name]
            key = stamp_key(name)
            fit = StampFit(was_s, math.inf)
            known: Known = "no"
            why = _KEPT
            if key not in self._rules.keep:
                fit = fitted_stamps(problem, rates, values, name, used_s)
                known = _identifiability(fit.std_error)
                why = "" if known != "no" else _flat(fit.std_error)
            std_s = was_s if known == "no" else float(f"{fit.std_s:.4g}")
            self._noise = self._noise.with_stamps(name, std_s)
            problem = with_stamps(problem, rates, name, used_s, std_s)
            error = None if known == "no" else fit.std_error
            self._stamps.append(TunedParameter(key, was_s, std_s, error, known, why))
        return problem

    def _associated(self, values: FloatArray) -> tuple[list[list[Series]], list[Run]]:
        """Replay the recordings with the noise `values`; return their long tracks and their runs."""
        # The estimator ekf-replay fuses late data.
        config = replace(self._noise.config_with(values), estimator="ekf-replay")
        all_series = []
        runs = []
        for name, messages in self._recordings.items():
            series, run = recorded_series(messages, config, name, _GATE_STDS)
            most = self._rules.max_observations
            long = [
                item for item in series if len(item.observations) >= _MIN_OBSERVATIONS
            ]
            all_series.append(
                [replace(item, observations=item.observations[:most]) for item in long]
            )
            runs.append(run)
        return all_series, runs

    def _split_ns(self, tracks: Sequence[Series]) -> float:
        """Return the stamp at which the held-out part of a recording begins; infinity if no part is held out."""
        if self._rules.train_share == 1.0:
            return math.inf
        stamps_ns = [
            item.measurement.stamp_ns for track in tracks for item in track.observations
        ] or [0]
        return min(stamps_ns) + round(
            self._rules.train_share * (max(stamps_ns) - min(stamps_ns))
        )

    def _maximum(
        self, problem: Problem, start: FloatArray
    ) -> tuple[FloatArray, Likelihood, BoolArray]:
        """Return the parameters at the maximum, the likelihood there, and the mask of free parameters.

        The other parameters keep their configured values.
        """
        while True:
            free = self._free(problem)
            values, likelihood = problem.maximum(start, free)
            unbounded = free & problem.without_maximum(values)
            if not unbounded.any():
                return values, likelihood, free
            self._unbounded |= unbounded
            start = np.where(unbounded, self._configured, values)

    def _free(self, problem: Problem) -> BoolArray:
        """Return the mask of parameters that are fitted: enough measurements, a maximum, and not kept.

        Raises `DataError` if no standard deviation can be fitted.
        """
        free = np.asarray(
            (problem.counts() >= _MIN_COUNT) & ~self._kept & ~self._unbounded
        )
        if not free[self._is_std].any():
            raise self._nothing_to_fit(
                f"no free parameter has {_MIN_COUNT} measurements on tracks of moving objects; use a longer recording, "
                "check the gate of the association, and see `fgtrack info` for sensors without a model"
            )
        return free

    def _nothing_to_fit(self, why: str) -> DataError:
        if self._unbounded.any():
            keys = ", ".join(np.array(self._noise.keys)[self._unbounded])
            why = f"the errors of {keys} are 0 or almost 0: was the recording simulated without noise?"
        return DataError(
            f"{', '.join(self._recordings)}: nothing to fit noise to: {why}"
        )

    def _best_start(self, problem: Problem) -> FloatArray:
        """Return the best of three start vectors: the one that reaches the highest maximum on a part of the data.

        Returns the configured values if the part is too small for a comparison.
        """
        self._on_step("starts")
        longest = sorted(problem.series, key=lambda item: -len(item.observations))[
            :_START_TRACKS
        ]
        shortened = [
            replace(item, observations=item.observations[:_START_OBSERVATIONS])
            for item in longest
        ]
        part = replace(problem, series=shortened)
        free = self._free(problem) & (part.counts() >= _MIN_COUNT)
        if not free.any():  # the part is too small for a comparison
            return self._configured.copy()
        moving = np.flatnonzero(free[: self._space.num_motion])
        reached: list[tuple[float, FloatArray]] = []
        for factor in (1.0, _START_FACTOR, 1.0 / _START_FACTOR):
            start = self._configured.copy()
            start[moving] *= factor
            values, likelihood = part.maximum(start, free)
            reached.append((likelihood.cost(np.log(values[free])).objective, values))
        return min(reached, key=lambda item: item[0])[1]

    def _fitted(
        self, problem: Problem, start: FloatArray
    ) -> tuple[FloatArray, Likelihood, tuple[TunedParameter, ...]]:
        """Return the maximum with identifiable parameters only, the likelihood, and a report by parameter.

        A parameter that is not identifiable keeps its configured value. If the data reject this value, the parameter
        gets the nearest value that they do not reject. The other parameters are not refitted, as they would compensate
        for it.

        Raises `DataError` if no parameter is identifiable.
        """
        count = len(start)
        known: list[Known] = ["no"] * count
        values, likelihood, free = self._maximum(problem, start)
        why = np.full(
            count, f"fewer than {_MIN_COUNT} measurements on tracks", dtype=object
        )
        why[self._unbounded] = _NO_MAXIMUM
        why[self._kept] = _KEPT
        log_std = np.full(count, math.nan)
        log_std[free] = likelihood.log_std(np.log(values[free]))
        errors = log_std.copy()
        for row in sorted(
            np.flatnonzero(free & self._is_std).tolist(), key=lambda item: -errors[item]
        ):
            why[row] = ""
            known[row] = _identifiability(errors[row])
            if known[row] != "no":
                continue
            limit = self._limit(likelihood, values, row)
            if limit == self._configured[row]:
                why[row] = _flat(errors[row])
            else:
                known[row] = "limit"
                why[row] = (
                    f"only bounded: {'below' if values[row] < limit else 'above'} {limit:.3g} at 95 %"
                )
            values[row] = limit
            log_std[row] = math.nan
        if not {"yes", "roughly"} & set(known):
            raise self._nothing_to_fit(
                "no parameter is identifiable from these measurements; use a longer recording"
            )
        tuned_values = ConfigNoise(self._noise.config_with(values)).values
        rows = zip(
            self._noise.keys,
            self._configured,
            tuned_values,
            log_std,
            known,
            why,
            strict=True,
        )
        parameters = [
            TunedParameter(
                key,
                float(was),
                float(now),
                None if math.isnan(error) else float(error),
                how,
                reason,
            )
            for key, was, now, error, how, reason in rows
            if key
        ]
        return values, likelihood, tuple(parameters)

    def _limit(self, likelihood: Likelihood, values: FloatArray, row: int) -> float:
        """Return the value of parameter `row` nearest to its configured value that the data do not reject at 95 %.

        The other parameters keep their `values`, the maximum.
        """
        shares = np.linspace(0.0, 1.0, 41)
        rows = np.broadcast_to(values, (len(shares), len(values))).copy()
        rows[:, row] = values[row] * (self._configured[row] / values[row]) ** shares
        heights = likelihood.totals(rows)
        rejected = np.flatnonzero(heights < heights[0] - _REJECTED)
        if not len(rejected):
            return float(self._configured[row])
        return float(rows[max(int(rejected[0]) - 1, 0), row])

    def _held_out(
        self,
        trained: FloatArray,
        series: Sequence[Sequence[Series]],
        splits_ns: Sequence[float],
    ) -> HeldOut | None:
        """Validate the parameters `trained`, fitted to the first part, on the rest of the recordings.

        Returns None if the rest has no innovations that count.
        """
        rest = [
            replace(item, from_ns=at_ns)
            for tracks, at_ns in zip(series, splits_ns, strict=True)
            for item in tracks
        ]
        before, squares_before = self._scored(
            rest, np.where(self._is_std, self._configured, trained)
        )
        after, squares_after = self._scored(rest, trained)
        if not before:
            return None
        innovations = tuple(
            InnovationFit(
                *name,
                len(squares),
                float(np.mean(squares)),
                float(np.mean(squares_after[name])),
                1.96 * math.sqrt(2.0 / len(squares)),
            )
            for name, squares in sorted(squares_before.items())
        )
        return HeldOut(
            1.0 - self._rules.train_share,
            len(before),
            float(np.mean(before)),
            float(np.mean(after)),
            innovations,
        )

    def _scored(
        self, series: Sequence[Series], values: FloatArray
    ) -> tuple[list[float], dict[tuple[str, str], list[float]]]:
        """Return the log-likelihoods of the counted innovations, and their squared components over the variances.

        The squares are lists by sensor and component. `values` are the parameters, shape (p,).
        """
        terms = list[float]()
        squares = dict[tuple[str, str], list[float]]()
        for item in series:
            for step in compress(filtered(item, self._space, values), item.counted):
                terms.append(float(step.update.log_likelihood))
                observation = step.observation
                names = [
                    observation.measurement.model.components[i]
                    for i in observation.measured
                ]
                for name, square in zip(
                    names, np.square(step.y) / np.diag(step.update.S), strict=True
                ):
                    squares.setdefault((observation.sensor, name), []).append(
                        float(square)
                    )
        return terms, squares

    def _sensor(self, name: str, problem: Problem, values: FloatArray) -> SensorNoise:
        row = self._space.names.index((name, ""))
        count = int(problem.counts()[row])
        observations = chain.from_iterable(item.observations for item in problem.series)
        own = sum(item.sensor == name and not item.tuned for item in observations)
        return SensorNoise(
            name, count, own, float(outlier_share(values[row])) if count else None
        )


def _identifiability(std_error: float) -> Known:
    """Return `yes`, `roughly` or `no` for a parameter with this relative standard error."""
    if std_error <= _KNOWN:
        return "yes"
    return "roughly" if std_error <= _ROUGHLY_KNOWN else "no"


def _flat(std_error: float) -> str:
    return f"flat likelihood: standard error {100.0 * std_error:.0f} %"
