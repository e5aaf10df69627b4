"""Smoothers of several objects with one motion model: what each of them does, with the same steps taken at once.

gtsam solves each window on its own; what is NumPy is computed for all of them together, by the same functions.
"""

from collections.abc import Sequence
from contextlib import suppress

import numpy as np

from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement, UpdateResult, UpdateStatus
from fgtrack.estimation.factor_graph.rows import Segment
from fgtrack.estimation.factor_graph.smoother import FixedLagSmoother
from fgtrack.estimation.factor_graph.states import states
from fgtrack.estimation.factor_graph.window_update import Update
from fgtrack.estimation.terms import curved
from fgtrack.estimation.whitening import innovations, whitened

_FAILED = UpdateResult(UpdateStatus.FAILED)


def look_up(smoothers: Sequence[FixedLagSmoother], stamps_ns: Sequence[int]) -> None:
    """Let each of `smoothers` find its state at one of `stamps_ns`, so that `state_at` knows it."""
    asked = [
        (one.window, stamp_ns)
        for one, stamp_ns in zip(smoothers, stamps_ns, strict=True)
        if one.window.known_at(stamp_ns) is None
    ]
    if asked:
        found = states(smoothers[0].motion, [window.around(stamp_ns) for window, stamp_ns in asked])
        for (window, stamp_ns), state in zip(asked, found, strict=True):
            window.know(stamp_ns, state)


def update(smoothers: Sequence[FixedLagSmoother], measurements: Sequence[Measurement]) -> list[UpdateResult]:
    """`FixedLagSmoother.update` of one of `measurements` for each of `smoothers`.

    Raises `DataError`, before anything has changed, for one that is older than its window where that is an error.
    """
    measurements = [item.seen_by(one.motion) for one, item in zip(smoothers, measurements, strict=True)]
    statuses = [one.status_of(item.stamp_ns) for one, item in zip(smoothers, measurements, strict=True)]
    results = [UpdateResult(status) for status in statuses]
    young = [row for row, status in enumerate(statuses) if status is not UpdateStatus.TOO_OLD]
    if not young:
        return results
    smoothers, measurements = [smoothers[row] for row in young], [measurements[row] for row in young]
    look_up(smoothers, [item.stamp_ns for item in measurements])
    prepared: list[tuple[int, FixedLagSmoother, Update]] = []
    for row, (judged, rows) in enumerate(_judged(smoothers, measurements, [statuses[row] for row in young])):
        results[young[row]] = judged
        if judged.innovation is None:
            continue
        try:
            prepared.append((row, smoothers[row], smoothers[row].prepare([measurements[row]], [rows])))
        except RuntimeError:
            results[young[row]] = _FAILED
    with suppress(np.linalg.LinAlgError):  # else each window linearises its own, and the one that cannot fails
        Segment.linearise([each for *_, change in prepared for each in change.factors if isinstance(each, Segment)])
    for row, one, change in prepared:
        try:
            one.solve(change)
        except RuntimeError:
            results[young[row]] = _FAILED
            continue
        one.settle(measurements[row].stamp_ns)
    return results


def _judged(
    smoothers: Sequence[FixedLagSmoother], measurements: Sequence[Measurement], statuses: Sequence[UpdateStatus]
) -> list[tuple[UpdateResult, FloatArray | None]]:
    """What will become of `measurements`, and their rows at the states at their stamps where they are linear."""
    known = [one.window.state_at(item.stamp_ns) for one, item in zip(smoothers, measurements, strict=True)]
    found: list[tuple[UpdateResult, FloatArray | None]] = [(_FAILED, None)] * len(measurements)
    means, covariances = np.array([mean for mean, _ in known]), np.array([covariance for _, covariance in known])
    for group in innovations(measurements, means, covariances):
        group = group.at(np.isfinite(group.nis))
        rows: list[FloatArray] = []
        with suppress(np.linalg.LinAlgError):  # else each window finds its own, and the one that cannot fails
            rows = list(whitened(group.y, group.H, group.R))
        for place, position in enumerate(group.positions.tolist()):
            result = UpdateResult(statuses[position], group.y[place], float(group.nis[place]))
            found[position] = result, rows[place] if rows and not curved(measurements[position]) else None
    return found
