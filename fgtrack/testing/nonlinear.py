"""What an estimator makes of a mildly nonlinear model, against the oracle of `fgtrack verify`."""

from collections.abc import Sequence

import numpy as np

from fgtrack.core.time import NS_PER_S, nanoseconds
from fgtrack.core.types import TrackState
from fgtrack.estimation.base import Measurement
from fgtrack.estimation.dense_joint import difference
from fgtrack.pipeline import verify_streams
from fgtrack.pipeline.oracle.estimates import smoothed
from fgtrack.pipeline.oracle.filters import filtered
from fgtrack.pipeline.oracle.sightings import Eye, Sighting
from fgtrack.testing.promise import Draw, Subject, require
from fgtrack.testing.streams import Stream

#: Good approximations differ by less: of the mean in standard deviations, of the covariance relative to these.
_NEAR_SIGMA, _NEAR_COVARIANCE = 1.0, 0.15


def comes_near_the_posterior_of_a_nonlinear_model(subject: Subject, stream: Stream) -> None:
    """In the order of the stamps: the extended Kalman filter, or least squares over all states.

    Noise, Jacobians, the pose and motion of sensors, angles and losses all count there.
    """
    estimator, _ = subject.fed(stream)
    claims, motion = subject.claims, stream.motion
    if claims.nonlinear == "at convergence":
        estimator.converge()  # type: ignore[attr-defined]  # the claim says that it has it
    newest_ns = max(stream.newest_ns - nanoseconds(claims.held_s), stream.start.stamp_ns)
    known = [measurement for measurement in stream.measurements if measurement.stamp_ns <= newest_ns or claims.smooths]
    problem = verify_streams.problem_of(motion, stream.start, _sightings(known))
    expected = smoothed(problem).state_at if claims.smooths else filtered(problem).state_at
    for at_ns in (newest_ns,) if claims.held_s else (newest_ns, newest_ns + NS_PER_S // 10):
        off, covariance = difference(estimator.state_at(at_ns), TrackState(at_ns, *expected(at_ns)), motion)
        require(
            off < _NEAR_SIGMA and covariance < _NEAR_COVARIANCE,
            f"the state at {at_ns} differs from that of an independent calculation by {off:.1e} standard deviations in "
            f"the mean and {covariance:.1e} in the covariance ({_NEAR_SIGMA}, {_NEAR_COVARIANCE} allowed)",
        )


def _sightings(measurements: Sequence[Measurement]) -> list[Sighting]:
    """`measurements` in the words of the oracle."""
    found = []
    for one in measurements:
        loss = None if one.loss is None else (one.loss.kind, one.loss.width)
        found.append(Sighting(one.stamp_ns, one.model.components, one.z, one.R, Eye(*one.pose), loss))
    return found


def mild_draws() -> tuple[Draw, ...]:
    """Range, bearing, Doppler and yaw from a turning vehicle; outliers under a loss."""
    return _mild, _mild_robust


def _mild(rng: np.random.Generator) -> Stream:
    return _in_order(verify_streams.mild(rng))


def _mild_robust(rng: np.random.Generator) -> Stream:
    return _in_order(verify_streams.mild_robust(rng))


def _in_order(stream: verify_streams.Stream) -> Stream:
    return Stream(stream.motion, stream.measurements, stream.prior)
