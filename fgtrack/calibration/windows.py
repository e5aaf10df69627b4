"""How far back the tracker must reach, and what a shorter reach would lose."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from fgtrack.calibration.arrivals import Arrivals
from fgtrack.calibration.finding import Finding, milliseconds, nice_above, percent
from fgtrack.pipeline.config import Config
from fgtrack.tracking.existence import ExistenceRules

__all__ = ["BeyondLag", "beyond_lags", "window_findings"]

_LAGS_S = (0.05, 0.1, 0.15, 0.2, 0.3, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 5.0, 10.0, 20.0)
_LOST = 0.001  # share of detections that may fall beyond
_ALL = 0.999  # share that a window should hold
_SPARE = 1.2
_LONGEST_STORAGE_S = 60.0
_LISTS = 3.0  # of the slowest sensor that a window, and a track, should outlive


@dataclass(frozen=True)
class BeyondLag:
    """What a window of one length would not hold."""

    lag_s: float
    share: Mapping[str, float]
    """Of the detections of each sensor."""


def beyond_lags(arrivals: Sequence[Arrivals]) -> list[BeyondLag]:
    """Shares beyond each lag, up to the first that holds everything."""
    rows = []
    for lag_s in _LAGS_S:
        rows.append(BeyondLag(lag_s, {one.name: one.beyond(lag_s) for one in arrivals}))
        if not any(rows[-1].share.values()):
            break
    return rows


def window_findings(arrivals: Sequence[Arrivals], config: Config) -> Iterator[Finding]:
    """Detections that are refused for their delay, or fall beyond the window; settings that a slow sensor defeats."""
    needed_s = 0.0
    for one in arrivals:
        most_s, limit_s = one.quantile_s(_ALL), config.sensors[one.name].max_delay_s
        if limit_s is not None and one.beyond(limit_s) > _LOST:
            text = (
                f"{percent(one.beyond(limit_s))} of its detections come later than max_delay_s {limit_s:g} s allows "
                f"and are refused; 99.9 % come within {milliseconds(most_s)}."
            )
            mend = {f"sensors.{one.name}.max_delay_s": nice_above(_SPARE * most_s)}
            yield Finding("window", one.name, 50.0 + 40.0 * one.beyond(limit_s), text, mend)
        elif limit_s is not None:
            most_s = min(most_s, limit_s)
        needed_s = max(needed_s, most_s)
    yield from _window(arrivals, config, needed_s)
    yield from _life(arrivals, config)


def _window(arrivals: Sequence[Arrivals], config: Config, needed_s: float) -> Iterator[Finding]:
    found = config.effective
    told = f"{found.lag_key} {found.lag_s:g} s is shorter than"
    slowest = max(arrivals, key=lambda one: one.period_s or 0.0, default=None)
    if slowest is None:
        return
    period_s = slowest.period_s or 0.0
    if needed_s > found.reach_s:
        worst = max(arrivals, key=lambda one: one.beyond(found.reach_s))
        lost = worst.beyond(found.reach_s)
        text = f"{told} the delays: {percent(lost)} of the detections of {worst.name} fall beyond it."
        value = min(nice_above(_SPARE * max(needed_s, _LISTS * period_s)), _LONGEST_STORAGE_S)
        yield Finding("window", "window", 50.0 + 40.0 * lost, text, {found.lag_key: value})
    elif found.lag_s < period_s:
        text = (
            f"{told} the time between two lists of {slowest.name}, {period_s:.3g} s: nothing of it is ever smoothed "
            "together."
        )
        yield Finding("window", "window", 55.0, text, {found.lag_key: nice_above(_LISTS * period_s)})


def _life(arrivals: Sequence[Arrivals], config: Config) -> Iterator[Finding]:
    """A time after which a track ends, against how often it can be seen at all."""
    rules = config.lifecycle
    if isinstance(rules, ExistenceRules):
        key, limit_s = "lifecycle.out_of_view_s", rules.out_of_view_s
    else:
        key, limit_s = "lifecycle.forget_s", rules.forget_s
    placing = [one for one in arrivals if config.sensors[one.name].gives_position and one.period_s]
    if isinstance(rules, ExistenceRules) and len(placing) == 1:
        return  # only a list that could not show a track ends it
    fastest_s = min((one.period_s or math.inf for one in placing), default=math.inf)
    silent_s = {}
    for one in placing:
        period_s = one.period_s or 0.0
        alone = len(placing) == 1 or period_s > 2.0 * fastest_s
        if alone or fastest_s > limit_s:
            silent_s[one.name] = period_s
    name = max(silent_s, key=silent_s.__getitem__, default=None)
    if name is not None and silent_s[name] > limit_s:
        text = (
            f"{key} {limit_s:g} s is shorter than the time in which {name} may say nothing, {silent_s[name]:.3g} s: a "
            "track that it alone sees ends in between."
        )
        yield Finding("track", name, 55.0, text, {key: nice_above(_LISTS * silent_s[name])})
