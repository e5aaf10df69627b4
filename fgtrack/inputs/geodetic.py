"""Conversion of latitude and longitude to the local plane (east, north) of the tracks, and back.

The plane touches the WGS84 ellipsoid at the origin. Positions have height 0 and are
projected orthographically (Snyder: Map projections, USGS Professional Paper 1395, 1987,
section 20). At the distance d from the origin, lengths towards the origin are shortened
by d^2 / (2 R^2). This is 1e-4 at 100 km, less than the errors of motion models. Beyond,
a warning is logged.
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
"""Names of the mapped fields from which x_m and y_m in the map are computed."""
_FAR_M = 100e3
# Fewer far positions, or a smaller share of them, are outliers.
_FEWEST_FAR = 10
_FAR_SHARE = 0.05
#: Fixed-point iterations of the height; each one reduces the error by the factor d^2 / (2 R^2).
_ITERATIONS = 4
_logger = logging.getLogger(__name__)


@cache
def warn_once(text: str) -> None:
    """Log the warning `text` once, although an input may be opened several times."""
    _logger.warning(text)


class LocalPlane:
    """Local plane of an input: x_m to the east and y_m to the north of the origin.

    Without a given origin, the first position becomes the origin.
    """

    def __init__(self, origin: Origin | None = None, *, warns: bool = True) -> None:
        """`warns`: log a warning on positions that are far from the origin."""
        self.origin = origin
        self._num_near = 0
        self._num_far = 0
        self._warned = not warns

    @property
    def origin_deg(self) -> tuple[float, float] | None:
        """Latitude and longitude of the origin; None before the first position."""
        return (
            None
            if self.origin is None
            else (self.origin.latitude_deg, self.origin.longitude_deg)
        )

    def in_plane(
        self, values: Mapping[str, Any]
    ) -> dict[str, Any]:  # Any: values of mapped fields
        """Return `values` with x_m and y_m in the plane instead of latitude_deg and longitude_deg.

        If a coordinate is None, x_m and y_m are None; if it is invalid, they are NaN. `values` without latitude_deg
        keep their x_m and y_m.
        """
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
        """Return east and north of a position in m. Without an origin, the position becomes the origin.

        NaN for coordinates that do not exist on Earth, and for a position on the other side of the Earth.
        """
        if not (abs(latitude_deg) <= 90.0 and abs(longitude_deg) <= 180.0):
            return math.nan, math.nan
        if self.origin is None:
            self.origin = Origin(float(latitude_deg), float(longitude_deg))
        from pymap3d import geodetic2enu

        at = self.origin.latitude_deg, self.origin.longitude_deg
        x_m, y_m, up_m = map(
            float, geodetic2enu(latitude_deg, longitude_deg, 0.0, *at, 0.0)
        )
        far_m = math.hypot(x_m, y_m, up_m)
        if far_m <= _FAR_M:
            self._num_near += 1
        else:
            self._num_far += 1
            limit = max(_FEWEST_FAR, _FAR_SHARE * self._num_near)
            if not self._warned and self._num_far >= limit:
                self._warned = True
                where = f"{far_m / 1e3:.0f} km from the origin {at[0]:.4f}, {at[1]:.4f}"
                warn_once(
                    f"positions are {where}: set `input.origin` within 100 km of the positions"
                )
        return (x_m, y_m) if abs(up_m) < _EARTH_M else (math.nan, math.nan)


_EARTH_M = 6.3e6
"""Distance below the plane, in m, beyond which a position is on the other side of the Earth."""


def latitudes_longitudes_deg(
    origin_deg: tuple[float, float], x_m: FloatArray, y_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return latitudes and longitudes in degrees, shape (n,) each, of positions (n,) in the plane at `origin_deg`.

    Fixed-point iteration finds the height above the plane at which the height above the
    ellipsoid is 0.
    """
    from pymap3d import enu2geodetic

    up_m = np.zeros(len(x_m))
    for _ in range(_ITERATIONS):
        latitude_deg, longitude_deg, height_m = enu2geodetic(
            x_m, y_m, up_m, *origin_deg, 0.0
        )
        up_m = up_m - height_m
    return np.asarray(latitude_deg), np.asarray(longitude_deg)
