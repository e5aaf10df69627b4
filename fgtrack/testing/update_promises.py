"""Promises about the results of an update, the window, and inputs that cannot be fused.

The name of each function is the rest of a sentence that begins with the estimator.
"""

from dataclasses import replace

import numpy as np

from fgtrack.core.time import nanoseconds
from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Estimator, Measurement, UpdateStatus
from fgtrack.estimation.smoothing.terms import NEAR_NS
from fgtrack.testing.comparison import FUSED, ORDER, bits, close, probes_ns
from fgtrack.testing.promise import Subject, require, sound
from fgtrack.testing.streams import LAG_S, MS, Stream, measured

_LATE = (UpdateStatus.OUT_OF_SEQUENCE, UpdateStatus.BEYOND_WINDOW)


def counts_each_measurement_as_what_it_is(subject: Subject, stream: Stream) -> None:
    """Require a finite innovation and NIS; a reported innovation covariance must agree with the NIS.

    Every measurement has the same latency: none, one below the lag, and one above the lag. The latency alone makes no
    measurement out of sequence.
    """
    for latency_s in (0.0, 0.4 * LAG_S, 1.6 * LAG_S):
        _counts_right_with(subject, stream, nanoseconds(latency_s))


def _counts_right_with(subject: Subject, stream: Stream, latency_ns: int) -> None:
    """Require the expected status of each measurement of a stream with this latency."""
    estimator, newest_ns = subject.start(stream), stream.start.stamp_ns
    for place, measurement in enumerate(stream.measurements):
        stamp_ns, what = (
            measurement.stamp_ns,
            f"index {place} with a latency of {latency_ns} ns",
        )
        if latency_ns:
            estimator.advance(max(stamp_ns, newest_ns) + latency_ns)
        may_be_too_old = (
            stamp_ns < estimator.window_ns[0]
            or 0 < nanoseconds(subject.claims.held_s) < latency_ns
        )
        result, late = estimator.update(measurement), stamp_ns < newest_ns
        allowed = (
            [*_LATE, UpdateStatus.TOO_OLD, UpdateStatus.FAILED]
            if late
            else [UpdateStatus.IN_SEQUENCE]
        )
        allowed += [UpdateStatus.TOO_OLD] * may_be_too_old
        require(
            result.status in allowed,
            f"{what}: {'late' if late else 'in sequence'}, is {result.status}",
        )
        y, S, nis = result.innovation, result.innovation_covariance, result.nis
        complete = (result.status in FUSED) == (y is not None) == (nis is not None)
        require(complete, f"{what}: {result.status}, innovation {y}, NIS {nis}")
        if y is not None and nis is not None:
            right = (
                y.shape == measurement.z.shape
                and np.isfinite(y).all()
                and 0.0 <= nis < np.inf
            )
            require(right, f"{what}: the innovation is {y}, the NIS {nis}")
            if S is not None:
                sound(y, (S + S.T) / 2.0, f"the innovation at {what}")
                own = measurement.nis(y, S)
                right = np.allclose(S, S.T, 1e-9) and abs(own - nis) <= 1e-6 * (
                    1.0 + own
                )
                require(
                    right, f"{what}: the NIS is {nis}, not {own} by the covariance\n{S}"
                )
            newest_ns = max(newest_ns, stamp_ns)
    end_ns = estimator.window_ns[1]
    require(
        0 <= newest_ns - end_ns <= NEAR_NS,
        f"window_ns ends at {end_ns}, newest is {newest_ns}",
    )


def gives_symmetric_positive_definite_covariances(
    subject: Subject, stream: Stream
) -> None:
    """Require finite states with valid covariances, at the requested stamps."""
    estimator, _ = subject.fed(stream)
    for at_ns in probes_ns(stream, estimator.window_ns[0]):
        state = estimator.state_at(at_ns)
        require(
            state.stamp_ns == at_ns,
            f"state_at({at_ns}) gives a state at {state.stamp_ns}",
        )
        sound(state.mean, state.covariance, f"the state at {at_ns}")


def gives_the_same_bits_for_the_same_input(subject: Subject, stream: Stream) -> None:
    """Require equal bits of results and states if a stream is fused twice."""
    (first, said), (again, repeated) = subject.fed(stream), subject.fed(stream)
    require(repr(said) == repr(repeated), "results of update differ")
    probes = probes_ns(stream, first.window_ns[0])
    require(bits(first, probes) == bits(again, probes), "states differ")


def changes_no_input_and_no_output_later(subject: Subject, stream: Stream) -> None:
    """Require that measurements, and states that were returned, stay as they are."""
    copies = [replace(m, z=m.z.copy(), R=m.R.copy()) for m in stream.measurements]
    estimator = subject.start(stream)
    given: list[tuple[FloatArray, FloatArray]] = []
    for measurement in copies:
        result = estimator.update(measurement)
        state = estimator.state_at(max(measurement.stamp_ns, estimator.window_ns[0]))
        outputs = [state.mean, state.covariance] + (
            [] if result.innovation is None else [result.innovation]
        )
        given += [(output, output.copy()) for output in outputs]
    for copy, measurement in zip(copies, stream.measurements, strict=True):
        same = (copy.z == measurement.z).all() and (copy.R == measurement.R).all()
        require(same, f"z or R of the measurement at {measurement.stamp_ns} is changed")
    require(
        all((now == then).all() for now, then in given),
        "a state or innovation that was given changes later",
    )


def _unchanged(
    estimator: Estimator,
    newest_ns: int,
    measurement: Measurement,
    allowed: tuple[UpdateStatus, ...],
    what: str,
) -> None:
    """Require that an update has one of the `allowed` statuses and changes neither states nor the window."""
    probes = [newest_ns, newest_ns + 200 * MS]
    before, window_ns = bits(estimator, probes), estimator.window_ns
    result = estimator.update(measurement)
    require(result.status in allowed, f"{what} is {result.status}")
    require(
        result.nis is None and result.innovation is None, f"{what} has an innovation"
    )
    require(bits(estimator, probes) == before, f"{what} changes the state")
    require(estimator.window_ns == window_ns, f"{what} moves the window")


def reports_what_is_too_old_and_stays_as_it_was(
    subject: Subject, stream: Stream
) -> None:
    """Require the status `too_old` before the window, and no change of the estimator."""
    estimator, _ = subject.fed(stream)
    estimator.advance(stream.newest_ns + round(0.5e9 * LAG_S))
    rng = np.random.default_rng(0)
    for offset_ns in (-1, estimator.window_ns[0] - 1 - stream.start.stamp_ns):
        old, what = (
            measured(rng, stream.motion, offset_ns),
            f"a stamp before {estimator.window_ns[0]}",
        )
        _unchanged(estimator, stream.newest_ns, old, (UpdateStatus.TOO_OLD,), what)


def stays_as_it_was_after_a_failure_and_fuses_the_next(
    subject: Subject, stream: Stream
) -> None:
    """Require that a measurement of NaN changes nothing.

    A valid measurement afterwards must be fused in sequence.
    """
    estimator, _ = subject.fed(stream)
    rng, newest_ns = np.random.default_rng(1), stream.newest_ns
    for offset_ns in (-20 * MS, 0, 30 * MS):
        good = measured(
            rng, stream.motion, newest_ns - stream.start.stamp_ns + offset_ns
        )
        allowed = (
            (UpdateStatus.FAILED, UpdateStatus.TOO_OLD)
            if offset_ns < 0
            else (UpdateStatus.FAILED,)
        )
        for broken in (
            replace(good, z=good.z * np.nan),
            replace(good, R=good.R * np.nan),
        ):
            _unchanged(
                estimator,
                newest_ns,
                broken,
                allowed,
                "a measurement that is not a number",
            )
    status = estimator.update(good).status
    require(
        status is UpdateStatus.IN_SEQUENCE,
        f"after the failure a good measurement is {status}",
    )


def moves_only_the_window_with_the_clock(subject: Subject, stream: Stream) -> None:
    """Require that `advance` moves the window forwards, and changes neither states nor the newest stamp."""
    estimator, _ = subject.fed(stream)
    newest_ns = stream.newest_ns
    probes = [newest_ns, newest_ns + 100 * MS]
    before, oldest_ns = (
        [estimator.state_at(at_ns) for at_ns in probes],
        estimator.window_ns[0],
    )
    estimator.advance(newest_ns + 300 * MS)
    moved = estimator.window_ns
    require(moved[1] == newest_ns, f"the clock moves the newest stamp to {moved[1]}")
    require(moved[0] >= oldest_ns, f"the clock moves the window back to {moved[0]}")
    estimator.advance(newest_ns)
    require(estimator.window_ns == moved, "a clock that goes back moves the window")
    if not subject.claims.held_s:
        for state, at_ns in zip(before, probes, strict=True):
            close(
                estimator.state_at(at_ns),
                state,
                ORDER,
                stream,
                "that before the clock moved",
            )
    estimator.advance(newest_ns + 20 * round(LAG_S * 1e9))
    require(
        estimator.window_ns[0] > newest_ns, "the window does not leave the past behind"
    )
