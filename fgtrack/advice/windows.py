"""How far back the tracker must reach, and what a shorter reach would lose."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from fgtrack.advice.arrivals import Arrivals
from fgtrack.advice.finding import Finding, milliseconds, nice_above, percent
from fgtrack.pipeline.config import Config
from fgtrack.tracking.existence import ExistenceRules

__all__ = ["BeyondLag", "beyond_lags", "reach", "window_findings"]

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


@dataclass(frozen=True)
class Reach:
    """How far back the estimator of a configuration reaches."""

    key: str
    length_s: float
    behind_s: float
    """How much further back late detections are still fused."""


def reach(config: Config) -> Reach:
    """That of its estimator."""
    if config.estimator.startswith(("smoother", "ipls")):
        behind_s = config.smoother.ring_s if config.smoother.late == "fuse" else 0.0
        return Reach("smoother.lag_s", config.smoother.lag_s, behind_s)
    return Reach("filter.storage_s", config.filter.storage_s, 0.0)


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
        sensor = config.sensors[one.name]
        most_s = one.quantile_s(_ALL)
        limit_s = sensor.max_delay_s
        if limit_s is not None and one.beyond(limit_s) > _LOST:
            key, value = f"sensors.{one.name}.max_delay_s", nice_above(_SPARE * most_s)
            text = (
                f"{percent(one.beyond(limit_s))} of its detections come later than max_delay_s {limit_s:g} s allows "
                f"and are refused; 99.9 % come within {milliseconds(most_s)}. Set {key}: {value:g}."
            )
            yield Finding("window", one.name, 50.0 + 40.0 * one.beyond(limit_s), text, {key: value})
        elif limit_s is not None:
            most_s = min(most_s, limit_s)
        needed_s = max(needed_s, most_s)
    yield from _window(arrivals, config, needed_s)
    yield from _life(arrivals, config)


def _window(arrivals: Sequence[Arrivals], config: Config, needed_s: float) -> Iterator[Finding]:
    found = reach(config)
    lost = {one.name: one.beyond(found.length_s + found.behind_s) for one in arrivals}
    worst = max(lost, key=lost.__getitem__, default=None)
    slowest = max(arrivals, key=lambda one: one.period_s or 0.0, default=None)
    period_s = (slowest.period_s if slowest is not None else None) or 0.0
    if needed_s > found.length_s + found.behind_s and worst is not None:
        value = min(nice_above(_SPARE * max(needed_s, _LISTS * period_s)), _LONGEST_STORAGE_S)
        text = (
            f"{found.key} {found.length_s:g} s is shorter than the delays: {percent(lost[worst])} of the detections of "
            f"{worst} fall beyond it. Set {found.key}: {value:g}."
        )
        yield Finding("window", "window", 50.0 + 40.0 * lost[worst], text, {found.key: value})
    elif slowest is not None and found.length_s < period_s:
        value = nice_above(_LISTS * period_s)
        text = (
            f"{found.key} {found.length_s:g} s is shorter than the time between two lists of {slowest.name}, "
            f"{period_s:.3g} s: nothing of it is ever smoothed together. Set {found.key}: {value:g}."
        )
        yield Finding("window", "window", 55.0, text, {found.key: value})


def _life(arrivals: Sequence[Arrivals], config: Config) -> Iterator[Finding]:
    """Times after which a track ends, against how often it can be seen at all."""
    rules = config.lifecycle
    is_existence = isinstance(rules, ExistenceRules)
    key = "lifecycle.out_of_view_s" if is_existence else "lifecycle.forget_s"
    limit_s = rules.out_of_view_s if isinstance(rules, ExistenceRules) else rules.forget_s
    placing = [one for one in arrivals if config.sensors[one.name].gives_position and one.period_s]
    silent_s = {one.name: one.bursts.longest_s if one.bursts else 0.0 for one in placing}
    fastest_s = min((each.period_s or math.inf for each in placing), default=math.inf)
    for one in placing:
        period_s = one.period_s or 0.0
        alone = len(placing) == 1 or period_s > 2.0 * fastest_s
        shortest_s = period_s + (silent_s[one.name] if alone else 0.0)
        if (alone or fastest_s > limit_s) and limit_s < shortest_s:
            value = nice_above(_LISTS * shortest_s)
            text = (
                f"{key} {limit_s:g} s is shorter than the time in which {one.name} may say nothing, "
                f"{shortest_s:.3g} s: a track that it alone sees ends in between. Set {key}: {value:g}."
            )
            yield Finding("track", one.name, 55.0, text, {key: value})
