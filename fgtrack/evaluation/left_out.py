"""Which settings keep detections from tracking: said of every run, since what is filtered is missing silently."""

from collections.abc import Iterator, Mapping
from typing import Any

__all__ = ["because", "left_out"]


def because(counts: Mapping[str, int]) -> str:
    """`counts` by setting in words, the most first: `40 by filters.score, 2 by map.excluded`."""
    return ", ".join(f"{count} by {name}" for name, count in sorted(counts.items(), key=lambda item: -item[1]))


def left_out(meta: Mapping[str, Any]) -> Iterator[str]:
    """A line for each sensor of a run with this meta.json of which settings left out detections."""
    bounds, unread = (dict(meta.get(key) or {}) for key in ("out_of_bounds", "left_out"))
    for sensor in sorted({*bounds, *unread}):
        found = []
        if sensor in bounds:
            count, total = sum(bounds[sensor].values()), sum(meta["counts"][sensor].values())
            found.append(f"{count} of {total} detections out of bounds ({because(bounds[sensor])})")
        if sensor in unread:
            found.append(f"{sum(unread[sensor].values())} left out when read ({because(unread[sensor])})")
        yield f"{sensor}: {'; '.join(found)}"
