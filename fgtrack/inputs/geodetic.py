"""Latitude and longitude to the local plane (east, north) that tracks live in, and back.

The plane touches the WGS84 ellipsoid at the origin; positions are those at height 0 (orthographic projection; Snyder:
Map projections, USGS Professional Paper 1395, 1987, section 20). At the distance d it shortens lengths along the line
of sight by d^2 / (2 R^2), some 1e-4 at 100 km, less than the errors of motion models; hence the warning beyond.
"""

import logging
import math
from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np

from fgtrack.core.types import FloatArray
from fgtrack.inputs.settings import Origin

GEODETIC = ("latitude_deg", "longitude_deg")
"""Names of mapped fields that give x_m and y_m in the map."""
_FAR_M = 100e3
_ITERATIONS = 4  # each leaves d^2 / (2 R^2) of the error in height
_logger = logging.getLogger(__name__)


@cache
def warn_once(text: str) -> None:
    """Log a warning, the same text once: an input is opened several times."""
    _logger.warning(text)


class LocalPlane:
    """The plane of one input: x_m to the east and y_m to the north of its origin, the first position unless given."""

    def __init__(self, origin: Origin | None = None) -> None:
        self.origin = origin
        self._warned = False

    @property
    def origin_deg(self) -> tuple[float, float] | None:
        """Latitude and longitude of the origin; None before the first position."""
        return (
            None
            if self.origin is None
            else (self.origin.latitude_deg, self.origin.longitude_deg)
        )

    def placed(
        self, values: Mapping[str, Any]
    ) -> dict[str, Any]:  # Any: of mapped fields
        """Return `values` with x_m and y_m, None or NaN as they are, instead of latitude_deg and longitude_deg."""
        rest = dict(values)
        latitude_deg, longitude_deg = (rest.pop(name, None) for name in GEODETIC)
        if GEODETIC[0] in values:
            known = latitude_deg is not None and longitude_deg is not None
            rest["x_m"], rest["y_m"] = (
                self.position_m(latitude_deg, longitude_deg) if known else (None, None)
            )
        return rest

    def position_m(
        self, latitude_deg: float, longitude_deg: float
    ) -> tuple[float, float]:
        """East and north of a position; NaN where it is not on Earth."""
        if not (abs(latitude_deg) <= 90.0 and abs(longitude_deg) <= 180.0):
            return math.nan, math.nan
        if self.origin is None:
            self.origin = Origin(float(latitude_deg), float(longitude_deg))
        from pymap3d import geodetic2enu

        at = self.origin.latitude_deg, self.origin.longitude_deg
        x_m, y_m, up_m = map(
            float, geodetic2enu(latitude_deg, longitude_deg, 0.0, *at, 0.0)
        )
        if not self._warned and (far_m := math.hypot(x_m, y_m, up_m)) > _FAR_M:
            self._warned, where = (
                True,
                f"{far_m / 1e3:.0f} km from the origin {at[0]:.4f}, {at[1]:.4f}",
            )
            warn_once(f"a position is {where}: beyond 100 km set `input.origin` nearer")
        return (x_m, y_m) if abs(up_m) < _EARTH_M else (math.nan, math.nan)


_EARTH_M = 6.3e6
"""Radius, in the direction up, of what the plane does not reach."""


def latitudes_longitudes_deg(
    origin_deg: tuple[float, float], x_m: FloatArray, y_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return latitudes and longitudes, shape (n,) each, of positions (n,) in the plane about `origin_deg`.
    The height above the plane at which that above the ellipsoid is 0 results from fixed-point iteration.
    """
    from pymap3d import enu2geodetic

    up_m = np.zeros(len(x_m))
    for _ in range(_ITERATIONS):
        latitude_deg, longitude_deg, height_m = enu2geodetic(
            x_m, y_m, up_m, *origin_deg, 0.0
        )
        up_m = up_m - height_m
    return np.asarray(latitude_deg), np.asarray(longitude_deg)
