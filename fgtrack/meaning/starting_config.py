"""Starting configuration for a recording without one: guesses for its topics or tables, with the reasons."""

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from itertools import chain, count, islice
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML

from fgtrack.config.settings import Config
from fgtrack.config.yaml_file import validate
from fgtrack.core.errors import DataError, FgtrackError
from fgtrack.core.time import nanoseconds
from fgtrack.core.types import DESCRIBING, MEASURABLE, STATE_NAMES
from fgtrack.inputs.formats import ADAPTERS
from fgtrack.inputs.formats.fields import fields_of
from fgtrack.inputs.formats.native import NATIVE_ADAPTERS
from fgtrack.inputs.formats.objects import ODOMETRY
from fgtrack.inputs.formats.tables import headers, rows
from fgtrack.inputs.geodetic import GEODETIC
from fgtrack.inputs.info import OTHER_CLOCK_S, TopicInfo, describe
from fgtrack.inputs.ros.bag import Bag
from fgtrack.inputs.settings import CsvInput, CsvTable, Field, InputConfig, TopicInput
from fgtrack.inputs.source import input_kind, open_input
from fgtrack.meaning.assumed import assumed
from fgtrack.meaning.assumption import Assumed, departures
from fgtrack.meaning.guess import (
    Guess,
    agreeing_with_motion,
    guesses,
    time_unit,
    words_of,
)
from fgtrack.meaning.input_checks import TRIAL_S, input_checks, messages_within

__all__ = ["starting_config"]

# Number of rows of a table, and of messages of a topic, on which a guess is based.
_ROWS = 20_000
_MESSAGES = 20
_EGO = frozenset(("ego", "own", "ownship", "host", "self"))
_TRUTH = frozenset(
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
_OTHER_PACKAGES = (
    "sensor_msgs",
    "tf2_msgs",
    "visualization_msgs",
    "rcl_interfaces",
    "rosgraph_msgs",
    "std_msgs",
)
_POSITIONS = (
    {"x_m", "y_m"},
    {"range_m", "bearing_rad"},
    {"bearing_rad"},
    set(GEODETIC),
)
_NEEDED = {"ego": {"x_m", "y_m", "yaw_rad", "speed_mps"}, "truth": {"x_m", "y_m"}}


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

    @property
    def label(self) -> str:
        """Name of the topic or file."""
        return (
            self.item.topic
            if isinstance(self.item, TopicInput)
            else self.item.file or "the file"
        )


def _topic_part(bag: Bag, topic: TopicInfo, parts: Sequence[InputPart]) -> InputPart:
    """Return the guess for `topic` in addition to the other `parts`.

    Raises `DataError` with the reason if the topic cannot be used.
    """
    words = set(words_of(topic.name))
    is_truth = bool(words & _TRUTH and not words & _EGO)
    has_clock = topic.delay is None or abs(topic.delay["p50_s"]) < OTHER_CLOCK_S
    item = TopicInput(topic.name, stamp_from="message" if has_clock else "receipt")
    reasons = {
        "stamp_from": "its stamps come from another clock than the recorder's, or are not set"
    }
    problem = next(
        (
            entry.problem
            for entry in bag.topics
            if (entry.name, entry.type) == (topic.name, topic.type)
        ),
        None,
    )
    if problem is not None or not topic.count:
        raise DataError(problem or "no messages")
    sensor = _sensor_name(topic.name, parts)
    if topic.type == ODOMETRY or topic.type in ADAPTERS:
        return InputPart(
            "truth" if is_truth else "ego" if topic.type == ODOMETRY else sensor,
            item,
            reasons,
        )
    if topic.type.startswith(_OTHER_PACKAGES):
        raise DataError("no objects")
    part = _mapped(bag, item, topic.type, sensor)
    return replace(part, reasons={**reasons, **part.reasons})


def _mapped(bag: Bag, item: TopicInput, type_name: str, sensor: str) -> InputPart:
    """Return the guess for a topic of an unknown message type.

    Raises `DataError` if the type has no position (with the ranges of its fields), or a
    single pose (with a guess of the mapping).
    """
    messages = [
        one
        for topic, _, one in islice(bag.messages({item.topic}), _MESSAGES)
        if topic.type == type_name
    ]
    result: list[Mapping[str, Any]] = [fields_of(message) for message in messages]
    lists: dict[str, list[Mapping[str, Any]]] = {}
    for path, items in chain.from_iterable(each.items() for each in result):
        if isinstance(items, list):
            lists.setdefault(path, []).extend(map(fields_of, items))
    lists[""] = result  # the message itself is tried last
    for path, samples in lists.items():
        values = _columns(samples)
        own = guesses(values)
        if not any(wanted <= own.keys() for wanted in _POSITIONS):
            continue
        is_ego = (
            not path
            and _NEEDED["ego"] <= own.keys()
            and bool(set(words_of(item.topic)) & _EGO)
        )
        known = STATE_NAMES if is_ego else (*MEASURABLE, *DESCRIBING, "object_id")
        used = {key: one for key, one in own.items() if key in known}
        if not (path or is_ego or "range_m" in own):
            mapping = ", ".join(f"{key}: {one.path}" for key, one in used.items())
            raise DataError(
                f"one pose per message: the ego, truth or one object; fields: {{{mapping}}}"
            )
        fields = {
            **({"objects": path} if path else {}),
            **{key: one.path for key, one in used.items()},
        }
        reasons = {
            "objects": "the list in the message",
            **{key: one.reason for key, one in used.items()},
        }
        notes = _unused(values, used)
        if not (path or is_ego):
            notes += (
                "one object per message: set scan_s to combine the objects of a scan",
            )
        return InputPart(
            "ego" if is_ego else sensor, replace(item, fields=fields), reasons, notes
        )
    raise DataError(
        f"no position among {_spreads(_columns(lists[''])) or 'its fields'}"
    )


def _columns(samples: Sequence[Mapping[str, Any]]) -> dict[str, list[float]]:
    """Return the numbers of the samples by field name; empty for a text field."""
    names = dict.fromkeys(
        name
        for item in samples
        for name, value in item.items()
        if not isinstance(value, list)
    )
    return {
        name: [
            float(item[name])
            for item in samples
            if not isinstance(item.get(name), str | None)
        ]
        for name in names
    }


def _sensor_name(text: str, parts: Sequence[InputPart]) -> str:
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


def _table_part(
    file: Path, columns: Sequence[str], is_folder: bool, parts: Sequence[InputPart]
) -> InputPart:
    """Return the guess for a table in addition to the other `parts`.

    Raises `DataError` with the ranges of its columns if the table cannot be used.
    """
    cells = [cells for _, cells in islice(rows(file), 1, _ROWS)]
    values = {
        name: [_number(item[name]) for item in cells]
        for name in columns
        if any(item[name] for item in cells)
    }
    own = guesses(
        {
            name: [value for value in result if math.isfinite(value)]
            for name, result in values.items()
        }
    )
    words = set(words_of(file.stem))
    is_truth = bool(words & _TRUTH and not words & _EGO)
    is_ego = bool(words & _EGO)
    is_ego |= not (is_truth or "object_id" in own) and _NEEDED["ego"] <= own.keys()
    role = "ego" if is_ego else "truth" if is_truth else _sensor_name(file.stem, parts)
    if "stamp" not in own:
        raise DataError(f"no column of times among {_spreads(values)}")
    column = str(own["stamp"].path)
    unit, why = time_unit(
        column, [value for value in values[column] if math.isfinite(value)]
    )
    if is_ego:
        own = agreeing_with_motion(
            own, {name: np.array(result) for name, result in values.items()}, unit
        )
    missing = _NEEDED.get(role, set()) - own.keys()
    if missing or not any(wanted <= own.keys() for wanted in _POSITIONS):
        raise DataError(
            f"no column for {', '.join(sorted(missing)) or 'a position'} among {_spreads(values)}"
        )
    is_sensor = not (is_ego or is_truth)
    known = (
        "stamp",
        "receipt",
        *((*MEASURABLE, *GEODETIC, *DESCRIBING) if is_sensor else STATE_NAMES),
    )
    used = {
        key: item
        for key, item in own.items()
        if key in known or (key == "object_id" and not is_ego)
    }
    named = [str(own[key].path) for key in ("x_m", "y_m") if key in own and is_sensor]
    in_map = bool(named) and all(
        set(words_of(name)) & {"east", "easting", "north", "northing"} for name in named
    )
    table = CsvTable(
        {key: item.path for key, item in used.items()},
        file.name if is_folder else None,
        unit,  # type: ignore[arg-type]  # a name of NS_PER_UNIT
        frame="map" if in_map else None,
    )
    reasons = {
        **{key: item.reason for key, item in used.items()},
        "time_unit": why,
        "frame": "east and north",
    }
    return InputPart(role, table, reasons, _unused(values, used))


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _unused(
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
    return (f"not used: {_spreads(rest)}",) if rest else ()


def _spreads(values: Mapping[str, Sequence[float]]) -> str:
    result = []
    for name, samples in values.items():
        finite = [value for value in samples if math.isfinite(value)]
        result.append(
            f"{name} ({min(finite):.4g} to {max(finite):.4g})" if finite else name
        )
    return ", ".join(result)


def starting_config(recording: Path) -> str:
    """Return the YAML text of a starting configuration for `recording`, with everything else as comments.

    Raises `CallError` if the path does not exist. Raises `DataError` if it is not an
    input, or damaged at its start.
    """
    parts, refused = _parts(recording)
    taken = _readable(recording, parts, refused)
    config = Config(input=_input(taken))
    checks = list[str]()
    with_sensors = Assumed(config)
    try:
        source = open_input(recording, config.input)
        with_sensors = assumed(config, source)
        checks += map(
            str,
            input_checks(
                list(messages_within(source.messages(), nanoseconds(TRIAL_S))),
                with_sensors.config,
            ),
        )
    except FgtrackError as error:
        if taken:  # without any part the error only repeats this
            checks.append(str(error))
    head = [
        f"Starting configuration for {recording.name} (fgtrack info --write)",
        "Guesses from names and values: check units, frames and noise, then run",
        f"  fgtrack info {recording} -c THIS.yaml; fgtrack replay {recording} -c THIS.yaml -o RUN",
        *(f"Check: {line}" for line in checks),
        *(f"Not used: {line}" for line in refused),
        *(f"{part.label}: {note}" for part in taken for note in part.notes),
    ]
    text = with_sensors.to_yaml(
        head, [item for part in taken for item in _comments(part)]
    )
    validate(
        Config,
        YAML(typ="safe", pure=True).load(text) or {},
        "the starting configuration",
    )
    return text


def _parts(recording: Path) -> tuple[list[InputPart], list[str]]:
    """Return the guesses for the parts of the recording, and a line for each other part.

    The most probable ego comes first.
    """
    parts: list[InputPart] = []
    refused: list[str] = []
    makers: dict[str, Callable[[], InputPart]] = {}
    if input_kind(recording) == "csv":
        is_folder = recording.is_dir()
        for file, columns in headers(recording).items():
            makers[file.name] = partial(_table_part, file, columns, is_folder, parts)
    else:
        result = describe(recording)
        refused += [] if result.problem is None else [result.problem]
        if result.kind == "recording" and not any(
            topic.type in NATIVE_ADAPTERS for topic in result.topics
        ):
            bag = Bag(recording)
            makers = {
                f"{topic.name} ({topic.type})": partial(_topic_part, bag, topic, parts)
                for topic in result.topics
            }
    for label, make in makers.items():
        try:
            parts.append(make())
        except DataError as error:
            refused.append(f"{label}: {error}")
    return sorted(
        parts,
        key=lambda part: (part.role != "ego", not set(words_of(part.label)) & _EGO),
    ), refused


def _readable(
    recording: Path, parts: Sequence[InputPart], refused: list[str]
) -> list[InputPart]:
    """Return the parts whose first message can be read, one for each role.

    Appends a line to `refused` for each of the other parts.
    """
    taken: list[InputPart] = []
    for part in parts:
        guess = f"{part.label} as {part.role}"
        if any(part.role == other.role for other in taken):
            settings = json.dumps(departures(part.item))
            refused.append(f"{guess}: another part has this role; settings {settings}")
            continue
        try:
            next(iter(open_input(recording, _input([part])).messages()), None)
            taken.append(part)
        except FgtrackError as error:
            refused.append(f"{guess}: {error}")
    return taken


def _input(parts: Sequence[InputPart]) -> InputConfig:
    tables = {part.role: part.item for part in parts if isinstance(part.item, CsvTable)}
    topics = {
        part.role: part.item for part in parts if isinstance(part.item, TopicInput)
    }
    ego = tables.pop("ego", None)
    truth = tables.pop("truth", None)
    return InputConfig(
        ego=topics.pop("ego", None),
        truth=topics.pop("truth", None),
        detections=topics,
        csv=CsvInput(ego, tables, truth),
    )


def _comments(part: InputPart) -> Iterator[tuple[Sequence[str], str]]:
    """Yield the key path and the reason of each guess."""
    is_table = isinstance(part.item, CsvTable)
    section = [
        *(["csv"] if is_table else []),
        *(["detections"] if part.role not in ("ego", "truth") else []),
        part.role,
    ]
    own = {item.name for item in fields(part.item)}
    for name, reason in part.reasons.items():
        yield (
            [
                "input",
                *section,
                *([] if name in own else ["columns" if is_table else "fields"]),
                name,
            ],
            reason,
        )
