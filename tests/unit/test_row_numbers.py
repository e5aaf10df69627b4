"""Compiled loops check no index, so each call checks the row numbers and the sizes of the arrays that it is given."""

import inspect
from collections.abc import Iterator
from importlib import import_module
from typing import Any

import numpy as np
import pytest
from support.raising import MS, START_NS, lists, make

from fgtrack.estimation.base import Measurement, Start
from fgtrack.estimation.smoothing.bank import SmootherBank
from fgtrack.models.measurement import SensorPose, measurement_model
from fgtrack.models.motion import CTRV

MODULES = (
    "fgtrack.estimation.kernels.kalman",
    "fgtrack.estimation.kernels.replay",
    "fgtrack.karle2023.storage_kernels",
    "fgtrack.estimation.smoothing.factor_kernels",
    "fgtrack.estimation.smoothing.insertion_kernels",
    "fgtrack.estimation.smoothing.interpolation_kernels",
    "fgtrack.estimation.smoothing.linearisation_kernels",
    "fgtrack.estimation.smoothing.relinearisation_kernels",
    "fgtrack.estimation.smoothing.solution_kernels",
    "fgtrack.models.view_kernels",
    "fgtrack.tracking.decisions.ranking_kernels",
    "fgtrack.tracking.decisions.step_kernels",
    "fgtrack.tracking.facing_kernels",
    "fgtrack.tracking.kernels",
    "fgtrack.tracking.lives.counter_kernels",
    "fgtrack.tracking.lives.existence_kernels",
    "fgtrack.tracking.lives.visibility_kernels",
)
#: Names of arguments that are row numbers, or indices of what a row has.
ROW_NUMBERS = {"tracks", "rows", "indices", "anchors", "by_x", "sensors", "components"}
#: Names of arguments by whose length a call is as long as it is, and further ones by function.
LENGTHS = {"counts", "rows", "tracks"}
FURTHER_LENGTHS = {
    "arrive.mean", "correct.H", "correct.y", "distinct.pairs", "fade.probabilities", "faults.means",
    "innovations.H", "innovations.y", "judge.probabilities", "judge.scans_ns", "near.points", "update.probabilities",
    "pose_error.points", "pose_error.components", "add_pose_error.R",
    "place.linearised1", "propagate.mean", "read.y", "turned.means", "widen.P", "widen.R",
}  # fmt: skip
HYPOTHESES: dict[str, Any] = {
    "lifecycle": {"kind": "existence"},
    "association": {"kind": "hypotheses"},
}
Calls = dict[str, list[Any]]


def _compiled(module: Any) -> Iterator[str]:
    for name, value in vars(module).items():
        if (
            hasattr(value, "py_func")
            and value.signatures
            and value.py_func.__module__ == module.__name__
        ):
            yield name


def _copied(value: Any) -> Any:
    if isinstance(value, tuple):
        return tuple(map(_copied, value))
    return value.copy() if isinstance(value, np.ndarray) else value


@pytest.fixture(scope="module")
def calls() -> Calls:
    """The arguments of a call of each compiled function, by module and name, of trackers that run."""
    recorded, patch = Calls(), pytest.MonkeyPatch()
    for path in MODULES:
        module = import_module(path)
        for name in _compiled(module):
            own = getattr(module, name)

            def called(
                *arguments: Any, _own: Any = own, _key: str = f"{path}.{name}"
            ) -> Any:
                sized = [
                    len(each) for each in arguments if isinstance(each, np.ndarray)
                ]
                if min(sized, default=0) > 1 or _key not in recorded:
                    recorded[_key] = [_own, *map(_copied, arguments)]
                return _own(*arguments)

            patch.setattr(module, name, called)
            for user in (
                "fgtrack.estimation.smoothing.bank",
                "fgtrack.tracking.association",
            ):
                if getattr(import_module(user), name, None) is own:
                    patch.setattr(import_module(user), name, called)
    for tracker in (
        make("ekf-replay"),
        make("smoother"),
        make("smoother-banded"),
        make("ekf-backward-forward"),
        make("ekf-replay", **HYPOTHESES),
    ):
        for k, messages in enumerate(lists(9)):
            for message in messages:
                tracker.receive(message)
            tracker.tick(START_NS + 100 * k * MS)
    _see_ranges_and_bearings()
    patch.undo()
    return recorded


def _see_ranges_and_bearings() -> None:
    """Let a smoother of two objects linearise measurements, and converge."""
    motion, ids, pose = CTRV(), [0, 1], SensorPose(-30.0, 0.0, 0.1)
    model = measurement_model(("range_m", "bearing_rad"), motion)
    bank = SmootherBank(motion, 1.0)
    bank.advance(START_NS)
    for track_id in ids:
        bank.birth(track_id, Start(stamp_ns=START_NS, yaw_rad=0.0, speed_mps=20.0))
    for k in range(1, 4):
        z = np.array([30.0 + 2.0 * k, -0.1])
        seen = Measurement(START_NS + 100 * k * MS, model, z, 0.01 * np.eye(2), pose)
        bank.update(seen.stamp_ns, ids, [seen, seen])
    bank.converge()


def _with(arguments: list[Any], place: int, value: Any) -> list[Any]:
    given = list(map(_copied, arguments))
    given[place] = value
    return given


def test_a_row_number_beyond_an_end_is_refused(calls: Calls) -> None:
    tried, accepted = 0, list[str]()
    for key, (function, *arguments) in calls.items():
        names = list(inspect.signature(function.py_func).parameters)
        for place, (name, value) in enumerate(zip(names, arguments, strict=True)):
            is_row = (
                isinstance(value, np.ndarray)
                and value.dtype == np.int64
                and value.ndim == 1
            )
            if name not in ROW_NUMBERS or not is_row or not len(value):
                continue
            for wrong in (-3, 10**6, 2**40):
                broken = value.copy()
                broken[-1] = wrong
                tried += 1
                if name == "indices" and key.endswith("locate"):  # written, not read
                    continue
                if key.endswith("pose_error"):  # compared, not read as indices
                    continue
                try:
                    function(*_with(arguments, place, broken))
                except IndexError:
                    continue
                accepted.append(f"{key}: {name} {wrong}")
        if "stack" in names:
            place = names.index("stack")
            codes, *others = arguments[place]
            for wrong in (-3, 10**6, 2**40):
                broken = codes.copy()
                broken[-1] = wrong
                tried += 1
                try:
                    function(*_with(arguments, place, (broken, *others)))
                except IndexError:
                    continue
                accepted.append(f"{key}: components of a stack {wrong}")
    assert tried > 30
    assert not accepted


def test_an_array_that_is_too_small_is_refused(calls: Calls) -> None:
    tried, accepted = 0, set[str]()
    for key, (function, *arguments) in calls.items():
        names = list(inspect.signature(function.py_func).parameters)
        for place, (name, value) in enumerate(zip(names, arguments, strict=True)):
            parts = value if isinstance(value, tuple) else (value,)
            for row, part in enumerate(parts):
                is_array = (
                    isinstance(part, np.ndarray)
                    and len(part) > 0
                    and part.flags.writeable
                )
                if not is_array or name in LENGTHS:
                    continue
                less = np.ascontiguousarray(part[: len(part) // 2])
                given = (
                    (*parts[:row], less, *parts[row + 1 :])
                    if isinstance(value, tuple)
                    else less
                )
                tried += 1
                try:
                    function(*_with(arguments, place, given))
                except IndexError:
                    continue
                accepted.add(
                    f"{key.rpartition('.')[2]}.{name}{row if isinstance(value, tuple) else ''}"
                )
    assert tried > 80
    assert accepted <= FURTHER_LENGTHS, " ".join(sorted(accepted - FURTHER_LENGTHS))
