"""Indices of equal items, which are calculated at once."""

from collections.abc import Hashable, Sequence

__all__ = ["equal_ones"]


def equal_ones(items: Sequence[Hashable]) -> list[list[int]]:
    """Positions of equal `items`, ascending, in the order of the first of each."""
    groups: dict[Hashable, list[int]] = {}
    for position, item in enumerate(items):
        groups.setdefault(item, []).append(position)
    return list(groups.values())
