"""Promises about the states and the innovations of an estimator.

The name of each function is the rest of a sentence that begins with the estimator.
"""

from dataclasses import replace

import numpy as np

from fgtrack.core.time import nanoseconds
from fgtrack.estimation.base import Measurement
from fgtrack.testing.comparison import (
    CONVERGED,
    FUSED,
    ORDER,
    close,
    close_to_joint,
    converged,
    probes_ns,
    tolerance_of,
)
from fgtrack.testing.promise import Subject, WrongError, require
from fgtrack.testing.references import dense_joint, innovation, predicted
from fgtrack.testing.streams import LAG_S, MS, Stream

_FILTERED = 1e-7
#: Repeated reweighting under a robust loss stops at small steps, but converges slowly.
_REWEIGHTED = 1e-2
#: Averages over the spread of a state differ by less from the values at its mean: of the mean in standard deviations,
#: of the covariance relative to these.
_NEAR_SIGMA, _NEAR_COVARIANCE = 1.0, 0.05


def is_the_kalman_filter_in_sequence(subject: Subject, stream: Stream) -> None:
    """Require the status `in_sequence` and the state of a Kalman filter, for measurements in order."""
    estimator, results = subject.fed(stream)
    statuses = [result.status.value for result in results]
    require(statuses == ["in_sequence"] * len(results), f"statuses are {statuses}")
    at_ns = stream.newest_ns - round(subject.claims.held_s * 1e9)
    close_to_joint(
        subject,
        stream,
        estimator,
        [at_ns],
        "the Kalman filter's",
        max(1e-9, subject.claims.tolerance),
    )


def gives_the_dense_joint_posterior_in_any_order(
    subject: Subject, stream: Stream
) -> None:
    """Require that all measurements inside the window are fused, and that the states are exact."""
    estimator, results = subject.fed(stream)
    refused = [k for k, result in enumerate(results) if result.status not in FUSED]
    require(
        not refused,
        f"of the measurements inside the window the one at index {refused[:1]} is not fused",
    )
    tolerance = tolerance_of(subject, stream)
    close_to_joint(
        subject,
        stream,
        estimator,
        probes_ns(stream),
        "the dense joint posterior",
        tolerance,
    )


def keeps_all_that_it_accepts_and_nothing_else(
    subject: Subject, stream: Stream
) -> None:
    """Require that measurements inside the window are fused, and that the states depend on these measurements alone.

    The clock runs ahead of the stamps, and the window is shorter than the stream.
    """
    estimator, accepted, newest_ns = (
        subject.start(stream),
        list[Measurement](),
        stream.start.stamp_ns,
    )
    for place, measurement in enumerate(stream.measurements):
        oldest_ns = estimator.window_ns[0]
        status = estimator.update(measurement).status
        inside = measurement.stamp_ns >= oldest_ns
        require(
            (status in FUSED) == inside,
            f"index {place}: {status}, the window begins at {oldest_ns}",
        )
        if inside:
            accepted.append(measurement)
            newest_ns = max(newest_ns, measurement.stamp_ns)
        estimator.advance(newest_ns + round(0.3e9 * LAG_S))
    known, oldest_ns = (
        replace(stream, measurements=tuple(accepted)),
        estimator.window_ns[0],
    )
    probes = (
        [oldest_ns, *probes_ns(known, oldest_ns)]
        if subject.claims.smooths
        else [newest_ns, newest_ns + 100 * MS]
    )
    close_to_joint(
        subject,
        known,
        estimator,
        probes,
        "that of these",
        tolerance_of(subject, stream),
    )


def gives_the_estimate_of_the_time_order_in_any_order(
    subject: Subject, stream: Stream
) -> None:
    """Require the same states for two orders of arrival: the order of the stream, and the order of the stamps.

    In the second order, measurements with equal stamps are reversed, because their order must not matter either.
    """
    ordered = tuple(sorted(stream.measurements, key=lambda item: -item.stamp_ns)[::-1])
    result, expected = (
        subject.fed(each)[0] for each in (stream, replace(stream, measurements=ordered))
    )
    tolerance = CONVERGED if converged(subject, result, expected) else ORDER
    for at_ns in (stream.start.stamp_ns, stream.newest_ns, stream.newest_ns + 100 * MS):
        close(
            result.state_at(at_ns),
            expected.state_at(at_ns),
            tolerance,
            stream,
            "that of the time order",
        )


def fuses_a_late_measurement_exactly(subject: Subject, stream: Stream) -> None:
    """Require that the last measurement of the stream, which is late, is fused exactly."""
    estimator, results = subject.fed(stream)
    require(
        results[-1].status in FUSED, f"the last measurement is {results[-1].status}"
    )
    close_to_joint(
        subject,
        stream,
        estimator,
        [stream.newest_ns],
        "the dense joint posterior",
        1e-9,
    )


def reports_the_innovation_against_all_that_it_has_fused(
    subject: Subject, stream: Stream
) -> None:
    """Require the innovation and the NIS that the state before the measurement predicts.

    A late measurement is checked for smoothers. In a linear model it is also checked for
    estimators that retrodict. In a nonlinear model, estimators with sigma points are not
    checked.
    """
    estimator, claims = subject.start(stream), subject.claims
    fused: list[Measurement] = []
    for measurement in stream.measurements:
        at_ns, newest_ns = measurement.stamp_ns, estimator.window_ns[1]
        if stream.motion.linear:
            before = dense_joint(stream.motion, stream.start, fused, [at_ns])[at_ns]
        else:
            before = estimator.state_at(at_ns)
        result = estimator.update(measurement)
        fused.append(measurement)
        known = claims.smooths or at_ns > newest_ns
        if not (
            known or claims.retrodicts
            if stream.motion.linear
            else known and not claims.spreads
        ):
            continue
        said = f"the innovation at {at_ns} is {result.innovation}, its NIS {result.nis}"
        if result.innovation is None or result.nis is None:
            raise WrongError(said)
        y, H = innovation(stream.motion, measurement, before.mean)
        S = H @ before.covariance @ H.T + measurement.R
        nis = float(y @ np.linalg.solve(S, y))
        off = float((np.abs(result.innovation - y) / np.sqrt(np.diag(S))).max())
        nis_off = abs(result.nis - nis) / (1.0 + nis)
        tolerance = tolerance_of(subject, stream) if stream.motion.linear else 1e-6
        require(
            off < tolerance,
            f"{said}: {off:.1e} standard deviations from that of the state before",
        )
        require(
            nis_off < max(tolerance, 1e-8), f"{said}: off by {nis_off:.1e} of 1 + NIS"
        )


def predicts_ahead_by_the_motion_model(subject: Subject, stream: Stream) -> None:
    """Require that a state after the newest stamp is the prediction of the newest state."""
    estimator, _ = subject.fed(stream)
    now, ahead = (
        estimator.state_at(stream.newest_ns),
        estimator.state_at(stream.newest_ns + 200 * MS),
    )
    expected = predicted(stream.motion, now, ahead.stamp_ns)
    averaged = subject.claims.spreads and not stream.motion.linear
    close(
        ahead,
        expected,
        0.3 if averaged else 1e-6,
        stream,
        "the prediction of the newest one",
    )


def gives_the_posterior_of_a_nonlinear_model(subject: Subject, stream: Stream) -> None:
    """Compare the states with a plain calculation, for measurements in the order of their stamps.

    The calculation is an extended Kalman filter, an iterated filter, or least squares over all states. It shows errors
    in noise, Jacobians, poses and motion of sensors, angles and losses.
    """
    estimator, claims = subject.fed(stream)[0], subject.claims
    repeats = converged(subject, estimator) or claims.iterates
    tolerance = CONVERGED if repeats else _FILTERED
    if repeats and any(item.loss for item in stream.measurements):
        tolerance = _REWEIGHTED
    newest_ns = max(
        stream.newest_ns - nanoseconds(claims.held_s), stream.start.stamp_ns
    )
    probes = [newest_ns] if claims.held_s else [newest_ns, newest_ns + 100 * MS]
    limits = (
        (_NEAR_SIGMA, _NEAR_COVARIANCE) if claims.spreads else (tolerance, tolerance)
    )
    close_to_joint(
        subject, stream, estimator, probes, "that of a plain calculation", *limits
    )
