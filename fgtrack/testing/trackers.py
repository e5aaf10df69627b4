"""Promises of a whole tracker, in any order of arrival."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

from fgtrack.estimation.registry import ESTIMATORS, Claims
from fgtrack.pipeline.build import build_tracker
from fgtrack.testing.drawn_scenes import Scene, drawn
from fgtrack.testing.outcomes import Build, Tolerance, difference, outcome
from fgtrack.testing.promise import BrokenPromiseError, fault, require, run_all

_LATE_S, _LATE_EGO_S = 0.9, 0.3
_ROUNDING = Tolerance(1e-6, 1e-6)
#: Misses and clutter, so that late lists change decisions. Some tracks are older than the window.
_DENSE: dict[str, Any] = {
    "num_objects": 4,
    "length_s": 3.5,
    "detected": 0.7,
    "clutter": 3.0,
}


@dataclass(frozen=True)
class _Case:
    """A kind of drawn scenes."""

    scene: dict[str, Any]  # Any: arguments of `drawn`
    is_linear: bool


_CASES = (
    _Case({"kinds": ("position", "identity"), "frame": "map"}, is_linear=True),
    _Case({"kinds": ("position", "doppler")}, is_linear=False),
)


def gives_the_tracks_of_the_time_order_in_any_order(
    scene: Scene, late: Scene, build: Build
) -> None:
    """Require that late messages give the tracks of the same messages in order.

    Compared are the track of each detection, the states of the tracks at several stamps, their status, class and
    identity, and the final tracks.
    """
    text = difference(outcome(late, build), outcome(scene, build), _ROUNDING)
    require(not text, text)


def tracker_checks(
    estimator: str,
    *,
    build: Build = build_tracker,
    seed: int = 0,
    num_scenes: int = 1,
) -> dict[str, Callable[[], None]]:
    """Return the checks of `check_tracker` by name of the promise; no check for an estimator that is not exact."""
    claims = Claims.of(ESTIMATORS.load(estimator))
    if not claims.is_exact:
        return {}
    check = gives_the_tracks_of_the_time_order_in_any_order
    name = check.__name__.replace("_", " ")
    return {name: partial(_run, name, estimator, claims, build, seed, num_scenes)}


def check_tracker(
    estimator: str,
    *,
    build: Build = build_tracker,
    seed: int = 0,
    num_scenes: int = 10,
) -> None:
    """Raise `BrokenPromiseError` unless a tracker finds the same tracks in any order of arrival, inside the window.

    Parameters
    ----------
    estimator
        Name of a registered estimator that is exact for late measurements.
    build
        Function that makes the tracker of a configuration.
    seed, num_scenes
        Seed, and number of drawn scenes of each kind.
    """
    checks = tracker_checks(estimator, build=build, seed=seed, num_scenes=num_scenes)
    run_all(estimator, checks)


def _run(
    name: str,
    estimator: str,
    claims: Claims,
    build: Build,
    seed: int,
    num_scenes: int,
) -> None:
    """Raise `BrokenPromiseError` with the first scene that breaks the promise."""
    for scene in _scenes(claims, seed, num_scenes):
        own = scene.with_estimator(estimator)
        late = own.late(seed, _LATE_S, _LATE_EGO_S)
        check = gives_the_tracks_of_the_time_order_in_any_order
        text = fault(check, own, late, build)
        if text:
            raise BrokenPromiseError(estimator, {name: f"{text}\nscene: {late}"})


def _scenes(claims: Claims, seed: int, num_scenes: int) -> Iterator[Scene]:
    """Yield drawn scenes in which an estimator with these claims is exact."""
    for case in _CASES:
        if not case.is_linear and claims.nonlinear != "at once":
            continue
        for number in range(num_scenes):
            yield drawn(seed + number, **_DENSE, **case.scene)
