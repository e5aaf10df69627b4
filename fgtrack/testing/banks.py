"""Promises of an estimator about several objects at once."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fgtrack.core.types import STATE_NAMES, YAW_RATE, TrackState
from fgtrack.estimation.base import (
    Estimator,
    Measurement,
    Start,
    TrackBank,
    UpdateResult,
)
from fgtrack.estimation.object_bank import state_of
from fgtrack.estimation.registry import estimator_bank
from fgtrack.models.motion import MotionModel
from fgtrack.testing.promise import Subject, require, sound
from fgtrack.testing.references import difference
from fgtrack.testing.streams import LAG_S, MS, Stream

_TOGETHER = 1e-6
_NUM_OBJECTS = 8  # more than are fused one by one
_GONE = 2
List = dict[int, Measurement]
"""Measurements of one stamp, by object."""


def gives_each_of_several_objects_what_it_gives_one_alone(
    subject: Subject, stream: Stream
) -> None:
    """Require that each of several objects has the results of an estimator that has this object alone.

    Each list has a measurement of most objects. Half way through, an object is removed and a new object begins.
    """
    objects = [_shifted(stream, number) for number in range(_NUM_OBJECTS)]
    lists = [  # of what was measured together; each object is missing in every fourth list
        {
            k: item.measurements[index]
            for k, item in enumerate(objects)
            if (index + k) % 4
        }
        for index in range(len(stream.measurements))
    ]
    half, new = (len(lists) + 1) // 2, len(objects)
    later = [
        {new if number == _GONE else number: m for number, m in item.items()}
        for item in lists[half:]
    ]
    bank = estimator_bank(
        subject.name, stream.motion, LAG_S, subject.options, factory=subject.factory
    )
    for number, item in enumerate(objects):
        bank.advance(max(bank.present_ns, item.start.stamp_ns))
        bank.birth(number, item.start)
    reported = _fed(bank, lists[:half])
    bank.remove(_GONE)
    bank.birth(new, objects[_GONE].start)
    reported += _fed(bank, later)
    expected_ids = [number for number in range(new + 1) if number != _GONE]
    require(
        sorted(bank.track_ids) == expected_ids,
        f"its objects are {bank.track_ids}, not {expected_ids}",
    )
    for number in expected_ids:
        own = objects[_GONE if number == new else number]
        begun = half if number == new else 0
        estimator, results = _alone(
            subject, own, number, [*lists[:half], *later], begun
        )
        _same_results(
            number, [item[number] for item in reported if number in item], results
        )
        for at_ns in (bank.present_ns - 120 * MS, bank.present_ns):
            state = state_of(bank, stream.motion, number, at_ns)
            off, covariance = difference(
                state, estimator.state_at(at_ns), stream.motion
            )
            require(
                off < _TOGETHER and covariance < _TOGETHER,
                f"the state of object {number} at {at_ns} differs from what it is alone by {off:.1e} standard "
                f"deviations in the mean and {covariance:.1e} in the covariance",
            )
    _publishes_the_present(bank, stream.motion)
    for report in bank.smoothed():
        state = _known(report.state, stream.motion)
        sound(
            state.mean,
            state.covariance,
            f"a smoothed state of object {report.track_id}",
        )


def _shifted(stream: Stream, number: int) -> Stream:
    """Return the stream of another object, which is `number` times 0.36 m to the side."""
    shift = np.array([0.3, -0.2]) * number
    start: Start = replace(
        stream.start, position_m=tuple(np.add(stream.start.position_m, shift).tolist())
    )
    moved = (
        replace(item, z=item.z + np.pad(shift, (0, len(item.z) - 2)))
        for item in stream.measurements
    )
    return replace(stream, measurements=tuple(moved), start=start)


def _alone(
    subject: Subject, own: Stream, number: int, lists: Sequence[List], begun: int
) -> tuple[Estimator, list[UpdateResult]]:
    """Return an estimator of the object `number` alone, and its results for `lists`. It begins with the list
    `begun`.
    """
    estimator, results = subject.start(own), list[UpdateResult]()
    now_ns = own.start.stamp_ns
    for index, item in enumerate(lists):
        now_ns = max(now_ns, *(measurement.stamp_ns for measurement in item.values()))
        if index + 1 == begun:
            estimator.advance(now_ns)
        if index >= begun:
            estimator.advance(now_ns)
            given: Measurement | None = item.get(number)
            if given is not None:
                results.append(estimator.update(given))
    return estimator, results


def _same_results(
    number: int, found: Sequence[UpdateResult], expected: Sequence[UpdateResult]
) -> None:
    for one, other in zip(found, expected, strict=True):
        require(
            one.status is other.status,
            f"of object {number} an update is {one.status}, alone it is {other.status}",
        )
        if other.innovation is not None:
            pairs = (one.innovation, other.innovation), (one.nis, other.nis)
            same = all(
                a is not None
                and b is not None
                and np.allclose(a, b, _TOGETHER, _TOGETHER)
                for a, b in pairs
            )
            require(
                same,
                f"of object {number} the innovation is {one.innovation}, alone it is {other.innovation}",
            )


def _known(state: TrackState, motion: MotionModel) -> TrackState:
    """Return the entries of a kinematic state that `motion` estimates, without entries that are always 0."""
    rows = [
        k
        for k, name in enumerate(STATE_NAMES[: len(state.mean)])
        if k < YAW_RATE or name in motion.state_names
    ]
    return TrackState(
        state.stamp_ns, state.mean[rows], state.covariance[np.ix_(rows, rows)]
    )


def _publishes_the_present(bank: TrackBank, motion: MotionModel) -> None:
    """Require that `present` returns the kinematic states of all objects now, in their order."""
    shown = bank.present()
    require(
        len(shown) == len(bank.track_ids),
        f"present() gives {len(shown)} states of {len(bank.track_ids)} objects",
    )
    for number, state in zip(bank.track_ids, shown, strict=True):
        own = state_of(bank, motion, number, bank.present_ns)
        expected = _known(
            TrackState(own.stamp_ns, *motion.published(own.mean, own.covariance)),
            motion,
        )
        result, what = _known(state, motion), f"the present state of object {number}"
        sound(result.mean, result.covariance, what)
        same = (
            state.stamp_ns == bank.present_ns
            and max(difference(result, expected)) < _TOGETHER
        )
        require(same, f"{what} is {state}, not {expected}")


def _fed(bank: TrackBank, lists: Sequence[List]) -> list[dict[int, UpdateResult]]:
    """Give `lists` to a bank as the tracker does, and return its results by object."""
    reported = []
    for item in lists:
        stamp_ns = next(iter(item.values())).stamp_ns
        bank.advance(max(bank.present_ns, stamp_ns))
        bank.states_at(stamp_ns)
        reported.append(
            dict(
                zip(
                    item,
                    bank.update(stamp_ns, list(item), list(item.values())),
                    strict=True,
                )
            )
        )
    return reported
