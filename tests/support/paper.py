"""The paper's tracker, for tests that mean it and not whatever is the default."""

from fgtrack.config.settings import Config
from fgtrack.config.shipped import read_config


def paper(*settings: str) -> Config:
    """The method of Karle et al. 2023 with `settings` of the form a.b=value, and an ego that may be uncertain."""
    return read_config("karle2023", ["ego.uncertainty=independent", *settings])
