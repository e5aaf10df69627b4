"""A tracker that decides something in the order of arrival is found out by the promise of whole trackers."""

import re

import numpy as np
import pytest

from fgtrack import Config
from fgtrack.core.types import Revision
from fgtrack.estimation.base import Measurement, UpdateResult, UpdateStatus
from fgtrack.estimation.filters.replay import ReplayEkf
from fgtrack.estimation.registry import ESTIMATORS
from fgtrack.pipeline.build import build_tracker
from fgtrack.testing import BrokenPromiseError, check_tracker, tracker_checks
from fgtrack.testing.outcomes import Build
from fgtrack.tracking.decided_tracker import DecidedTracker
from fgtrack.tracking.ego.trajectory import EgoTrajectory
from fgtrack.tracking.tracker import MultiObjectTracker

PROMISE = "gives the tracks of the time order in any order"


def decides_at_arrival(config: Config) -> MultiObjectTracker:
    return build_tracker(config.replace({"association.revise": False}))


def starts_tracks_at_arrival(config: Config) -> MultiObjectTracker:
    """Starts no track with a list that is late."""
    tracker = build_tracker(config)
    assert isinstance(tracker, DecidedTracker)
    decisions, add = tracker.decisions, tracker.decisions.add

    def added(entry):  # type: ignore[no-untyped-def]
        newest = decisions.newest
        if newest is not None and entry.batch.stamp_ns < newest.stamp_ns:
            entry.may_start[:] = False
        return add(entry)

    decisions.add = added  # type: ignore[method-assign]
    return tracker


class EgoOfArrival(EgoTrajectory):
    """Keeps the pose that a list was given at its arrival."""

    def changed_after_ns(self) -> int | None:
        super().changed_after_ns()
        return None


def places_at_arrival(config: Config) -> MultiObjectTracker:
    tracker = build_tracker(config)
    tracker._parts.ego.__class__ = EgoOfArrival
    return tracker


def conceals_revisions(config: Config) -> MultiObjectTracker:
    tracker = build_tracker(config)

    def revised() -> list[Revision]:
        return []

    tracker.revised = revised  # type: ignore[method-assign]
    return tracker


BROKEN = (
    (decides_at_arrival, "detections have another track"),
    (starts_tracks_at_arrival, "detections have another track"),
    (places_at_arrival, "the state at|another track"),
    (conceals_revisions, "detections have another track"),
)


@pytest.mark.parametrize(("build", "fault"), BROKEN)
def test_a_tracker_that_decides_at_arrival_is_found_out(
    build: Build, fault: str
) -> None:
    with pytest.raises(BrokenPromiseError, match="scene: drawn") as error:
        check_tracker("ekf-replay", build=build, num_scenes=1)
    assert list(error.value.promises) == [PROMISE]
    assert re.search(fault, error.value.promises[PROMISE])


class DropsLateData(ReplayEkf):
    def update(self, measurement: Measurement) -> UpdateResult:
        if self.window_ns[0] <= measurement.stamp_ns < self.window_ns[1]:
            return UpdateResult(
                UpdateStatus.OUT_OF_SEQUENCE, np.zeros(len(measurement.z)), 0.0
            )
        return super().update(measurement)


class KeepsWhatIsTakenBack(ReplayEkf):
    withdraw = None  # type: ignore[assignment]


@pytest.mark.parametrize(
    "broken",
    [pytest.param(DropsLateData, marks=pytest.mark.slow), KeepsWhatIsTakenBack],
)
def test_an_estimator_that_depends_on_the_arrival_is_found_out(
    broken: type, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ESTIMATORS, "load", lambda name: broken)
    with pytest.raises(BrokenPromiseError, match=r"the state at .* s of the track"):
        check_tracker("ekf-replay", num_scenes=1)


def test_nothing_is_promised_of_an_estimator_that_is_not_exact() -> None:
    assert tracker_checks("drop") == {}
    assert list(tracker_checks("asd")) == [PROMISE]


def test_a_tracker_keeps_the_promise() -> None:
    check_tracker("ekf-replay", num_scenes=1)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [each for each in ESTIMATORS.names() if tracker_checks(each)]
)
def test_a_tracker_keeps_the_promise_with_each_exact_estimator(name: str) -> None:
    check_tracker(name, num_scenes=5)
