"""A wrong equation of any motion or measurement model is found by the oracle, also one that is no number."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from support import oracle_measurements
from support.oracle_models import MODEL_TOLERANCE, model_differences

from fgtrack.core.types import FloatArray
from fgtrack.models import measurement
from fgtrack.models.motion import CTRV, MotionModel, WhiteNoise
from fgtrack.testing.references import Difference

Break = Callable[[pytest.MonkeyPatch], None]


def component(name: str, cartesian: bool, **changed: Callable[[Any, Any], Any]) -> Break:
    """Break parts of what is measured as `name`, of Cartesian states or of the others."""
    known = measurement._COMPONENTS[name]

    def broken(part: str, change: Callable[[Any, Any], Any]) -> Callable[[Any], Any]:
        right = getattr(known, part)
        return lambda scene: change(right(scene), 1.0) if scene.cartesian_motion is cartesian else right(scene)

    wrong = known._replace(**{part: broken(part, change) for part, change in changed.items()})
    return lambda patch: patch.setitem(measurement._COMPONENTS, name, wrong)


def no_number(value: Any, _: float) -> Any:
    return tuple(each * np.nan for each in value) if isinstance(value, tuple) else value * np.nan


def method(kind: type, name: str, change: Callable[..., Any]) -> Break:
    """Let a method give `change(what it gave, itself, *its arguments)`."""
    right = getattr(kind, name)
    return lambda patch: patch.setattr(kind, name, lambda self, *given: change(right(self, *given), self, *given))


def densities_of_yaw_as_they_ever_were(patch: pytest.MonkeyPatch) -> None:
    usual, right = CTRV()._density, WhiteNoise._density.func

    def wrong(self: CTRV) -> FloatArray:
        return np.where(np.isin(np.arange(self.dim), [2, 4]), np.resize(usual, self.dim), right(self))

    patch.setattr(CTRV, "_density", property(wrong))


def bearings_off(patch: pytest.MonkeyPatch) -> None:
    right = measurement.position_gradient

    def wrong(components: tuple[str, ...], *given: Any) -> Any:
        found = right(components, *given)
        return found if found is None or "bearing_rad" not in components else 0.1 * found

    for where in (measurement, oracle_measurements):
        patch.setattr(where, "position_gradient", wrong)


def shown_too_sure(given: tuple[FloatArray, FloatArray], model: MotionModel, *_: Any) -> tuple[FloatArray, FloatArray]:
    return given[0], 0.01 * given[1] if model.cartesian else given[1]


BROKEN: dict[str, Break] = {
    "Jacobian of a Cartesian range rate is no number": component("range_rate_mps", True, gradient=no_number),
    "value of a curvature is no number": component("curvature_radpm", False, value=no_number),
    "Jacobian of a curvature is no number": component("curvature_radpm", False, by_yaw_rate=no_number),
    "Cartesian yaw is no number": component("yaw_rad", True, value=no_number),
    "densities of yaw that are set are not used": densities_of_yaw_as_they_ever_were,
    "published covariance of a Cartesian state": method(MotionModel, "kinematic", shown_too_sure),
    "covariance of a birth": method(MotionModel, "from_kinematic", lambda found, *_: (found[0], 2.0 * found[1])),
    "derivative by the pose": method(measurement.MeasurementModel, "pose_jacobian", lambda found, *_: -3.0 * found),
    "derivative of a position": bearings_off,
    "Jacobian back in time": method(CTRV, "jacobian", lambda F, _, x, t: F * np.where(np.min(t) < 0.0, 2.0, 1.0)),
}


def missed() -> Iterator[tuple[str, Difference]]:
    for name, apart in model_differences():
        if not max(map(abs, np.nan_to_num(apart, nan=np.inf))) < MODEL_TOLERANCE:
            yield name, apart


def test_all_models_are_right() -> None:
    assert list(missed()) == []


@pytest.mark.slow
@pytest.mark.parametrize("what", BROKEN)
def test_what_is_broken_in_a_model_is_found_out(what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    BROKEN[what](monkeypatch)
    assert list(missed())
