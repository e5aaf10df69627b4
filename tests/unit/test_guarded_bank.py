"""A bank outlives what its estimators raise: the track that failed ends, the others go on."""

from collections.abc import Sequence

import numpy as np
import pytest

from fgtrack.core.errors import DataError
from fgtrack.core.types import TrackState
from fgtrack.estimation.base import (
    Estimator,
    Measurement,
    Start,
    UpdateResult,
    UpdateStatus,
)
from fgtrack.estimation.filters.replay import ReplayEkf
from fgtrack.estimation.object_bank import ObjectBank, changing_nothing
from fgtrack.models.motion import CTRV, MotionModel
from fgtrack.tracking.guarded_bank import GuardedBank

MS = 1_000_000
MOTION = CTRV()


class Moody(ReplayEkf):
    """Does what is asked of it by the measured x: 1000 raises, 2000 gives a state that is none, 3000 is bad data."""

    def __init__(self, start: Start, motion: MotionModel = MOTION) -> None:
        super().__init__(motion, start, 1.0)
        self.mood = 0.0

    def update(self, measurement: Measurement) -> UpdateResult:
        if measurement.z[0] == 3000.0:
            raise DataError("not this one")
        if measurement.z[0] == 1000.0:
            raise np.linalg.LinAlgError("singular")
        if measurement.z[0] >= 2000.0:
            self.mood = measurement.z[0]
            return UpdateResult(UpdateStatus.IN_SEQUENCE)
        return super().update(measurement)

    def state_at(self, stamp_ns: int) -> TrackState:
        state = super().state_at(stamp_ns)
        if self.mood == 4000.0:
            raise RuntimeError("no state")
        return (
            TrackState(stamp_ns, state.mean * np.nan, state.covariance)
            if self.mood == 2000.0
            else state
        )


def bank_of(*x_m: float, motion: MotionModel = MOTION) -> GuardedBank:
    """A bank of cars that drive east at 10 m/s from these places, seen five times."""
    bank = GuardedBank(
        lambda: ObjectBank(motion, lambda start: Moody(start, motion), 1.0)
    )
    bank.advance(0)
    for track_id, x in enumerate(x_m):
        bank.birth(
            track_id,
            Start(
                stamp_ns=0,
                position_m=(x, 0.0),
                yaw_rad=0.0,
                speed_mps=10.0,
                speed_std_mps=1.0,
            ),
        )
    for k in range(1, 6):
        step(bank, 100 * MS * k, [x + 1.0 * k for x in x_m])
    assert counted(bank) == {}
    return bank


def step(
    bank: GuardedBank, stamp_ns: int, x_m: Sequence[float]
) -> tuple[list[UpdateResult], list[TrackState]]:
    """A tick with a measurement of every track."""
    bank.advance(stamp_ns)
    measured = [
        Measurement.of(stamp_ns, x_m=x, y_m=0.0, std={"x_m": 0.3, "y_m": 0.3})
        for x in x_m
    ]
    return bank.update(stamp_ns, bank.track_ids, measured), bank.present()


def counted(bank: GuardedBank) -> dict[str, int]:
    """Counts of failures."""
    return {failure.value: count for failure, count in bank.failures.counts.items()}


def states(bank: GuardedBank) -> dict[int, TrackState]:
    return dict(zip(bank.track_ids, bank.present(), strict=True))


def test_a_track_whose_update_raises_ends_and_the_others_go_on() -> None:
    bank, calm = bank_of(0.0, 100.0, 200.0), bank_of(0.0, 100.0, 200.0)
    step(calm, 600 * MS, [6.0, 106.0, 206.0])
    results, _ = step(bank, 600 * MS, [6.0, 1000.0, 206.0])
    failed, fused = UpdateStatus.FAILED, UpdateStatus.IN_SEQUENCE
    assert [result.status for result in results] == [fused, failed, fused]
    assert counted(bank) == {"update failed": 1, "track ended": 1}
    assert "singular" in str(bank.failures.last)
    assert bank.failures.ended == [
        {"track_id": 1, "now_ns": 600 * MS, "failure": "update failed"}
    ]
    assert bank.track_ids == (0, 2)
    for track_id, state in states(bank).items():
        assert state.mean.tobytes() == states(calm)[track_id].mean.tobytes()
    bank.remove(1)  # as the tracker does when its time has come


def test_of_tracks_that_are_updated_together_all_of_the_call_end() -> None:
    class Together(ObjectBank[Moody]):
        def update(
            self,
            stamp_ns: int,
            track_ids: Sequence[int],
            measurements: Sequence[Measurement],
        ) -> list[UpdateResult]:
            raise RuntimeError("together")

    bank = GuardedBank(lambda: Together(MOTION, Moody, 1.0))
    bank.advance(0)
    for track_id in range(3):
        bank.birth(track_id, Start(yaw_rad=0.0))
    seen = [Measurement.of(0, x_m=0.0, y_m=0.0, std=0.3)] * 2
    assert [result.status for result in bank.update(0, [0, 2], seen)] == [
        UpdateStatus.FAILED
    ] * 2
    assert (bank.track_ids, len(bank.present())) == ((1,), 1)
    assert counted(bank) == {"update failed": 2, "track ended": 2}


def test_a_track_whose_state_is_not_finite_ends() -> None:
    bank = bank_of(0.0, 100.0)
    _, found = step(bank, 600 * MS, [6.0, 2000.0])
    assert counted(bank) == {"not finite": 1, "track ended": 1}
    assert bank.failures.last == "the state of track 1 is not finite"
    assert all(np.isfinite(state.mean).all() for state in found)
    assert bank.track_ids == (0,)


def test_states_that_are_not_finite_are_not_offered() -> None:
    bank = bank_of(0.0, 100.0)
    bank.advance(600 * MS)
    bank.update(
        600 * MS,
        [1],
        [Measurement.of(600 * MS, x_m=2000.0, y_m=0.0, std={"x_m": 0.3, "y_m": 0.3})],
    )
    assert bank.states_at(600 * MS).track_ids == (0,)


def test_where_all_are_asked_and_one_raises_that_one_ends() -> None:
    bank = bank_of(0.0, 100.0)
    _, found = step(bank, 600 * MS, [6.0, 4000.0])
    assert counted(bank) == {"estimator raised": 1, "track ended": 1}
    assert [round(state.mean[0]) for state in found] == [6]


def test_a_birth_that_raises_leaves_no_track() -> None:
    def start(prior: Start) -> Estimator:
        raise ValueError("no room")

    bank = GuardedBank(lambda: ObjectBank(MOTION, start, 1.0))
    bank.advance(0)
    bank.birth(0, Start())
    assert (bank.track_ids, len(bank.present())) == ((), 0)
    assert counted(bank) == {"birth failed": 1}


def test_a_bank_that_cannot_remove_a_track_is_replaced() -> None:
    class Sticky(ObjectBank[Moody]):
        def remove(self, track_id: int) -> None:
            raise RuntimeError("stuck")

    bank = GuardedBank(lambda: Sticky(MOTION, Moody, 1.0))
    bank.advance(0)
    for track_id in range(2):
        bank.birth(track_id, Start(yaw_rad=0.0))
    bank.remove(0)
    assert (bank.track_ids, len(bank.present())) == ((), 0)
    assert counted(bank) == {"estimator raised": 1, "track ended": 1}


def test_a_track_whose_state_is_as_before_goes_on() -> None:
    class Full(ObjectBank[Moody]):
        def update(
            self,
            stamp_ns: int,
            track_ids: Sequence[int],
            measurements: Sequence[Measurement],
        ) -> list[UpdateResult]:
            with changing_nothing(track_ids):
                raise MemoryError("no array of 8 GB")

    bank = GuardedBank(lambda: Full(MOTION, Moody, 1.0))
    bank.advance(0)
    for track_id in range(2):
        bank.birth(track_id, Start(yaw_rad=0.0))
    seen = [Measurement.of(0, x_m=0.0, y_m=0.0, std=0.3)] * 2
    assert [result.status for result in bank.update(0, [0, 1], seen)] == [
        UpdateStatus.FAILED
    ] * 2
    assert bank.track_ids == (0, 1)
    assert counted(bank) == {"update failed": 2}
    assert bank.failures.first == "not enough memory: no array of 8 GB"


def test_a_track_that_has_ended_is_not_updated_and_the_others_are() -> None:
    bank = bank_of(0.0, 100.0)
    bank.remove(1)
    bank.advance(600 * MS)
    seen = [Measurement.of(600 * MS, x_m=x, y_m=0.0, std=0.3) for x in (6.0, 106.0)]
    results = bank.update(600 * MS, [0, 1], seen)
    assert [result.status for result in results] == [
        UpdateStatus.IN_SEQUENCE,
        UpdateStatus.FAILED,
    ]
    assert counted(bank) == {"update failed": 1}
    assert bank.failures.first == "a measurement of track 1 could not be fused"
    assert bank.track_ids == (0,)


@pytest.mark.parametrize(
    "answer", [[], [None], [UpdateResult(UpdateStatus.IN_SEQUENCE)] * 2]
)
def test_tracks_of_an_update_without_a_result_each_end(
    answer: list[UpdateResult],
) -> None:
    class Careless(ObjectBank[Moody]):
        def update(
            self,
            stamp_ns: int,
            track_ids: Sequence[int],
            measurements: Sequence[Measurement],
        ) -> list[UpdateResult]:
            return answer

    bank = GuardedBank(lambda: Careless(MOTION, Moody, 1.0))
    bank.advance(0)
    bank.birth(0, Start(yaw_rad=0.0))
    assert (
        bank.update(0, [0], [Measurement.of(0, x_m=0.0, y_m=0.0, std=0.3)])[0].status
        is UpdateStatus.FAILED
    )
    assert counted(bank) == {"update failed": 1, "track ended": 1}
    assert bank.track_ids == ()


def test_bad_data_propagates_and_leaves_no_track_in_an_unknown_state() -> None:
    bank = bank_of(0.0, 100.0)
    with pytest.raises(DataError, match="not this one"):
        step(bank, 600 * MS, [6.0, 3000.0])
    assert bank.track_ids == ()


class FailsOnce(ObjectBank):
    """A bank that raises at the first `left` questions for its states."""

    def __init__(self, left: list[int]) -> None:
        super().__init__(MOTION, Moody, 1.0)
        self.left = left

    def present(self) -> list[TrackState]:
        if self.left[0]:
            self.left[0] -= 1
            raise RuntimeError("not now")
        return super().present()


def test_a_bank_that_raises_once_without_tracks_is_made_again() -> None:
    left = [1]
    bank = GuardedBank(lambda: FailsOnce(left))
    bank.advance(100 * MS)
    assert list(bank.present()) == []
    assert counted(bank) == {"estimator raised": 1}
    bank.birth(3, Start(stamp_ns=100 * MS, yaw_rad=0.0, speed_std_mps=1.0))
    assert step(bank, 200 * MS, [1.0])[0][0].status is UpdateStatus.IN_SEQUENCE


def test_a_bank_that_raises_twice_without_tracks_cannot_go_on() -> None:
    left = [2]
    bank = GuardedBank(lambda: FailsOnce(left))
    bank.advance(100 * MS)
    with pytest.raises(DataError, match=r"even without tracks .* not now"):
        bank.present()
