"""The steps of `fgtrack advise`: findings in order of importance, and a configuration that follows them."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import count
from pathlib import Path

from fgtrack.advice.changes import Recorded
from fgtrack.advice.checks import Check, Evidence, checks
from fgtrack.advice.ledger import SUMMARY_S, summary
from fgtrack.advice.page import Advice
from fgtrack.advice.paired_replay import PairedReplay
from fgtrack.advice.proposals import benefit, effect
from fgtrack.advice.run_quality import RunQuality, harm, noise_findings, objection
from fgtrack.clocks.agreement import Agreement, agreement_findings, agreements
from fgtrack.clocks.arrivals import (
    FEWEST,
    LONGEST_STORAGE_S,
    Arrivals,
    arrivals_of,
    overtaken_shares,
    window_findings,
)
from fgtrack.clocks.offsets import OffsetReport, estimate_offsets
from fgtrack.clocks.stamps import bias_findings, clock_findings, stamp_findings
from fgtrack.config.reading import ConfigLike, read_config
from fgtrack.config.settings import Config
from fgtrack.core.diagnostic import EGO, late_ego
from fgtrack.core.errors import CallError, DataError
from fgtrack.core.finding import Finding, milliseconds, percent
from fgtrack.core.time import nanoseconds
from fgtrack.core.types import DetectionList, Message
from fgtrack.evaluation.diagnostics import diagnostics
from fgtrack.inputs.errors import UntilBreak
from fgtrack.meaning.assumed import source_of
from fgtrack.meaning.assumption import Assumed
from fgtrack.meaning.corrected import corrected
from fgtrack.meaning.decision import Decision
from fgtrack.meaning.draft import drafted
from fgtrack.meaning.input_checks import TRIAL_S, input_checks, messages_within
from fgtrack.meaning.placement import mounts_of, plain_mount
from fgtrack.meaning.sample import SAMPLE_S
from fgtrack.meaning.times import clock_constant
from fgtrack.noise.parameters import TuneRules
from fgtrack.noise.tune import tune_sources
from fgtrack.pipeline.replay import replay_in_memory
from fgtrack.runs import Run
from fgtrack.tracking.ego.trajectory import MAX_EXTRAPOLATION_S

__all__ = ["Adviser", "advise"]

TRACKED_S = 300.0
"""Length of the first part of the recording that is tracked, to assess clocks and noise.

Delays are taken from the whole recording.
"""
TUNED_S = 60.0
"""Length of the first part of the recording to which noise is fitted."""
# No part is held out: a replay validates the fitted noise.
_TUNE_RULES = TuneRules(train_share=1.0, max_rounds=3, max_observations=1500)
# A finding of this weight without a setting makes further checks meaningless.
_USELESS = 90.0
# Share of overtaken lists of a sensor above which a finding is given.
_OFTEN = 0.05
_SLOW_EGO_S = 0.2


def advise(
    recording: str | Path,
    config: ConfigLike | None = None,
    *,
    map: str | Path | None = None,  # noqa: A002 - the name of the option
    pit_map: str | Path | None = None,
    set: Mapping[str, object] | None = None,  # noqa: A002 - the name of the option
    reference: str | None = None,
    tune: bool = False,
    ledger: bool = False,
    on_step: Callable[[str, float], None] = lambda text, share: None,
) -> Advice:
    """Return findings on a recording, and the settings that correct them; `advice.config` contains these.

    The recording is replayed before and after. Settings that make the tracks worse are
    not advised. `config`, `map`, `pit_map` and `set` are as in `fgtrack.replay`.
    `reference` is the sensor with the correct clock; it is needed if two clocks differ
    and the recording has no truth. With `tune`, inconsistent noise is fitted. With
    `ledger`, policies for late lists are compared over the first minute. `on_step` is
    called before each step with its name and the finished share.

    Raises `CallError` for an invalid configuration, and `DataError` if nothing can be
    read or tracked.
    """
    resolved = read_config(config, set, track_map=map, pit_map=pit_map)
    on_step("reading", 0.0)
    draft = drafted(recording, resolved)
    readable = UntilBreak(draft.source.messages())
    messages = list(readable)
    broken = None if readable.error is None else str(readable.error)
    result = Assumed(draft.config, draft.assumed.assumptions)
    adviser = Adviser(
        str(recording), messages, result, reference, on_step, draft.decisions
    )
    advice = adviser.advice(broken, tune, ledger)
    return replace(advice, config=draft.asking(advice.config))


class Adviser:
    """Steps of `advise`. Each step uses the settings from the steps before it."""

    def __init__(
        self,
        recording: str,
        messages: Sequence[Message],
        found: Assumed,
        reference: str | None = None,
        on_step: Callable[[str, float], None] = lambda text, share: None,
        decisions: Sequence[Decision] = (),
    ) -> None:
        self._recording = recording
        self._messages = messages
        self._reference = reference
        self._on_step = on_step
        self._assumed = found
        self._config = found.config
        self._decisions = decisions
        self._findings: list[Finding] = []
        # Findings with settings that have not helped alone; together they may.
        self._pending: list[Finding] = []
        self._agreements: list[Agreement] = []
        self._arrivals = arrivals_of(messages)
        self._tracked = list(messages_within(messages, nanoseconds(TRACKED_S)))
        self._outcomes: list[tuple[Config, RunQuality | None]] = []
        self._clocks: OffsetReport | None = None

    def advice(
        self, broken: str | None = None, tune: bool = False, ledger: bool = False
    ) -> Advice:
        """Run all steps and return the advice.

        `broken` is the reason why the recording can be read only in part, or None.
        """
        if self._assumed.assumptions:
            text = f"not configured: {'. '.join(self._assumed.lines())}."
            self._findings.append(Finding("assumed", "sensors", 35.0, text))
        self._findings += self._questions()
        self._adopt(self._unknown_sensors())
        before = self._config
        sensors = [
            name
            for name in self._arrivals
            if name != EGO and name not in before.ignore_sensors
        ]
        if not sensors:
            raise DataError(
                f"{self._recording}: no detections of a configured sensor; configure its sensors (sensors.NAME)"
            )
        self._take(self._stamps(sensors))
        self._take(self._input())
        self._take(self._mounts())
        self._on_step("clocks", 0.1)
        self._take(self._offsets())
        seen = arrivals_of(
            corrected(message, self._config.sensors)
            for message in self._messages
            if isinstance(message, DetectionList) and message.sensor in sensors
        )
        shares = overtaken_shares(seen, sensors)
        self._take(self._late(shares))
        self._take(
            window_findings(
                [one for one in seen.values() if one.has_stamps], self._config
            )
        )
        self._take(self._ego(seen))
        self._on_step("tracking", 0.3)
        self._take(self._diagnostics(self._outcome(self._config)))
        self._settle()
        new = self._outcome(self._config)
        if new is not None:
            self._agreements = agreements(self._tracked, self._config, new.run)
            self._take(agreement_findings(self._agreements))
        if new is not None and not self._is_useless:
            evidence = self._evidence(seen, new)
            self._take(
                item
                for item in noise_findings(new)
                if evidence.doubt(item.about) is None
            )
        self._on_step("parts", 0.5)
        self._take(self._changes())
        if tune and new is not None:
            self._adopt(self._tuned(new))
        old = self._outcome(before)
        new = self._outcome(self._config)
        policies = None
        with suppress(DataError):  # no track can be assessed
            first = list(
                messages_within(
                    self._tracked, nanoseconds(SUMMARY_S if ledger else 0.0)
                )
            )
            policies = summary(PairedReplay.of(first, self._config)) if ledger else None
        made = checks(self._evidence(seen, new))
        self._findings += _failed_checks(made, self._findings)
        return Advice(
            recording=self._recording,
            findings=tuple(sorted(self._findings, key=lambda one: -one.weight)),
            checks=tuple(made),
            config=self._config,
            arrivals=tuple(seen.values()),
            overtaken=shares,
            before=old,
            after=new,
            broken=broken,
            ledger=policies,
        )

    def _adopt(self, findings: Iterable[Finding]) -> None:
        """Store findings and apply their settings; they are not replayed here."""
        for item in findings:
            self._findings.append(item)
            self._config = read_config(self._config, item.settings)

    def _take(self, findings: Iterable[Finding]) -> None:
        """Store findings; replay their settings, and apply those that help."""
        for item in findings:
            if not item.settings:
                self._findings.append(item)
                continue
            config = read_config(self._config, item.settings)
            helps = self._helps(config)
            if helps is None:
                self._pending.append(item)
                continue
            self._config = config
            self._findings.append(replace(item, effect=helps))

    def _settle(self) -> None:
        """Replay the pending settings together: apply them if they help together, else withdraw them."""
        together = self._config
        for item in self._pending:
            together = read_config(together, item.settings)
        helps = self._helps(together) if len(self._pending) > 1 else None
        for item in self._pending:
            keys = ", ".join(item.settings)
            if helps is not None:
                together_helps = f"with the other settings, {helps}"
                self._findings.append(replace(item, effect=together_helps))
                continue
            config = read_config(self._config, item.settings)
            old, new = self._outcome(self._config), self._outcome(config)
            worse = None if old is None or new is None else harm(old, new)
            why = worse or f"nothing improves ({effect(old, new)})"
            text = f"{item.text} {keys} was replayed, but {why}: not changed."
            self._findings.append(replace(item, text=text, settings={}))
        self._config = self._config if helps is None else together
        self._pending = []

    def _helps(self, config: Config) -> str | None:
        """Return a clause on the result that improves with `config`; None if none does, or if one gets worse."""
        old, new = self._outcome(self._config), self._outcome(config)
        if config == self._config or (
            old is not None and new is not None and harm(old, new) is not None
        ):
            return None
        return benefit(old, new)

    def _questions(self) -> Iterator[Finding]:
        """Yield the open questions about what the numbers of the recording mean."""
        for item in self._decisions:
            if item.certainty == "open":
                yield Finding(
                    "question", item.about, 96.0, f"{item.reason}. {item.question}."
                )

    def _stamps(self, sensors: Sequence[str]) -> Iterator[Finding]:
        """Yield known differences of clocks, and other findings on stamps, of the sensors and the ego."""
        for name in [*sensors, *([EGO] if EGO in self._arrivals else [])]:
            one = self._arrivals[name]
            constant = None
            offset_s = 0.0
            if name != EGO and one.stamps_ns.any():
                offset_s = self._config.sensors[name].clock_offset_s
                stamps_ns = one.stamps_ns - nanoseconds(offset_s)
                one = replace(one, stamps_ns=stamps_ns)
                if len(stamps_ns) >= FEWEST:
                    constant = clock_constant(one.delays_s)
            if constant is None:
                yield from stamp_findings(one)
                continue
            key = f"sensors.{name}.clock_offset_s"
            side = "after" if constant.offset_s > 0.0 else "before"
            text = (
                f"its stamps lie {abs(constant.offset_s):g} s {side} the recorder's clock ({constant.name}); after the "
                f"correction its median delay is {milliseconds(constant.delay_s)}."
            )
            total_s = round(offset_s + constant.offset_s, 4)
            yield Finding("clock", name, 93.0, text, {key: total_s})

    def _input(self) -> Iterator[Finding]:
        """Yield probable errors in the reading of the first seconds."""
        first = list(messages_within(self._messages, nanoseconds(TRIAL_S)))
        for one in input_checks(first, self._config):
            weight = 94.0 if one.is_blocking else 45.0
            yield Finding("input", one.about, weight, f"{one.text}.", one.settings)

    @property
    def _is_useless(self) -> bool:
        """True if a severe finding has no setting: further checks are meaningless then."""
        return any(
            item.weight >= _USELESS and not item.settings for item in self._findings
        )

    def _unknown_sensors(self) -> Iterator[Finding]:
        """Yield the sensors of the recording that are not configured."""
        known = {*self._config.sensors, *self._config.ignore_sensors, EGO}
        unknown = [name for name in self._arrivals if name not in known]
        if not unknown:
            return
        lists = [
            item
            for item in self._messages
            if isinstance(item, DetectionList) and item.objects
        ]
        first = {
            item.sensor: ", ".join(item.objects[0].measured) for item in reversed(lists)
        }
        has = "; ".join(f"{name}: {first.get(name, 'nothing')}" for name in unknown)
        text = f"no model of {', '.join(unknown)} ({has}): set sensors.NAME.std, or ignore them."
        ignored = sorted({*self._config.ignore_sensors, *unknown})
        yield Finding("model", "sensors", 98.0, text, {"ignore_sensors": ignored})

    def _diagnostics(self, outcome: RunQuality | None) -> Iterator[Finding]:
        """Yield the diagnostics of a run with the advised settings.

        Sensors with a known severe problem, and known sentences, are skipped.
        """
        known = {one.about for one in self._findings if one.weight >= _USELESS}
        told = {one.text for one in self._findings}
        for one in [] if outcome is None else diagnostics(outcome.run):
            if one.about not in known and f"{one.text}." not in told:
                yield Finding("track", one.about, 70.0, f"{one.text}.", one.settings)

    def _mounts(self) -> Iterator[Finding]:
        """Yield mounts that differ from the configured ones, against other sensors or objects that stand still."""
        if self._is_useless:
            return
        first = list(messages_within(self._tracked, nanoseconds(SAMPLE_S)))
        lists = [item for item in first if isinstance(item, DetectionList)]
        frames = {item.sensor: item.frame for item in lists if item.objects}
        mounts = mounts_of(first, self._config)
        for item in mounts.sensors:
            if not item.is_off or not mounts.is_placed(item.sensor):
                continue
            reference = mounts.references[item.sensor]
            source = (
                f"relative to {reference}"
                if reference != item.sensor
                else "relative to objects that stand still"
            )
            key = f"sensors.{item.sensor}.mount"
            text = f"its mount differs from the configured one. Estimated {source}: {item.words}."
            settings = {key: plain_mount(item.pose)}
            if frames.get(item.sensor) != "sensor":
                text += f" Set `frame: sensor` in its input, and {key} to this mount."
                settings = {}
            yield Finding("mount", item.sensor, 75.0, text, settings)

    def _offsets(self) -> Iterator[Finding]:
        """Yield clock offsets and position biases, if they can be estimated."""
        if self._is_useless:
            return
        doubtful = {item.about for item in self._findings if item.kind == "clock"}
        unlimited = all(
            sensor.max_delay_s is None for sensor in self._config.sensors.values()
        )
        # The run can be reused if it refuses no message for its delay.
        is_same = unlimited and self._config.estimator != "ekf-backward-forward"
        try:
            outcome = self._outcome(self._config) if is_same else None
            self._clocks = estimate_offsets(
                self._tracked,
                self._config,
                self._reference,
                doubtful,
                None if outcome is None else outcome.run,
            )
        except (DataError, CallError) as error:
            if self._reference is not None and isinstance(error, CallError):
                raise
            return
        yield from clock_findings(
            self._clocks,
            {
                name: sensor.clock_offset_s
                for name, sensor in self._config.sensors.items()
            },
        )
        yield from bias_findings(self._clocks, self._config.ego)

    def _changes(self) -> Iterator[Finding]:
        """Yield what changes along a long recording: clocks, mounts and noise."""
        if not self._is_useless:
            config = self._config
            yield from Recorded(
                self._messages, config, lambda part: self._run(part, config)
            ).findings()

    def _late(self, shares: Mapping[str, float]) -> Iterator[Finding]:
        """Yield a finding if lists are often overtaken and the estimator cannot handle this."""
        often = {name: share for name, share in shares.items() if share > _OFTEN}
        if often and self._config.estimator == "ekf-backward-forward":
            named = ", ".join(
                f"{percent(share)} of {name}" for name, share in often.items()
            )
            text = (
                f"newer lists overtake older ones ({named}), and ekf-backward-forward forgets all measurements fused "
                "after the stamp of a late list; smoother keeps them too, if the output may wait."
            )
            yield Finding("late", "estimator", 60.0, text, {"estimator": "ekf-replay"})

    def _ego(self, seen: Mapping[str, Arrivals]) -> Iterator[Finding]:
        """Yield gaps and low rates of the ego states, and an ego that arrives later than the lists in a moving frame.

        `seen` are the arrivals of the sensors.
        """
        one = self._arrivals.get(EGO)
        if one is None or len(one.stamps_ns) < FEWEST or not one.has_stamps:
            return
        limit_s = MAX_EXTRAPOLATION_S
        gaps_s = one.steps_s
        long_s = gaps_s[gaps_s > 2.0 * limit_s]
        if len(long_s):
            text = (
                f"{len(long_s)} gaps in its states are longer than {2.0 * limit_s:g} s, up to {long_s.max():.3g} s: "
                "detections in the middle of a gap cannot be transformed to the map, and fail."
            )
            yield Finding("ego", EGO, 65.0, text)
        lists = (item for item in self._messages if isinstance(item, DetectionList))
        moving = {item.sensor for item in lists if item.frame != "map"}
        delays_s = {
            name: each.quantile_s(0.5)
            for name, each in seen.items()
            if name in moving and each.has_stamps
        }
        if late := late_ego(one.quantile_s(0.5), delays_s):
            yield Finding("ego", EGO, 55.0, f"{late.text}.")
        if one.period_s > _SLOW_EGO_S:
            text = (
                f"one state every {milliseconds(one.period_s)}: the interpolated pose is uncertain in a turn. Record "
                "the ego at a higher rate."
            )
            yield Finding("ego", EGO, 35.0, text)

    def _tuned(self, before: RunQuality) -> Iterator[Finding]:
        """Yield the noise fitted to the recording, or the reason why it is not adopted."""
        is_assumed = any(
            item.key.endswith(".std") for item in self._assumed.assumptions
        )
        if not is_assumed and not any(item.kind == "noise" for item in self._findings):
            return
        steps = count()
        messages = list(messages_within(self._tracked, nanoseconds(TUNED_S)))
        try:
            report = tune_sources(
                {self._recording: source_of(lambda: messages)},
                self._config,
                _TUNE_RULES,
                lambda text: self._on_step(
                    f"tune: {text}", 0.9 - 0.55 * 0.8 ** next(steps)
                ),
            )
        except DataError as error:
            yield Finding("tune", "tune", 76.0, f"no noise is changed: {error}.")
            return
        self._on_step("tracking", 0.9)
        after = self._outcome(report.config)
        why = None if after is None else objection(before, after)
        if why is not None:
            yield Finding(
                "tune",
                "tune",
                76.0,
                f"no noise is changed: with the fitted noise, {why}.",
            )
            return
        settings = {
            item.key: item.tuned
            for item in report.parameters
            if item.tuned != item.configured
        }
        stay = ", ".join(
            item.key for item in report.parameters if item.key not in settings
        )
        rest = f" Unchanged: {stay}." if stay else ""
        yield Finding(
            "tune",
            "tune",
            76.0,
            f"noise fitted to the recording by maximum likelihood.{rest}",
            settings,
        )

    def _outcome(self, config: Config) -> RunQuality | None:
        """Return the outcome of the first minutes with `config`; None if nothing can be tracked.

        Outcomes are cached.
        """
        for known, outcome in self._outcomes:
            if known == config:
                return outcome
        run = self._run(self._tracked, config)
        result = None if run is None else RunQuality.of(run)
        self._outcomes.append((config, result))
        return result

    def _run(self, messages: Sequence[Message], config: Config) -> Run | None:
        """Return the run of `messages` with `config`; None if nothing can be tracked.

        A smoother is replaced by the replaying EKF, which is faster.
        """
        if config.estimator.startswith("smoother"):
            storage_s = min(config.effective.reach_s, LONGEST_STORAGE_S)
            config = replace(
                config,
                estimator="ekf-replay",
                filter=replace(config.filter, storage_s=storage_s),
            )
        with suppress(DataError):
            return replay_in_memory(messages, config)
        return None

    def _evidence(
        self, seen: Mapping[str, Arrivals], outcome: RunQuality | None
    ) -> Evidence:
        """Return the results on which the tests are based."""
        lists = (item for item in self._messages if isinstance(item, DetectionList))
        return Evidence(
            self._config,
            self._findings,
            self._arrivals.get(EGO),
            seen,
            {item.sensor for item in lists if item.frame != "map"},
            self._clocks,
            self._agreements,
            self._decisions,
            outcome,
        )


# Kinds of the findings that report a failed test, by its property; other tests fail by their findings.
_REPORTED_BY = {
    "use": ("track", "clock", "input", "question"),
    "births": ("track",),
    "breaks": ("track",),
    "truth": (),
    "positions against speed": (),
}


def _failed_checks(made: Iterable[Check], findings: Sequence[Finding]) -> list[Finding]:
    """Return findings on the failed tests that no finding reports yet."""
    known = {(item.kind, item.about) for item in findings}
    return [
        Finding("test", one.about, 60.0, f"{one.what}: {one.text}.")
        for one in made
        if one.verdict == "finding"
        and one.what in _REPORTED_BY
        and not any((kind, one.about) in known for kind in _REPORTED_BY[one.what])
    ]
