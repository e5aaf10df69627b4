"""`fgtrack convert`: from any input to a stream or a bag, with other delays if wanted."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from fgtrack.cli.arguments import ConfigFile, Input, Overwrite, StorageOption
from fgtrack.cli.show import progress, say
from fgtrack.core.errors import CallError
from fgtrack.core.types import DetectionList, Message
from fgtrack.evaluation.diagnostics import excluded_lines
from fgtrack.io.output import check_apart
from fgtrack.io.recording import check_recording, write_recording
from fgtrack.io.source import open_input
from fgtrack.pipeline.load import load
from fgtrack.pipeline.shipped import read_config
from fgtrack.sim.redelay import Redelayed, SensorDelays, redelay


def convert(
    recording: Input,
    out: Annotated[Path, typer.Argument(help="Stream (.jsonl, .jsonl.gz), else a rosbag2 folder.")],
    config_file: ConfigFile = None,
    delays_file: Annotated[
        Path | None,
        typer.Option("--delays", help="Give detections other delays, losses and clock errors by sensor (YAML)."),
    ] = None,
    seed: Annotated[
        int | None, typer.Option("--seed", min=0, help="Seed of the random generator of --delays.", show_default="0")
    ] = None,
    storage: StorageOption = "mcap",
    overwrite: Overwrite = False,
) -> None:
    """Convert a recording into a stream or a rosbag2 folder."""
    if seed is not None and delays_file is None:
        raise CallError("--seed: only --delays draws random numbers, name its file")
    config = read_config(config_file)
    check_apart(out, [recording, config_file, delays_file])
    check_recording(out, overwrite)
    source = open_input(recording, config.input)
    unread: dict[str, Counter[str]] = {}
    with progress("convert"):
        messages = source.messages() if delays_file is None else _redelayed(source.messages, delays_file, seed or 0)
        count = write_recording(
            out, _counted(messages, unread), storage, settings=source.settings(), overwrite=overwrite
        )
    lost = messages.num_lost if isinstance(messages, Redelayed) else {}
    losses = ", ".join(f"{number} of {sensor}" for sensor, number in lost.items() if number)
    say(f"{out}: {count} messages{losses and f', lost {losses}'}")
    for line in excluded_lines({"left_out": unread}):
        say(line)


def _counted(messages: Iterable[Message], unread: dict[str, Counter[str]]) -> Iterator[Message]:
    """`messages`; by sensor and setting what the reader has left out of them is added to `unread`."""
    for message in messages:
        if isinstance(message, DetectionList) and message.left_out:
            unread.setdefault(message.sensor, Counter()).update(message.left_out)
        yield message


def _redelayed(read: Callable[[], Iterator[Message]], delays_file: Path, seed: int) -> Redelayed:
    delays = load(dict[str, SensorDelays], delays_file)
    try:
        return redelay(read, delays, np.random.default_rng(seed))
    except CallError as error:
        raise CallError(f"{delays_file}: {error}") from error
