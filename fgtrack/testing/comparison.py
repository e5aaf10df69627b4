"""Comparison of the states of an estimator with a reference, within a tolerance."""

from collections.abc import Hashable, Iterable
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import pairwise
from typing import Any

from fgtrack.core.types import TrackState
from fgtrack.estimation.base import Estimator, UpdateStatus
from fgtrack.estimation.registry import Claims
from fgtrack.testing.promise import Subject, require
from fgtrack.testing.references import (
    dense_joint,
    difference,
    kalman_filter,
    rounding_bound,
)
from fgtrack.testing.streams import MS, Stream

FUSED = (
    UpdateStatus.IN_SEQUENCE,
    UpdateStatus.OUT_OF_SEQUENCE,
    UpdateStatus.BEYOND_WINDOW,
)
#: Tolerances in standard deviations: of estimates that were iterated, and of two orders of arrival.
CONVERGED, ORDER = 1e-5, 1e-9


def close(
    found: TrackState,
    expected: TrackState,
    tolerance: float,
    stream: Stream,
    what: str,
    of_covariance: float = 0.0,
) -> None:
    """Require that two states agree in mean and covariance within `tolerance`.

    `of_covariance` is the tolerance of the covariance; 0 for the same `tolerance`.
    """
    mean_sigma, covariance = difference(found, expected, stream.motion)
    at_s = (found.stamp_ns - stream.start.stamp_ns) / 1e9
    require(
        mean_sigma < tolerance and covariance < (of_covariance or tolerance),
        f"the state at {at_s:.9f} s differs from {what} by {mean_sigma:.1e} standard deviations in the mean and "
        f"{covariance:.1e} in the covariance (tolerance {tolerance:.1e})",
    )


@dataclass(frozen=True)
class _Problem:
    """Input of a reference. Equal problems have the same result, which is calculated once."""

    content: Hashable
    claims: Claims
    stamps_ns: tuple[int, ...]
    stream: Stream = field(compare=False)


def _joint(
    subject: Subject, stream: Stream, stamps_ns: Iterable[int]
) -> dict[int, TrackState]:
    """Reference states at `stamps_ns`, by stamp.

    The reference is the joint posterior in a linear model and for estimators that converge. Else it is the state of a
    Kalman filter. The reference of a filter uses the measurements up to each stamp.
    """
    claims = Claims(
        smooths=subject.claims.smooths,
        nonlinear=subject.claims.nonlinear,
        iterates=subject.claims.iterates,
    )
    return _calculated(_Problem(stream.content, claims, tuple(stamps_ns), stream))


@lru_cache(maxsize=64)
def _calculated(problem: _Problem) -> dict[int, TrackState]:
    """See `_joint`."""
    stream, claims, stamps_ns = problem.stream, problem.claims, problem.stamps_ns
    if not stream.motion.linear and claims.nonlinear != "at convergence":
        return kalman_filter(
            stream.motion,
            stream.start,
            stream.measurements,
            stamps_ns,
            iterated=claims.iterates,
        )
    if claims.smooths:
        return dense_joint(stream.motion, stream.start, stream.measurements, stamps_ns)
    states = dict[int, TrackState]()
    for at_ns in stamps_ns:
        known = [m for m in stream.measurements if m.stamp_ns <= at_ns]
        states |= dense_joint(stream.motion, stream.start, known, [at_ns])
    return states


def close_to_joint(
    subject: Subject,
    stream: Stream,
    estimator: Estimator,
    stamps_ns: Iterable[int],
    what: str,
    tolerance: float,
    of_covariance: float = 0.0,
) -> None:
    """Require that the states at `stamps_ns` agree with the reference of `_joint`, see `close`."""
    for at_ns, expected in _joint(subject, stream, stamps_ns).items():
        close(
            estimator.state_at(at_ns), expected, tolerance, stream, what, of_covariance
        )


def tolerance_of(subject: Subject, stream: Stream) -> float:
    """Return the tolerance of an exact estimator for a stream, larger where stamps nearly coincide."""
    return max(
        subject.claims.tolerance,
        subject.claims.rounding * rounding_bound(stream.motion, stream.stamps_ns),
    )


def probes_ns(stream: Stream, oldest_ns: int = 0) -> list[int]:
    """Return stamps for a comparison, from `oldest_ns` on: all stamps, the middles between them, and a later stamp."""
    stamps = stream.stamps_ns
    middles = [(a + b) // 2 for a, b in pairwise(stamps) if b - a >= MS]
    return [
        at_ns
        for at_ns in (*stamps, *middles, stamps[-1] + 100 * MS)
        if at_ns >= oldest_ns
    ]


def bits(estimator: Estimator, stamps_ns: list[int]) -> list[bytes]:
    """Return the states at `stamps_ns` as bytes, so that equal bytes are equal bits."""
    states = [estimator.state_at(stamp_ns) for stamp_ns in stamps_ns]
    return [state.mean.tobytes() + state.covariance.tobytes() for state in states]


def converged(
    subject: Subject, *estimators: Any
) -> bool:  # Any: the claim promises `converge`
    """Call `converge` of `estimators` if their claims need it. Return True if it was called."""
    needed = subject.claims.nonlinear == "at convergence"
    for estimator in estimators if needed else ():
        getattr(estimator, "bank", estimator).converge()
    return needed
