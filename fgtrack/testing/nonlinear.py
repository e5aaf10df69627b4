"""What an estimator gives in a mildly nonlinear model, against a plain calculation."""

from fgtrack.core.time import NS_PER_S, nanoseconds
from fgtrack.testing.promise import Subject, require
from fgtrack.testing.references import difference, kalman_filter, least_squares
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
    for at_ns in (newest_ns,) if claims.held_s else (newest_ns, newest_ns + NS_PER_S // 10):
        if claims.smooths:
            expected = least_squares(motion, stream.start, stream.measurements, [at_ns])[at_ns]
        else:
            expected = kalman_filter(motion, stream.start, stream.measurements, at_ns)
        off, covariance = difference(estimator.state_at(at_ns), expected, motion)
        require(
            off < _NEAR_SIGMA and covariance < _NEAR_COVARIANCE,
            f"the state at {at_ns} differs from that of a plain calculation by {off:.1e} standard deviations in "
            f"the mean and {covariance:.1e} in the covariance ({_NEAR_SIGMA}, {_NEAR_COVARIANCE} allowed)",
        )
