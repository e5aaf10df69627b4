"""A bank outlives what its estimators raise: the track begins anew or ends, the others go on."""

from collections.abc import Sequence

import numpy as np
import pytest

from fgtrack.core.errors import DataError
from fgtrack.core.types import FloatArray, SmoothedReport, TrackState
from fgtrack.estimation.base import Estimator, Measurement, Start, StatesAt, UpdateResult, UpdateStatus
from fgtrack.estimation.failures import EndedTrack, Failure
from fgtrack.estimation.forwarding import has
from fgtrack.estimation.object_bank import ObjectBank
from fgtrack.estimation.replay import ReplayEkf
from fgtrack.models.motion import CTRA, CTRV, MotionModel
from fgtrack.tracking.restarting import RestartingBank

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
        return TrackState(stamp_ns, state.mean * np.nan, state.covariance) if self.mood == 2000.0 else state


def bank_of(*x_m: float, motion: MotionModel = MOTION) -> RestartingBank:
    """A bank of cars that drive east at 10 m/s from these places, seen five times."""
    bank = RestartingBank(lambda: ObjectBank(motion, lambda start: Moody(start, motion), 1.0))
    bank.advance(0)
    for track_id, x in enumerate(x_m):
        bank.birth(track_id, Start(stamp_ns=0, position_m=(x, 0.0), yaw_rad=0.0, speed_mps=10.0, speed_std_mps=1.0))
    for k in range(1, 6):
        step(bank, 100 * MS * k, [x + 1.0 * k for x in x_m])
    assert counted(bank) == {}
    return bank


def step(bank: RestartingBank, stamp_ns: int, x_m: Sequence[float]) -> tuple[list[UpdateResult], list[TrackState]]:
    """A tick with a measurement of every track."""
    bank.advance(stamp_ns)
    measured = [Measurement.of(stamp_ns, x_m=x, y_m=0.0, std={"x_m": 0.3, "y_m": 0.3}) for x in x_m]
    return bank.update(stamp_ns, bank.track_ids, measured), bank.present()


def counted(bank: RestartingBank) -> dict[str, int]:
    """What was done about failures, and the failures."""
    return {failure.value: count for failure, count in bank.failures.counts.items()}


def states(bank: RestartingBank) -> dict[int, TrackState]:
    return dict(zip(bank.track_ids, bank.present(), strict=True))


def test_a_track_whose_update_raises_begins_anew_where_it_was_and_is_no_surer_than_before() -> None:
    bank, calm = bank_of(0.0), bank_of(0.0)
    [before] = bank.present()
    calm.advance(600 * MS)
    [result], [after] = step(bank, 600 * MS, [1000.0])
    assert result == UpdateResult(UpdateStatus.FAILED)
    assert counted(bank) == {"update failed": 1, "track restarted": 1}
    assert "singular" in str(bank.failures.last)
    travelled = np.array([before.mean[3] * 0.1, 0.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(after.mean, before.mean + travelled, atol=1e-9)
    surer = after.covariance - calm.present()[0].covariance
    assert np.linalg.eigvalsh(surer)[0] > -1e-9
    assert after.covariance[0, 0] < 6.0 * before.covariance[0, 0]
    [result], [state] = step(bank, 700 * MS, [7.0])
    assert result.status is UpdateStatus.IN_SEQUENCE
    assert state.mean[0] == pytest.approx(7.0, abs=0.3)


def test_a_track_that_fails_again_before_an_update_has_succeeded_ends() -> None:
    bank = bank_of(0.0)
    step(bank, 600 * MS, [1000.0])
    step(bank, 700 * MS, [1000.0])
    assert (counted(bank), bank.track_ids) == ({"update failed": 2, "track restarted": 1, "track ended": 1}, ())
    assert bank.failures.ended == [EndedTrack(0, 700 * MS, Failure.UPDATE_FAILED)]
    bank.remove(0)  # as the tracker does when its time has come


def test_a_track_that_fails_again_after_an_update_has_succeeded_begins_anew_again() -> None:
    bank = bank_of(0.0)
    for stamp_ns, x_m in ((600, 1000.0), (700, 7.0), (800, 1000.0), (900, 9.0)):
        step(bank, stamp_ns * MS, [x_m])
    assert (counted(bank), bank.track_ids) == ({"update failed": 2, "track restarted": 2}, (0,))


def test_tracks_that_failed_together_are_told_apart_by_their_next_updates() -> None:
    bank = bank_of(0.0, 100.0, 200.0)
    step(bank, 600 * MS, [6.0, 1000.0, 206.0])
    assert counted(bank) == {"update failed": 3, "track restarted": 3}  # nobody knows which of them it was
    results, _ = step(bank, 700 * MS, [7.0 if i == 0 else 1000.0 if i == 1 else 207.0 for i in bank.track_ids])
    assert [result.status for result in results].count(UpdateStatus.FAILED) == 1
    assert sorted(bank.track_ids) == [0, 2]
    assert counted(bank) == {"update failed": 4, "track restarted": 3, "track ended": 1}
    assert states(bank)[2].mean[0] == pytest.approx(207.0, abs=0.5)


def test_a_measurement_that_is_said_to_have_failed_is_not_fused() -> None:
    bank, calm = bank_of(0.0, 100.0), bank_of(0.0, 100.0)
    step(bank, 600 * MS, [6.5, 1000.0])  # the first is updated, then the second raises
    calm.advance(600 * MS)
    np.testing.assert_allclose(states(bank)[0].mean, states(calm)[0].mean, atol=1e-9)


def test_a_track_whose_state_is_not_finite_begins_anew() -> None:
    bank = bank_of(0.0, 100.0)
    _, found = step(bank, 600 * MS, [6.0, 2000.0])
    assert counted(bank) == {"not finite": 1, "track restarted": 1}
    assert bank.failures.last == "the state of track 1 is not finite"
    assert all(np.isfinite(state.mean).all() for state in found)
    assert states(bank)[1].mean[0] == pytest.approx(106.0, abs=0.5)


def test_states_that_are_not_finite_are_not_offered() -> None:
    bank = bank_of(0.0, 100.0)
    bank.advance(600 * MS)
    bank.update(600 * MS, [1], [Measurement.of(600 * MS, x_m=2000.0, y_m=0.0, std={"x_m": 0.3, "y_m": 0.3})])
    assert bank.states_at(600 * MS).track_ids == (0,)


def test_where_all_are_asked_and_one_raises_all_begin_anew() -> None:
    bank = bank_of(0.0, 100.0)
    _, found = step(bank, 600 * MS, [6.0, 4000.0])
    assert counted(bank) == {"estimator raised": 1, "track restarted": 2}
    assert [round(state.mean[0]) for state in found] == [6, 106]


def test_a_track_that_even_anew_has_no_state_ends_and_the_others_stay() -> None:
    class Cursed(Moody):
        def state_at(self, stamp_ns: int) -> TrackState:
            if self.cursed:
                raise RuntimeError("never")
            return super().state_at(stamp_ns)

        def __init__(self, start: Start) -> None:
            super().__init__(start)
            self.cursed = start.position_m[0] > 50.0

    bank = RestartingBank(lambda: ObjectBank(MOTION, Cursed, 1.0))
    bank.advance(0)
    for track_id, x_m in enumerate((0.0, 100.0)):
        bank.birth(track_id, Start(position_m=(x_m, 0.0), yaw_rad=0.0, speed_mps=10.0))
    assert len(bank.present()) == 1
    assert bank.track_ids == (0,)
    assert bank.failures.counts[Failure.TRACK_ENDED] == 1


def test_a_birth_that_raises_leaves_no_track() -> None:
    def start(prior: Start) -> Estimator:
        raise ValueError("no room")

    bank = RestartingBank(lambda: ObjectBank(MOTION, start, 1.0))
    bank.advance(0)
    bank.birth(0, Start())
    assert (bank.track_ids, bank.present()) == ((), [])
    assert counted(bank) == {"birth failed": 1}


def test_bad_data_is_an_answer_and_is_let_through() -> None:
    bank = bank_of(0.0)
    with pytest.raises(DataError, match="not this one"):
        step(bank, 600 * MS, [3000.0])
    assert counted(bank) == {}


def test_a_bank_that_cannot_remove_a_track_is_made_anew_without_it() -> None:
    class Sticky(ObjectBank):
        def remove(self, track_id: int) -> None:
            raise RuntimeError("stuck")

    bank = RestartingBank(lambda: Sticky(MOTION, Moody, 1.0))
    bank.advance(0)
    for track_id in range(2):
        bank.birth(track_id, Start(yaw_rad=0.0))
    bank.remove(0)
    assert bank.track_ids == (1,)


def test_an_acceleration_is_kept() -> None:
    bank = bank_of(0.0, motion=CTRA())
    [before] = bank.present()
    step(bank, 600 * MS, [1000.0])
    [after] = bank.present()
    kept: FloatArray = after.mean[5:]
    np.testing.assert_allclose(kept, before.mean[5:])


def test_births_do_not_list_all_tracks() -> None:
    """Else a list of many new objects takes the square of their number."""
    listed = 0

    class Listing(ObjectBank):
        @property
        def track_ids(self) -> tuple[int, ...]:
            nonlocal listed
            listed += 1
            return super().track_ids

    bank = RestartingBank(lambda: Listing(MOTION, lambda start: Moody(start, MOTION), 1.0))
    for track_id in range(20):
        bank.birth(track_id, Start(yaw_rad=0.0))
        assert has(bank, track_id)
    for track_id in range(10):
        bank.remove(track_id)
    assert not has(bank, 0)
    assert listed == 0
    assert bank.track_ids == tuple(range(10, 20))


class Wrong(ObjectBank[Moody]):
    """A bank that answers with what is none from the third tick on."""

    wrong = ""
    _ticks = 0

    def advance(self, now_ns: int) -> None:
        self._ticks += 1
        super().advance(now_ns)

    def _is(self, wrong: str) -> bool:
        return self.wrong == wrong and self._ticks >= 3

    @property
    def track_ids(self) -> tuple[int, ...]:
        return None if self._is("no tracks") else super().track_ids  # type: ignore[return-value]  # wrong on purpose

    def smoothed(self) -> list[SmoothedReport]:
        return None if self._is("no smoothed states") else super().smoothed()  # type: ignore[return-value]  # the same

    def states_at(self, stamp_ns: int) -> StatesAt:
        found = super().states_at(stamp_ns)
        if self._is("complex states"):
            return StatesAt(found.track_ids, found.means * 1j, found.covariances)
        return StatesAt((), found.means, found.covariances) if self._is("other tracks") else found

    def present(self) -> list[TrackState]:
        states = super().present()
        if self._is("complex present"):
            return [TrackState(one.stamp_ns, one.mean + 0j, one.covariance) for one in states]
        return states


@pytest.mark.parametrize(
    "wrong", ["no tracks", "no smoothed states", "complex states", "other tracks", "complex present"]
)
def test_an_answer_that_is_none_is_counted_and_the_track_goes_on(wrong: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Wrong, "wrong", wrong)
    bank = RestartingBank(lambda: Wrong(MOTION, Moody, 1.0))
    bank.advance(0)
    bank.birth(0, Start(stamp_ns=0, yaw_rad=0.0, speed_mps=10.0))
    for k in range(1, 4):
        bank.advance(100 * MS * k)
        bank.states_at(100 * MS * k)
        assert np.isrealobj(bank.present()[0].mean)
        assert bank.smoothed() == []
    assert bank.track_ids == (0,)
    assert counted(bank) == {"estimator raised": 1, "track restarted": 1}
