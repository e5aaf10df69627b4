"""`fgtrack info`: what is in a recording."""

from datetime import UTC, datetime
from pathlib import Path

from rich.table import Table

from fgtrack.cli.arguments import ConfigFile, Input
from fgtrack.cli.show import console, progress, say, table, warn
from fgtrack.core.errors import DataError
from fgtrack.io.info import DelayInfo, InputInfo, describe
from fgtrack.io.source import open_input
from fgtrack.pipeline.config import Config
from fgtrack.pipeline.shipped import read_config
from fgtrack.pipeline.trial import Trial, try_out

_OTHER_CLOCK_S = 3600.0  # nothing is that late: the stamps and the recorder have different clocks


def info(recording: Input, config_file: ConfigFile = None) -> None:
    """Show topics, rates and delays of a recording.

    With a configuration also what it would take from them, what a message of each is read as, and what a replay of the
    first seconds makes of them.
    """
    config = None if config_file is None else read_config(config_file)
    found = describe(recording, None if config is None else config.input)
    say(_heading(found))
    console().print(_table(found, "–" if config is None else "ignored"))
    for topic in found.topics:
        if topic.note is not None and topic.used_as is None:
            say(f"{topic.name}: {topic.note}")
    trial = None
    if config is not None and found.problem is None:
        trial = _try_out(recording, config)
    problem = found.problem if trial is None else trial.problem
    if problem is not None:
        raise DataError(problem)


def _try_out(recording: Path, config: Config) -> Trial:
    with progress("first seconds"):
        trial = try_out(open_input(recording, config.input).messages(), config)
    for name, text in trial.samples.items():
        say(f"first of {name}: {text}")
    if trial.run is not None:
        for sensor, counts in trial.run.meta["counts"].items():
            became = ", ".join(f"{count} {fate.replace('_', ' ')}" for fate, count in counts.items() if count)
            say(f"first {trial.duration_s:g} s of {sensor}: {became or 'no detection'}")
        say(f"first {trial.duration_s:g} s: {len(set(trial.run.tracks['track_id'].tolist()))} tracks")
    for line in trial.suspicions:
        warn(line)
    return trial


def _heading(found: InputInfo) -> str:
    text = f"{found.path}: {found.kind}"
    if found.start_ns is None:
        return f"{text}, empty"
    start = datetime.fromtimestamp(found.start_ns // 1_000_000_000, UTC)
    return f"{text}, {found.duration_s:.3f} s from {start:%Y-%m-%d %H:%M:%S} UTC ({found.start_ns} ns)"


def _table(found: InputInfo, unused: str) -> Table:
    rows = table("topic", "type", "taken as", ">messages", ">rate [Hz]", ">delay [ms] mean/p50/p90/max")
    for topic in found.topics:
        rate = "–" if topic.rate_hz is None else f"{topic.rate_hz:.1f}"
        rows.add_row(topic.name, topic.type, topic.used_as or unused, str(topic.count), rate, _delay(topic.delay))
    return rows


def _delay(delay: DelayInfo | None) -> str:
    if delay is None:
        return "–"
    if abs(delay.p50_s) > _OTHER_CLOCK_S:
        return "other clock"
    return "/".join(f"{1e3 * value:.0f}" for value in (delay.mean_s, delay.p50_s, delay.p90_s, delay.max_s))
