"""Speed and course columns of a table of position reports, tested on the motion of the objects."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fgtrack.core.geometry import wrap_angle
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.inputs.settings import Field
from fgtrack.meaning.guess import Guess
from fgtrack.meaning.single_reports import links_of_ids

__all__ = ["Motion", "motion_of", "with_velocity"]

#: Factor to m/s by unit.
_SPEEDS = {
    "knots": 1852.0 / 3600.0,
    "m/s": 1.0,
    "km/h": 1.0 / 3.6,
    "mph": 0.44704,
    "tenths of knots": 185.2 / 3600.0,
    "cm/s": 0.01,
}
#: Numbers that mean "unknown" in AIS (ITU-R M.1371-5, table 48), also in tenths.
_NO_SPEED = (102.3, 1023.0)
_NO_COURSE = (360.0, 3600.0, 511.0)
#: Distance from which the positions show a course, and fewest such steps.
_MOVED_M = 20.0
_FEWEST = 10
#: A unit is refuted if it differs from the distance per second by more than this velocity and share.
_TOLERANCE_MPS = 0.5
_TOLERANCE_SHARE = 0.15
_QUANTILE = 0.8
#: Smallest mean cosine of course minus direction of travel that confirms a convention.
_AGREEMENT = 0.9
#: Speed below which a course is random.
_AT_REST_MPS = 0.5


class Motion(NamedTuple):
    """Steps of the objects from report to report."""

    rows: IntArray
    """Row of the report at the beginning of each step, shape (m,)."""
    speed_mps: FloatArray
    """Distance per second, shape (m,)."""
    course_rad: FloatArray
    """Direction of travel, counter-clockwise from east, shape (m,)."""


@dataclass(frozen=True)
class _Unit:
    name: str
    scale: float
    misfit_mps: float


def motion_of(times_s: FloatArray, points_m: FloatArray, ids: IntArray) -> Motion:
    """Return the clear steps of the objects with informative `ids` (n,); empty without such identities."""
    order = np.argsort(times_s, kind="stable")
    firsts, seconds = links_of_ids(times_s[order], points_m[order], ids[order])
    firsts, seconds = order[firsts], order[seconds]
    moved_m = points_m[seconds] - points_m[firsts]
    distances_m = np.hypot(*moved_m.T)
    clear = distances_m > _MOVED_M
    elapsed_s = times_s[seconds] - times_s[firsts]
    return Motion(
        firsts[clear],
        (distances_m / np.maximum(elapsed_s, 1e-9))[clear],
        np.arctan2(moved_m[:, 1], moved_m[:, 0])[clear],
    )


def with_velocity(
    values: Mapping[str, FloatArray],
    speeds: Sequence[str],
    courses: Sequence[str],
    motion: Motion,
) -> dict[str, Guess]:
    """Return the guesses of `speed_mps` and `yaw_rad` that agree with `motion`; a column that does not is left out.

    `values` contain the numbers of the columns, NaN where missing, shape (n,). `speeds` and
    `courses` are the columns that may contain them by their names. A course is only read
    together with a speed, because it is random at rest.
    """
    found: dict[str, Guess] = {}
    units = [(name, unit) for name in speeds if (unit := _unit(values[name], motion))]
    if not units:
        return found
    column, unit = min(units, key=lambda each: each[1].misfit_mps)
    found["speed_mps"] = Guess(
        Field(column, unit.scale, unknown=_present(values[column], _NO_SPEED)),
        f"{unit.name}: differs from the distance per second by up to {unit.misfit_mps:.2g} m/s",
    )
    readings = [
        (
            agreement,
            Field(name, scale, offset, True, _present(values[name], _NO_COURSE)),
        )
        for name in courses
        for scale, offset in ((-1.0, 90.0), (1.0, 0.0), (-0.1, 90.0))
        if (agreement := _agreement(values[name], scale, offset, motion)) is not None
    ]
    best, field = max(readings, key=lambda each: each[0], default=(0.0, None))
    if field is not None and best >= _AGREEMENT:
        least = float(f"{_AT_REST_MPS / unit.scale:.2g}")
        kind = "counter-clockwise from east" if field.scale > 0.0 else "compass"
        found["yaw_rad"] = Guess(
            Field(
                field.path,
                field.scale,
                field.offset,
                True,
                field.unknown,
                {column: least},
            ),
            f"{kind}: mean cosine {best:.3f} with the direction of travel; not below {least:g} of {column}",
        )
    return found


def _present(values: FloatArray, unknown: Sequence[float]) -> tuple[float, ...]:
    return tuple(each for each in unknown if (values == each).any())


def _unit(values: FloatArray, motion: Motion) -> _Unit | None:
    """Return the unit with which the numbers differ least from the distance per second; None if all are refuted."""
    raw = values[motion.rows]
    known = np.isfinite(raw) & ~np.isin(raw, _NO_SPEED)
    if known.sum() < _FEWEST:
        return None
    travelled_mps = motion.speed_mps[known]
    fits = [
        _Unit(
            name,
            scale,
            float(np.quantile(np.abs(scale * raw[known] - travelled_mps), _QUANTILE)),
        )
        for name, scale in _SPEEDS.items()
    ]
    best = min(fits, key=lambda fit: fit.misfit_mps)
    limit_mps = max(_TOLERANCE_MPS, _TOLERANCE_SHARE * float(np.median(travelled_mps)))
    return best if best.misfit_mps <= limit_mps else None


def _agreement(
    values: FloatArray, scale: float, offset: float, motion: Motion
) -> float | None:
    """Return the mean cosine of the converted numbers minus the direction of travel; None for too few numbers."""
    raw = values[motion.rows]
    known = np.isfinite(raw) & ~np.isin(raw, _NO_COURSE)
    if known.sum() < _FEWEST:
        return None
    off_rad = [
        wrap_angle(math.radians(scale * each + offset) - course_rad)
        for each, course_rad in zip(
            raw[known].tolist(), motion.course_rad[known].tolist(), strict=True
        )
    ]
    return float(np.mean(np.cos(off_rad)))
