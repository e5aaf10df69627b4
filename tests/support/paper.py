"""The paper's tracker, for tests that mean it and not whatever is the default."""

from fgtrack.config.reading import read_config
from fgtrack.config.settings import Config


def paper(*settings: str) -> Config:
    """The method of Karle et al. 2023 with `settings` of the form a.b=value, and an ego that may be uncertain."""
    return read_config("karle2023", ["ego.uncertainty=independent", *settings])
