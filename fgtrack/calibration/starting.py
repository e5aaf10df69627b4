"""A starting configuration for a recording that nobody has configured: what its parts probably are, and why."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import fields
from pathlib import Path

from ruamel.yaml import YAML

from fgtrack.calibration.parts import Part, table_parts, topic_parts
from fgtrack.calibration.trial import beginning, suspicions
from fgtrack.core.errors import CallError, FgtrackError
from fgtrack.io.adapters.native import NATIVE_ADAPTERS
from fgtrack.io.config import CsvInput, CsvTable, InputConfig, TopicInput
from fgtrack.io.info import InputInfo, describe
from fgtrack.io.output import new_file
from fgtrack.io.ros.bag import Bag
from fgtrack.io.source import input_kind, open_input
from fgtrack.pipeline.assumptions.assumed import Assumed, assumed, departures
from fgtrack.pipeline.config import Config
from fgtrack.pipeline.load import validate

__all__ = ["starting_config", "write_starting"]

_MARK = "(fgtrack info --write)"
_TRIAL_NS = 5_000_000_000


def write_starting(out: Path, recording: Path, overwrite: bool) -> None:
    """Write the starting configuration for `recording`; raises as `starting_config` and `new_file`."""
    text = starting_config(recording)
    with new_file(out, overwrite) as file:
        file.write(text.encode())


def starting_config(recording: Path) -> str:
    """YAML text of a configuration for `recording`: what can be taken as settings, all else as comments.

    Raises
    ------
    CallError
        Nothing is there.
    DataError
        It is not an input, or damaged from the start.
    """
    found, parts, left = _parts(recording)
    taken, refused = _readable(recording, parts)
    config = Config(input=_input(taken))
    try:
        source = open_input(recording, config.input)
        with_sensors = assumed(config, source)
        checks = [str(one) for one in suspicions(list(beginning(source.messages(), _TRIAL_NS)), with_sensors.config)]
    except FgtrackError as error:  # of a recording in which nothing can be taken
        with_sensors, checks = Assumed(config, ()), [str(error)] if taken else []
    head = [
        f"Starting configuration for {recording.name} {_MARK}",
        "Guesses from names and values: check units, frames and noise, then",
        f"  fgtrack info {recording} -c THIS.yaml; fgtrack replay {recording} -c THIS.yaml -o RUN",
        *_contents(found),
        *(f"Check: {line}" for line in [*map(str, found.cautions), *checks, *filter(None, [found.problem])]),
        *(f"Not taken: {line}" for line in [*left, *refused]),
        *(f"{part.label}: {note}" for part in taken for note in part.notes),
    ]
    text = with_sensors.to_yaml(head, [one for part in taken for one in _comments(part)])
    validate(Config, YAML(typ="safe", pure=True).load(text) or {}, "the starting configuration")
    return text


def _contents(found: InputInfo) -> Iterator[str]:
    yield f"{found.kind}, {found.duration_s:.1f} s:"
    for topic in found.topics:
        rate = "" if topic.rate_hz is None else f", {topic.rate_hz:.3g} Hz"
        delay = "" if topic.delay is None else f", median delay {topic.delay.p50_s:.3g} s"
        yield f"  {topic.name} ({topic.type}): {topic.count} messages{rate}{delay}"


def _parts(recording: Path) -> tuple[InputInfo, list[Part], list[str]]:
    """What is in the recording, its parts with a guess, and what nothing is guessed of."""
    try:
        found = describe(recording)
    except CallError:
        if not recording.exists() or input_kind(recording) != "csv":
            raise
        parts, left = table_parts(recording)
        taken, _ = _readable(recording, parts)
        found = describe(recording, _input(taken)) if taken else InputInfo(recording, "csv", None, 0.0, (), None)
        return found, parts, left
    if found.kind != "recording" or any(topic.type in NATIVE_ADAPTERS for topic in found.topics):
        return found, [], []
    parts, left = topic_parts(Bag(recording), found.topics)
    return found, parts, left


def _readable(recording: Path, parts: Sequence[Part]) -> tuple[list[Part], list[str]]:
    """The parts of which a first message can be read, each role once, and why not the others."""
    taken: list[Part] = []
    refused: list[str] = []
    for part in parts:
        what = f"{part.label} as {part.role}"
        if any(part.role == other.role for other in taken):
            refused.append(f"{what}: there is another one, {json.dumps(departures(part.item))}")
            continue
        try:
            next(iter(open_input(recording, _input([part])).messages()), None)
            taken.append(part)
        except FgtrackError as error:
            refused.append(f"{what}: {error}")
    return taken, refused


def _input(parts: Sequence[Part]) -> InputConfig:
    tables = {part.role: part.item for part in parts if isinstance(part.item, CsvTable)}
    topics = {part.role: part.item for part in parts if isinstance(part.item, TopicInput)}
    ego, truth = tables.pop("ego", None), tables.pop("truth", None)
    return InputConfig(
        ego=topics.pop("ego", None),
        truth=topics.pop("truth", None),
        detections=topics,
        csv=CsvInput(ego, tables, truth),
    )


def _comments(part: Part) -> Iterator[tuple[Sequence[str], str]]:
    """Yield paths of keys, and the reasons of their guesses."""
    is_table = isinstance(part.item, CsvTable)
    of = [*(["csv"] if is_table else []), *(["detections"] if part.role not in ("ego", "truth") else []), part.role]
    own = {one.name for one in fields(part.item)}
    for name, reason in part.reasons.items():
        yield ["input", *of, *([] if name in own else ["columns" if is_table else "fields"]), name], reason
