"""Parts of a recording: topics and tables with a role, and the words in names from which roles are guessed."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from itertools import count

from fgtrack.inputs.geodetic import GEODETIC
from fgtrack.inputs.settings import CsvTable, Field, TopicInput
from fgtrack.meaning.guess import Guess, words_of

__all__ = [
    "EGO_WORDS",
    "FULL_EGO",
    "NEEDED",
    "POSITIONS",
    "TRUTH_WORDS",
    "InputPart",
    "sensor_name",
    "spreads",
    "unused",
]

EGO_WORDS = frozenset(("ego", "own", "ownship", "host", "self"))
TRUTH_WORDS = frozenset(
    (
        "truth",
        "gt",
        "groundtruth",
        "label",
        "labels",
        "reference",
        "cars",
        "opponent",
        "target",
        "npc",
    )
)
_GENERAL = frozenset(
    (
        "perception",
        "detections",
        "detection",
        "objects",
        "object",
        "tracks",
        "track",
        "list",
        "sensing",
        "data",
        "csv",
    )
)
POSITIONS = (
    {"x_m", "y_m"},
    {"range_m", "bearing_rad"},
    {"bearing_rad"},
    set(GEODETIC),
)
NEEDED = {"ego": {"x_m", "y_m"}, "truth": {"x_m", "y_m"}}
"""Required components; heading and speed of the ego follow from its positions."""
FULL_EGO = {"x_m", "y_m", "yaw_rad", "speed_mps"}
"""Components of an ego that is recognised without its name."""


@dataclass(frozen=True)
class InputPart:
    """Guess for a topic or a table: its role, its settings, and the reasons."""

    role: str
    """`ego`, `truth`, or the name of a sensor."""
    item: TopicInput | CsvTable
    """Settings of the topic or table."""
    reasons: Mapping[str, str]
    """Reason of each guess, by setting or component."""
    notes: tuple[str, ...] = ()
    """Notes on unused fields, and on settings to check."""
    rank: int = 0
    """Rank among several parts with one role: the lowest is used."""
    role_reason: str = ""
    """Reason of the role if a test chose this part; else empty."""

    @property
    def label(self) -> str:
        """Name of the topic or file."""
        return (
            self.item.topic
            if isinstance(self.item, TopicInput)
            else self.item.file or "the file"
        )

    @property
    def path(self) -> tuple[str, ...]:
        """Key path of the settings of the topic or table."""
        table = ("csv",) if isinstance(self.item, CsvTable) else ()
        section = () if self.role in ("ego", "truth") else ("detections",)
        return ("input", *table, *section, self.role)

    def comments(self) -> Iterator[tuple[tuple[str, ...], str]]:
        """Yield the key path and the reason of each guess."""
        own = {item.name for item in fields(self.item)}
        values = "columns" if isinstance(self.item, CsvTable) else "fields"
        for name, reason in self.reasons.items():
            yield (*self.path, *(() if name in own else (values,)), name), reason


def sensor_name(text: str, parts: Sequence[InputPart]) -> str:
    """Return a name for a sensor from the name of its topic or file, different from the roles in `parts`."""
    words = words_of(text)
    name = (
        "_".join([word for word in words if word not in _GENERAL] or words) or "sensor"
    )
    taken = {part.role for part in parts} | {"ego", "truth"}
    return (
        name
        if name not in taken
        else next(f"{name}_{k}" for k in count(2) if f"{name}_{k}" not in taken)
    )


def unused(
    values: Mapping[str, Sequence[float]], used: Mapping[str, Guess]
) -> tuple[str, ...]:
    """Return a note on the fields or columns that are not `used`; empty if all are used."""
    paths = [
        item.path.path if isinstance(item.path, Field) else item.path
        for item in used.values()
    ]
    names = {
        name for path in paths for name in ([path] if isinstance(path, str) else path)
    }
    rest = {name: result for name, result in values.items() if name not in names}
    return (f"not used: {spreads(rest)}",) if rest else ()


def spreads(values: Mapping[str, Sequence[float]]) -> str:
    """Return names with their smallest and largest values: `temp (20 to 21), comment`."""
    result = []
    for name, samples in values.items():
        finite = [value for value in samples if math.isfinite(value)]
        result.append(
            f"{name} ({min(finite):.4g} to {max(finite):.4g})" if finite else name
        )
    return ", ".join(result)
