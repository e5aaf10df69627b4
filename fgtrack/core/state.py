"""Checkpoints of objects that change, as arrays and plain values.

A class derives from `Stateful` and names its changing attributes in `STATE`. All other attributes are fixed when the
object is made. A checkpoint can therefore be put into any object that was made with the same arguments, also in
another process. Arrays and containers are copied. Values that never change are shared: numbers, texts, frozen records
and objects without a `STATE`.
"""

import pickle
from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from importlib import import_module
from io import BytesIO
from typing import Any, ClassVar, TypeVar

import numpy as np

from fgtrack.core.errors import CallError, DataError

_T = TypeVar("_T")
Snapshot = Mapping[str, Any]
"""Copied values of attributes by name. Any: each attribute has its own type."""


class Stateful:
    """Base of objects whose state can be copied and put back."""

    STATE: ClassVar[tuple[str, ...]] = ()
    """Names of the attributes that change after the object is made."""

    def checkpoint(self) -> Snapshot:
        """Return a copy of the state. Later changes of the object do not change the copy."""
        return copied_attributes(self, self.STATE)

    def restore(self, snapshot: Snapshot) -> None:
        """Set the state to that of a checkpoint. The checkpoint stays as it is, and can be restored again."""
        put_back(self, self.STATE, snapshot)


def copied_attributes(owner: object, names: Iterable[str]) -> Snapshot:
    """Return copies of the attributes `names` of an object."""
    return {name: copied(getattr(owner, name)) for name in names}


def put_back(owner: object, names: Iterable[str], snapshot: Snapshot) -> None:
    """Set the attributes `names` of `owner` to the values in a snapshot, which stays as it is."""
    for name in names:
        own = getattr(owner, name)
        if isinstance(own, Stateful):
            own.restore(snapshot[name])
        else:
            setattr(owner, name, copied(snapshot[name]))


def stateful(item: object) -> Stateful:
    """Return `item`. Raises `CallError` for an object of a class without a state, for example of a plug-in."""
    if not isinstance(item, Stateful):
        raise CallError(
            f"{type(item).__name__} has no checkpoint: derive the class from fgtrack.Stateful, and name the "
            "attributes that change in its STATE"
        )
    return item


def copied(value: _T) -> _T:
    """Return a copy of a value that may change. A value that never changes is returned itself.

    A `Stateful` object gives its checkpoint.
    """
    copy = _copier(type(value))
    return value if copy is None else copy(value)


def _new_copier(kind: type) -> Callable[[Any], Any] | None:
    """Return the function that copies objects of the type `kind`; None if these objects never change."""
    if issubclass(kind, Stateful):
        return kind.checkpoint
    if issubclass(kind, np.ndarray):
        return kind.copy
    if issubclass(kind, dict):
        return _copied_mapping
    if issubclass(kind, list | set | deque):
        return _copied_items
    if kind is tuple:
        return _copied_tuple
    if is_dataclass(kind) and not kind.__dataclass_params__.frozen:  # type: ignore[attr-defined]
        return _record_copier(kind)
    return None


_copier: Callable[[type], Callable[[Any], Any] | None] = cache(_new_copier)


def _are_fixed(values: Collection[Any]) -> bool:
    """True if no value can change.

    A tuple counts as fixed if its items are fixed and no item is a tuple.
    """
    kinds = set(map(type, values))
    if tuple in kinds:
        kinds.remove(tuple)
        kinds.update(
            type(item) for each in values if type(each) is tuple for item in each
        )
    return all(_copier(kind) is None for kind in kinds)


def _copied_mapping(mapping: dict[Any, Any]) -> dict[Any, Any]:
    """Return a copy of a dictionary or counter, with the same order; keys never change."""
    result = mapping.copy()
    if not _are_fixed(mapping.values()):
        for key, value in mapping.items():
            result[key] = copied(value)
    return result


def _copied_items(items: Any) -> Any:
    """Return a copy of a list, set or deque."""
    result = items.copy()
    if not _are_fixed(items):
        for row, item in enumerate(items):
            result[row] = copied(item)
    return result


def _copied_tuple(items: tuple[Any, ...]) -> tuple[Any, ...]:
    return items if _are_fixed(items) else tuple(map(copied, items))


def _record_copier(kind: type) -> Callable[[Any], Any]:
    """Return the function that copies records of a dataclass that may change."""
    names = [each.name for each in fields(kind)]
    copier = _copier

    def copy(record: Any) -> Any:
        result: Any = object.__new__(kind)
        for name in names:
            value = getattr(record, name)
            own = copier(type(value))
            setattr(result, name, value if own is None else own(value))
        return result

    return copy


def to_bytes(checkpoint: object) -> bytes:
    """Return a checkpoint as bytes, see `from_bytes`."""
    return pickle.dumps(checkpoint, protocol=5)


def from_bytes(data: bytes) -> object:
    """Return the checkpoint of bytes that `to_bytes` made.

    Only arrays, containers and records of fgtrack are read, so that a file can run no code of others. Raises
    `DataError` for all other contents.
    """
    try:
        result: object = _Reader(BytesIO(data)).load()
        return result
    except DataError:
        raise
    except Exception as error:
        raise DataError(f"the checkpoint cannot be read ({error})") from error


_ALLOWED = {
    "builtins": {"set", "frozenset", "bytearray", "complex", "slice", "range"},
    "fgtrack.models.measurement": {"_shared_model"},
    "collections": {"Counter", "deque", "OrderedDict", "defaultdict"},
    "_codecs": {"encode"},
    "functools": {"partial"},
    "itertools": {"chain", "repeat"},
    "numpy": {"dtype", "ndarray", "int64", "float64", "bool_", "bool"},
}
_NUMPY_MAKERS = ("_reconstruct", "_frombuffer", "scalar")


class _Reader(pickle.Unpickler):
    """Reads records of fgtrack, containers and arrays, and refuses all other objects."""

    def find_class(self, module: str, name: str) -> Any:
        if name in _ALLOWED.get(module, ()) or (
            module.startswith(("numpy.core.", "numpy._core.")) and name in _NUMPY_MAKERS
        ):
            return super().find_class(module, name)
        if module.startswith("fgtrack.") and "." not in name:
            found = getattr(import_module(module), name)
            if isinstance(found, type):
                return found
        raise DataError(
            f"the checkpoint contains {module}.{name}, which is not a state: load a file of `save`"
        )
