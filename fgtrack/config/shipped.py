"""Configurations, scenarios and sweeps that come with the package, by name."""

from collections.abc import Iterable
from pathlib import Path
from typing import Literal

from fgtrack.core.errors import CallError, did_you_mean

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
