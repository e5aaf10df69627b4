"""Period, noise and velocities of objects that a sensor reports one by one: a rotating RADAR, ADS-B, AIS, V2X.

Such a sensor has no lists. Its reports are linked by object, by the reported identities
or by their distance. The period of an object is then the time between its reports.
"""

import math
from dataclasses import dataclass, field

import numpy as np

from fgtrack.core.geometry import wrap_angles
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.meaning.scatter import MAD, Trend, line_errors, sight_errors

__all__ = ["NO_ID", "SingleReports", "links_of_ids", "single_reports"]

NO_ID = -1
"""Number of a report without an identity."""
#: Reports of the beginning that are evaluated.
_MOST_REPORTS = 20_000
#: Fewest links and triples for an estimate, and fewest triples for a trend with range.
_FEWEST = 20
_FEWEST_FOR_TREND = 100
#: Share of reports with an identity from which reports are linked by it.
_IDENTIFIED = 0.5
#: Highest speed of an object, and largest difference of the errors of two reports.
_FASTEST_MPS = 400.0
_LARGEST_ERROR_M = 1_000.0
#: Share of the links of equal identities that an object can travel, if identities are informative.
_POSSIBLE = 0.95
#: Reports of an object in quicker succession, in periods, are copies through several receivers.
_COPY = 0.3
#: A link without an identity takes from 0.5 to 1.5 periods; a triple with a longer gap than 2.5 periods is not used.
_LINK_PERIODS = (0.5, 1.5)
_LONGEST_PERIODS = 2.5
#: Quantile of the times between the reports of an object that counts as its longest usual silence.
_SILENCE = 0.9
#: Ratio of the scatters at far and near ranges from which the scatter grows with the range.
_GROWING = 1.25
#: Smallest scatter at far ranges from which a growth is estimated.
_LEAST_GROWN_M = 1.0
#: A heading is compared where the object moves by this multiple of the scatter.
_CLEAR = 5.0
#: Reported headings and speeds with larger errors, in rad and as a share of the speed, are no measurements.
_LARGEST_YAW_RAD = 0.5
_LARGEST_SPEED_SHARE = 0.5


@dataclass(frozen=True)
class SingleReports:
    """Objects of a sensor that reports them one by one."""

    period_s: float
    """Median time between successive reports of an object."""
    silence_s: float
    """Time between successive reports of an object that 90 % stay below."""
    speed_mps: float
    """Median speed of the objects between successive reports."""
    num_triples: int
    """Number of triples of successive reports from which the noise is estimated."""
    by_id: bool
    """True if reports are linked by identities."""
    along: Trend
    """Noise of positions along the line of sight from the origin of the positions."""
    across: Trend
    """Noise of positions across the line of sight."""
    std: dict[str, float] = field(default_factory=dict)
    """Standard deviations of `yaw_rad` and `speed_mps` against the motion; missing without a test."""
    uninformative: dict[str, str] = field(default_factory=dict)
    """Components that contradict the motion, with the reason."""


def single_reports(
    times_s: FloatArray,
    points_m: FloatArray,
    sights_m: FloatArray,
    ids: IntArray,
    velocities: FloatArray,
    revisit_s: float | None,
) -> SingleReports | None:
    """Return the estimates from n reports; None if too few reports belong to one object.

    `times_s` (n,) are the stamps. `points_m` (n, 2) are in a frame that is fixed on Earth,
    `sights_m` (n, 2) are the same positions seen from the sensor. `ids` (n,) are numbers of
    identities, or `NO_ID`. `velocities` (n, 2) contain yaw and speed, NaN where missing.
    `revisit_s` is the time between reports in the same area, for reports without identities.
    """
    order = np.argsort(times_s, kind="stable")[:_MOST_REPORTS]
    times_s, points_m, sights_m = times_s[order], points_m[order], sights_m[order]
    ids, velocities = ids[order], velocities[order]
    firsts, seconds = links_of_ids(times_s, points_m, ids)
    by_id = len(firsts) >= _FEWEST
    if not by_id and revisit_s is not None:
        firsts, seconds = _nearest_links(times_s, points_m, revisit_s)
    if len(firsts) < _FEWEST:
        return None
    elapsed_s = times_s[seconds] - times_s[firsts]
    period_s = float(np.median(elapsed_s))
    distances_m = np.hypot(*(points_m[seconds] - points_m[firsts]).T)
    triples = _triples(firsts, seconds, len(times_s))
    lasting_s = np.maximum(*np.diff(times_s[triples], axis=1).T)
    triples = triples[lasting_s <= _LONGEST_PERIODS * period_s]
    if len(triples) < _FEWEST:
        return None
    along, across = _noise(times_s[triples], points_m[triples], sights_m[triples])
    result = SingleReports(
        period_s,
        float(np.quantile(elapsed_s, _SILENCE)),
        float(np.median(distances_m / elapsed_s)),
        len(triples),
        by_id,
        along,
        across,
    )
    _compare_velocities(
        result, times_s[triples], points_m[triples], velocities[triples[:, 1]]
    )
    return result


def links_of_ids(
    times_s: FloatArray, points_m: FloatArray, ids: IntArray
) -> tuple[IntArray, IntArray]:
    """Return the indices of successive reports of each identity, (m,) each; empty if identities do not inform.

    `times_s` (n,) ascend, `points_m` are (n, 2), and `ids` (n,) are numbers, or `NO_ID`.
    Equal identities inform if nearly all objects could travel from each report to the next.
    Copies of a report are left out.
    """
    nothing = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    known = np.flatnonzero(ids != NO_ID)
    if len(known) < max(_IDENTIFIED * len(ids), 1):
        return nothing
    firsts, seconds = _successive(ids, known)
    elapsed_s = times_s[seconds] - times_s[firsts]
    if not len(elapsed_s) or not (elapsed_s > 0.0).any():
        return nothing
    shortest_s = _COPY * float(np.median(elapsed_s[elapsed_s > 0.0]))
    is_copy = np.zeros(len(ids), dtype=bool)
    is_copy[seconds[elapsed_s < shortest_s]] = True
    firsts, seconds = _successive(ids, known[~is_copy[known]])
    elapsed_s = times_s[seconds] - times_s[firsts]
    distances_m = np.hypot(*(points_m[seconds] - points_m[firsts]).T)
    possible = distances_m <= _FASTEST_MPS * elapsed_s + _LARGEST_ERROR_M
    usable = possible & (elapsed_s > 0.0)
    if not len(possible) or possible.mean() < _POSSIBLE:
        return nothing
    return firsts[usable], seconds[usable]


def _successive(ids: IntArray, rows: IntArray) -> tuple[IntArray, IntArray]:
    """Return the indices of each report and of the next one with its identity; `rows` ascend in time."""
    grouped = rows[np.argsort(ids[rows], kind="stable")]
    same = ids[grouped[1:]] == ids[grouped[:-1]]
    return grouped[:-1][same], grouped[1:][same]


def _nearest_links(
    times_s: FloatArray, points_m: FloatArray, period_s: float
) -> tuple[IntArray, IntArray]:
    """Return the indices of reports that are mutual nearest neighbours a period apart, (m,) each."""
    shortest_s, longest_s = (factor * period_s for factor in _LINK_PERIODS)
    begins = np.searchsorted(times_s, times_s + shortest_s)
    ends = np.searchsorted(times_s, times_s + longest_s)
    nearest = np.full(len(times_s), -1)
    best_m = np.full(len(times_s), math.inf)
    back = np.full(len(times_s), -1)
    for row, (begin, end) in enumerate(
        zip(begins.tolist(), ends.tolist(), strict=True)
    ):
        if begin == end:
            continue
        distances_m = np.hypot(*(points_m[begin:end] - points_m[row]).T)
        at = int(np.argmin(distances_m))
        limit_m = _FASTEST_MPS * longest_s + _LARGEST_ERROR_M
        if distances_m[at] > limit_m:
            continue
        nearest[row] = begin + at
        if distances_m[at] < best_m[begin + at]:
            best_m[begin + at] = distances_m[at]
            back[begin + at] = row
    rows = np.flatnonzero(nearest >= 0)
    mutual = rows[back[nearest[rows]] == rows]
    return mutual, nearest[mutual]


def _triples(firsts: IntArray, seconds: IntArray, n: int) -> IntArray:
    """Return the indices of three successive reports of an object, shape (m, 3)."""
    following = np.full(n, -1)
    following[firsts] = seconds
    thirds = following[seconds]
    return np.column_stack([firsts, seconds, thirds])[thirds >= 0]


def _noise(
    times_s: FloatArray, points_m: FloatArray, sights_m: FloatArray
) -> tuple[Trend, Trend]:
    """Return the noise along and across the line of sight, by the distances of triples from straight lines.

    Shapes (m, 3), (m, 3, 2) and (m, 3, 2). The median ignores objects that turn.
    """
    rest_m = line_errors(times_s, points_m)
    along_m, across_m, ranges_m = sight_errors(rest_m, sights_m[:, 1])
    return _trend(along_m, ranges_m), _trend(across_m, ranges_m)


def _trend(rest_m: FloatArray, ranges_m: FloatArray) -> Trend:
    """Return the standard deviation of `rest_m` (m,), with its growth if the far half scatters more than the near."""
    std_m = _std(rest_m)
    if len(rest_m) < _FEWEST_FOR_TREND:
        return Trend(std_m)
    is_far = ranges_m > np.median(ranges_m)
    near_m, far_m = _std(rest_m[~is_far]), _std(rest_m[is_far])
    if far_m <= max(_GROWING * near_m, _LEAST_GROWN_M):
        return Trend(std_m)
    near2, far2 = (
        float(np.median(np.square(ranges_m[each]))) for each in (~is_far, is_far)
    )
    growth = math.sqrt((far_m**2 - near_m**2) / (far2 - near2))
    # The noise at short range cannot be negative; then all of it grows.
    rest2 = near_m**2 - growth**2 * near2
    if rest2 <= 0.0:
        return Trend(0.0, _std(rest_m / np.maximum(ranges_m, 1e-9)))
    return Trend(math.sqrt(rest2), growth)


def _std(values: FloatArray) -> float:
    return float(np.median(np.abs(values))) / MAD


def _compare_velocities(
    result: SingleReports,
    times_s: FloatArray,
    points_m: FloatArray,
    velocities: FloatArray,
) -> None:
    """Add the errors of reported headings and speeds (m, 2) to `result`, against the motion over each triple."""
    span_s = times_s[:, 2] - times_s[:, 0]
    moved_m = points_m[:, 2] - points_m[:, 0]
    distances_m = np.hypot(*moved_m.T)
    clear_m = _CLEAR * max(result.along.std, result.across.std, 0.2)
    yaw_rad = velocities[:, 0]
    turned = np.isfinite(yaw_rad) & (distances_m > clear_m)
    if turned.sum() >= _FEWEST:
        course_rad = np.arctan2(moved_m[:, 1], moved_m[:, 0])
        off_rad = np.abs(wrap_angles(yaw_rad[turned] - course_rad[turned]))
        std_rad = float(np.median(off_rad)) / MAD
        if std_rad > _LARGEST_YAW_RAD:
            result.uninformative["yaw_rad"] = (
                f"it differs by {float(np.median(off_rad)):.2g} rad from the direction of travel"
            )
        else:
            result.std["yaw_rad"] = std_rad
    speed_mps = velocities[:, 1]
    known: BoolArray = np.isfinite(speed_mps)
    if known.sum() >= _FEWEST:
        travelled_mps = distances_m[known] / span_s[known]
        std_mps = _std(speed_mps[known] - travelled_mps)
        typical_mps = max(float(np.median(travelled_mps)), 1.0)
        if std_mps > _LARGEST_SPEED_SHARE * typical_mps:
            result.uninformative["speed_mps"] = (
                f"it differs by {std_mps:.2g} m/s from the distance travelled per second"
            )
        else:
            result.std["speed_mps"] = std_mps
