"""A sign error or an error of 10 % in any one entry of a shipped model breaks the promise about that entry.

Every entry of every shipped F, Q and H is wrong once, and every entry of a predicted state and measurement. The fault
is in the result of the compiled transition, or of the shipped measurement model: the levels that estimators call.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from itertools import product
from pathlib import Path

import numpy as np
import pytest

import fgtrack
from fgtrack.cli.main import run
from fgtrack.core.types import FloatArray
from fgtrack.estimation.registry import ESTIMATORS, MOTION_MODELS
from fgtrack.models import transitions
from fgtrack.models.correlated_errors import CorrelatedErrors
from fgtrack.models.measurement import (
    AT_ORIGIN,
    COMPONENTS,
    MeasurementModel,
    SensorPose,
    measurement_model,
)
from fgtrack.models.motion import CT, CTRA, CTRV, CV, MotionModel, WhiteNoise
from fgtrack.testing import (
    BrokenPromiseError,
    measurement_model_checks,
    motion_model_checks,
)
from fgtrack.testing.equations import EQUATIONS

Checks = Mapping[str, Callable[[], None]]
Entry = tuple[int, ...]
MEAN, JACOBIAN, NOISE = (
    "obeys its equation",
    "has the jacobian of its equation",
    "has the noise of its equation",
)
COMPILED = "moves in compiled loops as by its equation"
COMPOSES = "has noise that composes"
VALUE, BY_STATE, BY_POSE = (
    "measures by its definition",
    "has the jacobian of its definition",
    "has the pose jacobian of its definition",
)
SPLITS = "splits an error that is correlated in time"
FACTORS = (1.1, -1.0)

WHITE: tuple[WhiteNoise, ...] = (CTRV(), CTRA(), CT(), CV())
ERRORS = CorrelatedErrors(CV(), (("sensor.x_m", 1.0), ("sensor.y_m", 2.0)))
MODELS: tuple[MotionModel, ...] = (*WHITE, ERRORS)
by_type = pytest.mark.parametrize(
    "model", MODELS, ids=lambda model: type(model).__name__
)


def broken(checks: Checks, names: set[str] | None = None) -> set[str]:
    """Names of the promises that are broken, of all `checks` or of some."""
    result = set[str]()
    for name in checks if names is None else names:
        try:
            checks[name]()
        except BrokenPromiseError as error:
            result |= set(error.promises)
    return result


def wrong(values: FloatArray, entry: Entry, factor: float, instead: float) -> None:
    """Multiply an entry of stacked arrays by `factor`, or add `instead` where the entry is 0."""
    index = (..., *entry)
    values[index] = np.where(values[index] == 0.0, instead, factor * values[index])


def wrong_noise(Q: FloatArray, entry: Entry, factor: float) -> None:
    """Let an entry of a covariance and its mirrored entry be wrong, by a tenth of its scale where the entry is 0."""
    row, column = entry
    scale = np.sqrt(np.abs(Q[..., row, row] * Q[..., column, column]))
    Q[..., row, column] = np.where(
        Q[..., row, column] == 0.0, 0.1 * scale, factor * Q[..., row, column]
    )
    Q[..., column, row] = Q[..., row, column]


def entries(model: MotionModel) -> Iterator[tuple[str, Entry]]:
    """Each entry of each result. Of two mirrored entries of Q the upper one stands for both."""
    n = model.dim
    yield from ((MEAN, (row,)) for row in range(n))
    yield from ((JACOBIAN, entry) for entry in product(range(n), repeat=2))
    yield from (
        (NOISE, (row, column))
        for row, column in product(range(n), repeat=2)
        if row <= column
    )


def sabotage(
    patch: pytest.MonkeyPatch,
    model: MotionModel,
    what: str,
    entry: Entry,
    factor: float,
) -> None:
    """Let one entry of one result of `model` be wrong. Other models of the same loop stay right."""

    def change(mean: FloatArray, F: FloatArray, Q: FloatArray) -> None:
        if what == MEAN:
            wrong(mean, entry, factor, 0.1)
        elif what == JACOBIAN:
            wrong(F, entry, factor, 0.1)
        else:
            wrong_noise(Q, entry, factor)

    if isinstance(model, CorrelatedErrors):
        for name, position in (("predict", 0), ("jacobian", 1), ("process_noise", 2)):
            patch.setattr(
                CorrelatedErrors,
                name,
                _changed(getattr(CorrelatedErrors, name), change, position),
            )
        return
    right = transitions.transitions

    def transition(
        kind: int,
        x: FloatArray,
        dt_s: FloatArray,
        noise: FloatArray,
        mean: FloatArray,
        F: FloatArray,
        Q: FloatArray,
    ) -> None:
        right(kind, x, dt_s, noise, mean, F, Q)
        if (
            isinstance(model, WhiteNoise)
            and kind == model.kind
            and x.shape[1] == model.dim
        ):
            change(mean, F, Q)

    patch.setattr(transitions, "transitions", transition)


def _changed(
    right: Callable[..., FloatArray],
    change: Callable[[FloatArray, FloatArray, FloatArray], None],
    position: int,
) -> Callable[..., FloatArray]:
    """A method whose result is changed in the given position of (mean, F, Q)."""

    def method(
        model: MotionModel, x: FloatArray, dt_s: float | FloatArray
    ) -> FloatArray:
        result = right(model, x, dt_s).copy()
        n = model.dim
        parts = [np.ones(n), np.eye(n), np.eye(n)]
        parts[position] = result
        change(*parts)
        return result

    return method


def test_every_shipped_motion_model_has_an_equation_and_is_sabotaged_here() -> None:
    shipped = {MOTION_MODELS.load(name) for name in ("ctrv", "ctra", "ct", "cv")} | {
        CorrelatedErrors
    }
    assert set(EQUATIONS) == shipped == {type(model) for model in MODELS}


@pytest.mark.long
@by_type
def test_each_entry_of_a_motion_model_is_promised_by_name(
    monkeypatch: pytest.MonkeyPatch, model: MotionModel
) -> None:
    """Of the promises about mean, F and Q exactly the one about the wrong result breaks."""
    checks, promised = motion_model_checks(model), {MEAN, JACOBIAN, NOISE}
    assert broken(checks, promised) == set()
    for (what, entry), factor in product(entries(model), FACTORS):
        with monkeypatch.context() as patch:
            sabotage(patch, model, what, entry, factor)
            assert broken(checks, promised) == {what}, (what, entry, factor)


@by_type
def test_a_fault_of_one_motion_model_breaks_no_promise_of_another(
    monkeypatch: pytest.MonkeyPatch, model: MotionModel
) -> None:
    promised = {MEAN, JACOBIAN, NOISE, COMPOSES}
    others = {
        type(each): motion_model_checks(each)
        for each in MODELS
        if type(each) is not type(model)
    }
    if isinstance(model, CV):
        del others[CorrelatedErrors]  # its base is the broken model
    sabotage(monkeypatch, model, JACOBIAN, (0, 2), -1.0)
    assert broken(motion_model_checks(model), promised) == {JACOBIAN, COMPOSES}
    for checks in others.values():
        assert broken(checks, promised) == set()


@pytest.mark.parametrize(
    ("model", "index"),
    [
        (model, int(index))
        for model in WHITE
        for index in np.flatnonzero(model.noise)
        if index
        not in (
            (1, 3) if model.cartesian else (1,)
        )  # the second axis has the noise of the first one
    ],
    ids=lambda value: str(value) if isinstance(value, int) else type(value).__name__,
)
def test_a_parameter_that_is_10_percent_off_composes_and_is_found_by_the_equation(
    monkeypatch: pytest.MonkeyPatch, model: WhiteNoise, index: int
) -> None:
    """A density, or another parameter of the compiled transition, that counts for more than is documented."""
    promised = {MEAN, JACOBIAN, NOISE, COMPILED, COMPOSES}
    checks, noise = motion_model_checks(model), model.noise.copy()
    assert broken(checks, promised) == set()
    noise[
        index : index + (2 if index == 0 or (index == 2 and model.cartesian) else 1)
    ] *= 1.1
    monkeypatch.setitem(model.__dict__, "noise", noise)
    found = broken(checks, promised)
    assert {NOISE, COMPILED} <= found
    assert COMPOSES not in found
    assert ({MEAN, JACOBIAN} & found == set()) == (
        index != model.dim
    )  # the rate at which a yaw rate relaxes


@pytest.mark.slow
def test_a_fault_in_the_source_of_the_compiled_transition_is_found(
    tmp_path: Path,
) -> None:
    """The package is copied, mutated and compiled: verify compares the machine code, and not a second writing."""
    shutil.copytree(
        Path(fgtrack.__file__).parent,
        tmp_path / "fgtrack",
        ignore=shutil.ignore_patterns("__pycache__"),
    )
    file = tmp_path / "fgtrack" / "models" / "short_bends.py"
    text, right = file.read_text(), "q, r = noise[3] * t, noise[4] * t"
    assert text.count(right) == 1
    file.write_text(text.replace(right, "q, r = 1.1 * noise[3] * t, noise[4] * t"))
    script = (
        "from fgtrack.models.motion import CTRV\n"
        "from fgtrack.testing import BrokenPromiseError, check_motion_model\n"
        "try:\n    check_motion_model(CTRV())\n"
        "except BrokenPromiseError as error:\n    print(*error.promises, sep='\\n')\n"
    )
    environment = os.environ | {
        "PYTHONPATH": str(tmp_path),
        "NUMBA_CACHE_DIR": str(tmp_path / "cache"),
    }
    command = [sys.executable, "-c", script]
    result = subprocess.run(
        command,
        env=environment,
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    assert {NOISE, COMPILED} <= set(result.stdout.splitlines())


def states_of(component: str) -> list[tuple[str, ...]]:
    """Names of the states that determine a component."""
    return [
        model.state_names
        for model in WHITE
        if component != "curvature_radpm" or not model.cartesian
    ]


def wrong_jacobian(
    patch: pytest.MonkeyPatch,
    component: str,
    state_names: tuple[str, ...],
    column: int,
    factor: float,
) -> None:
    """Let one entry in the row of `component` be wrong in every H of these states, linear or not."""
    linear, nonlinear = MeasurementModel.selection, MeasurementModel.jacobian

    def changed(model: MeasurementModel, H: FloatArray) -> FloatArray:
        if (
            component not in model.components
            or model.state_names[: len(state_names)] != state_names
        ):
            return H
        result = np.array(H)
        wrong(result, (model.components.index(component), column), factor, 0.1)
        return result

    def jacobian(
        model: MeasurementModel, x: FloatArray, pose: SensorPose = AT_ORIGIN
    ) -> FloatArray:
        return (
            changed(model, nonlinear(model, x, pose))
            if not model.linear
            else _broadcast(model, x)
        )

    def _broadcast(model: MeasurementModel, x: FloatArray) -> FloatArray:
        return np.broadcast_to(
            model.selection(x.shape[-1]),
            (*x.shape[:-1], len(model.components), x.shape[-1]),
        )

    patch.setattr(
        MeasurementModel, "selection", lambda model, n: changed(model, linear(model, n))
    )
    patch.setattr(MeasurementModel, "jacobian", jacobian)


#: Each entry is tried with one factor; the other factors are slow.
each_factor = pytest.mark.parametrize(
    "first",
    [0, *(pytest.param(k, marks=pytest.mark.slow) for k in range(1, len(FACTORS)))],
)


@pytest.mark.long
@each_factor
@pytest.mark.parametrize("component", COMPONENTS)
def test_each_entry_of_a_measurement_jacobian_is_promised_by_name(
    monkeypatch: pytest.MonkeyPatch, component: str, first: int
) -> None:
    checks = measurement_model_checks(component)
    assert broken(checks) == set()
    for names in states_of(component):
        for column in range(len(names)):
            factor = FACTORS[(first + column) % len(FACTORS)]
            with monkeypatch.context() as patch:
                wrong_jacobian(patch, component, names, column, factor)
                assert broken(checks, {VALUE, BY_STATE, BY_POSE}) == {BY_STATE}, (
                    names,
                    column,
                    factor,
                )


#: A component that a state holds, an angle that it holds, and a component that follows from the pose.
FEW = ("x_m", "yaw_rad", "range_m")


@pytest.mark.parametrize(
    "component",
    [
        name if name in FEW else pytest.param(name, marks=pytest.mark.slow)
        for name in COMPONENTS
    ],
)
def test_a_fault_of_one_component_breaks_no_promise_of_another(
    monkeypatch: pytest.MonkeyPatch, component: str
) -> None:
    wrong_jacobian(monkeypatch, component, CTRV.state_names, 0, -1.0)
    for each in COMPONENTS:
        found = broken(measurement_model_checks(each))
        assert found - {SPLITS} == ({BY_STATE} if each == component else set())


@pytest.mark.parametrize("component", COMPONENTS)
def test_each_measured_value_is_promised_by_name(
    monkeypatch: pytest.MonkeyPatch, component: str
) -> None:
    right, checks = MeasurementModel.predict, measurement_model_checks(component)

    def times(factor: float) -> Callable[..., FloatArray]:
        def predict(
            model: MeasurementModel, x: FloatArray, pose: SensorPose = AT_ORIGIN
        ) -> FloatArray:
            z = np.array(right(model, x, pose))
            z[..., [name == component for name in model.components]] *= factor
            return z

        return predict

    for factor in FACTORS:
        with monkeypatch.context() as patch:
            patch.setattr(MeasurementModel, "predict", times(factor))
            assert broken(checks) - {SPLITS} == {VALUE}


@pytest.mark.long
@each_factor
@pytest.mark.parametrize(
    "component", [name for name in COMPONENTS if name.startswith(("range", "bearing"))]
)
def test_each_entry_of_a_pose_jacobian_is_promised_by_name(
    monkeypatch: pytest.MonkeyPatch, component: str, first: int
) -> None:
    right, checks = MeasurementModel.pose_jacobian, measurement_model_checks(component)

    def wrong_in(column: int, factor: float) -> Callable[..., FloatArray]:
        def pose_jacobian(
            model: MeasurementModel, x: FloatArray, pose: SensorPose
        ) -> FloatArray:
            D = right(model, x, pose)
            if component in model.components:
                wrong(D, (model.components.index(component), column), factor, 0.1)
            return D

        return pose_jacobian

    for column in range(5):
        factor = FACTORS[(first + column) % len(FACTORS)]
        with monkeypatch.context() as patch:
            patch.setattr(MeasurementModel, "pose_jacobian", wrong_in(column, factor))
            assert broken(checks) == {BY_POSE}, (column, factor)


def test_the_entries_that_compiled_loops_select_are_promised(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The compiled filter reads `selected`, and no Jacobian."""
    model, checks = (
        measurement_model(("yaw_rad",), CTRV()),
        measurement_model_checks("yaw_rad"),
    )
    assert broken(checks) == set()
    monkeypatch.setitem(model.__dict__, "selected", np.array([3]))
    assert broken(checks) == {"is linear where the state has it", VALUE}


@pytest.mark.long
def test_the_command_names_the_model_and_the_promise(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without estimators, which take most of the time. Their promises about streams break as well."""
    monkeypatch.setattr(ESTIMATORS, "loaded", dict[str, object])
    sabotage(monkeypatch, CTRV(), NOISE, (2, 2), 1.1)
    wrong_jacobian(monkeypatch, "bearing_rad", CTRV.state_names, 1, -1.0)
    assert run(["verify"]) == 1
    out = capsys.readouterr().out
    assert f"ctrv: broken promise: it {NOISE}\nprocess_noise: entry 2, 2 is " in out
    assert f"bearing_rad: broken promise: it {BY_STATE}\njacobian is " in out
    assert "ctra: broken" not in out
    assert "range_m: broken" not in out
