"""Changes values: what a user, a driver or a converter gets wrong in data that are well-formed.

A document is what a file or a sequence of messages holds: lists, dictionaries and single values. `change` changes one
thing in it. The same random numbers always make the same change.
"""

import math
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction
from typing import Any

import numpy as np

#: Keys of records that are no values: the time when a record arrives, and the class of the message in a program.
ARRIVAL, KIND = "at_ns", "type"
_HOUR_NS = 3600 * 10**9
_MANY = (2000, 3000, 6000)


class _Missing:
    """Stands for a value that is left out."""

    def __deepcopy__(self, memo: object) -> "_Missing":
        return self


_MISSING = _Missing()


@dataclass(frozen=True)
class Place:
    """A value in a document: `inside[key]`."""

    inside: Any
    key: Any
    path: str

    @property
    def value(self) -> Any:
        """The value."""
        return self.inside[self.key]

    def put(self, value: Any) -> None:
        """Replace the value, or leave it out."""
        if value is _MISSING:
            del self.inside[self.key]
        else:
            self.inside[self.key] = value


Change = Callable[[np.random.Generator, Any], Any]


def _pick(*values: Any) -> Change:
    """Return a change to one of `values`."""
    return lambda rng, _: deepcopy(values[rng.integers(len(values))])


def _times(*factors: float) -> Change:
    def scaled(rng: np.random.Generator, value: Any) -> Any:
        factor = factors[rng.integers(len(factors))]
        if not _is_number(value):
            return factor
        return (
            round(value * factor)
            if isinstance(value, int) and math.isfinite(value * factor)
            else value * factor
        )

    return scaled


def _plus(*steps: int) -> Change:
    def moved(rng: np.random.Generator, value: Any) -> Any:
        step = steps[rng.integers(len(steps))]
        return value + step if _is_number(value) else step

    return moved


def _as_text(rng: np.random.Generator, value: Any) -> Any:
    forms = (str(value), f" {value} ", f"{value},0", f"{value}m", repr([value]))
    return forms[rng.integers(len(forms))]


def _as_list(rng: np.random.Generator, value: Any) -> Any:
    forms = ([value], [value, value], [[value]], {"value": value}, [None], [])
    return deepcopy(forms[rng.integers(len(forms))])


def _negated(rng: np.random.Generator, value: Any) -> Any:
    return -value if _is_number(value) else -1.0


_LONG = "x" * 5000
#: Changes of a value that any file can hold, by name.
PLAIN: dict[str, Change] = {
    "not a number": _pick(math.nan),
    "infinite": _pick(math.inf, -math.inf),
    "none": _pick(None),
    "missing": _pick(_MISSING),
    "empty": _pick("", [], {}),
    "text": _as_text,
    "other text": _pick(
        "x",
        "nan",
        "inf",
        "1e5",
        "0x10",
        "1_000",
        "true",
        "[bold]",
        "=HYPERLINK(1)",
        "../x",
        "a.b.c",
    ),
    "text of other letters": _pick(
        "ä",
        "車",
        "\u202eabc",
        "\x00",
        "\x1b[31m",
        "a\nb",
        "\ud800",
        "🚗",
        _LONG,
        "ＡＢ",
    ),
    "number": _pick(0, 1, -1, 3, 0.5, 1e6),
    "list": _as_list,
    "boolean": _pick(True, False),
    "huge": _pick(
        1e308,
        -1e308,
        1e200,
        1e19,
        10**30,
        2**63,
        2**63 - 1,
        -(2**63) - 1,
        2**64,
        2**70,
        10**400,
    ),
    "tiny": _pick(5e-324, 1e-300, -1e-308, 1e-12),
    "zero": _pick(0, 0.0, -0.0),
    "unit": _times(
        1e3,
        1e-3,
        1e6,
        1e-6,
        1e9,
        1e-9,
        57.29577951308232,
        0.017453292519943295,
        3.6,
        1.852,
    ),
    "sign": _negated,
    "time": _plus(
        _HOUR_NS,
        -_HOUR_NS,
        10**9,
        -(10**9),
        24 * _HOUR_NS,
        3 * 10**8,
        -3 * 10**8,
        1,
        315_964_800 * 10**9,
    ),
}


def _numpy(*kinds: Callable[[Any], Any]) -> Change:
    def converted(rng: np.random.Generator, value: Any) -> Any:
        kind = kinds[rng.integers(len(kinds))]
        with np.errstate(all="ignore"):
            try:
                return kind(value)
            except (TypeError, ValueError, ArithmeticError):
                return kind(1)

    return converted


#: Changes of a value to what only a program can hold, by name.
OF_PROGRAMS: dict[str, Change] = {
    "numpy float": _numpy(np.float16, np.float32, np.float64, np.longdouble),
    "numpy integer": _numpy(np.uint64, np.int64, np.int32, np.uint8, np.int8),
    "numpy wraps": _pick(
        np.uint64(2**63 + 5), np.uint64(0), np.int32(-1), np.int8(-128), np.float16(6e4)
    ),
    "numpy array": _numpy(
        np.array,
        np.atleast_1d,
        lambda value: np.array([value, value]),
        lambda _: np.zeros(0),
    ),
    "numpy text": _pick(
        np.str_("car"),
        np.bytes_(b"car"),
        np.bool_(True),
        np.datetime64(0, "ns"),
        np.timedelta64(1, "s"),
    ),
    "other number": _numpy(Decimal, Fraction, complex),
    "object": _pick(
        b"abc", (), (1.0,), frozenset({1}), object, Ellipsis, range(3), bytearray(b"1")
    ),
    "masked": _pick(
        np.ma.masked, np.void(b"1"), np.array(None), np.array("x"), np.float64(math.nan)
    ),
}


def _covariance(rng: np.random.Generator, value: Any) -> Any:
    """Another covariance, of another shape or with wrong entries."""
    is_flat = isinstance(value, list) and value and all(map(_is_number, value))
    flat = [float(each) for each in value] if is_flat else [1.0, 0.0, 0.0, 1.0]
    n = max(math.isqrt(len(flat)), 1)
    square = [flat[k * n : (k + 1) * n] for k in range(n)]
    asymmetric, indefinite, broken = list(flat), list(flat), list[Any](flat)
    asymmetric[-2 if n > 1 else 0] += 1.0
    indefinite[1 if n > 1 else 0] = indefinite[n if n > 1 else 0] = -1e3
    broken[int(rng.integers(len(flat)))] = (
        None,
        math.nan,
        math.inf,
        "1",
        1e308,
        -1.0,
        0.0,
        [1.0],
    )[rng.integers(8)]
    choices: tuple[Any, ...] = (
        *(
            flat[:-1],
            [*flat, 1.0],
            flat[:n],
            flat[:1],
            [],
            [flat],
            square,
            asymmetric,
            indefinite,
            broken,
            broken,
        ),
        *(
            [0.0] * len(flat),
            [-each for each in flat],
            [1e18 * each for each in flat],
            [1e-18 * each for each in flat],
        ),
        *(
            [1.0] * len(flat),
            [[each] for each in flat],
            {"x_m": 1.0},
            1.0,
            "0.1 0 0 0.1",
            [1] * len(flat),
        ),
        *([0.0] * 36, [1.0] * 36, [str(each) for each in flat], [True] * len(flat)),
    )
    return choices[rng.integers(len(choices))]


def _covariance_of_programs(rng: np.random.Generator, value: Any) -> Any:
    changed = _covariance(rng, value)
    forms = (
        tuple,
        np.array,
        lambda each: np.array(each, dtype=np.float32),
        lambda each: np.asmatrix(each),
        list,
    )
    try:
        with np.errstate(all="ignore"):
            return forms[rng.integers(len(forms))](changed)
    except (TypeError, ValueError):
        return changed


def _truncated(rng: np.random.Generator, value: list[Any]) -> None:
    del value[int(rng.integers(len(value))) :]


def _repeated(rng: np.random.Generator, value: list[Any]) -> None:
    at = int(rng.integers(len(value)))
    value.insert(at, deepcopy(value[at]))


def _turned(rng: np.random.Generator, value: list[Any]) -> None:
    value.reverse()


def _shuffled(rng: np.random.Generator, value: list[Any]) -> None:
    order = rng.permutation(len(value)).tolist()
    value[:] = [value[k] for k in order]


def _grown(rng: np.random.Generator, value: list[Any]) -> None:
    one, count = value[int(rng.integers(len(value)))], _MANY[rng.integers(len(_MANY))]
    value += (
        [deepcopy(one) for _ in range(count)]
        if rng.integers(2)
        else [_moved(rng, one) for _ in range(count)]
    )


def _moved(rng: np.random.Generator, value: Any) -> Any:
    """A copy of a detection or row at another position."""
    value = deepcopy(value)
    if isinstance(value, dict):
        for key in ("x_m", "y_m", "bearing_rad", "latitude_deg", "longitude_deg"):
            if key in value and _is_number(value[key]):
                value[key] += float(
                    rng.normal(0.0, 1.0 if key.endswith(("rad", "deg")) else 100.0)
                )
    return value


#: Changes of a list in a document, by name.
OF_LISTS: dict[str, Callable[[np.random.Generator, list[Any]], None]] = {
    "truncated": _truncated,
    "repeated": _repeated,
    "reversed": _turned,
    "shuffled": _shuffled,
}


def places(
    document: Any, hidden: Sequence[str] = (ARRIVAL,), path: str = ""
) -> list[Place]:
    """Return all values in a document, those that contain others too, without keys that are `hidden`."""
    found = []
    for key in _keys(document):
        if key in hidden:
            continue
        name = f"{path}[{key}]" if isinstance(key, int) else f"{path}.{key}"
        found.append(Place(document, key, name))
        found += places(document[key], hidden, name)
    return found


def change(rng: np.random.Generator, document: Any, of_programs: bool = False) -> str:
    """Change one thing in `document`, a list or a dictionary; return what, for a reader."""
    everywhere = places(document, (ARRIVAL, KIND) if of_programs else (ARRIVAL,))
    if not everywhere:
        return "nothing to change"
    kinds = [_value, _value, _value, _value, _everywhere, _list, _added, _covariances]
    if isinstance(document, list) and any(
        isinstance(each, dict) and "stamp_ns" in each for each in document
    ):
        kinds += [_messages, _messages]
    if rng.integers(200) == 0:
        kinds = [_many]
    return kinds[rng.integers(len(kinds))](rng, document, everywhere, of_programs)


def _changes(of_programs: bool) -> dict[str, Change]:
    return PLAIN | OF_PROGRAMS if of_programs else PLAIN


def _chosen(rng: np.random.Generator, items: Sequence[Any]) -> Any:
    return items[rng.integers(len(items))]


def _value(
    rng: np.random.Generator, document: Any, everywhere: list[Place], of_programs: bool
) -> str:
    """Change one value. Each name of a field is as likely as any other."""
    names = sorted({str(each.key) for each in everywhere})
    name = _chosen(rng, names)
    place = _chosen(rng, [each for each in everywhere if str(each.key) == name])
    kind = _chosen(rng, list(_changes(of_programs)))
    old, new = place.value, _changes(of_programs)[kind](rng, place.value)
    place.put(new)
    return f"{place.path}: {old!r:.60} -> {_shown(new)} ({kind})"


def _everywhere(
    rng: np.random.Generator, document: Any, everywhere: list[Place], of_programs: bool
) -> str:
    """Change a field in every message of one sensor, or in all rows, in the same way."""
    leaves = [
        each for each in everywhere if not isinstance(each.value, list | dict)
    ] or everywhere
    place = _chosen(rng, leaves)
    sensor = _sensor(document, place)
    kind = _chosen(rng, list(_changes(of_programs)))
    seed, count = int(rng.integers(2**32)), 0
    for each in leaves:
        if each.key == place.key and _sensor(document, each) == sensor:
            each.put(
                _changes(of_programs)[kind](np.random.default_rng(seed), each.value)
            )
            count += 1
    return f"all {count} {place.key} of {sensor}: {kind} (seed {seed})"


def _sensor(document: Any, place: Place) -> Any:
    number = place.path[1:].partition("]")[0]
    if (
        isinstance(document, list)
        and number.isdigit()
        and isinstance(document[int(number)], dict)
    ):
        return source(document[int(number)])
    return None


def source(record: dict[str, Any]) -> str:
    """Return the name of the sensor of a record, or its type."""
    return repr(record.get("sensor", record.get("type")))


def _list(
    rng: np.random.Generator, document: Any, everywhere: list[Place], of_programs: bool
) -> str:
    lists = [each for each in everywhere if isinstance(each.value, list) and each.value]
    if not lists:
        return _value(rng, document, everywhere, of_programs)
    place, kind = _chosen(rng, lists), _chosen(rng, list(OF_LISTS))
    OF_LISTS[kind](rng, place.value)
    return f"{place.path}: {kind}"


def _added(
    rng: np.random.Generator, document: Any, everywhere: list[Place], of_programs: bool
) -> str:
    """Add a field that nobody knows, or rename one. Constructors of messages take no such field."""
    mappings = [
        each for each in everywhere if isinstance(each.value, dict) and each.value
    ]
    if of_programs or not mappings:
        return _value(rng, document, everywhere, of_programs)
    place = _chosen(rng, mappings)
    name, value = (
        _chosen(
            rng, ["unknown", "", "ä", "x_mm", "stamp", "covariances", "\x1b[31m", _LONG]
        ),
        PLAIN["list"](rng, 1.0),
    )
    if rng.integers(2):
        key = _chosen(rng, [each for each in place.value if each != ARRIVAL] or [""])
        value = place.value.pop(key, None)
    place.value[name] = value
    return f"{place.path}: field {name!r:.30} = {_shown(value)}"


def _covariances(
    rng: np.random.Generator, document: Any, everywhere: list[Place], of_programs: bool
) -> str:
    found = [each for each in everywhere if each.key == "covariance"]
    if not found:
        return _value(rng, document, everywhere, of_programs)
    place = _chosen(rng, found)
    new = (_covariance_of_programs if of_programs else _covariance)(rng, place.value)
    place.put(new)
    return f"{place.path}: {_shown(new)} (covariance)"


def _many(
    rng: np.random.Generator, document: Any, everywhere: list[Place], of_programs: bool
) -> str:
    lists = [each for each in everywhere if isinstance(each.value, list) and each.value]
    if not lists:
        return _value(rng, document, everywhere, of_programs)
    place = _chosen(rng, [each for each in lists if each.key == "objects"] or lists)
    _grown(rng, place.value)
    return f"{place.path}: {len(place.value)} entries"


_KINDS_OF_ORDER = (
    *("again", "other contents", "shuffled", "reversed", "jump"),
    *("one ahead", "lost", "swapped", "same stamp"),
)


def _messages(
    rng: np.random.Generator,
    document: list[Any],
    everywhere: list[Place],
    of_programs: bool,
) -> str:
    """Change the order of messages, their clocks and how often they come."""
    rows = [
        k
        for k, each in enumerate(document)
        if isinstance(each, dict) and "stamp_ns" in each
    ]
    row = int(_chosen(rng, rows))
    one, arrivals_ns = (
        document[row],
        [each.get(ARRIVAL) if isinstance(each, dict) else None for each in document],
    )
    sensor = source(one)
    same = [k for k in rows if source(document[k]) == sensor]
    step_ns = int(
        _chosen(
            rng,
            [
                _HOUR_NS,
                -_HOUR_NS,
                10**9,
                -(10**9),
                4 * 10**8,
                -4 * 10**8,
                10**18,
                -(10**18),
            ],
        )
    )
    key = str(_chosen(rng, ["stamp_ns", "receipt_ns"]))
    kind = str(
        _chosen(
            rng,
            [
                "again",
                "other contents",
                "shuffled",
                "reversed",
                "jump",
                "one ahead",
                "lost",
                "swapped",
                "same stamp",
            ],
        )
    )
    match kind:
        case "again":
            for _ in range(int(_chosen(rng, [1, 2, 30]))):
                document.insert(row, deepcopy(one))
        case "other contents":
            other = deepcopy(one)
            for each in places(other):
                if isinstance(each.value, float):
                    each.put(each.value * 1.5 + 1.0)
            document.insert(row + 1, other)
        case "shuffled":
            order = rng.permutation(rows).tolist()
            document[:] = _permuted(document, dict(zip(rows, order, strict=True)))
        case "reversed":
            stamps = [document[k].get(key) for k in same]
            for k, stamp in zip(same, reversed(stamps), strict=True):
                document[k][key] = stamp
        case "jump":
            for k in same[same.index(row) :]:
                document[k][key] = _moved_by(document[k].get(key), step_ns)
        case "one ahead":
            one[key] = _moved_by(one.get(key), step_ns)
        case "lost":
            for k in reversed(
                same[same.index(row) :][: int(_chosen(rng, [1, 5, 1000]))]
            ):
                del document[k]
        case "swapped":
            other_row = int(_chosen(rng, rows))
            document[:] = _permuted(document, {row: other_row, other_row: row})
        case _:
            for k in same:
                document[k][key] = one.get(key)
    if kind in ("shuffled", "swapped"):  # the arrivals stay
        for each, at_ns in zip(document, arrivals_ns, strict=True):
            if at_ns is not None and isinstance(each, dict):
                each[ARRIVAL] = at_ns
    return f"messages: {kind} at {row} ({sensor}, {key}, {step_ns})"


def _permuted(document: list[Any], order: dict[int, int]) -> list[Any]:
    return [document[order.get(k, k)] for k in range(len(document))]


def _moved_by(value: Any, step_ns: int) -> Any:
    return value + step_ns if _is_number(value) else step_ns


def _shown(value: Any) -> str:
    return "left out" if value is _MISSING else f"{value!r:.80}"


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _keys(value: Any) -> list[Any]:
    return (
        list(value)
        if isinstance(value, dict)
        else list(range(len(value)))
        if isinstance(value, list)
        else []
    )
