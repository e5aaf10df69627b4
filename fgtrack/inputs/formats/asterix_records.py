"""Decoding of ASTERIX records: numbers are read at the bits that libasterix's specification gives.

libasterix itself creates an object for every part of every item, which takes
milliseconds for a record. Here only the requested numbers are read.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from itertools import chain, repeat
from typing import Any, NamedTuple

Record = dict[str, float]
"""Numbers in the unit of the standard, by item or item/part; numbers that the record lacks are missing."""
_End = Callable[[bytes, int], int]
"""Returns the first byte behind an item, from the block and the item's first byte."""
_Item = Callable[[Record, bytes, int], int]
"""Adds the numbers of an item to the record, and returns the first byte behind the item.

The arguments are the record, the block and the item's first byte.
"""
_Spec = Any  # libasterix has a class for every item of every edition


class _Number(NamedTuple):
    """Name, bits and scale of a number in an item."""

    name: str
    end: int
    """First bit behind the number, counted from the beginning of the item."""
    size: int
    signed: bool
    lsb: float

    def read(self, item: bytes, record: Record) -> None:
        """Add the number to `record`.

        The length of an item varies. An item that ends before the number adds nothing.
        """
        beyond = 8 * len(item) - self.end
        if beyond >= 0:
            value = int.from_bytes(item, "big") >> beyond & (1 << self.size) - 1
            if self.signed and value >> self.size - 1:
                value -= 1 << self.size
            record[self.name] = value * self.lsb


class RecordReader:
    """Reader of the records of one edition of a category."""

    def __init__(
        self, edition: _Spec, names: Iterable[str], lsb: Mapping[str, float]
    ) -> None:
        """Prepare the reader for the numbers `names`, each given as item or item/part; unknown names are ignored.

        `lsb` holds values of the least significant bit that replace the values of the library.
        """
        items = [
            getattr(each, "cv_non_spare", None)
            for each in edition.cv_uap.cv_record.cv_items_list
        ]
        self._items = _items(items, set(names), lsb, "")
        #: Items of a record by its field specification.
        self._present: dict[bytes, list[_Item]] = {}

    def __call__(self, block: bytes) -> Iterator[Record]:
        """Yield the records of `block`; raises `ValueError` or `IndexError` if the block is malformed."""
        at = 0
        while at < len(block):
            record: Record = {}
            at = _read_present(self._items, self._present, record, block, at)
            if at > len(block):
                raise ValueError("a record ends beyond its block")
            yield record


def _read_numbers(
    end: _End, numbers: list[_Number], record: Record, block: bytes, at: int
) -> int:
    """Add the `numbers` of an item to the record. Arguments and result are those of `_Item`."""
    behind = end(block, at)
    for number in numbers:
        number.read(block[at:behind], record)
    return behind


def _read_present(
    items: list[_Item | None],
    known: dict[bytes, list[_Item]],
    record: Record,
    block: bytes,
    at: int,
) -> int:
    """Add the numbers of all items in the field specification at byte `at` to `record`.

    Returns the first byte behind the items.

    Raises `ValueError` for an item that the specification lacks.
    """
    first = at
    while block[at : at + 1] and block[at] & 1:
        at += 1
    at += 1
    present = known.get(block[first:at])
    if present is None:
        bits = [each >> k & 1 for each in block[first:at] for k in range(7, 0, -1)]
        chosen = [
            items[k] if k < len(items) else None for k, bit in enumerate(bits) if bit
        ]
        present = [item for item in chosen if item is not None]
        if len(present) < len(chosen):
            raise ValueError("a record has an item that the specification lacks")
        known[block[first:at]] = present
    for read in present:
        at = read(record, block, at)
    return at


def _items(
    specs: Iterable[_Spec], names: set[str], lsb: Mapping[str, float], prefix: str
) -> list[_Item | None]:
    return [
        None if spec is None else _item(spec, names, lsb, prefix + spec.cv_name)
        for spec in specs
    ]


def _item(spec: _Spec, names: set[str], lsb: Mapping[str, float], name: str) -> _Item:
    rule = spec.cv_rule
    variation = getattr(rule, "cv_variation", None) or rule.cv_default_variation
    if hasattr(variation, "cv_fspec_max_bytes"):
        parts = _items(variation.cv_items_list, names, lsb, f"{name}/")
        return partial(_read_present, parts, {})
    numbers = [each for each in _numbers(variation, name, 0) if each.name in names]
    return partial(
        _read_numbers,
        _end(variation),
        [each._replace(lsb=lsb.get(each.name, each.lsb)) for each in numbers],
    )


def _numbers(variation: _Spec, name: str, at: int) -> Iterator[_Number]:
    """Yield the numbers of an item and of its nested parts; the item, or part, begins at bit `at`."""
    if hasattr(variation, "cv_rule"):
        content = getattr(variation.cv_rule, "cv_content", None)
        size = variation.cv_bit_size
        signed = getattr(content, "cv_signedness", None)
        is_signed = signed is not None and signed.__name__ == "Signed"
        yield _Number(name, at + size, size, is_signed, getattr(content, "cv_lsb", 1))
    elif hasattr(variation, "cv_items_list"):
        nested = isinstance(variation.cv_items_list[0], list)
        for part in (
            chain.from_iterable(variation.cv_items_list)
            if nested
            else variation.cv_items_list
        ):
            # A missing part is the bit that announces an extension.
            spec, size = part or (None, 1)
            item = getattr(spec, "cv_non_spare", None)
            if item is not None and hasattr(item.cv_rule, "cv_variation"):
                yield from _numbers(
                    item.cv_rule.cv_variation, f"{name}/{item.cv_name}", at
                )
            at += size


def _end(variation: _Spec) -> _End:
    if hasattr(variation, "cv_explicit_type"):
        return lambda block, at: at + max(block[at], 1)
    if hasattr(variation, "cv_rep_bytes"):
        width = variation.cv_rep_bytes
        size = variation.cv_variation.cv_bit_size
        if width is None:
            return partial(_extended_end, repeat((size + 1) // 8))
        return lambda block, at: (
            at + width + int.from_bytes(block[at : at + width], "big") * size // 8
        )
    if hasattr(variation, "cv_bit_size"):
        fixed = variation.cv_bit_size // 8
        return lambda _, at: at + fixed
    return partial(
        _extended_end,
        [
            sum(1 if part is None else part[1] for part in group) // 8
            for group in variation.cv_items_list
        ],
    )


def _extended_end(sizes: Iterable[int], block: bytes, at: int) -> int:
    """Return the first byte behind parts of the given `sizes`; the last bit of each part announces the next part."""
    for size in sizes:
        at += size
        if not block[at - 1] & 1:
            break
    return at
