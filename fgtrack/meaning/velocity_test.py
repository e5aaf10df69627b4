"""Decides how the velocities of a sensor's topic or table are read."""

from collections.abc import Iterator, Mapping
from dataclasses import replace

from fgtrack.config.settings import Config
from fgtrack.core.types import Detection, DetectionList
from fgtrack.inputs.formats.fields import paths_of
from fgtrack.inputs.settings import CsvTable, Field, FieldPath, TopicInput
from fgtrack.meaning.assumption import departures
from fgtrack.meaning.decision import Decision
from fgtrack.meaning.guess import words_of
from fgtrack.meaning.motions import motions, straight_paths
from fgtrack.meaning.sample import Sample
from fgtrack.meaning.scans import scans_of
from fgtrack.meaning.velocities import (
    SPEED_UNITS,
    VelocityMeaning,
    by_name,
    meaning_of,
)

__all__ = ["velocity_decisions"]

_VELOCITIES = ("speed_mps", "range_rate_mps")


def velocity_decisions(sample: Sample) -> Iterator[Decision]:
    """Yield a decision on each velocity that a topic or table maps and the user has not given."""
    inputs = sample.config.input
    mappings = {name: item.fields for name, item in inputs.detections.items()}
    mappings |= {name: item.columns for name, item in inputs.csv.detections.items()}
    for name, mapping in sorted(mappings.items()):
        path = sample.input_path(name)
        key = "fields" if name in inputs.detections else "columns"
        if path is None or not mapping or not sample.is_open((*path, key)):
            continue
        given = [one for one in _VELOCITIES if one in mapping]
        if given:
            yield _decision(sample, name, (*path, key), dict(mapping), given)


def _decision(
    sample: Sample,
    name: str,
    path: tuple[str, ...],
    mapping: dict[str, FieldPath],
    given: list[str],
) -> Decision:
    """Return the decision on the velocity of one sensor: the whole mapping, with the velocity as it is used."""
    rest = {key: one for key, one in mapping.items() if key not in _VELOCITIES}
    choices = [_meaning(sample, name, rest, mapping[key]) for key in given]
    in_map = any(
        isinstance(each, DetectionList) and each.sensor == name and each.frame == "map"
        for each in sample.messages
    )
    new = dict(rest)
    texts = []
    for key, meaning in zip(given, choices, strict=True):
        raw = mapping[key]
        component = meaning.component
        if len(paths_of(raw)) > 1 and component == "range_rate_mps" and in_map:
            component = None  # a relative velocity needs positions relative to the ego
        if component is not None and component not in new:
            new[component] = _used(raw, meaning)
        use = "not used" if component is None else f"read as {component}"
        texts.append(f"{', '.join(paths_of(raw))}: {meaning.reason}; {use}")
    is_tested = all(meaning.certainty != "assumed" for meaning in choices)
    settings = {path: departures(new)}
    return Decision(
        name,
        "velocity",
        settings,
        "tested" if is_tested else "assumed",
        "; ".join(texts),
    )


def _used(raw: FieldPath, meaning: VelocityMeaning) -> FieldPath:
    """Return the path, or both paths, of a velocity with the conversion to m/s."""
    paths = paths_of(raw)
    unknown = raw.unknown if isinstance(raw, Field) else ()
    path: str | list[str] = paths[0] if len(paths) == 1 else paths
    if meaning.scale == 1.0 and not unknown:
        return path
    return Field(path, meaning.scale, unknown=unknown)


def _meaning(
    sample: Sample, name: str, rest: Mapping[str, FieldPath], raw: FieldPath
) -> VelocityMeaning:
    """Return the meaning of the values at the paths of `raw`, which are read without a conversion."""
    paths = paths_of(raw)
    unknown = raw.unknown if isinstance(raw, Field) else ()
    order = by_name([words_of(one) for one in paths])
    unit = _unit(raw)
    columns: dict[str, FieldPath] = dict(rest)
    for component, one in zip(_VELOCITIES, paths, strict=False):
        columns[component] = Field(one, unknown=unknown)
    values = (lambda item: (item.speed_mps,)) if len(paths) == 1 else _pair
    sensor = sample.config.sensors.get(name)
    mount = None if sensor is None else sensor.mount
    scans = scans_of(
        sample.read(_alone(sample.config, name, columns)),
        name,
        values,
        mount,
        around_ego=True,
    )
    if scans is None:
        return VelocityMeaning(
            order[0], unit or "m/s", 1.0, "assumed", float("nan"), "by its name"
        )
    return meaning_of(motions(scans, straight_paths(scans)), order, unit)


def _pair(item: Detection) -> tuple[float | None, float | None]:
    return item.speed_mps, item.range_rate_mps


def _unit(raw: FieldPath) -> str | None:
    """Return the unit of speed whose conversion to m/s is the scale of the field.

    None for a field without a scale, and for a scale that belongs to no unit.
    """
    if not isinstance(raw, Field) or raw.scale == 1.0:
        return None
    return next(
        (unit for unit, scale in SPEED_UNITS.items() if abs(scale - raw.scale) < 1e-6),
        None,
    )


def _alone(config: Config, name: str, mapping: Mapping[str, FieldPath]) -> Config:
    """Return `config` with the ego and one sensor alone, with another mapping of its fields or columns."""
    inputs = config.input
    topics: dict[str, TopicInput] = {}
    tables: dict[str, CsvTable] = {}
    if name in inputs.detections:
        topics[name] = replace(inputs.detections[name], fields=mapping)
    else:
        tables[name] = replace(inputs.csv.detections[name], columns=mapping)
    csv = replace(inputs.csv, detections=tables, truth=None)
    alone = replace(inputs, detections=topics, csv=csv, truth=None)
    # The velocity is tested though another question about the sensor is open.
    return replace(config, input=alone, ignore_sensors=())
