"""Numbers of the records of an ASTERIX category, at the bits that the specification in libasterix gives them.

libasterix makes an object of every part of every item, which takes milliseconds for a record; here only the numbers
that are asked for are read.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from itertools import chain, repeat
from typing import Any, NamedTuple

Record = dict[str, float]
"""Numbers by item, or item/part, in the unit of the standard; those that a record does not have are missing."""
_End = Callable[[bytes, int], int]
"""Byte behind an item that begins at a byte of the block."""
_Item = Callable[[Record, bytes, int], int]
"""Adds the numbers of an item that begins at a byte of the block to the record, and returns the byte behind it."""
_Spec = Any  # libasterix has a class of every item of every edition


class _Number(NamedTuple):
    name: str
    end: int
    """Bit behind it, from the begin of its item."""
    size: int
    signed: bool
    lsb: float

    def read(self, item: bytes, record: Record) -> None:
        """Add it to `record`; not where the item, whose length varies, ends before it."""
        beyond = 8 * len(item) - self.end
        if beyond >= 0:
            value = int.from_bytes(item, "big") >> beyond & (1 << self.size) - 1
            record[self.name] = (
                value - (1 << self.size)
                if self.signed and value >> self.size - 1
                else value
            ) * self.lsb


class RecordReader:
    """Reads the records of one edition of a category."""

    def __init__(
        self, edition: _Spec, names: Iterable[str], lsb: Mapping[str, float]
    ) -> None:
        """`names`: the numbers to read, item or item/part; unknown ones are ignored. `lsb` replaces the least
        significant bit of the library for some of them.
        """
        items = [
            getattr(each, "cv_non_spare", None)
            for each in edition.cv_uap.cv_record.cv_items_list
        ]
        self._items = _items(items, set(names), lsb, "")
        self._present: dict[bytes, list[_Item]] = {}  # by the field specification

    def __call__(self, block: bytes) -> Iterator[Record]:
        """Yield the records of `block`. Raises `ValueError` or `IndexError` where it is malformed."""
        at = 0
        while at < len(block):
            record: Record = {}
            at = _read_present(self._items, self._present, record, block, at)
            if at > len(block):
                raise ValueError("a record ends beyond its block")
            yield record


def _read_plain(
    end: _End, numbers: list[_Number], record: Record, block: bytes, at: int
) -> int:
    """See `_Item`."""
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
    """Add the numbers of the items that the field specification at `at` has to `record`; returns the byte behind."""
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
            raise ValueError("an item is not in the specification")
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
        _read_plain,
        _end(variation),
        [each._replace(lsb=lsb.get(each.name, each.lsb)) for each in numbers],
    )


def _numbers(variation: _Spec, name: str, at: int) -> Iterator[_Number]:
    """Yield the numbers of an item, or of a part that begins at its bit `at`, down to the parts of parts."""
    if hasattr(variation, "cv_rule"):
        content = getattr(variation.cv_rule, "cv_content", None)
        size, signed = variation.cv_bit_size, getattr(content, "cv_signedness", None)
        is_signed = signed is not None and signed.__name__ == "Signed"
        yield _Number(name, at + size, size, is_signed, getattr(content, "cv_lsb", 1))
    elif hasattr(variation, "cv_items_list"):
        nested = isinstance(variation.cv_items_list[0], list)
        for part in (
            chain.from_iterable(variation.cv_items_list)
            if nested
            else variation.cv_items_list
        ):
            spec, size = part or (None, 1)  # a bit that announces an extension
            own = getattr(spec, "cv_non_spare", None)
            if own is not None and hasattr(own.cv_rule, "cv_variation"):
                yield from _numbers(
                    own.cv_rule.cv_variation, f"{name}/{own.cv_name}", at
                )
            at += size


def _end(variation: _Spec) -> _End:
    if hasattr(variation, "cv_explicit_type"):
        return lambda block, at: at + max(block[at], 1)
    if hasattr(variation, "cv_rep_bytes"):
        width, size = variation.cv_rep_bytes, variation.cv_variation.cv_bit_size
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
    """Byte behind parts of `sizes`, each of which ends with the bit that announces another one."""
    for size in sizes:
        at += size
        if not block[at - 1] & 1:
            break
    return at
