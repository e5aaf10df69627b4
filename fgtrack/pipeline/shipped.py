"""Configurations, scenarios and sweeps that come with the package, by name."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from fgtrack.core.checks import check_paths
from fgtrack.core.errors import CallError, did_you_mean
from fgtrack.pipeline.config import Config
from fgtrack.pipeline.load import load, plain, read_yaml, validate, with_settings
from fgtrack.sim.scenario import Scenario

Kind = Literal["configuration", "scenario", "sweep"]

_FOLDERS = {"configuration": ".", "scenario": "scenarios", "sweep": "sweeps"}
_PACKAGE = Path(__file__).parents[1]


def shipped_folder() -> Path:
    """Where the shipped files are: inside an installed package, beside it in a checkout."""
    inside = _PACKAGE / "configs"
    return inside if inside.is_dir() else _PACKAGE.parent / "configs"


def shipped(kind: Kind) -> dict[str, Path]:
    """The shipped files of one kind by name, in alphabetical order."""
    return {path.stem: path for path in sorted((shipped_folder() / _FOLDERS[kind]).glob("*.yaml"))}


def find_file(kind: Kind, name: str | Path, folder: Path | None = None) -> Path:
    """The file `name`, relative to `folder`, or the shipped one of that name where there is no such file.

    Raises
    ------
    CallError
        There is neither.
    """
    path = Path(name) if folder is None else folder / name
    if path.is_file():
        return path
    known = shipped(kind)
    if str(name) in known:
        return known[str(name)]
    if path.exists() or path.suffix or len(Path(name).parts) != 1:
        raise CallError(f"{path}: there is no such {kind} file")
    hint = did_you_mean(name, known) or f"; shipped are {', '.join(known)}"
    raise CallError(f"{path}: there is no such file, and no shipped {kind} of that name{hint}")


def summary(path: Path) -> str:
    """What a shipped file is for: its first line, a comment."""
    return path.read_text(encoding="utf-8").partition("\n")[0].removeprefix("# ")


def read_config(
    name: str | Path | Config | None,
    settings: Sequence[str] = (),
    *,
    track_map: str | Path | None = None,
    pit_map: str | Path | None = None,
    estimator: str | None = None,
    folder: Path | None = None,
) -> Config:
    """The configuration of a file (in `folder`) or of that shipped name, else the defaults.

    `settings` are of the form a.b=value; maps and estimator replace those that the file names. Raises `CallError` for
    what does not fit.
    """
    check_paths(map=track_map, pit_map=pit_map)
    if not isinstance(estimator, str | None):
        raise CallError(f"estimator: must be a name, is a {type(estimator).__name__}")
    if isinstance(name, Config):
        config = with_settings(Config, plain(name), settings, "the given configuration") if settings else name
    else:
        check_paths(config=name)
        config = load(Config, None if name is None else find_file("configuration", name, folder), settings)
    track = str(track_map) if track_map else config.map.track
    pit = str(pit_map) if pit_map else config.map.pit
    return replace(config, map=replace(config.map, track=track, pit=pit), estimator=estimator or config.estimator)


def settings_of(values: Mapping[str, object] | None) -> list[str]:
    """Settings of the form a.b=value from a mapping of keys to plain values, numbers of NumPy among them.

    Raises `CallError` for what is no mapping, and no plain value.
    """
    if not isinstance(values, Mapping | None):
        raise CallError(f"set: must be a mapping of keys to values, is a {type(values).__name__}")
    try:
        return [f"{key}={json.dumps(value, default=_number)}" for key, value in (values or {}).items()]
    except (TypeError, ValueError) as error:
        raise CallError(f"set: only plain values can be set ({error})") from error


def _number(value: object) -> object:
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"a {type(value).__name__} is none")


def read_scenario(name: str | Path | Scenario, folder: Path | None = None, duration_s: float | None = None) -> Scenario:
    """The scenario of a file in `folder` or of that shipped name, as long as `duration_s`; raises as `read_config`."""
    if isinstance(name, Scenario):
        raw, origin = plain(name), "the given scenario"
    else:
        check_paths(scenario=name)
        path = find_file("scenario", name, folder)
        raw, origin = read_yaml(path), str(path)
    return validate(Scenario, raw if duration_s is None else {**raw, "duration_s": duration_s}, origin)
