"""Times at which a node is done with its ticks."""

import pytest

from fgtrack.runs import Node

MS = 1_000_000


@pytest.mark.parametrize(("due_ms", "took_ms", "done_ms", "misses"), [
    ([0, 20, 40], [5, 5, 5], [5, 25, 45], 0),
    ([0, 20, 40], [20, 20, 20], [20, 40, 60], 0),
    ([0, 20, 40, 60], [35, 10, 5, 1], [35, 45, 50, 61], 2),
    ([0, 20, 40], [30, 30, 30], [30, 60, 90], 3),
    ([], [], [], 0),
])  # fmt: skip
def test_a_tick_begins_when_the_one_before_is_done(
    due_ms: list[int], took_ms: list[int], done_ms: list[int], misses: int
) -> None:
    node = Node(20 * MS)
    assert [
        node.done_ns(due * MS, took * MS)
        for due, took in zip(due_ms, took_ms, strict=True)
    ] == [done * MS for done in done_ms]
    assert node.misses == misses
