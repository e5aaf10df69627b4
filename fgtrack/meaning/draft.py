"""Draft of the settings of a recording: what its numbers mean, how sure that is, and what remains to be asked."""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from fgtrack.config.recorded import recorded
from fgtrack.config.settings import Config
from fgtrack.config.yaml_file import plain, validate, with_value
from fgtrack.core.checks import check_paths
from fgtrack.core.errors import CallError, DataError, FgtrackError
from fgtrack.core.types import EgoState, Message
from fgtrack.inputs.formats.native import NATIVE_ADAPTERS
from fgtrack.inputs.formats.tables import headers
from fgtrack.inputs.settings import CsvInput, CsvTable, InputConfig, TopicInput
from fgtrack.inputs.source import InputSource, input_kind, open_input
from fgtrack.meaning.assumed import assumed, unmodelled_sensors
from fgtrack.meaning.assumption import Assumed, departures
from fgtrack.meaning.decision import Certainty, Decision
from fgtrack.meaning.ego_choice import with_consistent_ego
from fgtrack.meaning.evidence import decided
from fgtrack.meaning.guess import words_of
from fgtrack.meaning.parts import EGO_WORDS, InputPart
from fgtrack.meaning.reports import report_part
from fgtrack.meaning.tables import table_part

__all__ = ["Draft", "drafted", "opened", "opened_together"]

ROLE = "role"
"""Property of a decision on the role of a topic or table."""
#: Order of decisions for a reader.
_CERTAINTIES = ("open", "tested", "assumed")


@dataclass(frozen=True)
class Draft:
    """A recording with all settings of a replay, and the decisions behind those that the user has not given."""

    source: InputSource
    """The recording, read with the settings."""
    assumed: Assumed
    """Settings of the user and of the decisions, with assumptions about noise, coverage and clutter."""
    decisions: tuple[Decision, ...] = ()
    """Decisions from names and from tests, in the order in which they were made."""
    parts: tuple[InputPart, ...] = ()
    """Topics or tables whose mapping is drafted."""
    unused: tuple[str, ...] = ()
    """A line for each topic, table, field or column that is not used."""

    @property
    def open_sensors(self) -> tuple[str, ...]:
        """Sensors with an open question, which the runs leave out."""
        names = {
            item.about
            for item in self.decisions
            if item.leaves_out and item.about not in ("ego", "the recording")
        }
        return tuple(sorted(names))

    @property
    def provisional_sensors(self) -> tuple[str, ...]:
        """Sensors that the runs use with an assumed lever arm, although its question is open."""
        names = {item.about for item in self.decisions if item.is_provisional}
        return tuple(sorted(names))

    @property
    def config(self) -> Config:
        """Complete configuration of a replay; sensors with an open question are ignored."""
        config = self.assumed.config
        ignored = dict.fromkeys([*config.ignore_sensors, *self.open_sensors])
        return replace(config, ignore_sensors=tuple(ignored))

    @property
    def questions(self) -> tuple[str, ...]:
        """Questions that the recording does not answer, a line each with the key to set."""
        return tuple(
            f"{item.about}: {item.question}"
            for item in self.decisions
            if item.question is not None
        )

    @property
    def problem(self) -> str | None:
        """Line on the open questions, and on the sensors that they concern; None without open questions."""
        asked = [item for item in self.decisions if item.certainty == "open"]
        if not asked:
            return None
        names = ", ".join(self.open_sensors)
        left_out = f"{names} left out of the runs; " if names else ""
        if provisional := ", ".join(self.provisional_sensors):
            left_out += f"{provisional} used with an assumed mount; "
        questions = "; ".join(f"{item.about}: {item.question}" for item in asked)
        return f"{left_out}open: {questions}"

    def lines(self) -> list[str]:
        """Return the result in lines: open questions, tested decisions, assumptions, unused parts."""
        others = [
            item
            for item in self.decisions
            if item.what != ROLE or item.certainty != "assumed"
        ]
        ranked = sorted(others, key=lambda item: _CERTAINTIES.index(item.certainty))
        roles = [f"{part.label} as {part.role}" for part in self.parts]
        lines = [
            item.line if item.question is None else f"{item.line}. {item.question}"
            for item in ranked
        ]
        if roles:
            lines.append(f"read, by names, types and values: {', '.join(roles)}")
        return [
            *lines,
            *self.assumed.lines(),
            *(f"not used: {line}" for line in self.unused),
        ]

    def with_assumed(self, assumed: Assumed) -> "Draft":
        """Return the draft with other settings and assumptions. It does not ignore sensors with an open question."""
        ignored = [
            name
            for name in assumed.config.ignore_sensors
            if name not in self.open_sensors
        ]
        config = replace(assumed.config, ignore_sensors=tuple(ignored))
        return replace(self, assumed=replace(assumed, config=config))

    def asking(self, config: Config) -> Config:
        """Return `config` such that a later draft asks the open questions again.

        No sensor with an open question is ignored, and a sensor with an assumed lever arm
        has its mapping alone.
        """
        kept = self.with_assumed(Assumed(config)).assumed.config
        sensors = {
            name: item
            for name, item in kept.sensors.items()
            if name not in self.provisional_sensors
        }
        return replace(kept, sensors=sensors)

    def to_yaml(self, head: Iterable[str] = ()) -> str:
        """Return YAML text of all settings that differ from the defaults; each decision has its reason as a comment.

        Only the mapping of a sensor with an open question, or with an assumed lever arm,
        is written. The sensor is not ignored, so the question is asked until it is answered.
        """
        comments = [item for part in self.parts for item in part.comments()]
        comments += [
            (path, f"{item.certainty}: {item.reason}")
            for item in self.decisions
            for path in item.settings
            if item.what != ROLE
        ]
        asked = [f"Open: {line}" for line in self.questions]
        unused = [f"Not used: {line}" for line in self.unused]
        notes = [f"{part.label}: {note}" for part in self.parts for note in part.notes]
        written = replace(self.assumed, config=self.asking(self.assumed.config))
        return written.to_yaml([*head, *asked, *unused, *notes], comments)


def drafted(recording: Path | str, config: Config | None = None) -> Draft:
    """Return all settings of a recording: given ones stay, tests decide the others, and the rest is assumed.

    The steps are those of `opened`, and assumptions about noise, coverage and clutter
    from the detections. Raises the exceptions of `opened`.
    """
    draft = opened(recording, config)
    return draft.with_assumed(assumed(draft.config, draft.source))


def opened(recording: Path | str, config: Config | None = None) -> Draft:
    """Open a recording with the settings that decide what its numbers mean, without assumptions about its sensors.

    Roles of topics or tables, and their fields or columns, come from names and values.
    Then tests decide (`fgtrack.meaning.evidence`). A recording whose sensors have a
    mapping and noise is opened as given.

    Raises the exceptions of `open_input`.
    """
    check_paths(recording=recording)
    path = Path(recording)
    given = config or Config()
    kind = input_kind(path)
    parts: list[InputPart] = []
    unused: tuple[str, ...] = ()
    mapped = given
    if _is_unmapped(given.input) and kind in ("csv", "recording"):
        parts, unused = _mapped(path, kind)
        mapped = _overlaid(replace(given, input=_with_parts(given.input, parts)), given)
        if not parts and unused:
            source = _unreadable(path, kind, unused)
            return Draft(source, Assumed(given), unused=unused)
    decisions = [_role(part) for part in parts]
    source = open_input(path, mapped.input)
    settled: set[str] = set()
    if not parts:
        settled = {name for name, item in given.sensors.items() if item.std}
    if parts or not settled or unmodelled_sensors(given, _named(given.input)):
        mapped, tested = decided(path, _with_mounts(given, source), mapped, settled)
        decisions += tested
        source = open_input(path, mapped.input)
    draft = Draft(
        source, Assumed(mapped), tuple(decisions), tuple(parts), tuple(unused)
    )
    return draft.with_assumed(draft.assumed)


def opened_together(
    recordings: Iterable[Path | str], config: Config
) -> tuple[dict[str, InputSource], Config, tuple[str, ...]]:
    """Open several recordings of one vehicle by name; the first one decides the settings for all.

    Returns the sources by path, the settings, and a line for each recording with open
    questions. Raises the exceptions of `open_input`.
    """
    sources: dict[str, InputSource] = {}
    problems: list[str] = []
    for path in recordings:
        draft = opened(path, config)
        config = draft.config if not sources else config
        sources[str(path)] = draft.source
        if draft.problem is not None:
            problems.append(f"{path}: {draft.problem}")
    return sources, config, tuple(problems)


def _is_unmapped(config: InputConfig) -> bool:
    """True if `config` names neither a topic nor the columns of a table."""
    topics = [config.ego, *config.detections.values()]
    topics += config.truth if isinstance(config.truth, tuple) else [config.truth]
    tables = [config.csv.ego, config.csv.truth, *config.csv.detections.values()]
    return not any(one and one.topic for one in topics) and not any(
        one and one.columns for one in tables
    )


def _with_mounts(given: Config, source: InputSource) -> Config:
    """Return `given` with the mounts that the recording carries, which need no test."""
    raw = plain(given)
    for name, sensor in recorded(source).sensors.items():
        if sensor.mount is not None:
            path = ("sensors", name, "mount")
            raw = with_value(raw, path, plain(sensor.mount))
    return validate(Config, raw, "recorded")


def _overlaid(config: Config, given: Config) -> Config:
    """Return `config` with the keys of topics and tables that `given` contains.

    Raises `CallError` for a topic or table that the draft does not contain.
    """
    raw = plain(config)
    for path in _leaves(departures(given.input), ("input",)):
        known: object = raw
        for name in path[:-1]:
            known = known.get(name) if isinstance(known, Mapping) else None
        if known is None:
            raise CallError(
                f"{'.'.join(path)}: the draft of the recording has no such topic or table; "
                "its names are shown by `fgtrack info RECORDING --write`"
            )
        value: object = plain(given)
        for name in path:
            value = value[name]  # type: ignore[index]  # a path of nested mappings
        raw = with_value(raw, path, value)
    return validate(Config, raw, "drafted")


def _leaves(values: object, path: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    """Yield the path of each setting inside the topics and tables of nested mappings."""
    if not isinstance(values, Mapping):
        yield path
        return
    for name, value in values.items():
        is_role = path[-1] in ("ego", "truth", "detections", "csv", "input")
        if is_role or path[-2:-1] == ("detections",):
            yield from _leaves(value, (*path, name))
        else:
            yield (*path, name)


def _named(config: InputConfig) -> set[str]:
    return {*config.detections, *config.csv.detections}


def _role(part: InputPart) -> Decision:
    """Return the decision on the role of a part."""
    reason = f"{part.label} is read as {part.role}, by its name, type and values"
    settings = {part.path: departures(part.item)}
    certainty: Certainty = "tested" if part.role_reason else "assumed"
    return Decision(part.role, ROLE, settings, certainty, part.role_reason or reason)


def _unreadable(path: Path, kind: str, unused: Sequence[str]) -> InputSource:
    """Return a source whose messages raise `DataError`, because no part of the recording is recognised."""

    def messages() -> Iterator[Message]:
        raise DataError(
            f"{path}: no part is recognised as ego or detections ({'; '.join(unused)}): "
            "name them in the configuration (`input`)"
        )
        yield  # makes it an iterator

    return InputSource(path, kind, messages)


def _mapped(path: Path, kind: str) -> tuple[list[InputPart], tuple[str, ...]]:
    """Return the parts of the recording that can be read, one for each role, and a line for each other part."""
    if kind == "csv" and (part := report_part(path)) is not None:
        return [part], ()
    parts, unused = _parts(path, kind)
    parts = with_consistent_ego(parts, partial(_ego_states, path))
    taken = _readable(path, parts, unused)
    return taken, tuple(unused)


def _parts(recording: Path, kind: str) -> tuple[list[InputPart], list[str]]:
    """Return the guesses for the parts of the recording, and a line for each other part.

    The most probable ego comes first.
    """
    parts: list[InputPart] = []
    refused: list[str] = []
    makers: dict[str, Callable[[], InputPart]] = {}
    if kind == "csv":
        is_folder = recording.is_dir()
        for file, columns in headers(recording).items():
            makers[file.name] = partial(table_part, file, columns, is_folder, parts)
    else:
        # Readers of bags are imported for bags alone.
        from fgtrack.inputs.info import describe
        from fgtrack.inputs.ros.bag import Bag
        from fgtrack.meaning.topics import topic_part

        result = describe(recording)
        refused += [] if result.problem is None else [result.problem]
        if not any(topic.type in NATIVE_ADAPTERS for topic in result.topics):
            bag = Bag(recording)
            makers = {
                f"{topic.name} ({topic.type})": partial(topic_part, bag, topic, parts)
                for topic in result.topics
            }
    for label, make in makers.items():
        try:
            parts.append(make())
        except DataError as error:
            refused.append(f"{label}: {error}")
    return sorted(
        parts,
        key=lambda part: (
            part.role != "ego",
            part.rank,
            not set(words_of(part.label)) & EGO_WORDS,
        ),
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
            alone = _with_parts(InputConfig(), [part])
            next(iter(open_input(recording, alone).messages()), None)
            taken.append(part)
        except FgtrackError as error:
            refused.append(f"{guess}: {error}")
    return taken


def _ego_states(path: Path, part: InputPart) -> Iterator[EgoState]:
    """Yield the states of the ego in `part`, until the recording breaks off."""
    with suppress(FgtrackError):
        source = open_input(path, _with_parts(InputConfig(), [part]))
        for message in source.messages():
            if isinstance(message, EgoState):
                yield message


def _with_parts(config: InputConfig, parts: Sequence[InputPart]) -> InputConfig:
    """Return `config` with the mapping of the parts."""
    tables = {part.role: part.item for part in parts if isinstance(part.item, CsvTable)}
    topics = {
        part.role: part.item for part in parts if isinstance(part.item, TopicInput)
    }
    csv_ego = tables.pop("ego", None)
    csv_truth = tables.pop("truth", None)
    return replace(
        config,
        ego=topics.pop("ego", None),
        truth=topics.pop("truth", None),
        detections=topics,
        csv=CsvInput(csv_ego, tables, csv_truth),
    )
