"""`fgtrack info`: what is in a recording."""

from collections.abc import Set
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from fgtrack.calibration.starting import write_starting
from fgtrack.calibration.trial import Trial, try_out
from fgtrack.cli.arguments import ConfigFile, FormOption, Input, Json, Overwrite
from fgtrack.cli.show import chosen_form, progress, say, sentences, show, warn
from fgtrack.core.errors import CallError, DataError, FgtrackError
from fgtrack.evaluation.diagnostics import excluded_lines
from fgtrack.evaluation.tables import NO_VALUE, Column, Table, Value
from fgtrack.io.info import OTHER_CLOCK_S, InputInfo, describe
from fgtrack.io.output import check_apart, check_output
from fgtrack.io.source import open_input
from fgtrack.pipeline.assumptions.assumed import assumed
from fgtrack.pipeline.config import Config
from fgtrack.pipeline.shipped import read_config

_DELAYS = ("delay_mean_s", "delay_p50_s", "delay_p90_s", "delay_max_s")


def info(
    recording: Input,
    config_file: ConfigFile = None,
    write: Annotated[
        Path | None,
        typer.Option("--write", metavar="MY.yaml", help="Write a commented starting configuration for the recording."),
    ] = None,
    overwrite: Overwrite = False,
    as_json: Json = False,
    form: FormOption = None,
) -> None:
    """Show topics, rates and delays of a recording.

    With a configuration (or with the one of --write, which guesses what topics, fields and columns are) also what it
    would take from them, what a message of each is read as, and what a replay of the first seconds makes of them.
    """
    form = chosen_form(as_json, form)
    if write is not None:
        if config_file is not None:
            raise CallError("--write, -c: a starting configuration is made from the recording alone, give one of them")
        check_output(write, overwrite)
        check_apart(write, [recording])
        write_starting(write, recording, overwrite)
        if form is None:
            say(f"{write}: written; check its guesses, they are applied below")
        config_file = str(write)
    config = None if config_file is None else read_config(config_file)
    found = describe(recording, None if config is None else config.input)
    topics = _table(found, NO_VALUE if config is None else "ignored")
    comes_to = (config or Config()).effective
    show(topics, form, {**_values(found, topics), "effective": comes_to.values()})
    if form is None:
        sentences([f"{config_file or 'without a configuration'}: {comes_to}"])
    for one in found.cautions:
        warn(str(one))
    trial = None
    if config is not None and found.problem is None and form is None:
        trial = _try_out(recording, config, {(one.about, one.text.split()[0]) for one in found.cautions})
    elif form is None:
        with suppress(FgtrackError), progress("detections"):  # whose topics and columns nothing names
            sentences(assumed(Config(), open_input(recording)).lines())
    problem = found.problem if trial is None else trial.problem
    if problem is not None:
        raise DataError(problem)


def _try_out(recording: Path, config: Config, warned: Set[tuple[str, str]]) -> Trial:
    with progress("first seconds"):
        source = open_input(recording, config.input)
        open_settings = assumed(config, source)
        trial = try_out(source.messages(), open_settings.config)
    sentences(open_settings.lines())
    for name, text in trial.samples.items():
        say(f"first of {name}: {text}")
    if trial.run is not None:
        for sensor, counts in trial.run.meta["counts"].items():
            became = ", ".join(f"{count} {fate.replace('_', ' ')}" for fate, count in counts.items() if count)
            say(f"first {trial.duration_s:g} s of {sensor}: {became or 'no detection'}")
        for line in excluded_lines(trial.run.meta):
            say(f"first {trial.duration_s:g} s of {line}")
        say(f"first {trial.duration_s:g} s: {len(set(trial.run.tables['tracks']['track_id'].tolist()))} tracks")
    for found in trial.suspicions:
        if (found.about, found.text.split()[0]) not in warned:
            warn(str(found))
    return trial


def _values(found: InputInfo, topics: Table) -> dict[str, object]:
    """JSON values."""
    about = {"path": str(found.path), "kind": found.kind, "start_ns": found.start_ns, "duration_s": found.duration_s}
    return {**about, "problem": found.problem, "cautions": list(map(str, found.cautions)), "topics": topics.plain()}


def _heading(found: InputInfo) -> str:
    text = f"{found.path}: {found.kind}"
    if found.start_ns is None:
        return f"{text}, empty"
    start = datetime.fromtimestamp(found.start_ns // 1_000_000_000, UTC)
    return f"{text}, {found.duration_s:.3f} s from {start:%Y-%m-%d %H:%M:%S} UTC ({found.start_ns} ns)"


def _table(found: InputInfo, unused: str) -> Table:
    records = []
    for one in found.topics:
        record: dict[str, object] = {"topic": one.name, "messages": one.count, "rate_hz": one.rate_hz}
        delay = one.delay
        delays = (None,) * 4 if delay is None else (delay.mean_s, delay.p50_s, delay.p90_s, delay.max_s)
        record |= zip(_DELAYS, delays, strict=True)
        records.append(record | {"taken_as": one.used_as or unused, "type": one.type})
    columns = [
        Column("topic", left=True),
        Column("messages"),
        Column("rate\n[Hz]", "rate_hz"),
        Column("delay [ms]\nmean/p50/p90/max", " ".join(_DELAYS), "{}/{}/{}/{}", 1e3, text=_whole),
        Column("taken as", "taken_as", left=True),
        Column("type", left=True),
    ]
    notes = [
        f"{topic.name}: {topic.note}" for topic in found.topics if topic.note is not None and topic.used_as is None
    ]
    return Table(_heading(found), records, columns, ("topic",), notes)


def _whole(value: Value) -> str:
    """Whole milliseconds; of a recorder with another clock than the sensor nothing."""
    return f"{value:.0f}" if abs(float(value)) < 1e3 * OTHER_CLOCK_S else NO_VALUE
