"""`fgtrack config`: the resolved configuration."""

from fgtrack.cli.arguments import ConfigFile, Settings
from fgtrack.pipeline.config import Config
from fgtrack.pipeline.load import dump, load


def config(config_file: ConfigFile = None, settings: Settings = None) -> None:
    """Print the configuration with every default written out."""
    print(dump(load(Config, config_file, settings or [])), end="")
