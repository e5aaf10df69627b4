"""A starting configuration for a recording that nobody has configured: what its parts probably are, and why."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap

from fgtrack.calibration.parts import Part, table_parts, topic_parts
from fgtrack.calibration.trial import beginning, suspicions
from fgtrack.core.errors import CallError, FgtrackError, printable
from fgtrack.io.adapters.native import NATIVE_ADAPTERS
from fgtrack.io.config import CsvInput, CsvTable, Field, InputConfig, TopicInput
from fgtrack.io.info import InputInfo, describe
from fgtrack.io.output import new_file
from fgtrack.io.ros.bag import Bag
from fgtrack.io.source import input_kind, open_input
from fgtrack.pipeline.assumptions.assumed import Assumed, assumed
from fgtrack.pipeline.config import Config
from fgtrack.pipeline.load import plain, validate

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
        with_sensors, checks = Assumed(Config(), ()), [str(error)] if taken else []
    lines = [
        f"# Starting configuration for {recording.name} {_MARK}",
        "# Guesses from names and values: check units, frames and noise, then",
        f"#   fgtrack info {recording} -c THIS.yaml; fgtrack replay {recording} -c THIS.yaml -o RUN",
        *(f"# {line}" for line in _contents(found)),
        *(
            f"# Check: {line}"
            for line in [*map(str, found.cautions), *checks, *([found.problem] if found.problem else [])]
        ),
        *(f"# Not taken: {line}" for line in [*left, *refused]),
    ]
    head = "".join(f"{printable(line)}\n" for line in lines)
    rest = Assumed(replace(with_sensors.config, input=InputConfig()), with_sensors.assumptions).to_yaml()
    text = head + (_dumped(_document(taken)) if taken else "") + rest
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
            refused.append(f"{what}: there is another one, {_dumped(_document([part]), flow=True)}")
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


def _document(parts: Sequence[Part]) -> CommentedMap:
    """The section `input` with a comment for each guess."""
    document, csv = CommentedMap(), CommentedMap()
    for part in sorted(parts, key=lambda one: ("ego", "truth").index(one.role) if one.role in ("ego", "truth") else 2):
        place = csv if isinstance(part.item, CsvTable) else document
        if part.role not in ("ego", "truth"):
            place = place.setdefault("detections", CommentedMap())
        place[part.role] = _item(part)
    if csv:
        document["csv"] = csv
    return CommentedMap(input=document)


def _item(part: Part) -> CommentedMap:
    """A topic or table, of which only what is set is written."""
    default = plain(TopicInput("") if isinstance(part.item, TopicInput) else CsvTable({}))
    item = CommentedMap((key, value) for key, value in plain(part.item).items() if value != default.get(key))
    if isinstance(part.item, CsvTable):
        item["time_unit"] = part.item.time_unit
    for key in ("fields", "columns"):
        if key in item:
            item[key] = inner = CommentedMap((name, _field(path)) for name, path in item[key].items())
            for name in inner:
                if reason := part.reasons.get(name):
                    inner.yaml_add_eol_comment(printable(reason), name)
    for name in item.keys() & part.reasons.keys():
        item.yaml_add_eol_comment(printable(part.reasons[name]), name)
    lines = [*part.notes, *([f"not used: {', '.join(part.unused)}"] if part.unused else [])]
    if lines:
        indent = 4 + 2 * isinstance(part.item, CsvTable) + 2 * (part.role not in ("ego", "truth"))
        item.yaml_set_comment_before_after_key(next(iter(item)), before=printable("; ".join(lines)), indent=indent)
    return item


def _field(path: Any) -> Any:  # Any: plain values
    """A path with what converts it, on one line."""
    if not isinstance(path, dict):
        return path
    default = plain(Field(""))
    found = CommentedMap((key, value) for key, value in path.items() if key == "path" or value != default[key])
    found.fa.set_flow_style()
    return found


def _dumped(document: CommentedMap, flow: bool = False) -> str:
    yaml, text = YAML(), StringIO()
    yaml.width = 4096
    if flow:
        yaml = YAML(typ="safe", pure=True)
        yaml.width, yaml.default_flow_style = 4096, True
    yaml.dump(plain(document) if flow else document, text)
    return text.getvalue().strip() if flow else text.getvalue()
