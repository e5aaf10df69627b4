"""`fgtrack info`: what is in a recording."""

from datetime import UTC, datetime

from rich.table import Table

from fgtrack.cli.arguments import ConfigFile, Input
from fgtrack.cli.show import console, say, table
from fgtrack.core.errors import DataError
from fgtrack.io.info import DelayInfo, InputInfo, describe
from fgtrack.pipeline.shipped import read_config

_OTHER_CLOCK_S = 3600.0  # nothing is that late: the stamps and the recorder have different clocks


def info(recording: Input, config_file: ConfigFile = None) -> None:
    """Show topics, rates and delays of a recording.

    With a configuration also what it would take from them.
    """
    config = None if config_file is None else read_config(config_file).input
    found = describe(recording, config)
    say(_heading(found))
    console().print(_table(found))
    for topic in found.topics:
        if topic.note is not None:
            say(f"{topic.name}: {topic.note}")
    if found.problem is not None:
        raise DataError(found.problem)


def _heading(found: InputInfo) -> str:
    text = f"{found.path}: {found.kind}"
    if found.start_ns is None:
        return f"{text}, empty"
    start = datetime.fromtimestamp(found.start_ns // 1_000_000_000, UTC)
    return f"{text}, {found.duration_s:.3f} s from {start:%Y-%m-%d %H:%M:%S} UTC ({found.start_ns} ns)"


def _table(found: InputInfo) -> Table:
    rows = table("topic", "type", "taken as", ">messages", ">rate [Hz]", ">delay [ms] mean/p50/p90/max")
    for topic in found.topics:
        rate = "–" if topic.rate_hz is None else f"{topic.rate_hz:.1f}"
        rows.add_row(topic.name, topic.type, topic.used_as or "–", str(topic.count), rate, _delay(topic.delay))
    return rows


def _delay(delay: DelayInfo | None) -> str:
    if delay is None:
        return "–"
    if abs(delay.p50_s) > _OTHER_CLOCK_S:
        return "other clock"
    return "/".join(f"{1e3 * value:.0f}" for value in (delay.mean_s, delay.p50_s, delay.p90_s, delay.max_s))
