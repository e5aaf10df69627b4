"""Promises of every motion model: predict, and publish a state; and of shipped ones, to obey their equation."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from fgtrack.core.errors import CallError
from fgtrack.core.linalg import kernels
from fgtrack.core.types import ACCEL, STATE_NAMES, YAW_RATE, FloatArray
from fgtrack.models.motion import CARTESIAN, POLAR, MotionModel, WhiteNoise
from fgtrack.testing.equations import Moments, MotionEquation, equation_of, moments
from fgtrack.testing.promise import (
    BrokenPromiseError,
    WrongError,
    fault,
    require,
    run_all,
    sound,
)
from fgtrack.testing.references import slope

ModelCheck = Callable[[MotionModel, FloatArray, float], None]
"""Raises `WrongError` for the fault of a model at a state (n,) and a duration."""

#: Of the covariance from which a covariance of first order is distinguished from one with higher terms.
_SMALL = 1e-6
_NUM_STATES = 20
#: Of every other state a short duration as between two measurements, of the rest up to a long gap.
_LONGEST_S = 0.5, 4.0
#: Entries of Jacobians and covariances must agree with the equation to this share.
_ENTRY_TOLERANCE = 1e-7


def check_motion_model(
    model: MotionModel, seed: int = 0, equation: MotionEquation | None = None
) -> None:
    """Raise `BrokenPromiseError` unless `model` keeps the contract. The error contains the state and the duration.

    With an `equation`, mean, Jacobian and noise must also agree with the stochastic differential equation. A shipped
    model has an equation of its own.
    """
    run_all(repr(model), motion_model_checks(model, seed, equation))


def motion_model_checks(
    model: MotionModel, seed: int = 0, equation: MotionEquation | None = None
) -> dict[str, Callable[[], None]]:
    """Return the checks of `check_motion_model` by name of the promise, for `pytest.mark.parametrize`."""
    checks: dict[str, Callable[[], None]] = {
        _name(check): partial(_run, _name(check), check, model, seed)
        for check in _CHECKS
    }
    equation = equation or equation_of(model)
    if equation is None:
        return checks
    cases = _EquationCases(model, seed, equation)
    of_equation = list(_EQUATION_CHECKS)
    if isinstance(model, WhiteNoise) and model.is_compiled:
        of_equation.append(_moves_in_compiled_loops_as_by_its_equation)
    return checks | {
        _name(check): partial(_run_equation, _name(check), check, cases)
        for check in of_equation
    }


def _name(check: Callable[..., None]) -> str:
    return check.__name__.removeprefix("_").replace("_", " ")


def _run(name: str, check: ModelCheck, model: MotionModel, seed: int) -> None:
    for x, dt_s in _cases(model, seed):
        if wrong := fault(check, model, x, dt_s):
            raise BrokenPromiseError(
                repr(model), {name: f"{wrong}\nx = {x.tolist()}, dt_s = {dt_s!r}"}
            )


def _cases(model: MotionModel, seed: int) -> list[tuple[FloatArray, float]]:
    """Return random states (n,) of a model, with durations."""
    rng, cases = np.random.default_rng(seed), list[tuple[FloatArray, float]]()
    for number in range(_NUM_STATES):
        kinematic = rng.normal(size=6) * [50.0, 50.0, 2.0, 20.0, 0.3, 2.0]
        x = model.from_kinematic(kinematic, np.eye(6))[0]
        others = [float(name not in STATE_NAMES) for name in model.state_names[4:]]
        x[4:] += others * rng.normal(size=model.dim - 4)
        dt_s = 0.0 if number == 0 else float(rng.uniform(1e-3, _LONGEST_S[number % 2]))
        cases.append((x, dt_s))
    return cases


@dataclass(frozen=True)
class _EquationCases:
    """A motion model, and the equation that it must obey."""

    model: MotionModel
    seed: int
    equation: MotionEquation

    @cached_property
    def states(self) -> tuple[FloatArray, FloatArray]:
        """States (m, n) and durations (m,). An object at rest, a straight course and a spin are among them."""
        cases = _cases(self.model, self.seed)
        x, dt_s = (
            np.array([case[0] for case in cases]),
            np.array([case[1] for case in cases]),
        )
        x[1, 2:], x[2, 4:] = 0.0, 0.0
        if self.model.dim > YAW_RATE:
            x[3, YAW_RATE] = -3.0
        return x, dt_s

    @cached_property
    def expected(self) -> Moments:
        """Mean, Jacobian and noise of the equation at the states."""
        return moments(self.equation, *self.states)


def _run_equation(
    name: str, check: Callable[[_EquationCases, int], None], cases: _EquationCases
) -> None:
    x, dt_s = cases.states
    for case in range(len(x)):
        if wrong := fault(check, cases, case):
            text = f"{wrong}\nx = {x[case].tolist()}, dt_s = {float(dt_s[case])!r}"
            raise BrokenPromiseError(repr(cases.model), {name: text})


def _each_equal(
    values: FloatArray, expected: FloatArray, scale: FloatArray | float, what: str
) -> None:
    """Require that each entry of `values` equals the entry of `expected`, relative to its own size and its `scale`."""
    require(
        np.shape(values) == expected.shape,
        f"{what} has shape {np.shape(values)}, expected {expected.shape}",
    )
    off = np.abs(values - expected) / (np.abs(expected) + scale)
    worst = np.unravel_index(np.argmax(off), off.shape)
    entry = ", ".join(str(index) for index in worst)
    require(
        off[worst] < _ENTRY_TOLERANCE,
        f"{what}: entry {entry} is {values[worst]!r}, by the equation {expected[worst]!r}",
    )


def _obeys_its_equation(cases: _EquationCases, case: int) -> None:
    x, dt_s = cases.states
    for mean in (
        cases.model.predict(x[case], float(dt_s[case])),
        cases.model.transition(x[case], dt_s[case]).mean,
    ):
        _each_equal(mean, cases.expected.mean[case], 1.0, "the predicted state")


def _has_the_jacobian_of_its_equation(cases: _EquationCases, case: int) -> None:
    x, dt_s = cases.states
    for F in (
        cases.model.jacobian(x[case], float(dt_s[case])),
        cases.model.transition(x[case], dt_s[case]).F,
    ):
        _each_equal(F, cases.expected.F[case], 1.0, "jacobian")


def _has_the_noise_of_its_equation(cases: _EquationCases, case: int) -> None:
    """Check the process noise against the noise of the equation.

    A check of composition is not enough: a noise density that is 10 % off composes perfectly.
    """
    x, dt_s = cases.states
    expected = cases.expected.Q[case]
    sigma = np.sqrt(np.diag(expected))
    scale = np.outer(sigma, sigma) + np.finfo(np.float64).tiny
    for Q in (
        cases.model.process_noise(x[case], float(dt_s[case])),
        cases.model.transition(x[case], dt_s[case]).Q,
    ):
        _each_equal(Q, expected, scale, "process_noise")


def _moves_in_compiled_loops_as_by_its_equation(
    cases: _EquationCases, case: int
) -> None:
    """Check the prediction of compiled loops, which do not call the model."""
    model, (x, dt_s) = cases.model, cases.states
    assert isinstance(model, WhiteNoise)  # the only models that compiled loops take
    mean, P = x[case][None].copy(), np.diag(1.0 + np.arange(model.dim))[None]
    F, Q = cases.expected.F[case], cases.expected.Q[case]
    expected = F @ P[0] @ F.T + Q
    propagate = kernels("fgtrack.estimation.kernels.kalman").propagate
    propagate(
        model.kind, model.noise, mean, P, np.ones(1, dtype=np.int64), float(dt_s[case])
    )
    _each_equal(mean[0], cases.expected.mean[case], 1.0, "the state in a compiled loop")
    sigma = np.sqrt(np.diag(expected))
    _each_equal(
        P[0], expected, np.outer(sigma, sigma), "the covariance in a compiled loop"
    )


def _equal(
    values: FloatArray, expected: FloatArray, tolerance: float, what: str
) -> None:
    """Require that `values` equals `expected` within `tolerance`; NaN never does."""
    values = np.asarray(values)
    require(
        values.shape == expected.shape,
        f"{what} has shape {values.shape}, expected {expected.shape}",
    )
    off = np.abs(values - expected).max() / (1.0 + np.abs(expected).max())
    require(off < tolerance, f"{what} is\n{values}\nexpected\n{expected}")


def _has_a_state_that_measurements_determine(
    model: MotionModel, x: FloatArray, dt_s: float
) -> None:
    names = model.state_names
    right = names[:4] in (POLAR, CARTESIAN) and len(set(names)) == len(names)
    require(
        right,
        f"state_names are {names}: begin with {POLAR} or {CARTESIAN}, and give each name once",
    )
    require(model in {model}, "it is not hashable, or not equal to itself")


def _flows_on_where_it_stopped(model: MotionModel, x: FloatArray, dt_s: float) -> None:
    after = model.predict(model.predict(x, 0.3 * dt_s), 0.7 * dt_s)
    _equal(after, model.predict(x, dt_s), 1e-9, "predict over two parts")
    _equal(
        model.predict(model.predict(x, dt_s), -dt_s), x, 1e-9, "predict in a round trip"
    )


def _has_the_jacobian_of_its_prediction(
    model: MotionModel, x: FloatArray, dt_s: float
) -> None:
    _equal(
        model.jacobian(x, dt_s),
        slope(lambda state: model.predict(state, dt_s), x),
        1e-6,
        "jacobian",
    )
    if model.linear:
        _equal(
            model.jacobian(x, dt_s),
            model.jacobian(0.0 * x, dt_s),
            1e-12,
            "jacobian of a linear model",
        )


def _has_noise_that_composes(model: MotionModel, x: FloatArray, dt_s: float) -> None:
    a, b = 0.3 * dt_s, 0.7 * dt_s
    between = model.predict(x, a)
    F = model.jacobian(between, b)
    parts = F @ model.process_noise(x, a) @ F.T + model.process_noise(between, b)
    Q = model.process_noise(x, dt_s)
    scale = (
        np.sqrt(np.abs(np.outer(np.diag(Q), np.diag(Q)))) + np.finfo(np.float64).tiny
    )
    _equal(
        parts / scale, Q / scale, 1e-6, "F(b) Q(a) F(b)' + Q(b) scaled like Q(a + b),"
    )


def _has_noise_that_is_symmetric_and_positive_definite(
    model: MotionModel, x: FloatArray, dt_s: float
) -> None:
    Q = model.process_noise(x, dt_s)
    if dt_s:
        sound(x, Q, "process_noise")
    else:
        _equal(Q, np.zeros_like(Q), 1e-15, "process_noise over 0 s")


def _refuses_noise_of_a_negative_duration(
    model: MotionModel, x: FloatArray, dt_s: float
) -> None:
    try:
        model.process_noise(x, -0.1 - dt_s)
    except CallError:
        return
    raise WrongError("process_noise accepts it; let self.forward(dt_s) check it")


def _has_the_transition_of_its_functions(
    model: MotionModel, x: FloatArray, dt_s: float
) -> None:
    """Check that `transition` equals `predict`, `jacobian` and `process_noise`.

    The states are one state, and several numbers of states, each with another duration.
    """
    counts = 1, 2, 3, 24
    cases: list[tuple[FloatArray, float | FloatArray]] = [(x, dt_s)]
    cases += [
        (x + 0.05 * np.linspace(0.0, 1.0, m)[:, None], np.linspace(0.1, 1.0, m) * dt_s)
        for m in counts
    ]
    for states, durations_s in cases:
        result = model.transition(states, durations_s)
        functions = model.predict, model.jacobian, model.process_noise
        for name, part, function in zip(result._fields, result, functions, strict=True):
            _equal(
                part,
                function(states, durations_s),
                1e-9,
                f"{name} of the transition of {states.shape}",
            )


def _takes_arrays_of_states_and_durations(
    model: MotionModel, x: FloatArray, dt_s: float
) -> None:
    states, durations_s = (
        np.stack([x, x + 0.1, x - 0.1]),
        np.array([[dt_s], [0.5 * dt_s]]),
    )
    for function in (model.predict, model.jacobian, model.process_noise):
        one_by_one = np.array(
            [[function(state, float(t)) for state in states] for t in durations_s[:, 0]]
        )
        _equal(
            function(states, durations_s),
            one_by_one,
            1e-12,
            f"{function.__name__} of an array",
        )
        empty = function(states[:0], durations_s).shape == (2, 0, *one_by_one.shape[2:])
        require(empty, f"{function.__name__} of no state at all has the wrong shape")


def _keeps_its_inputs(model: MotionModel, x: FloatArray, dt_s: float) -> None:
    for function in (model.predict, model.jacobian, model.process_noise):
        state = x.copy()
        function(state, dt_s)
        require(
            (state == x).all(),
            f"{function.__name__} changes the state that it is given",
        )


def _shown(model: MotionModel, x: FloatArray) -> FloatArray:
    """Return the kinematic state of the state `x` (n,), whose entries are selected by name."""
    own = dict(zip(model.state_names, x.tolist(), strict=True))
    if model.cartesian:
        own["yaw_rad"], own["speed_mps"] = (
            math.atan2(x[3], x[2]),
            math.hypot(x[2], x[3]),
        )
    names = STATE_NAMES if "accel_mps2" in model.state_names else STATE_NAMES[:ACCEL]
    return np.array([own.get(name, 0.0) for name in names])


def _covariance(n: int) -> FloatArray:
    """Return a covariance whose entries are all different, shape (n, n)."""
    root = np.eye(n) + 0.3 * np.sin(np.arange(n * n, dtype=np.float64)).reshape(n, n)
    return _SMALL * root @ root.T


def _publishes_the_entries_of_its_state(
    model: MotionModel, x: FloatArray, dt_s: float
) -> None:
    """Check that the mean of `kinematic` has the entries of the state by name.

    The covariance is checked with difference quotients of the mean.
    """
    P, J = _covariance(model.dim), slope(lambda state: _shown(model, state), x)
    mean, covariance = model.kinematic(x, P)
    many, covariances = model.kinematic(np.stack([x, 1.1 * x]), np.stack([P, 2.0 * P]))
    _equal(mean, _shown(model, x), 1e-9, "the mean of kinematic")
    _equal(
        covariance / _SMALL,
        J @ P @ J.T / _SMALL,
        1e-5,
        f"the covariance of kinematic over {_SMALL}",
    )
    _equal(
        many,
        np.array([_shown(model, x), _shown(model, 1.1 * x)]),
        1e-9,
        "kinematic of an array",
    )
    _equal(
        covariances[0] / _SMALL,
        covariance / _SMALL,
        1e-9,
        "the covariance of kinematic of an array",
    )


def _is_as_it_was_after_a_kinematic_state(
    model: MotionModel, x: FloatArray, dt_s: float
) -> None:
    """Check that `from_kinematic` of `kinematic` returns the mean, and the covariance of the common entries.

    The covariance is that of small errors, because both functions are nonlinear.
    """
    P = _covariance(model.dim)
    shown, published = model.kinematic(x, P)
    back, covariance = model.from_kinematic(shown, published)
    require(
        back.shape == x.shape and covariance.shape == P.shape,
        "from_kinematic gives other shapes",
    )
    known = [
        k
        for k, name in enumerate(model.state_names)
        if k < 4 or name in STATE_NAMES[: len(shown)]
    ]
    both = np.ix_(known, known)
    _equal(back[known], x[known], 1e-9, "from_kinematic of kinematic")
    what = f"the covariance of from_kinematic of kinematic over {_SMALL}"
    _equal(covariance[both] / _SMALL, P[both] / _SMALL, 1e-4, what)


def _begins_with_a_sound_covariance(
    model: MotionModel, x: FloatArray, dt_s: float
) -> None:
    """Check that an unobserved entry of a new state has the mean 0 and the variance `start_variance`.

    The covariance must be symmetric and positive definite.
    """
    for name in model.state_names:
        variance = model.start_variance(name)
        require(
            0.0 < variance < math.inf,
            f"start_variance({name!r}) is {variance}; it must be positive and finite",
        )
    mean, P = _shown(model, x), np.eye(ACCEL)
    begun, covariance = model.from_kinematic(mean[:ACCEL], P)
    for k, name in enumerate(model.state_names[4:], start=4):
        if name not in STATE_NAMES[:ACCEL]:
            expected = np.zeros(model.dim)
            expected[k] = model.start_variance(name)
            _equal(begun[k], np.array(0.0), 1e-12, f"{name} of a birth")
            _equal(
                covariance[k], expected, 1e-9, f"the covariance of {name} of a birth"
            )
    sound(begun, covariance, "from_kinematic")


_CHECKS: tuple[ModelCheck, ...] = (
    _has_a_state_that_measurements_determine,
    _flows_on_where_it_stopped,
    _has_the_jacobian_of_its_prediction,
    _has_noise_that_composes,
    _has_noise_that_is_symmetric_and_positive_definite,
    _refuses_noise_of_a_negative_duration,
    _has_the_transition_of_its_functions,
    _takes_arrays_of_states_and_durations,
    _keeps_its_inputs,
    _publishes_the_entries_of_its_state,
    _is_as_it_was_after_a_kinematic_state,
    _begins_with_a_sound_covariance,
)
_EQUATION_CHECKS = (
    _obeys_its_equation,
    _has_the_jacobian_of_its_equation,
    _has_the_noise_of_its_equation,
)
