"""Configurations, scenarios and sweeps that come with the package, by name."""

import difflib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

from fgtrack.core.errors import CallError
from fgtrack.pipeline.config import Config
from fgtrack.pipeline.load import load
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
    alike = difflib.get_close_matches(str(name), known, 1)
    hint = f"did you mean {alike[0]}?" if alike else f"shipped are {', '.join(known)}"
    raise CallError(f"{path}: there is no such file, and no shipped {kind} of that name; {hint}")


def summary(path: Path) -> str:
    """What a shipped file is for: its first line, a comment."""
    return path.read_text(encoding="utf-8").partition("\n")[0].removeprefix("# ")


def read_config(
    name: str | Path | None,
    settings: Sequence[str] = (),
    *,
    track_map: str | None = None,
    pit_map: str | None = None,
    folder: Path | None = None,
) -> Config:
    """The configuration of a file (in `folder`) or of that shipped name, else the defaults.

    `settings` are of the form a.b=value; `track_map` and `pit_map` replace the maps that the file names. Raises
    `CallError` for what does not fit.
    """
    config = load(Config, None if name is None else find_file("configuration", name, folder), settings)
    maps = config.map
    return replace(config, map=replace(maps, track=track_map or maps.track, pit=pit_map or maps.pit))


def read_scenario(name: str | Path, folder: Path | None = None) -> Scenario:
    """The scenario of a file in `folder` or of that shipped name; raises as `read_config`."""
    return load(Scenario, find_file("scenario", name, folder))
