"""Reads configurations and scenarios: files, or those that come with the package."""

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
    """Return the configuration of a file (in `folder`), of that shipped name or of a mapping, else the defaults.
    `settings` as of `load`; maps and estimator replace those of the file. Raises `CallError` with the key.
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
    track, pit = track_map or config.map.track, pit_map or config.map.pit
    road = replace(config.map, track=track and str(track), pit=pit and str(pit))
    return replace(config, map=road, estimator=estimator or config.estimator)


def read_scenario(
    name: "str | Path | Scenario | Mapping[str, object]",
    folder: Path | None = None,
    duration_s: float | None = None,
) -> "Scenario":
    """Return the scenario of a file in `folder`, of a shipped name, or of a mapping with the keys of such a file.

    `duration_s` replaces its length. Raises as `read_config`.
    """
    from fgtrack.sim.scenario import Scenario

    if isinstance(name, Scenario):
        raw, origin = plain(name), "the given scenario"
    elif isinstance(name, Mapping):
        raw, origin = dict(name), "the given scenario"
    else:
        check_paths(scenario=name)
        path = find_file("scenario", name, folder)
        raw, origin = read_yaml(path), str(path)
    return validate(
        Scenario,
        raw if duration_s is None else {**raw, "duration_s": duration_s},
        origin,
    )
