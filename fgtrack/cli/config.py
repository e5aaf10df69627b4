"""`fgtrack config`: the resolved configuration, and the shipped files."""

from typing import Annotated, get_args

import typer

from fgtrack.cli.arguments import ConfigFile, Settings
from fgtrack.cli.show import entries, say
from fgtrack.pipeline.load import dump
from fgtrack.pipeline.shipped import Kind, read_config, shipped, summary


def config(
    config_file: ConfigFile = None,
    settings: Settings = None,
    listed: Annotated[
        bool, typer.Option("--list", help="List the shipped configurations, scenarios and sweeps.")
    ] = False,
) -> None:
    """Print the resolved configuration, or list the shipped ones."""
    if not listed:
        print(dump(read_config(config_file, settings or [])), end="")
        return
    for kind in get_args(Kind):
        say(f"{kind}s")
        entries({name: summary(path) for name, path in shipped(kind).items()})
