"""Configurations, scenarios and sweeps that the package contains, by name."""

from collections.abc import Iterable
from pathlib import Path
from typing import Literal

from fgtrack.core.errors import CallError, did_you_mean

Kind = Literal["configuration", "scenario", "sweep"]
_FOLDERS = {"configuration": ".", "scenario": "scenarios", "sweep": "sweeps"}
#: Shipped configurations for recordings of position reports, by the name of a sensor; see docs/recordings.md.
_REPORTS = {
    "smr": "airport",
    "mlat": "airport",
    "adsb": "adsb",
    "ais": "ais",
    "reports": "v2x",
}
_PACKAGE = Path(__file__).parents[1]


def shipped_folder() -> Path:
    """Folder of the shipped files: inside an installed package, or next to the package in a checkout."""
    inside = _PACKAGE / "configs"
    return inside if inside.is_dir() else _PACKAGE.parent / "configs"


def shipped(kind: Kind) -> dict[str, Path]:
    """Shipped files of one kind by name, in alphabetical order."""
    return {
        path.stem: path
        for path in sorted((shipped_folder() / _FOLDERS[kind]).glob("*.yaml"))
    }


def find_file(kind: Kind, name: str | Path, folder: Path | None = None) -> Path:
    """Return the file `name` in `folder`, else the shipped file with this name.

    Raises `CallError` if neither exists.
    """
    path = Path(name) if folder is None else folder / name
    if path.is_file():
        return path
    known = shipped(kind)
    if str(name) in known:
        return known[str(name)]
    hint = did_you_mean(name, known) or f"; shipped files are {', '.join(known)}"
    raise CallError(f"{path}: there is no such {kind} file{hint}")


def summary(path: Path) -> str:
    """Purpose of a shipped file: the comment in its first line."""
    return path.read_text(encoding="utf-8").partition("\n")[0].removeprefix("# ")


def suited_reports(sensors: Iterable[str]) -> str | None:
    """Advice to use the shipped configuration for reports of these sensors; None for other sensors."""
    names = set(sensors)
    suited = next((config for name, config in _REPORTS.items() if name in names), None)
    return suited and f"`-c {suited}` is the shipped configuration for these reports"
