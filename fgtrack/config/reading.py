"""Reads configurations and scenarios from files; shipped files are read by name."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from fgtrack.config.settings import Config
from fgtrack.config.shipped import find_file
from fgtrack.config.yaml_file import load, plain, read_yaml, validate
from fgtrack.core.checks import check_paths

if TYPE_CHECKING:  # a replay needs no simulator
    from fgtrack.sim.scenario import Scenario

ConfigLike = str | Path | Config | Mapping[str, object]
"""Name of a shipped configuration, path of a YAML file, a `Config`, or a mapping of settings such as `run.config`."""


def read_config(
    name: ConfigLike | None,
    settings: Sequence[str] | Mapping[str, object] | None = None,
    *,
    track_map: str | Path | None = None,
    pit_map: str | Path | None = None,
    estimator: str | None = None,
    folder: Path | None = None,
) -> Config:
    """Return a configuration: the defaults (None), a `Config`, a mapping, or a file.

    A file is searched in `folder`, else among the shipped names. `settings` as in
    `load`. Maps and the estimator replace those of the configuration. Raises
    `CallError` with the key.
    """
    check_paths(map=track_map, pit_map=pit_map)
    if isinstance(name, Mapping):
        name = Config.from_dict(name)
    if not isinstance(name, Config | None):
        check_paths(config=name)
        name = find_file("configuration", name, folder)
    config = (
        name
        if isinstance(name, Config) and not settings
        else load(Config, name, settings or ())
    )
    track = track_map or config.map.track
    pit = pit_map or config.map.pit
    road = replace(config.map, track=track and str(track), pit=pit and str(pit))
    return replace(config, map=road, estimator=estimator or config.estimator)


def read_scenario(
    name: "str | Path | Scenario | Mapping[str, object]",
    folder: Path | None = None,
    duration_s: float | None = None,
) -> "Scenario":
    """Return a scenario: a `Scenario`, a mapping with the keys of a scenario file, or a file.

    A file is searched in `folder`, else among the shipped names. `duration_s` replaces the
    duration. Raises the exceptions of `read_config`.
    """
    from fgtrack.sim.scenario import Scenario

    if isinstance(name, Scenario):
        raw = plain(name)
        origin = "the given scenario"
    elif isinstance(name, Mapping):
        raw = dict(name)
        origin = "the given scenario"
    else:
        check_paths(scenario=name)
        path = find_file("scenario", name, folder)
        raw = read_yaml(path)
        origin = str(path)
    return validate(
        Scenario,
        raw if duration_s is None else {**raw, "duration_s": duration_s},
        origin,
    )
