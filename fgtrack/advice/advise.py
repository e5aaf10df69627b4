"""The steps of `fgtrack advise`: findings in order of importance, and a configuration that follows them."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import count
from pathlib import Path

from fgtrack.advice.ledger import SUMMARY_S, summary
from fgtrack.advice.page import Advice
from fgtrack.advice.paired_replay import PairedReplay
from fgtrack.advice.run_quality import RunQuality, harm, noise_findings, objection
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
from fgtrack.meaning.draft import drafted
from fgtrack.meaning.input_checks import TRIAL_S, input_checks, messages_within
from fgtrack.noise.parameters import TuneRules
from fgtrack.noise.tune import tune_sources
from fgtrack.pipeline.clock import corrected
from fgtrack.pipeline.replay import replay_in_memory
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
    return Adviser(str(recording), messages, result, reference, on_step).advice(
        broken, tune, ledger
    )


class Adviser:
    """Steps of `advise`. Each step uses the settings from the steps before it."""

    def __init__(
        self,
        recording: str,
        messages: Sequence[Message],
        found: Assumed,
        reference: str | None = None,
        on_step: Callable[[str, float], None] = lambda text, share: None,
    ) -> None:
        self._recording = recording
        self._messages = messages
        self._reference = reference
        self._on_step = on_step
        self._assumed = found
        self._config = found.config
        self._findings: list[Finding] = []
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
        self._take(self._unknown_sensors())
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
        for name in [*sensors, *([EGO] if EGO in self._arrivals else [])]:
            self._take(stamp_findings(self._arrivals[name]))
        for one in input_checks(
            list(messages_within(self._messages, nanoseconds(TRIAL_S))), self._config
        ):
            self._take(
                [
                    Finding(
                        "input",
                        one.about,
                        94.0 if one.is_blocking else 45.0,
                        f"{one.text}.",
                        one.settings,
                    )
                ]
            )
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
        self._withdraw_harm(before)
        new = self._outcome(self._config)
        if new is not None and not self._is_useless:
            self._take(noise_findings(new))
        if tune and new is not None:
            self._take(self._tuned(new))
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
        return Advice(
            recording=self._recording,
            findings=tuple(sorted(self._findings, key=lambda one: -one.weight)),
            fine=tuple(self._fine(seen, new)),
            config=self._config,
            arrivals=tuple(seen.values()),
            overtaken=shares,
            before=old,
            after=new,
            broken=broken,
            ledger=policies,
        )

    def _take(self, findings: Iterable[Finding]) -> None:
        """Store findings and apply their settings."""
        for item in findings:
            self._findings.append(item)
            self._config = read_config(self._config, item.settings)

    def _withdraw_harm(self, before: Config) -> None:
        """Withdraw settings that make the replay worse; their findings stay."""
        if self._is_harm(before, self._config) is None:
            return
        self._config = before
        for one in sorted(
            filter(lambda one: one.settings, self._findings),
            key=lambda one: -one.weight,
        ):
            config = read_config(self._config, one.settings)
            worse = self._is_harm(self._config, config)
            if worse is None:
                self._config = config
                continue
            keys = ", ".join(one.settings)
            text = (
                f"{one.text} {keys} would correct this, but then {worse}: not changed."
            )
            self._findings[self._findings.index(one)] = replace(
                one, text=text, settings={}
            )

    def _is_harm(self, old: Config, new: Config) -> str | None:
        """Return a sentence on the result that gets worse from `old` to `new`; None if none does."""
        before = self._outcome(old)
        after = self._outcome(new)
        if old == new or before is None or after is None:
            return None
        return harm(before, after)

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

        A smoother is replaced by the replaying EKF, which is faster. Outcomes are
        cached.
        """
        for known, outcome in self._outcomes:
            if known == config:
                return outcome
        fast = config
        result = None
        if config.estimator.startswith("smoother"):
            storage_s = min(config.effective.reach_s, LONGEST_STORAGE_S)
            fast = replace(
                fast,
                estimator="ekf-replay",
                filter=replace(config.filter, storage_s=storage_s),
            )
        with suppress(DataError):
            result = RunQuality.of(replay_in_memory(self._tracked, fast))
        self._outcomes.append((config, result))
        return result

    def _fine(
        self, seen: Mapping[str, Arrivals], outcome: RunQuality | None
    ) -> Iterator[str]:
        """Yield the checks without a finding."""
        wrong = {(item.kind, item.about) for item in self._findings}
        kinds = {kind for kind, _ in wrong}
        ego = self._arrivals.get(EGO)
        if (
            ego is not None
            and not wrong & {("ego", EGO), ("clock", EGO), ("input", EGO)}
            and ego.period_s
        ):
            longest = milliseconds(float(ego.steps_s.max()))
            delay = milliseconds(ego.quantile_s(0.5))
            yield f"the ego ({1.0 / ego.period_s:.0f} Hz, longest gap {longest}, delay {delay})"
        offsets = [] if self._clocks is None else self._clocks.others
        noise = () if outcome is None else outcome.noise
        stamped = [
            name
            for name, item in seen.items()
            if len(item.stamps_ns) >= FEWEST and not item.is_receipt
        ]
        named = {
            "stamps": [name for name in stamped if ("clock", name) not in wrong],
            "clock": [
                item.sensor for item in offsets if item.is_known and not item.is_off
            ],
            "noise": [
                item.sensor
                for item in noise
                if ("noise", item.sensor) not in wrong and item.is_consistent
            ],
        }
        yield from (
            f"{what} of {', '.join(names)}" for what, names in named.items() if names
        )
        if not kinds & {"input", "model"}:
            yield "frames, angles and fields"
        if "window" not in kinds and any(item.has_stamps for item in seen.values()):
            found = self._config.effective
            yield f"{found.lag_key} ({found.lag_s:g} s) and max_delay_s"
        if "track" not in kinds and outcome is not None and outcome.truth is not None:
            tracked = percent(outcome.truth.tracked_share_in_view)
            yield f"tracks ({outcome.births} births, {tracked} of the time in view tracked)"
