"""`fgtrack info`, `advise` and `offsets`: contents and problems of a recording, clock offsets of its sensors."""

import shlex
from contextlib import suppress
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

from typer import Option

from fgtrack.advice.advise import advise as advised
from fgtrack.advice.page import rounded_ms
from fgtrack.cli.arguments import (
    ConfigFile,
    Input,
    Json,
    Overwrite,
    PitMap,
    Reference,
    Settings,
    TrackMap,
)
from fgtrack.cli.show import progress, say, sentences, show, warn
from fgtrack.clocks.offsets import OffsetReport, estimate_offsets
from fgtrack.clocks.stamps import clock_text
from fgtrack.config.reading import read_config
from fgtrack.config.settings import Config
from fgtrack.config.shipped import suited_reports
from fgtrack.config.yaml_file import plain
from fgtrack.core.errors import CallError, DataError, FgtrackError
from fgtrack.core.output import check_no_overlap, check_output, write_file
from fgtrack.core.time import nanoseconds
from fgtrack.evaluation.tables import NO_VALUE, Column, Table
from fgtrack.inputs.errors import UntilBreak
from fgtrack.inputs.info import InputInfo, describe
from fgtrack.inputs.settings import InputConfig
from fgtrack.inputs.source import input_kind
from fgtrack.meaning.assumption import Assumed
from fgtrack.meaning.draft import Draft, drafted, opened
from fgtrack.meaning.input_checks import (
    TRIAL_S,
    counted_lines,
    first_contents,
    input_checks,
    messages_within,
)
from fgtrack.pipeline.build import build_road
from fgtrack.pipeline.replay import Feed, with_origin

_DELAYS = ("mean_s", "p50_s", "p90_s", "max_s")


def info(
    recording: Input,
    config_file: ConfigFile = None,
    write: Annotated[
        Path | None,
        Option(metavar="MY.yaml", help="Write a guessed configuration to start from."),
    ] = None,
    overwrite: Overwrite = False,
    as_json: Json = False,
) -> None:
    """Show topics, rates and delays of a recording.

    With a configuration, also shows how topics or columns are used, the first message
    of each, and the detections of the first seconds. --write guesses such a
    configuration.
    """
    draft: Draft | None = None
    if write is not None:
        if config_file is not None:
            raise CallError(
                "--write, -c: --write guesses a configuration from the recording alone, give only one of the options"
            )
        check_output(write, overwrite)
        check_no_overlap(write, [recording])
        draft = drafted(recording)
        write_file(write, draft.to_yaml(_head(draft)), overwrite)
        if not as_json:
            say(f"{write}: written; check the guesses, which are applied below")
        config_file = str(write)
    config = None if config_file is None else read_config(config_file)
    read = _drafted_input(recording) if config is None else config.input
    result = describe(recording, read)
    topics = _topics(result, NO_VALUE if config is None else "ignored")
    effective = (config or Config()).effective
    problem = result.problem
    if as_json:
        values = {
            name: getattr(result, name)
            for name in ("kind", "start_ns", "duration_s", "problem")
        }
        show(
            topics,
            "json",
            {
                "path": str(result.path),
                **values,
                "topics": topics.plain(),
                "effective": plain(effective),
            },
        )
    else:
        show(topics, None)
        suited = (
            suited_reports(topic.name for topic in result.topics)
            if config is None
            else None
        )
        sentences(
            [suited or f"{config_file or 'without a configuration'}: {effective}"]
        )
        if config is None and suited is None:
            # Without a configuration, topics or columns may be unknown.
            with suppress(FgtrackError), progress("detections"):
                sentences(drafted(recording).lines())
        elif config is not None and problem is None:
            problem = _try_out(draft or drafted(recording, config))
    if problem is not None:
        raise DataError(problem)


def _try_out(draft: Draft) -> str | None:
    """Print decisions and the contents of the first seconds as they are read; return the recording's problem."""
    with progress("first seconds"):
        result = draft.config
        build_road(result.map, result.defects)  # raises if files are missing
        readable = UntilBreak(draft.source.messages())
        messages = list(messages_within(readable, nanoseconds(TRIAL_S)))
        feed = Feed(messages, result)
        received = list(feed)
    sentences(draft.lines())
    for name, text in first_contents(messages).items():
        say(f"first of {name}: {text}")
    for line in counted_lines(received, result):
        say(f"first {TRIAL_S:g} s of {line}")
    for item in input_checks(messages, result) if messages else ():
        warn(str(item))
    problem = feed.broken if readable.error is None else str(readable.error)
    return problem or draft.problem


def _head(draft: Draft) -> list[str]:
    """Return the first comment lines of a written configuration."""
    recording = draft.source.path
    return [
        f"Settings of {recording.name} (fgtrack info --write): names, values and tests decide what the numbers mean.",
        "Check units, frames and noise, then run",
        f"  fgtrack info {recording} -c THIS.yaml; fgtrack replay {recording} -c THIS.yaml -o RUN",
    ]


def _drafted_input(recording: Path) -> InputConfig | None:
    """Return the mapping of a recording without a configuration; None for a recording that needs none."""
    if input_kind(recording) != "csv":
        return None
    return opened(recording).config.input


def _topics(found: InputInfo, unused: str) -> Table:
    records = []
    for item in found.topics:
        record: dict[str, object] = {
            "topic": item.name,
            "messages": item.count,
            "rate_hz": item.rate_hz,
        }
        record |= {
            f"delay_{name}": None if item.delay is None else item.delay[name]
            for name in _DELAYS
        }
        record |= {f"late_{name}": share for name, share in item.late.items()}
        records.append(record | {"taken_as": item.used_as or unused, "type": item.type})
    columns = [
        Column("topic", left=True),
        Column("messages"),
        Column("rate\n[Hz]", "rate_hz"),
        Column(
            "delay [ms]\nmean/p50/p90/max",
            " ".join(f"delay_{name}" for name in _DELAYS),
            "{}/{}/{}/{}",
            1e3,
            text=rounded_ms,
        ),
        Column(
            "late [%]\nstream/object",
            "late_stream_share late_object_share",
            "{}/{}",
            1e2,
            text="{:.1f}".format,
        ),
        Column("taken as", "taken_as", left=True),
        Column("type", left=True),
    ]
    notes = [
        f"{topic.name}: {topic.note}"
        for topic in found.topics
        if topic.note is not None
    ]
    extent = "empty"
    if found.start_ns is not None:
        start = datetime.fromtimestamp(found.start_ns // 1_000_000_000, UTC)
        extent = f"{found.duration_s:.3f} s from {start:%Y-%m-%d %H:%M:%S} UTC ({found.start_ns} ns)"
    return Table(
        f"{found.path}: {found.kind}, {extent}", records, columns, ("topic",), notes
    )


def advise(
    recording: Input,
    config_file: ConfigFile = None,
    out: Annotated[
        Path | None,
        Option("-o", "--out", help="Write a configuration that follows the advice."),
    ] = None,
    tune: Annotated[
        bool, Option("--tune", help="Also fit the noise if it is inconsistent.")
    ] = False,
    ledger: Annotated[
        bool, Option("--ledger", help="Also compare policies for late lists.")
    ] = False,
    reference: Reference = None,
    track_map: TrackMap = None,
    pit_map: PitMap = None,
    settings: Settings = None,
    overwrite: Overwrite = False,
    as_json: Json = False,
) -> None:
    """Report what is late or wrong, and which settings correct it.

    Prints sentences in the order of importance, and the lateness of each sensor.
    """
    config = read_config(config_file, settings, track_map=track_map, pit_map=pit_map)
    if out is not None:
        check_output(out, overwrite)
        check_no_overlap(out, [recording, config_file])
    with progress("advise") as tell:
        advice = advised(
            recording,
            config,
            reference=reference,
            tune=tune,
            ledger=ledger,
            on_step=tell,
        )
    if out is not None:
        head = [
            f"Settings for {recording} (fgtrack advise).",
            "",
            *advice.comments(),
            "",
        ]
        write_file(out, Assumed(advice.config, ()).to_yaml(head), overwrite)
    show(advice.tables, "json" if as_json else None, advice.as_dict())
    if out is not None and not as_json:
        again = ["fgtrack", "replay", str(recording), "-c", str(out), "-o", "RUN"]
        say(f"{out}: written; apply the settings by `{shlex.join(again)}`")
    if advice.broken is not None:
        problem = with_origin(advice.broken, str(recording))
        raise DataError(f"{problem}; the messages before are used")


def offsets(
    recording: Input,
    config_file: ConfigFile = None,
    reference: Reference = None,
    track_map: TrackMap = None,
    pit_map: PitMap = None,
    settings: Settings = None,
    as_json: Json = False,
) -> None:
    """Estimate constant clock offsets of sensors.

    Reports sensors whose offset is not identifiable.
    """
    config = read_config(config_file, settings, track_map=track_map, pit_map=pit_map)
    with progress("offsets"):
        draft = drafted(recording, config)
        readable = UntilBreak(draft.source.messages())
        report = estimate_offsets(list(readable), draft.config, reference)
    for line in draft.lines() if not as_json else ():
        say(line)
    verdicts = {item.sensor: clock_text(item, report) for item in report.others}
    show(
        _offsets(report),
        "json" if as_json else None,
        asdict(report) | {"verdicts": verdicts},
    )
    if not as_json:
        sentences(f"{name}: {text}" for name, text in verdicts.items())
    if readable.error is not None:
        problem = with_origin(str(readable.error), str(recording))
        raise DataError(f"{problem}; the messages before are used")


def _offsets(report: OffsetReport) -> Table:
    records = [
        {
            "sensor": one.sensor,
            "offset_s": one.offset_s,
            "std_s": one.std_s,
            "num_detections": one.num_detections,
        }
        | {
            "known": "reference"
            if one.sensor == report.reference
            else "yes"
            if one.is_known
            else "no"
        }
        for one in report.sensors
    ]
    columns = [
        Column("sensor", left=True),
        Column("offset\n[ms]", "offset_s", scale=1e3, text="{:.1f}".format),
        Column("std\n[ms]", "std_s", scale=1e3, text="{:.1f}".format),
        Column("detections", "num_detections"),
        Column("known", left=True),
    ]
    notes = [f"{one.sensor}: {one.why}" for one in report.sensors]
    return Table(
        "Clock offsets (reported stamp - true time)",
        records,
        columns,
        ("sensor",),
        notes,
    )
