"""A wrong equation of any motion or measurement model is found by the oracle, also one that is no number."""

from collections.abc import Callable, Iterator, Sequence
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


def component(name: str, cartesian: bool, part: int) -> Break:
    """Let the value (part 0) or the derivative (1) of `name` be no number, of Cartesian states or of the others."""
    right = measurement._observed

    def wrong(names: Sequence[str], x: FloatArray, pose: Any, cartesian_state: bool) -> tuple[FloatArray, FloatArray]:
        found = right(names, x, pose, cartesian_state)
        if name in names and cartesian_state is cartesian:
            (found[0][..., None], found[1])[part][..., list(names).index(name), :] = np.nan
        return found

    return lambda patch: patch.setattr(measurement, "_observed", wrong)


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
    "Jacobian of a Cartesian range rate is no number": component("range_rate_mps", True, 1),
    "value of a curvature is no number": component("curvature_radpm", False, 0),
    "Jacobian of a curvature is no number": component("curvature_radpm", False, 1),
    "Cartesian yaw is no number": component("yaw_rad", True, 0),
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
