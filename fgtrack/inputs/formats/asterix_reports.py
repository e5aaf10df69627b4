"""Target reports of ASTERIX as detections: the items of each category, positions, velocities and accuracies."""

import math
from collections.abc import Mapping
from typing import NamedTuple

from fgtrack.core.geometry import wrap_angle
from fgtrack.core.types import Detection
from fgtrack.inputs.formats.asterix_records import Record
from fgtrack.inputs.geodetic import LocalPlane
from fgtrack.inputs.settings import Origin

__all__ = ["CATEGORIES", "Category", "Site", "detection"]

_NM_M = 1852.0
_FOOT_M = 0.3048
#: Radius that contains 95 % of a circular Gaussian, in standard deviations.
_PER_95 = 2.4477
#: 95 % radius of the position in m by NACp: DO-260B (RTCA, 2009), table 2-71.
_NACP_M = {
    11: 3.0,
    10: 10.0,
    9: 30.0,
    8: 92.6,
    7: 185.2,
    6: 555.6,
    5: 926.0,
    4: 1852.0,
    3: 3704.0,
    2: 7408.0,
    1: 18520.0,
}
#: 95 % radius of the position in m by NUCp of version 0: DO-260 (2000), table 2-11.
_NUCP_M = {
    9: 3.0,
    8: 10.0,
    7: 92.6,
    6: 185.2,
    5: 463.0,
    4: 926.0,
    3: 1852.0,
    2: 9260.0,
    1: 18520.0,
}
#: 95 % bound of the velocity in m/s by NACv: DO-260B, table 2-22.
_NACV_MPS = {4: 0.3, 3: 1.0, 2: 3.0, 1: 10.0}
_UNKNOWN_MPS = 10.0


class Category(NamedTuple):
    """Items of a category, as number or number/part; of several alternatives the first in the record is read."""

    sensor: str
    """Name of the sensor; empty if the type of the report determines it (`_KINDS`)."""
    stamp: tuple[str, ...]
    """Items with the stamp."""
    receipt: tuple[str, ...]
    """Items with the receipt; empty if the category has no second time."""
    address: str
    """Item with the address of the target."""
    positions: tuple[tuple[str, str, str], ...]
    """Items with a position, each with its two parts: LAT and LON, X and Y, or RHO and THETA."""
    velocity: tuple[str, str, str]
    """Item with the velocity, with its two parts: VX and VY, or speed and direction."""
    height: str
    """Item with the flight level."""
    unit_m: float = 1.0
    """Unit of X and Y in m."""
    lsb: Mapping[str, float] = {}
    """Least significant bits by item/part, where libasterix has wrong ones."""


_WGS84 = ("041", "LAT", "LON")
_CARTESIAN = ("042", "X", "Y")
_POLAR = ("040", "RHO", "THETA")
_GNSS = (("131", "LAT", "LON"), ("130", "LAT", "LON"))
_SYSTEM = (("105", "LAT", "LON"), ("100", "X", "Y"))
CATEGORIES = {
    # Edition 1.1, 5.2.20: +-8192 m/s in 16 bits, so 0.25 m/s; libasterix 1.1 has 1/16 m/s.
    10: Category(
        "",
        ("140",),
        (),
        "220",
        (_WGS84, _CARTESIAN, _POLAR),
        ("202", "VX", "VY"),
        "090/FL",
        lsb={"202/VX": 0.25, "202/VY": 0.25},
    ),
    20: Category(
        "mlat", ("140",), (), "220", (_WGS84, _CARTESIAN), ("202", "VX", "VY"), "090/FL"
    ),
    21: Category(
        "adsb",
        ("073", "071", "030"),
        ("077",),
        "080",
        _GNSS,
        ("160", "GS", "TA"),
        "145",
    ),
    48: Category(
        "radar",
        ("140",),
        (),
        "220",
        (_POLAR, _CARTESIAN),
        ("200", "GSP", "HDG"),
        "090/FL",
        _NM_M,
    ),
    62: Category(
        "system", ("070",), (), "380/ADR", _SYSTEM, ("185", "VX", "VY"), "136"
    ),
}


class Site:
    """Position of a station in the plane, and the direction of its north there, because meridians converge."""

    def __init__(self, plane: LocalPlane, station: Origin | None) -> None:
        self._x_m = self._y_m = self._turn_rad = 0.0
        self._given = station is not None
        self.misplaces = False
        """True if a relative position was converted although the station's position is unknown."""
        if station is not None:
            self._x_m, self._y_m = plane.position_m(
                station.latitude_deg, station.longitude_deg
            )
            x_m, y_m = plane.position_m(
                min(station.latitude_deg + 0.01, 90.0), station.longitude_deg
            )
            self._turn_rad = math.atan2(x_m - self._x_m, y_m - self._y_m)

    def position_m(self, x_m: float, y_m: float) -> tuple[float, float]:
        """Return the position in the plane, `x_m` to the east and `y_m` to the north of the station."""
        self.misplaces = not self._given
        c = math.cos(self._turn_rad)
        s = math.sin(self._turn_rad)
        return self._x_m + c * x_m + s * y_m, self._y_m - s * x_m + c * y_m


def detection(
    record: Record, number: int, category: Category, site: Site, plane: LocalPlane
) -> Detection | None:
    """Return the object of a target report; None if the report has no position."""
    position = next(
        (
            at
            for name in category.positions
            if (at := _position_m(record, *name, category.unit_m, site, plane))
        ),
        None,
    )
    if position is None:
        return None
    speed_mps, yaw_rad = _velocity(record, *category.velocity)
    address = record.get(category.address)
    level = record.get(category.height)
    return Detection(
        *position,
        yaw_rad,
        speed_mps,
        covariance=_accuracy(record, speed_mps) if number == 21 else None,
        z_m=None if level is None else 100.0 * _FOOT_M * level,
        id=None if address is None else f"{int(address):06X}",
    )


def _position_m(
    record: Record,
    item: str,
    first: str,
    second: str,
    unit_m: float,
    site: Site,
    plane: LocalPlane,
) -> tuple[float, float] | None:
    a = record.get(f"{item}/{first}")
    b = record.get(f"{item}/{second}")
    if a is None or b is None:
        return None
    if first == "LAT":
        return plane.position_m(a, b)
    if first == "RHO":
        a, b = a * math.sin(math.radians(b)), a * math.cos(math.radians(b))
    return site.position_m(unit_m * a, unit_m * b)


def _velocity(
    record: Record, item: str, first: str, second: str
) -> tuple[float | None, float | None]:
    """Return speed over ground and course. Both are None without a report. An object at rest has no course."""
    a = record.get(f"{item}/{first}")
    b = record.get(f"{item}/{second}")
    if a is None or b is None:
        return None, None
    if first == "VX":
        return math.hypot(a, b), math.atan2(b, a) if a or b else None
    return a * _NM_M, wrap_angle(math.radians(90.0 - b)) if a else None


def _accuracy(record: Record, speed_mps: float | None) -> tuple[float, ...] | None:
    """Return the covariance of the measured components from the accuracy categories; None if the record has no position
    accuracy.
    """
    radius_m = _NACP_M.get(int(record.get("090/NACP", 0)))
    if not radius_m and record.get("210/VN") == 0:
        radius_m = _NUCP_M.get(int(record.get("090/NUCPNIC", 0)))
    if radius_m is None:
        return None
    variances = [(radius_m / _PER_95) ** 2] * 2
    if speed_mps is not None:
        std_mps = (
            _NACV_MPS.get(int(record.get("090/NUCRNACV", 0)), _UNKNOWN_MPS) / _PER_95
        )
        variances += [(std_mps / max(speed_mps, std_mps)) ** 2] * bool(speed_mps) + [
            std_mps**2
        ]
    size = len(variances)
    return tuple(
        variances[row] if row == column else 0.0
        for row in range(size)
        for column in range(size)
    )
