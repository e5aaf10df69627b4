"""Changes along a recording: clocks that drift, mounts that turn, and noise that differs between parts.

Short parts at equal distances are tracked, and each gives an estimate of a quantity. A
line and a step are fitted to the estimates by weighted least squares. Only the ratios
of the standard deviations count, because errors that are common to all parts do not
matter: the scale follows from the residuals. Further parts locate a step more closely.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import stdtrit

from fgtrack.advice.run_quality import noise_fits
from fgtrack.clocks.offsets import TRUTH, OffsetReport, estimate_offsets
from fgtrack.config.settings import Config
from fgtrack.core.errors import CallError, DataError
from fgtrack.core.finding import Finding, milliseconds
from fgtrack.core.time import nanoseconds, seconds
from fgtrack.core.types import FloatArray, Message
from fgtrack.meaning.mounts import Mounts
from fgtrack.meaning.placement import mounts_of
from fgtrack.runs import Run

SHORTEST_S = 1200.0
"""A shorter recording is not assessed by parts."""
#: Length of a part, and the time between the beginnings of two parts.
_PART_S = 60.0
_PERIOD_S = 300.0
#: Fewest estimates, and probability of each tail beyond which a change is significant.
_FEWEST = 5
_SURE = 0.9995
#: A step is located within this time.
_LOCATED_S = 60.0
#: Smallest changes that matter: of a clock, of a mount's yaw, and of the logarithm of a standard deviation.
_CLOCK_S = 0.01
_YAW_RAD = math.radians(0.5)
_LOG_STD = math.log(1.25)


@dataclass(frozen=True)
class PartEstimate:
    """Estimate of a quantity in a part of a recording."""

    at_s: float
    """Middle of the part, after the first receipt."""
    value: float
    std: float


@dataclass(frozen=True)
class Change:
    """Change of a quantity along a recording."""

    is_step: bool
    """True for a step, False for a line over the whole recording."""
    size: float
    """Height of the step, or the change from the first to the last part."""
    half: float
    """Half width of the 95 % interval of the size."""
    from_s: float
    until_s: float
    """The step lies between these times. A line has changed by the smallest size that matters at both times."""


def change_of(estimates: Sequence[PartEstimate], smallest: float) -> Change | None:
    """Return the change that the estimates show, in order of time; None without a change of more than `smallest`.

    The change is a step or a line, whichever has the smaller Bayesian information
    criterion (Schwarz, Annals of Statistics 6, 1978). The time of a step counts as a
    parameter.
    """
    if len(estimates) < _FEWEST:
        return None
    times_s, values, stds = np.array(
        [(one.at_s, one.value, one.std) for one in estimates]
    ).T
    length_s = float(times_s[-1] - times_s[0])
    shapes = [(times_s - times_s[0]) / length_s]
    shapes += [(times_s >= time_s).astype(float) for time_s in times_s[1:]]
    fits = [_fitted(shape, values, stds) for shape in shapes]
    # The criterion n log(cost) + parameters log(n), as a factor on the cost.
    penalty = len(values) ** (1.0 / len(values))
    best = min(range(len(fits)), key=lambda k: fits[k][0] * (penalty if k > 0 else 1.0))
    cost, size, std = fits[best]
    dof = len(values) - 2
    std *= math.sqrt(cost / dof)
    if abs(size) <= max(smallest, float(stdtrit(dof, _SURE)) * std):
        return None
    half = float(stdtrit(dof, 0.975)) * std
    if best:
        return Change(True, size, half, *times_s[[best - 1, best]].tolist())
    reached_s = float(times_s[0]) + length_s * smallest / abs(size)
    return Change(False, size, half, reached_s, reached_s)


def _fitted(
    shape: FloatArray, values: FloatArray, stds: FloatArray
) -> tuple[float, float, float]:
    """Return the weighted sum of squared residuals of a + b shape, b, and its standard deviation."""
    design = np.column_stack([np.ones_like(shape), shape]) / stds[:, None]
    information = design.T @ design
    x = np.linalg.solve(information, design.T @ (values / stds))
    residuals = values / stds - design @ x
    variance = np.linalg.solve(information, np.eye(2))[1, 1]
    return float(residuals @ residuals), float(x[1]), math.sqrt(variance)


class Part:
    """Part of a recording, which is tracked when it is used."""

    def __init__(
        self,
        messages: Sequence[Message],
        at_s: float,
        config: Config,
        tracked: Callable[[Sequence[Message]], Run | None],
    ) -> None:
        self._messages = messages
        self._config = config
        self._tracked = tracked
        self.at_s = at_s
        """Middle of the part, after the first receipt."""

    @cached_property
    def run(self) -> Run | None:
        """Run of the part; None if nothing can be tracked."""
        return self._tracked(self._messages)

    @cached_property
    def clocks(self) -> OffsetReport | None:
        """Clock offsets; None if they cannot be estimated."""
        with suppress(DataError, CallError):
            if self.run is not None:
                return estimate_offsets(self._messages, self._config, run=self.run)
        return None

    @cached_property
    def mounts(self) -> Mounts | None:
        """Mounts of the sensors; None if they cannot be estimated."""
        with suppress(DataError):
            return mounts_of(self._messages, self._config)
        return None

    def clock(self, sensor: str) -> tuple[str, PartEstimate] | None:
        """Return the reference of the clock of a sensor, and the offset from the reference [s]; None if unknown."""
        report = self.clocks
        one = next(
            (
                each
                for each in (() if report is None else report.sensors)
                if each.sensor == sensor
            ),
            None,
        )
        if (
            report is None
            or one is None
            or not one.is_known
            or sensor == report.reference
        ):
            return None
        if one.offset_s is None or not one.std_s:
            return None
        return report.reference, PartEstimate(self.at_s, one.offset_s, one.std_s)

    def yaw(self, sensor: str) -> tuple[str, PartEstimate] | None:
        """Return the reference of the mount of a sensor, and the yaw of the mount [rad]; None if unknown."""
        mounts = self.mounts
        if mounts is None or sensor not in mounts or sensor not in mounts.references:
            return None
        one = mounts[sensor]
        reference = mounts.references[sensor]
        if reference == sensor or not math.isfinite(one.half_widths[0]):
            return None
        return reference, PartEstimate(self.at_s, one.yaw_rad, one.stds[0])

    def noise(self, sensor: str) -> tuple[str, PartEstimate] | None:
        """Return the logarithm of the error of a sensor, in configured standard deviations; None if unknown."""
        fit = next(
            (
                each
                for each in ([] if self.run is None else noise_fits(self.run))
                if each.sensor == sensor
            ),
            None,
        )
        if fit is None or not fit.ratio.is_known or not fit.ratio.low > 0.0:
            return None
        log_std = math.log(fit.ratio.high / fit.ratio.low) / 4.0 / 1.96
        estimate = PartEstimate(self.at_s, 0.5 * math.log(fit.ratio.mean), log_std)
        return "the configured noise", estimate


_Quantity = Callable[[Part, str], tuple[str, PartEstimate] | None]


@dataclass(frozen=True)
class Recorded:
    """A long recording that is assessed by parts."""

    messages: Sequence[Message]
    """Messages in order of receipt."""
    config: Config
    tracked: Callable[[Sequence[Message]], Run | None]
    """Returns the run of a part; None if nothing can be tracked."""

    @cached_property
    def _receipts_s(self) -> FloatArray:
        first_ns = self.messages[0].receipt_ns
        receipts_ns = np.array([message.receipt_ns for message in self.messages])
        return np.asarray((receipts_ns - first_ns) / nanoseconds(1.0))

    def part(self, begin_s: float) -> Part:
        """Return the part that begins at `begin_s` after the first receipt."""
        first, last = np.searchsorted(self._receipts_s, [begin_s, begin_s + _PART_S])
        at_s = begin_s + 0.5 * _PART_S
        return Part(self.messages[first:last], at_s, self.config, self.tracked)

    def findings(self) -> Iterator[Finding]:
        """Yield a finding for each sensor and quantity that changes along the recording.

        A recording that is shorter than `SHORTEST_S` gives none.
        """
        if not self.messages or self._receipts_s[-1] < SHORTEST_S:
            return
        begins_s = np.arange(0.0, self._receipts_s[-1] - _PART_S, _PERIOD_S)
        parts = [self.part(float(begin_s)) for begin_s in begins_s]
        for sensor in self.config.used_sensors:
            has_moved = False
            for quantity, smallest, text in _QUANTITIES:
                # A clock or a mount that changes makes errors that look like noise.
                if quantity is Part.noise and has_moved:
                    continue
                found = _estimates(parts, sensor, quantity)
                change = change_of([one for _, one in found], smallest)
                if change is None:
                    continue
                has_moved = True
                located = self._located(sensor, quantity, found, change)
                yield Finding(
                    "change", sensor, 72.0, text(found[0][0], located, found[-1][1])
                )

    def _located(
        self,
        sensor: str,
        quantity: _Quantity,
        found: Sequence[tuple[str, PartEstimate]],
        change: Change,
    ) -> Change:
        """Return a step with closer times, from parts between those that show the step."""
        if not change.is_step:
            return change
        from_s, until_s = change.from_s, change.until_s
        before = np.mean([one.value for _, one in found if one.at_s <= from_s])
        while until_s - from_s > _LOCATED_S:
            part = self.part(0.5 * (from_s + until_s) - 0.5 * _PART_S)
            result = quantity(part, sensor)
            if result is None or result[0] != found[0][0]:
                break
            if abs(result[1].value - before) > 0.5 * abs(change.size):
                until_s = part.at_s
            else:
                from_s = part.at_s
        return Change(True, change.size, change.half, from_s, until_s)


def _estimates(
    parts: Sequence[Part], sensor: str, quantity: _Quantity
) -> list[tuple[str, PartEstimate]]:
    """Return the estimates with the most frequent reference."""
    found = [one for part in parts if (one := quantity(part, sensor)) is not None]
    names = [name for name, _ in found]
    most = max(names, key=names.count, default=None)
    return [one for one in found if one[0] == most]


def _minutes(time_s: float) -> str:
    return f"minute {seconds(nanoseconds(time_s)) / 60.0:.0f}"


def _when(change: Change) -> str:
    if not change.is_step:
        return f"steadily, by more than the tolerance from {_minutes(change.from_s)} on"
    return f"between {_minutes(change.from_s)} and {_minutes(change.until_s)}"


def _clock_text(reference: str, change: Change, last: PartEstimate) -> str:
    against = "the truth" if reference == TRUTH else reference
    kind = "jumps" if change.is_step else "drifts"
    return (
        f"its clock {kind} by {1e3 * change.size:+.0f} ± {milliseconds(change.half)} against {against}, "
        f"{_when(change)}. A setting corrects a constant offset only: cut the recording, or correct the clock."
    )


def _yaw_text(reference: str, change: Change, last: PartEstimate) -> str:
    turn_deg, half_deg = math.degrees(change.size), math.degrees(change.half)
    return (
        f"its mount turns by {turn_deg:+.1f} ± {half_deg:.1f} degrees relative to {reference}, {_when(change)}, "
        f"or the mount of {reference} turns the other way. At the end its yaw is {last.value:.4f} rad. "
        "Cut the recording there, and set the mount of each part."
    )


def _noise_text(reference: str, change: Change, last: PartEstimate) -> str:
    return (
        f"its errors become {math.exp(change.size):.2g} times as large, {_when(change)}. At the end they are "
        f"{math.exp(last.value):.2g} times {reference}. Cut the recording, and tune the noise of each part."
    )


_QUANTITIES: Sequence[
    tuple[_Quantity, float, Callable[[str, Change, PartEstimate], str]]
] = (
    (Part.clock, _CLOCK_S, _clock_text),
    (Part.yaw, _YAW_RAD, _yaw_text),
    (Part.noise, _LOG_STD, _noise_text),
)
