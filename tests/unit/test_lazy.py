"""Sequences that make their items when they are read."""

import pytest

from fgtrack.estimation.base import Lazy


class Squares(Lazy[int]):
    """0, 1, 4, 9."""

    def __len__(self) -> int:
        return 4

    def item(self, index: int) -> int:
        return index * index


def test_a_lazy_sequence_reads_as_the_list_of_its_items() -> None:
    items = [0, 1, 4, 9]
    squares = Squares()
    assert list(squares) == items
    assert [squares[index] for index in range(-4, 4)] == 2 * items
    for part in (slice(1, 3), slice(None), slice(None, None, -1), slice(-2, 9)):
        assert squares[part] == items[part]
    assert 9 in squares
    assert list(reversed(squares)) == items[::-1]


@pytest.mark.parametrize("index", [4, -5])
def test_an_index_outside_a_lazy_sequence_is_an_error(index: int) -> None:
    with pytest.raises(IndexError):
        _ = Squares()[index]
