"""Configurations, scenarios and sweeps that come with the package, by name."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from fgtrack.config.settings import Config
from fgtrack.config.yaml_file import load, plain, read_yaml, validate
from fgtrack.core.checks import check_paths
from fgtrack.core.errors import CallError, did_you_mean

if TYPE_CHECKING:  # a replay needs no simulator
    from fgtrack.sim.scenario import Scenario

Kind = Literal["configuration", "scenario", "sweep"]
_FOLDERS = {"configuration": ".", "scenario": "scenarios", "sweep": "sweeps"}
#: Configurations by a sensor of recordings of reports, see docs/recordings.md.
_REPORTS = {
    "smr": "airport",
    "mlat": "airport",
    "adsb": "adsb",
    "ais": "ais",
    "reports": "v2x",
}
_PACKAGE = Path(__file__).parents[1]


def shipped_folder() -> Path:
    """Folder of the shipped files: inside an installed package, beside it in a checkout."""
    inside = _PACKAGE / "configs"
    return inside if inside.is_dir() else _PACKAGE.parent / "configs"


def shipped(kind: Kind) -> dict[str, Path]:
    """The shipped files of one kind by name, in alphabetical order."""
    return {
        path.stem: path
        for path in sorted((shipped_folder() / _FOLDERS[kind]).glob("*.yaml"))
    }


def find_file(kind: Kind, name: str | Path, folder: Path | None = None) -> Path:
    """Return the file `name` in `folder`, else the shipped one of that name. Raises `CallError` where both miss."""
    path = Path(name) if folder is None else folder / name
    if path.is_file():
        return path
    known = shipped(kind)
    if str(name) in known:
        return known[str(name)]
    hint = did_you_mean(name, known) or f"; shipped are {', '.join(known)}"
    raise CallError(f"{path}: there is no such {kind} file{hint}")


def summary(path: Path) -> str:
    """Purpose of a shipped file: its first line, a comment."""
    return path.read_text(encoding="utf-8").partition("\n")[0].removeprefix("# ")


def suited_reports(sensors: Iterable[str]) -> str | None:
    """Return the advice to use the shipped configuration of reports by these sensors; None for other sensors."""
    names = set(sensors)
    suited = next((config for name, config in _REPORTS.items() if name in names), None)
    return suited and f"`-c {suited}` is the shipped configuration of such reports"


def read_config(
    name: str | Path | Config | None,
    settings: Sequence[str] | Mapping[str, object] | None = None,
    *,
    track_map: str | Path | None = None,
    pit_map: str | Path | None = None,
    estimator: str | None = None,
    folder: Path | None = None,
) -> Config:
    """Return the configuration of a file (in `folder`) or of that shipped name, else the defaults.
    `settings` as of `load`; maps and estimator replace those of the file. Raises `CallError` with the key.
    """
    check_paths(map=track_map, pit_map=pit_map)
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
    name: "str | Path | Scenario",
    folder: Path | None = None,
    duration_s: float | None = None,
) -> "Scenario":
    """The scenario of a file in `folder` or of that shipped name, as long as `duration_s`; raises as `read_config`."""
    from fgtrack.sim.scenario import Scenario

    if isinstance(name, Scenario):
        raw, origin = plain(name), "the given scenario"
    else:
        check_paths(scenario=name)
        path = find_file("scenario", name, folder)
        raw, origin = read_yaml(path), str(path)
    return validate(
        Scenario,
        raw if duration_s is None else {**raw, "duration_s": duration_s},
        origin,
    )
