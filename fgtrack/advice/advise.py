"""The advice of `fgtrack advise`: findings in order of importance, and a configuration that follows it."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from fgtrack.advice.arrivals import FEWEST, Arrivals, arrivals_of, overtaken
from fgtrack.advice.clocks import offset_findings, receipt_findings, stamp_findings
from fgtrack.advice.finding import Finding, milliseconds, percent
from fgtrack.advice.noise import NoiseFit, noise_findings, noise_fits, objection
from fgtrack.advice.page import Advice
from fgtrack.advice.windows import beyond_lags, window_findings
from fgtrack.core.caution import EGO
from fgtrack.core.errors import CallError, DataError
from fgtrack.core.time import nanoseconds
from fgtrack.core.types import DetectionList, Message
from fgtrack.evaluation.cautions import USED, cautions
from fgtrack.io.errors import UntilBreak
from fgtrack.io.run import Run
from fgtrack.io.source import open_input
from fgtrack.pipeline.assumed import assumed, source_of
from fgtrack.pipeline.clock_offsets import OffsetReport, OffsetRules, estimate_offsets
from fgtrack.pipeline.config import Config
from fgtrack.pipeline.effective import effective
from fgtrack.pipeline.replay import replay_in_memory
from fgtrack.pipeline.shipped import read_config, settings_of
from fgtrack.pipeline.stamping import mended
from fgtrack.pipeline.trial import TRIAL_S, beginning, suspicions
from fgtrack.pipeline.truth_offsets import truth_offsets
from fgtrack.pipeline.tune import tuned

__all__ = ["advise"]

TRACKED_S = 300.0
"""So much of a recording is tracked, to judge clocks and noise; delays are those of all of it."""
_USELESS = 90.0  # what weighs more leaves nothing to be judged
_OFTEN = 0.05  # share of lists that are overtaken
_LOST = 0.02
_MOST_OFFSET_DETECTIONS = 2500


def advise(
    recording: str | Path,
    config: str | Path | Config | None = None,
    *,
    map: str | Path | None = None,  # noqa: A002 - the name of the option
    pit_map: str | Path | None = None,
    set: Mapping[str, object] | None = None,  # noqa: A002 - the name of the option
    reference: str | None = None,
    tune: bool = False,
    on_step: Callable[[str], None] = lambda text: None,
) -> Advice:
    """Say what is late, wrong or does not fit, and which settings mend it; `advice.config` follows the advice.

    Parameters
    ----------
    recording
        Path of anything that fgtrack reads.
    config
        Name of a shipped configuration, path of a YAML file, or a `Config`; None for the defaults.
    map, pit_map
        CSV files of the track and of the pit lane, or `oval`; in place of those of the configuration.
    set
        Values of single settings: `{"smoother.lag_s": 3.0}`.
    reference
        The sensor whose clock is right, where two do not agree and the recording has no truth.
    tune
        Whether noise that does not fit is fitted to the recording.
    on_step
        Is told what comes next.

    Raises
    ------
    CallError
        The configuration does not fit.
    DataError
        The recording cannot be read, or holds nothing to track.
    """
    resolved = read_config(config, settings_of(set), track_map=map, pit_map=pit_map)
    on_step("reading")
    readable = UntilBreak(open_input(recording, resolved.input).messages())
    messages = list(readable)
    broken = None if readable.error is None else str(readable.error)
    return _Adviser(str(recording), messages, resolved, reference, on_step).advice(broken, tune)


class _Adviser:
    """The steps of `advise`: each sees the settings of those before it."""

    def __init__(
        self,
        recording: str,
        messages: Sequence[Message],
        config: Config,
        reference: str | None,
        on_step: Callable[[str], None],
    ) -> None:
        self._recording, self._messages, self._reference, self._on_step = recording, messages, reference, on_step
        self._assumed = assumed(config, source_of(lambda: messages))
        self._config = self._assumed.config
        self._findings: list[Finding] = []
        self._arrivals = arrivals_of(messages)
        self._tracked = list(beginning(messages, nanoseconds(TRACKED_S)))

    def advice(self, broken: str | None, tune: bool) -> Advice:
        """All steps."""
        if self._assumed.assumptions:
            text = f"none is configured; assumed: {'; '.join(map(str, self._assumed.assumptions))}."
            text += "" if tune else " `fgtrack tune` fits them (--tune)."
            self._findings.append(Finding("noise", "sensors", 35.0, text))
        self._take(self._strangers())
        before = self._config
        sensors = [name for name in self._arrivals if name != EGO and name not in before.ignore_sensors]
        if not sensors:
            raise DataError(f"{self._recording}: there are no detections of a sensor that the configuration has")
        for name in [*sensors, *([EGO] if EGO in self._arrivals else [])]:
            self._take(stamp_findings(self._arrivals[name]))
        self._take(receipt_findings([self._arrivals[name] for name in sensors]))
        self._take(self._misread())
        self._take(self._offsets())
        seen = arrivals_of(
            mended(message, self._config.sensors)
            for message in self._messages
            if isinstance(message, DetectionList) and message.sensor in sensors
        )
        shares, timed = overtaken(seen, sensors), [one for one in seen.values() if one.has_stamps]
        self._take(self._late(timed, shares))
        self._take(window_findings(timed, self._config))
        self._take(self._ego())
        self._on_step("tracking")
        run_before = self._replayed(before)
        run_after = run_before if self._config == before else self._replayed(self._config)
        if run_after is not None and self._take(self._cautions(run_after)):
            run_after = self._replayed(self._config)
        fits = [] if run_after is None else noise_fits(run_after)
        if run_after is not None and not self._is_useless:
            self._take(noise_findings(run_after, fits, tune))
        if tune and any(one.kind == "noise" for one in self._findings):
            self._findings.append(self._tuned(run_after))
        return Advice(
            recording=self._recording,
            findings=tuple(sorted(self._findings, key=lambda one: -one.weight)),
            fine=tuple(self._fine(seen, fits)),
            config=self._config,
            arrivals=tuple(seen.values()),
            overtaken=shares,
            beyond=tuple(beyond_lags(timed)),
            noise=tuple(fits),
            used=_used(run_before, run_after),
            broken=broken,
        )

    def _take(self, findings: Iterator[Finding]) -> bool:
        """Keep findings, and follow them; whether that has changed a setting."""
        found = list(findings)
        self._findings += found
        values = {key: value for one in found for key, value in one.settings.items()}
        if values:
            self._config = read_config(self._config, settings_of(values))
        return bool(values)

    @property
    def _is_useless(self) -> bool:
        """Whether something is wrong that no setting mends: nothing else can be judged then."""
        return any(one.weight >= _USELESS and not one.settings for one in self._findings)

    def _strangers(self) -> Iterator[Finding]:
        """Sensors of the recording that the configuration does not know."""
        known = {*self._config.sensors, *self._config.ignore_sensors, EGO}
        strangers = [name for name in self._arrivals if name not in known]
        if not strangers:
            return
        measured = dict.fromkeys(strangers, "nothing")
        for message in self._messages:
            if isinstance(message, DetectionList) and message.sensor in strangers and message.objects:
                measured[message.sensor] = ", ".join(message.objects[0].measured)
        has = "; ".join(f"{name}: {components}" for name, components in measured.items())
        text = f"no model of {', '.join(strangers)} ({has}): give sensors.NAME.std, or leave them out."
        ignored = sorted({*self._config.ignore_sensors, *strangers})
        yield Finding("model", "sensors", 98.0, text, {"ignore_sensors": ignored})

    def _misread(self) -> Iterator[Finding]:
        """What is suspicious in how the first seconds are read."""
        for one in suspicions(list(beginning(self._messages, nanoseconds(TRIAL_S))), self._config):
            yield Finding("input", one.about, 94.0 if one.spoils else 45.0, f"{one.text}.", one.settings)

    def _cautions(self, run: Run) -> Iterator[Finding]:
        """What a run with the settings warns of, but of sensors whose trouble is known."""
        known = {one.about for one in self._findings if one.weight >= _USELESS}
        for one in cautions(run):
            if one.about not in known:
                yield Finding("track", one.about, 70.0, f"{one.text}.", one.settings)

    def _offsets(self) -> Iterator[Finding]:
        """Clocks that do not agree, where that can be known."""
        if self._is_useless:
            return
        self._on_step("clock offsets")
        config = replace(self._config, estimator="ekf-replay")
        try:
            report = None if self._reference is not None else truth_offsets(self._tracked, config)
            if report is None:
                report = self._between_sensors(config)
        except (DataError, CallError) as error:
            if self._reference is not None and isinstance(error, CallError):
                raise
            return
        if report is not None:
            configured_s = {name: sensor.clock_offset_s for name, sensor in self._config.sensors.items()}
            yield from offset_findings(report, configured_s)

    def _between_sensors(self, config: Config) -> OffsetReport | None:
        placing = [name for name, one in config.sensors.items() if one.gives_position and name in self._arrivals]
        placing = [name for name in placing if name not in config.ignore_sensors]
        if len(placing) < 2:
            return None
        reference = self._reference
        if reference is None:  # a clock that is wrong by itself is none to go by
            doubtful = {one.about for one in self._findings if one.kind == "clock"}
            trusted = [name for name in placing if name not in doubtful]
            if trusted and len(trusted) < len(placing):
                reference = max(trusted, key=lambda name: int(self._arrivals[name].counts.sum()))
        rules = OffsetRules(fit_noise=True, max_detections=_MOST_OFFSET_DETECTIONS)
        return estimate_offsets(self._tracked, config, reference, rules)

    def _late(self, arrivals: Sequence[Arrivals], shares: Mapping[str, float]) -> Iterator[Finding]:
        """Bursts, losses, and an estimator that cannot deal with what is overtaken."""
        for one in arrivals:
            if one.bursts is not None:
                bad = one.bursts
                text = (
                    f"{percent(bad.share)} of its lists are late (above {milliseconds(one.late_s)}) or lost, and these "
                    f"come together: {bad.count} times, for {bad.mean_length_s:.2g} s on average and "
                    f"{bad.longest_s:.2g} s at most. Its computer or its bus is overloaded now and then: limits and "
                    "windows must hold its worst times, not the usual ones."
                )
                yield Finding("late", one.name, 40.0, text)
            elif one.lost is not None and one.lost > _LOST:
                text = (
                    f"{percent(one.lost)} of its lists never came, one by one (period "
                    f"{milliseconds(one.period_s or 0.0)}). No setting brings them back."
                )
                yield Finding("loss", one.name, 25.0, text)
        often = {name: share for name, share in shares.items() if share > _OFTEN}
        if often and self._config.estimator == "ekf-backward-forward":
            named = ", ".join(f"{percent(share)} of {name}" for name, share in often.items())
            text = (
                f"lists are overtaken by newer ones ({named}), and ekf-backward-forward forgets what was fused after "
                "the stamp of a late list; where the output may wait, smoother takes them, too."
            )
            yield Finding("late", "estimator", 60.0, text, {"estimator": "ekf-replay"})

    def _ego(self) -> Iterator[Finding]:
        """Gaps and lateness of the ego."""
        one = self._arrivals.get(EGO)
        if one is None or len(one.stamps_ns) < FEWEST or not one.has_stamps:
            return
        limit_s = self._config.ego.max_extrapolation_s
        gaps = [gap_s for gap_s in (one.sensed_ns[1:] - one.sensed_ns[:-1]) / 1e9 if gap_s > 2.0 * limit_s]
        if gaps:
            text = (
                f"{len(gaps)} gaps in its states are longer than twice max_extrapolation_s {limit_s:g} s, the longest "
                f"{max(gaps):.3g} s: what is sensed in the middle cannot be placed, and fails."
            )
            yield Finding("ego", EGO, 65.0, text)
        period_s = one.period_s or 0.0
        if period_s > 0.2:
            text = (
                f"one state every {milliseconds(period_s)}: between them the pose is that of constant speed and yaw "
                "rate, which a turn belies. Record it more often."
            )
            yield Finding("ego", EGO, 35.0, text)

    def _tuned(self, before: Run | None) -> Finding:
        """The noise that is fitted to the recording, unless nothing can be or it is no better than that of `before`."""
        self._on_step("tune")
        try:
            report = tuned({self._recording: lambda: iter(self._tracked)}, self._config)
        except DataError as error:
            return Finding("tune", "tune", 76.0, f"no noise is changed: {error}.")
        self._on_step("tracking")
        after = self._replayed(report.config)
        why = None if before is None or after is None else objection(before, after)
        if why is not None:
            return Finding("tune", "tune", 76.0, f"no noise is changed. With what is fitted, {why}.")
        self._config = report.config
        settings = {one.key: one.tuned for one in report.parameters if one.tuned != one.configured}
        stay = ", ".join(one.key for one in report.parameters if one.key not in settings)
        rest = f" As configured stay {stay}." if stay else ""
        return Finding("tune", "tune", 76.0, f"fitted to the recording by maximum likelihood.{rest}", settings)

    def _replayed(self, config: Config) -> Run | None:
        """A run of the first minutes; None where nothing can be tracked."""
        config = replace(config, clock=replace(config.clock, ticks_file=None))
        try:
            return replay_in_memory(self._tracked, config)[0]
        except DataError:
            return None

    def _fine(self, seen: Mapping[str, Arrivals], fits: Sequence[NoiseFit]) -> Iterator[str]:
        wrong = {(one.kind, one.about) for one in self._findings}
        kinds = {kind for kind, _ in wrong}
        ego = self._arrivals.get(EGO)
        if ego is not None and not wrong & {("ego", EGO), ("clock", EGO), ("input", EGO)} and ego.period_s:
            longest, delay = milliseconds(ego.longest_gap_s), milliseconds(ego.quantile_s(0.5))
            yield f"the ego ({1.0 / ego.period_s:.0f} Hz, longest gap {longest}, delay {delay})"
        clocks = [name for name in seen if ("clock", name) not in wrong]
        if clocks:
            yield f"stamps of {', '.join(clocks)}"
        if not kinds & {"input", "model"}:
            yield "frames, angles and fields"
        if "window" not in kinds:
            found = effective(self._config)
            yield f"{found.lag_key} ({found.lag_s:g} s) and max_delay_s"
        if "track" not in kinds:
            yield "the life of tracks"
        noise = [one.sensor for one in fits if ("noise", one.sensor) not in wrong]
        if noise:
            yield f"noise of {', '.join(noise)}"


def _used(before: Run | None, after: Run | None) -> dict[str, tuple[float, float]]:
    """Share of the detections of each sensor that took part."""
    old, new = (
        {name: sum(one.get(fate, 0) for fate in USED) / (sum(one.values()) or 1) for name, one in counts.items()}
        for counts in ({} if run is None else run.meta["counts"] for run in (before, after))
    )
    return {name: (old.get(name, 0.0), share) for name, share in new.items()}
