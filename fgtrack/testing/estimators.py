"""Promises of every estimator, in any order of arrival."""

from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from itertools import pairwise
from typing import Any

import numpy as np

from fgtrack.core.time import nanoseconds
from fgtrack.core.types import FloatArray, TrackState
from fgtrack.estimation.base import Estimator, Measurement, UpdateStatus
from fgtrack.estimation.registry import ESTIMATORS, EXACT, Claims, Factory
from fgtrack.estimation.smoothing.terms import NEAR_NS
from fgtrack.models.motion import MotionModel
from fgtrack.testing.banks import gives_each_of_several_objects_what_it_gives_one_alone
from fgtrack.testing.promise import (
    Draw,
    Promise,
    Subject,
    WrongError,
    require,
    run_all,
    sound,
)
from fgtrack.testing.references import (
    dense_joint,
    difference,
    innovation,
    kalman_filter,
    predicted,
    rounding_bound,
)
from fgtrack.testing.streams import (
    LAG_S,
    LINEAR,
    MS,
    NONLINEAR,
    Stream,
    informative,
    measured,
    one_late,
    regular,
    shuffled,
    with_outliers,
)

FUSED = (
    UpdateStatus.IN_SEQUENCE,
    UpdateStatus.OUT_OF_SEQUENCE,
    UpdateStatus.BEYOND_WINDOW,
)
_LATE = (UpdateStatus.OUT_OF_SEQUENCE, UpdateStatus.BEYOND_WINDOW)
_FIRST_LATE, _ONE_LAG = (
    "any lag, first late measurement",
    "one lag, first late measurement",
)
_CONVERGED, _ORDER, _FILTERED = 1e-5, 1e-9, 1e-7
#: Repeated reweighting under a robust loss stops at small steps, but converges slowly.
_REWEIGHTED = 1e-2
#: Averages over the spread of a state differ by less from the values at its mean: of the mean in standard deviations,
#: of the covariance relative to these.
_NEAR_SIGMA, _NEAR_COVARIANCE = 1.0, 0.05


def _close(
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


def _close_to_joint(
    subject: Subject,
    stream: Stream,
    estimator: Estimator,
    stamps_ns: Iterable[int],
    what: str,
    tolerance: float,
    of_covariance: float = 0.0,
) -> None:
    for at_ns, expected in _joint(subject, stream, stamps_ns).items():
        _close(
            estimator.state_at(at_ns), expected, tolerance, stream, what, of_covariance
        )


def _tolerance(subject: Subject, stream: Stream) -> float:
    return max(
        subject.claims.tolerance,
        subject.claims.rounding * rounding_bound(stream.motion, stream.stamps_ns),
    )


def _probes_ns(stream: Stream, oldest_ns: int = 0) -> list[int]:
    """Return stamps for a comparison, from `oldest_ns` on: all stamps, the middles between them, and a later stamp."""
    stamps = stream.stamps_ns
    middles = [(a + b) // 2 for a, b in pairwise(stamps) if b - a >= MS]
    return [
        at_ns
        for at_ns in (*stamps, *middles, stamps[-1] + 100 * MS)
        if at_ns >= oldest_ns
    ]


def _bits(estimator: Estimator, stamps_ns: list[int]) -> list[bytes]:
    states = [estimator.state_at(stamp_ns) for stamp_ns in stamps_ns]
    return [state.mean.tobytes() + state.covariance.tobytes() for state in states]


# --- the promises, each the rest of a sentence that begins with the estimator


def _is_the_kalman_filter_in_sequence(subject: Subject, stream: Stream) -> None:
    estimator, results = subject.fed(stream)
    statuses = [result.status.value for result in results]
    require(statuses == ["in_sequence"] * len(results), f"statuses are {statuses}")
    at_ns = stream.newest_ns - round(subject.claims.held_s * 1e9)
    _close_to_joint(
        subject,
        stream,
        estimator,
        [at_ns],
        "the Kalman filter's",
        max(1e-9, subject.claims.tolerance),
    )


def _gives_the_dense_joint_posterior_in_any_order(
    subject: Subject, stream: Stream
) -> None:
    estimator, results = subject.fed(stream)
    refused = [k for k, result in enumerate(results) if result.status not in FUSED]
    require(
        not refused,
        f"of the measurements inside the window the one at index {refused[:1]} is not fused",
    )
    tolerance = _tolerance(subject, stream)
    _close_to_joint(
        subject,
        stream,
        estimator,
        _probes_ns(stream),
        "the dense joint posterior",
        tolerance,
    )


def _keeps_all_that_it_accepts_and_nothing_else(
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
        [oldest_ns, *_probes_ns(known, oldest_ns)]
        if subject.claims.smooths
        else [newest_ns, newest_ns + 100 * MS]
    )
    _close_to_joint(
        subject, known, estimator, probes, "that of these", _tolerance(subject, stream)
    )


def _gives_the_estimate_of_the_time_order_in_any_order(
    subject: Subject, stream: Stream
) -> None:
    # Those of one stamp the other way round, because their order must not matter either.
    ordered = tuple(sorted(stream.measurements, key=lambda item: -item.stamp_ns)[::-1])
    result, expected = (
        subject.fed(each)[0] for each in (stream, replace(stream, measurements=ordered))
    )
    tolerance = _CONVERGED if _converged(subject, result, expected) else _ORDER
    for at_ns in (stream.start.stamp_ns, stream.newest_ns, stream.newest_ns + 100 * MS):
        _close(
            result.state_at(at_ns),
            expected.state_at(at_ns),
            tolerance,
            stream,
            "that of the time order",
        )


def _fuses_a_late_measurement_exactly(subject: Subject, stream: Stream) -> None:
    estimator, results = subject.fed(stream)
    require(
        results[-1].status in FUSED, f"the last measurement is {results[-1].status}"
    )
    _close_to_joint(
        subject,
        stream,
        estimator,
        [stream.newest_ns],
        "the dense joint posterior",
        1e-9,
    )


def _reports_the_innovation_against_all_that_it_has_fused(
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
        tolerance = _tolerance(subject, stream) if stream.motion.linear else 1e-6
        require(
            off < tolerance,
            f"{said}: {off:.1e} standard deviations from that of the state before",
        )
        require(
            nis_off < max(tolerance, 1e-8), f"{said}: off by {nis_off:.1e} of 1 + NIS"
        )


def _counts_each_measurement_as_what_it_is(subject: Subject, stream: Stream) -> None:
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


def _gives_symmetric_positive_definite_covariances(
    subject: Subject, stream: Stream
) -> None:
    estimator, _ = subject.fed(stream)
    for at_ns in _probes_ns(stream, estimator.window_ns[0]):
        state = estimator.state_at(at_ns)
        require(
            state.stamp_ns == at_ns,
            f"state_at({at_ns}) gives a state at {state.stamp_ns}",
        )
        sound(state.mean, state.covariance, f"the state at {at_ns}")


def _gives_the_same_bits_for_the_same_input(subject: Subject, stream: Stream) -> None:
    (first, said), (again, repeated) = subject.fed(stream), subject.fed(stream)
    require(repr(said) == repr(repeated), "results of update differ")
    probes = _probes_ns(stream, first.window_ns[0])
    require(_bits(first, probes) == _bits(again, probes), "states differ")


def _changes_no_input_and_no_output_later(subject: Subject, stream: Stream) -> None:
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
    before, window_ns = _bits(estimator, probes), estimator.window_ns
    result = estimator.update(measurement)
    require(result.status in allowed, f"{what} is {result.status}")
    require(
        result.nis is None and result.innovation is None, f"{what} has an innovation"
    )
    require(_bits(estimator, probes) == before, f"{what} changes the state")
    require(estimator.window_ns == window_ns, f"{what} moves the window")


def _reports_what_is_too_old_and_stays_as_it_was(
    subject: Subject, stream: Stream
) -> None:
    estimator, _ = subject.fed(stream)
    estimator.advance(stream.newest_ns + round(0.5e9 * LAG_S))
    rng = np.random.default_rng(0)
    for offset_ns in (-1, estimator.window_ns[0] - 1 - stream.start.stamp_ns):
        old, what = (
            measured(rng, stream.motion, offset_ns),
            f"a stamp before {estimator.window_ns[0]}",
        )
        _unchanged(estimator, stream.newest_ns, old, (UpdateStatus.TOO_OLD,), what)


def _stays_as_it_was_after_a_failure_and_fuses_the_next(
    subject: Subject, stream: Stream
) -> None:
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


def _moves_only_the_window_with_the_clock(subject: Subject, stream: Stream) -> None:
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
            _close(
                estimator.state_at(at_ns),
                state,
                _ORDER,
                stream,
                "that before the clock moved",
            )
    estimator.advance(newest_ns + 20 * round(LAG_S * 1e9))
    require(
        estimator.window_ns[0] > newest_ns, "the window does not leave the past behind"
    )


def _predicts_ahead_by_the_motion_model(subject: Subject, stream: Stream) -> None:
    estimator, _ = subject.fed(stream)
    now, ahead = (
        estimator.state_at(stream.newest_ns),
        estimator.state_at(stream.newest_ns + 200 * MS),
    )
    expected = predicted(stream.motion, now, ahead.stamp_ns)
    averaged = subject.claims.spreads and not stream.motion.linear
    _close(
        ahead,
        expected,
        0.3 if averaged else 1e-6,
        stream,
        "the prediction of the newest one",
    )


def _gives_the_posterior_of_a_nonlinear_model(subject: Subject, stream: Stream) -> None:
    """Compare the states with a plain calculation, for measurements in the order of their stamps.

    The calculation is an extended Kalman filter, an iterated filter, or least squares over all states. It shows errors
    in noise, Jacobians, poses and motion of sensors, angles and losses.
    """
    estimator, claims = subject.fed(stream)[0], subject.claims
    repeats = _converged(subject, estimator) or claims.iterates
    tolerance = _CONVERGED if repeats else _FILTERED
    if repeats and any(item.loss for item in stream.measurements):
        tolerance = _REWEIGHTED
    newest_ns = max(
        stream.newest_ns - nanoseconds(claims.held_s), stream.start.stamp_ns
    )
    probes = [newest_ns] if claims.held_s else [newest_ns, newest_ns + 100 * MS]
    limits = (
        (_NEAR_SIGMA, _NEAR_COVARIANCE) if claims.spreads else (tolerance, tolerance)
    )
    _close_to_joint(
        subject, stream, estimator, probes, "that of a plain calculation", *limits
    )


def _converged(
    subject: Subject, *estimators: Any
) -> bool:  # Any: the claim promises `converge`
    """Call `converge` of `estimators` if their claims need it. Return True if it was called."""
    needed = subject.claims.nonlinear == "at convergence"
    for estimator in estimators if needed else ():
        getattr(estimator, "bank", estimator).converge()
    return needed


def _drawn(make: Callable[..., Stream], *what: MotionModel | int) -> tuple[Draw, ...]:
    return tuple(partial(make, each) for each in what)


_BOTH = (LINEAR, NONLINEAR)
_PROMISES = (
    Promise(
        _is_the_kalman_filter_in_sequence,
        _drawn(regular, LINEAR),
        lambda claims: not claims.mixes,
    ),
    Promise(
        _gives_the_dense_joint_posterior_in_any_order,
        _drawn(shuffled, LINEAR),
        lambda claims: claims.is_exact,
        repeats=True,
    ),
    Promise(
        _keeps_all_that_it_accepts_and_nothing_else,
        (partial(shuffled, LINEAR, span_s=4.0 * LAG_S),),
        lambda claims: claims.is_exact,
        repeats=True,
    ),
    Promise(
        _gives_the_estimate_of_the_time_order_in_any_order,
        _drawn(shuffled, NONLINEAR),
        lambda claims: claims.is_exact and claims.nonlinear != "never",
        repeats=True,
    ),
    Promise(
        _fuses_a_late_measurement_exactly,
        _drawn(one_late, 1),
        lambda claims: claims.exact == _ONE_LAG,
    ),
    Promise(
        _fuses_a_late_measurement_exactly,
        _drawn(one_late, 1, 2, 6),
        lambda claims: claims.exact == _FIRST_LATE,
    ),
    Promise(
        _reports_the_innovation_against_all_that_it_has_fused,
        _drawn(shuffled, *_BOTH),
        lambda claims: claims.is_exact,
        repeats=True,
    ),
    Promise(_counts_each_measurement_as_what_it_is, _drawn(shuffled, *_BOTH)),
    Promise(
        _gives_symmetric_positive_definite_covariances,
        _drawn(shuffled, *_BOTH),
        repeats=True,
    ),
    Promise(_gives_the_same_bits_for_the_same_input, _drawn(shuffled, *_BOTH)),
    Promise(_changes_no_input_and_no_output_later, _drawn(shuffled, *_BOTH)),
    Promise(_reports_what_is_too_old_and_stays_as_it_was, _drawn(regular, *_BOTH)),
    Promise(
        _stays_as_it_was_after_a_failure_and_fuses_the_next, _drawn(regular, *_BOTH)
    ),
    Promise(_moves_only_the_window_with_the_clock, _drawn(regular, *_BOTH)),
    Promise(
        _predicts_ahead_by_the_motion_model,
        _drawn(regular, *_BOTH),
        lambda claims: not claims.mixes,
    ),
    Promise(
        _gives_the_posterior_of_a_nonlinear_model,
        (informative, with_outliers),
        lambda claims: not claims.mixes,
    ),
    Promise(
        gives_each_of_several_objects_what_it_gives_one_alone, _drawn(regular, *_BOTH)
    ),
)


def check_estimator(
    factory: str | Factory,
    *,
    exact: bool | str | None = None,
    seed: int = 0,
    num_streams: int = 10,
    **options: Any,
) -> None:
    """Raise `BrokenPromiseError` unless an estimator keeps the contract, with the measurements that show it.

    Parameters
    ----------
    factory
        Name of a registered estimator, or a class or function `(motion, start, lag_s, **options) -> Estimator`. A
        factory with a true attribute `bank` is called as `(motion, lag_s, **options) -> TrackBank`.
    exact
        True requires the dense joint posterior of a linear model in any order of arrival; False does not. A text
        has the meaning of `Claims.exact`. None takes the claims of the factory.
    seed, num_streams
        Seed, and number of random streams for each promise about any order of arrival.
    options
        Keyword parameters of the factory.
    """
    checks = estimator_checks(
        factory, exact=exact, seed=seed, num_streams=num_streams, **options
    )
    run_all(_name(factory), checks)


def estimator_checks(
    factory: str | Factory,
    *,
    exact: bool | str | None = None,
    seed: int = 0,
    num_streams: int = 10,
    **options: Any,
) -> dict[str, Callable[[], None]]:
    """Return the checks of `check_estimator` by name of the promise, for `pytest.mark.parametrize`."""
    made = ESTIMATORS.load(factory) if isinstance(factory, str) else factory
    claims = Claims.of(made)
    if exact is not None:
        claims = replace(
            claims, exact=exact if isinstance(exact, str) else EXACT if exact else ""
        )
    subject = Subject(_name(factory), made, claims, options)
    promised = [promise for promise in _PROMISES if promise.applies(claims)]
    return {
        promise.name: partial(promise.run, subject, seed, num_streams)
        for promise in promised
    }


def _name(factory: str | Factory) -> str:
    return (
        factory
        if isinstance(factory, str)
        else getattr(factory, "__name__", repr(factory))
    )
