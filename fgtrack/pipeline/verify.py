"""The certificate of exactness, measured on simulated streams: the answer is right, in whatever order things arrive.

In a linear model every estimator is held to the dense joint Gaussian of what has arrived. In a nonlinear one it is held
to its own answer in the order of the stamps, and those that say what they solve to an oracle that shares no code with
them (`fgtrack.pipeline.oracle`). So are the models and the dense joint.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fgtrack.core.time import NS_PER_S, nanoseconds
from fgtrack.core.types import TrackState
from fgtrack.estimation.base import Estimator, Measurement
from fgtrack.estimation.dense_joint import Difference, dense_joint, difference, innovation_difference, rounding_bound
from fgtrack.estimation.registry import ESTIMATORS, Claims, Factory
from fgtrack.models.motion import MotionModel
from fgtrack.pipeline import verify_streams as streams
from fgtrack.pipeline.certificate import (
    GROWN_TOLERANCE,
    MARGINALISED_TOLERANCE,
    NEAR_TOLERANCE,
    NOT_FUSED,
    ORACLE_TOLERANCE,
    ORDER_TOLERANCE,
    SHORT_TOLERANCE,
    WHOLE_TOLERANCE,
    Certificate,
    Check,
    Subject,
)
from fgtrack.pipeline.nasty_streams import gathered
from fgtrack.pipeline.verify_banks import bank_checks
from fgtrack.pipeline.verify_models import MODEL_TOLERANCE, largest, model_differences
from fgtrack.pipeline.verify_references import DEFAULTS_IN_A_RING, OPTIONS, Reference, reference
from fgtrack.pipeline.verify_streams import Stream

_CHECKPOINTS = 4
_EVERY = 6
_ITERATIONS = 30

_Draw = Callable[[np.random.Generator], Stream]

#: Streams of a linear model, and whether the oracle keeps all its digits there.
_LINEAR: tuple[tuple[_Draw, bool], ...] = ((streams.linear, True), (streams.close, False), (streams.late, True))
#: Streams of nonlinear models, and what a smoother may be off there once it has converged.
_NONLINEAR: tuple[tuple[_Draw, float], ...] = (
    (streams.whole, WHOLE_TOLERANCE),
    (streams.observed, WHOLE_TOLERANCE),
    (gathered, WHOLE_TOLERANCE),
    (streams.robust, WHOLE_TOLERANCE),
    (streams.accelerated, WHOLE_TOLERANCE),
    (streams.leaving, MARGINALISED_TOLERANCE),
    (streams.short, SHORT_TOLERANCE),
)
#: Streams on which also an estimator that does not say what it solves must come near the oracle.
_MILD: tuple[_Draw, ...] = (streams.mild, streams.mild_robust)


def exact_estimators() -> dict[str, Subject]:
    """The estimators that claim to be exact for any late measurements, plug-ins included, by name."""
    subjects = {name: _subject(name, factory) for name, factory in ESTIMATORS.loaded().items()}
    return {name: subject for name, subject in subjects.items() if subject.claims.is_exact}


def one_estimator(name: str) -> dict[str, Subject]:
    """The estimator `name`, whatever it claims. Raises `CallError` where there is none."""
    name = ESTIMATORS.resolve(name)
    return {name: _subject(name, ESTIMATORS.load(name))}


def _subject(name: str, factory: Factory) -> Subject:
    return Subject(factory, Claims.of(factory), OPTIONS.get(name, {}))


def verify(rng: np.random.Generator, subjects: Mapping[str, Subject]) -> Certificate:
    """Run every one of `subjects` on every stream, in every order of arrival; and check the models they share."""
    checks = [Check("models", name, "-", "SciPy", *apart, 0, MODEL_TOLERANCE) for name, apart in model_differences()]
    for draw, exactly in _LINEAR:
        stream = draw(rng)
        checks += [_dense_joint_itself(stream)] if exactly else []
        for order, places in stream.orders.items():
            checks += _against_dense_joint(stream, order, places, _able(stream, subjects))
    for draw, converged in _NONLINEAR:
        stream = draw(rng)
        for name, subject in _able(stream, subjects).items():
            checks += _nonlinear(stream, name, subject, converged)
        if "smoother" in subjects and not stream.late:  # what the default settings cost: no promise, a number
            claims = replace(subjects["smoother"].claims, nonlinear="at once")
            configured = replace(subjects["smoother"], claims=claims, options=DEFAULTS_IN_A_RING)
            checks += _nonlinear(stream, "smoother (defaults)", configured, None)
    for draw in _MILD:
        stream = draw(rng)
        for name, subject in subjects.items():
            checks += _nearby(stream, name, subject)
    for name, subject in subjects.items():
        checks += bank_checks(rng, name, subject)
    return Certificate(tuple(checks))


def _able(stream: Stream, subjects: Mapping[str, Subject]) -> dict[str, Subject]:
    """Those that fuse all that arrives, even where that is older than their window."""
    able = {}
    for name, subject in subjects.items():
        if not stream.late or (subject.claims.is_exact and _reaches(subject, stream)):
            able[name] = subject
    return able


def _reaches(subject: Subject, stream: Stream) -> bool:
    estimator = subject.start(stream)
    for measurement in stream.measurements:
        estimator.update(measurement)
    return estimator.window_ns[0] <= stream.measurements[0].stamp_ns


def _dense_joint_itself(stream: Stream) -> Check:
    probes_ns = [*stream.probes_ns(), stream.newest_ns, stream.newest_ns + NS_PER_S // 10]
    joint = dense_joint(stream.motion, stream.prior, stream.measurements, probes_ns)
    apart = largest(difference(joint[at], TrackState(at, *stream.solution.state_at(at))) for at in probes_ns)
    return Check(stream.name, "(dense joint)", "-", "SciPy", *apart, 0, ORACLE_TOLERANCE)


def _against_dense_joint(
    stream: Stream, order: str, places: Sequence[int], subjects: Mapping[str, Subject]
) -> list[Check]:
    """All of `subjects` on the same stream: at some moments the present, at the end the past as well.

    One that is not exact is held to it in the order of the stamps only; one that holds measurements back, as far as it
    has come.
    """
    motion, prior = stream.motion, stream.prior
    running = {name: subject.start(stream) for name, subject in subjects.items()}
    states = dict.fromkeys(subjects, Difference(0.0, 0.0))
    refused = dict.fromkeys(subjects, 0)
    innovations = dict.fromkeys(subjects, Difference(0.0, 0.0))
    arrived: list[Measurement] = []
    moments = {len(places) * (k + 1) // _CHECKPOINTS for k in range(_CHECKPOINTS)}
    for place in places:
        measurement = stream.measurements[place]
        sampled = len(arrived) % _EVERY == 1
        before = dense_joint(motion, prior, arrived, [measurement.stamp_ns]) if sampled else {}
        arrived.append(measurement)
        for name, estimator in running.items():
            result = estimator.update(measurement)
            refused[name] += result.status in NOT_FUSED
            if sampled:
                apart = innovation_difference(result, measurement, before[measurement.stamp_ns])
                innovations[name] = largest([innovations[name], apart])
        if len(arrived) in moments:
            newest_ns = max(m.stamp_ns for m in arrived)
            joint = dense_joint(motion, prior, arrived, [newest_ns, newest_ns + NS_PER_S // 10])
            for name, estimator in running.items():
                expected = _held_back(stream, subjects[name], arrived, newest_ns) or joint
                states[name] = largest([states[name], *_differences(estimator, expected)])
    smoothed = dense_joint(motion, prior, arrived, stream.probes_ns())
    for name, estimator in running.items():
        if subjects[name].claims.smooths:
            states[name] = largest([states[name], *_differences(estimator, smoothed)])
    stamps_ns = [prior.stamp_ns, *(m.stamp_ns for m in stream.measurements)]
    tolerances = {
        name: max(subject.claims.tolerance, subject.claims.rounding * rounding_bound(motion, stamps_ns))
        for name, subject in subjects.items()
        if subject.claims.is_exact or order == "time"
    }
    told = {
        name: tolerance
        for name, tolerance in tolerances.items()
        if order == "time" or subjects[name].claims.smooths or subjects[name].claims.retrodicts
    }
    parts = ("dense joint", states, tolerances), ("innovations", innovations, told)
    return [
        Check(stream.name, name, order, against, *found[name], refused[name], allowed.get(name))
        for name in subjects
        for against, found, allowed in parts
    ]


def _held_back(
    stream: Stream, subject: Subject, arrived: Sequence[Measurement], newest_ns: int
) -> dict[int, TrackState]:
    """The dense joint of what an estimator that waits has fused; nothing of one that does not wait."""
    if not subject.claims.held_s:
        return {}
    at_ns = max(newest_ns - nanoseconds(subject.claims.held_s), stream.prior.stamp_ns)
    return dense_joint(stream.motion, stream.prior, [m for m in arrived if m.stamp_ns <= at_ns], [at_ns])


def _nonlinear(stream: Stream, name: str, subject: Subject, converged: float | None) -> list[Check]:
    """Against its own estimate in the order of the stamps, and against the oracle of what it solves."""
    at_once, oracle = subject.claims.nonlinear == "at once", reference(stream, subject.claims.solves)
    runs = {order: _Run.of(stream, subject, places) for order, places in stream.orders.items()}
    checks = []

    def add(order: str, against: str, apart: Difference, tolerance: float) -> None:
        promised = None if converged is None or not (subject.claims.is_exact or oracle) else tolerance
        checks.append(Check(stream.name, name, order, against, *apart, runs[order].num_refused, promised))

    for order, run in runs.items():
        if order != "time" and (subject.claims.nonlinear != "never" or not subject.claims.is_exact):
            apart = largest(
                difference(run.states[at], state, stream.motion) for at, state in runs["time"].states.items()
            )
            add(order, "order of stamps", apart, ORDER_TOLERANCE if at_once else converged or math.inf)
        if oracle is not None:
            apart = _from_oracle(run.states, oracle, stream.motion)
            add(order, "SciPy", apart, subject.oracle_tolerance if at_once else converged or math.inf)
            if not at_once:
                add(order, "SciPy, as it grew", _from_oracle(run.before, oracle, stream.motion), GROWN_TOLERANCE)
    return checks


def _nearby(stream: Stream, name: str, subject: Subject) -> list[Check]:
    """In the order of the stamps, at present and ahead: near the extended Kalman filter or least squares.

    Of one that says what it solves more is asked for on the other streams, of one that mixes models nothing is known.
    """
    claims = subject.claims
    if claims.solves or claims.mixes or claims.held_s:
        return []
    expected = reference(stream, "least squares" if claims.smooths else "ekf")
    assert expected is not None
    run = _Run.of(stream, subject, stream.orders["time"])
    now = {at: state for at, state in run.states.items() if at >= stream.newest_ns}
    apart = _from_oracle(now, expected, stream.motion)
    return [Check(stream.name, name, "time", "SciPy, nearby", *apart, run.num_refused, NEAR_TOLERANCE)]


def _from_oracle(states: Mapping[int, TrackState], oracle: Reference, motion: MotionModel) -> Difference:
    """Largest difference at the stamps at which the oracle has a state."""
    expected = {at: estimate for at in states if (estimate := oracle(at)) is not None}
    return largest(difference(states[at], TrackState(at, *one), motion) for at, one in expected.items())


@dataclass(frozen=True)
class _Run:
    """What an estimator says after a whole stream, of the present and the past."""

    states: Mapping[int, TrackState]
    before: Mapping[int, TrackState]
    """The same before it was made to converge."""
    num_refused: int

    @classmethod
    def of(cls, stream: Stream, subject: Subject, places: Iterable[int]) -> "_Run":
        """Measurements arrive as `places` says."""
        estimator = subject.start(stream)
        statuses = [estimator.update(stream.measurements[place]).status for place in places]
        past_ns = stream.probes_ns() if subject.claims.is_exact or subject.claims.smooths else []
        stamps_ns = [*past_ns, stream.newest_ns, stream.newest_ns + NS_PER_S // 10]
        before = {at: estimator.state_at(at) for at in stamps_ns}
        states = before
        if subject.claims.nonlinear == "at convergence":
            estimator.converge(_ITERATIONS)  # type: ignore[attr-defined]  # the claim says that it has it
            states = {at: estimator.state_at(at) for at in stamps_ns}
        return cls(states, before, sum(status in NOT_FUSED for status in statuses))


def _differences(estimator: Estimator, expected: Mapping[int, TrackState]) -> list[Difference]:
    return [difference(estimator.state_at(at), state) for at, state in expected.items()]
