"""`fgtrack convert`: from any input to a stream or a bag."""

from pathlib import Path
from typing import Annotated

import typer

from fgtrack.cli.arguments import ConfigFile, Input
from fgtrack.cli.show import console, progress
from fgtrack.cli.storage import Storage, StorageOption, write_recording
from fgtrack.io.source import open_input
from fgtrack.pipeline.config import Config
from fgtrack.pipeline.load import load


def convert(
    recording: Input,
    out: Annotated[Path, typer.Argument(help="Stream (.jsonl, .jsonl.gz), else a rosbag2 folder.")],
    config_file: ConfigFile = None,
    storage: StorageOption = Storage.MCAP,
) -> None:
    """Convert a recording to an fgtrack stream or a rosbag2 folder."""
    source = open_input(recording, load(Config, config_file).input)
    with progress("convert"):
        count = write_recording(out, source.messages(), storage)
    console().print(f"{out}: {count} messages", highlight=False, soft_wrap=True)
