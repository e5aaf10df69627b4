"""What the resolved configuration of a run says, for those who read run folders."""

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from fgtrack.core.errors import DataError
from fgtrack.io.run import Run


def section(run: Run, name: str) -> Mapping[str, Any]:
    """The section `name` of the run's config.yaml; empty where it has none.

    Raises `DataError` where config.yaml is not YAML.
    """
    try:
        config = _load(run.config_text)
    except YAMLError as error:
        raise DataError(f"{run.path / 'config.yaml'}: is not YAML, repeat the run") from error
    found = config.get(name) if isinstance(config, dict) else None
    return found if isinstance(found, dict) else {}


@lru_cache(maxsize=64)
def _load(text: str) -> Any:
    """The YAML values of `text`. Kept: reading them takes longer than judging a run of 20 s, and sweeps repeat them."""
    return YAML(typ="safe", pure=True).load(text)
