import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement, Start, UpdateStatus
from fgtrack.estimation.filters.backward_forward import BackwardForwardBank
from fgtrack.estimation.filters.ekf import correct
from fgtrack.estimation.filters.propagation import EulerCtrv, ExactPropagator
from fgtrack.estimation.filters.published import PublishedStorage
from fgtrack.models.measurement import SensorPose, measurement_model
from fgtrack.models.motion import CTRV

STEP_NS = 10_000_000
START_NS = 1_600_000_000_000_000_000
DENSITY = np.array([4e-4, 4e-4, 9e-4, 1e-2, 2.5e-3])
POSITION = measurement_model(("x_m", "y_m"), CTRV())
POSE = measurement_model(("x_m", "y_m", "yaw_rad"), CTRV())
BEARING = measurement_model(("bearing_rad",), CTRV())


def euler() -> EulerCtrv:
    return EulerCtrv(CTRV(), DENSITY)


def bank(storage_steps: int = 50) -> BackwardForwardBank:
    made = BackwardForwardBank(euler(), STEP_NS, storage_steps)
    made.advance(START_NS)
    return made


def prior(stamp_ns: int, x_m: float = 0.0, y_m: float = 0.0, yaw_rad: float | None = 0.2) -> Start:
    return Start(
        stamp_ns=stamp_ns,
        position_m=(x_m, y_m),
        position_covariance=0.1 * np.eye(2),
        yaw_rad=yaw_rad,
        yaw_std_rad=0.3,
        speed_mps=40.0,
        speed_std_mps=2.0,
        yaw_rate_radps=0.1,
        yaw_rate_std_radps=0.2,
    )


def position(stamp_ns: int, x_m: float, y_m: float = 0.0) -> Measurement:
    return Measurement(stamp_ns, POSITION, np.array([x_m, y_m]), 0.09 * np.eye(2))


def same(a: FloatArray, b: FloatArray) -> None:
    np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-10)


def ms(value: float) -> int:
    return round(value * 1e6)


# --- the nearest stored state


# --- an update in the past


def test_what_was_fused_after_a_late_stamp_is_forgotten() -> None:
    """The definition of the method: after the late update, the newer one has left no trace."""
    with_newer, without_newer = bank(), bank()
    for made in (with_newer, without_newer):
        made.birth(0, prior(START_NS))
        made.advance(START_NS + 20 * STEP_NS)
    newer_ns, late_ns = START_NS + 15 * STEP_NS, START_NS + 10 * STEP_NS
    [newer] = with_newer.update(newer_ns, [0], [position(newer_ns, 9.0, 9.0)])
    assert newer.status is UpdateStatus.IN_SEQUENCE
    [late] = with_newer.update(late_ns, [0], [position(late_ns, 4.0)])
    [only] = without_newer.update(late_ns, [0], [position(late_ns, 4.0)])
    assert (late.status, only.status) == (UpdateStatus.OUT_OF_SEQUENCE, UpdateStatus.IN_SEQUENCE)
    same(with_newer.present()[0].mean, without_newer.present()[0].mean)
    same(with_newer.present()[0].covariance, without_newer.present()[0].covariance)


# --- births


# --- storage


def test_the_present_lies_between_grid_stamps_and_its_yaw_is_wrapped() -> None:
    made = bank()
    made.birth(0, prior(START_NS, yaw_rad=math.pi - 1e-4))
    made.advance(START_NS + ms(14))
    [state] = made.present()
    assert state.stamp_ns == made.present_ns == START_NS + ms(14)
    grid = made.states_at(START_NS + ms(10))
    means, _ = euler().propagate(grid.means, grid.covariances, np.array([1]), 0.004)
    same(state.mean[:2], means[0, :2])
    assert state.mean[2] == pytest.approx(-math.pi - 1e-4 + 0.0014)


# --- several measurements


def test_measurements_of_several_kinds_and_poses_in_one_call_are_fused_each_for_itself() -> None:
    together, alone = bank(), bank()
    for made in (together, alone):
        for track_id in range(4):
            made.birth(track_id, prior(START_NS, x_m=10.0 * track_id, y_m=1.0))
        made.advance(START_NS + 10 * STEP_NS)
    stamp_ns = START_NS + ms(60)
    R = np.array([[1e-3]])
    measurements = [
        position(stamp_ns, 3.0, 1.5),
        Measurement(stamp_ns, POSE, np.array([12.0, 1.0, 0.3]), 0.1 * np.eye(3)),
        Measurement(stamp_ns, BEARING, np.array([0.1]), R, SensorPose(0.0, 0.0, 0.0)),
        Measurement(stamp_ns, BEARING, np.array([0.1]), R, SensorPose(5.0, -3.0, 0.5)),
    ]
    ids = [2, 0, 3, 1]
    results = together.update(stamp_ns, ids, measurements)
    for track_id, measurement, result in zip(ids, measurements, results, strict=True):
        [one] = alone.update(stamp_ns, [track_id], [measurement])
        assert (one.status, one.nis) == (result.status, pytest.approx(result.nis))
        same(one.innovation, result.innovation)
    for a, b in zip(together.present(), alone.present(), strict=True):
        same(a.mean, b.mean)
        same(a.covariance, b.covariance)


def test_a_measurement_that_cannot_be_fused_fails_alone_and_changes_nothing() -> None:
    made = bank()
    for track_id in range(3):
        made.birth(track_id, prior(START_NS))
    before = made.present()
    bad = Measurement(START_NS, POSITION, np.array([math.nan, 0.0]), np.eye(2))
    results = made.update(START_NS, [0, 1, 2], [position(START_NS, 1.0), bad, position(START_NS, 2.0)])
    assert [result.status for result in results] == ["in_sequence", "failed", "in_sequence"]
    assert (results[1].innovation, results[1].nis) == (None, None)
    after = made.present()
    assert np.array_equal(before[1].mean, after[1].mean)
    assert not np.array_equal(before[0].mean, after[0].mean)
    assert not np.array_equal(before[2].mean, after[2].mean)


# --- against the simplest bank there is


@dataclass
class NaiveTrack:
    """Newest state last; a list, cut at its length."""

    stamps_ns: list[int]
    means: list[FloatArray]
    covariances: list[FloatArray]


@dataclass
class NaiveBank:
    """The method for one track at a time, on lists, one step after the other."""

    propagator: ExactPropagator
    length: int
    grid_ns: int
    tracks: dict[int, NaiveTrack] = field(default_factory=dict)

    def step(self, mean: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        means, covariances = self.propagator.propagate(mean[None], covariance[None], np.array([1]), STEP_NS / 1e9)
        return means[0], covariances[0]

    def advance(self, grid_ns: int) -> None:
        while self.grid_ns < grid_ns:
            self.grid_ns += STEP_NS
            for track in self.tracks.values():
                self.grow(track)

    def grow(self, track: NaiveTrack) -> None:
        mean, covariance = self.step(track.means[-1], track.covariances[-1])
        track.stamps_ns.append(track.stamps_ns[-1] + STEP_NS)
        track.means.append(mean)
        track.covariances.append(covariance)
        for column in (track.stamps_ns, track.means, track.covariances):
            del column[: -self.length]

    def birth(self, track_id: int, mean: FloatArray, covariance: FloatArray, stamp_ns: int) -> None:
        start_ns = self.grid_ns - max(round((self.grid_ns - stamp_ns) / STEP_NS), 0) * STEP_NS
        track = self.tracks[track_id] = NaiveTrack([start_ns], [mean], [covariance])
        while track.stamps_ns[-1] < self.grid_ns:
            self.grow(track)

    def nearest(self, stamp_ns: int) -> dict[int, int]:
        """Place of the stored state for every track that reaches back so far."""
        places = {}
        for track_id, track in self.tracks.items():
            if track.stamps_ns[0] - stamp_ns <= STEP_NS / 2:
                gaps = [abs(stored_ns - stamp_ns) for stored_ns in track.stamps_ns]
                places[track_id] = len(gaps) - 1 - gaps[::-1].index(min(gaps))
        return places

    def update(self, stamp_ns: int, track_ids: Sequence[int], measurements: Sequence[Measurement]) -> None:
        places = self.nearest(stamp_ns)
        for track_id, m in zip(track_ids, measurements, strict=True):
            track, place = self.tracks[track_id], places[track_id]
            mean = track.means[place][None]
            done = correct(
                mean, track.covariances[place][None], *m.model.linearised(m.z[None], mean, m.pose), m.R[None]
            )
            steps = len(track.means) - 1 - place
            del track.stamps_ns[place + 1 :], track.means[place:], track.covariances[place:]
            track.means.append(self.propagator.wrap(done.mean)[0])
            track.covariances.append(done.covariance[0])
            for _ in range(steps):
                self.grow(track)


@settings(deadline=None, max_examples=15)
@given(seed=st.integers(0, 2**32 - 1), length=st.sampled_from([1, 2, 7, 25, 150]))
def test_any_history_of_operations_is_that_of_a_bank_of_lists(seed: int, length: int) -> None:
    """Births, updates anywhere in the window, cut storage, long stretches and removals keep tracks apart."""
    rng = np.random.default_rng(seed)
    made = BackwardForwardBank(euler(), STEP_NS, length)
    made.advance(START_NS)
    naive = NaiveBank(euler(), length, START_NS)
    next_id = 0
    for _ in range(25):
        stamp_ns = made.present_ns - int(rng.integers(-STEP_NS, max(length - 1, 1) * STEP_NS))
        match rng.choice(["advance", "birth", "birth", "update", "update", "remove"], p=[0.3, 0.2, 0.1, 0.2, 0.1, 0.1]):
            case "advance":
                now_ns = made.present_ns + int(rng.integers(0, 2 * length)) * STEP_NS
                made.advance(now_ns)
                naive.advance(now_ns)
            case "birth":
                given_prior = prior(stamp_ns, *rng.normal(scale=100.0, size=2), yaw_rad=rng.uniform(-3.0, 3.0))
                made.birth(next_id, given_prior)
                mean = np.array([*given_prior.position_m, given_prior.yaw_rad, 40.0, 0.1])
                naive.birth(next_id, mean, np.diag([0.1, 0.1, 0.09, 4.0, 0.04]), stamp_ns)
                next_id += 1
            case "update":
                places = naive.nearest(stamp_ns)
                ids = [i for i in places if rng.random() < 0.7]
                rng.shuffle(ids)
                seen = [naive.tracks[i].means[places[i]][:2] + rng.normal(scale=0.3, size=2) for i in ids]
                measurements = [position(stamp_ns, *xy) for xy in seen]
                made.update(stamp_ns, ids, measurements)
                naive.update(stamp_ns, ids, measurements)
            case "remove" if naive.tracks:
                gone = int(rng.choice(list(naive.tracks)))
                made.remove(gone)
                del naive.tracks[gone]
        assert made.track_ids == tuple(naive.tracks)
        for back in range(0, length, 1 + length // 10):
            at_ns = made.present_ns - back * STEP_NS
            states, places = made.states_at(at_ns), naive.nearest(at_ns)
            assert states.track_ids == tuple(places)
            for row, (track_id, place) in enumerate(places.items()):
                track = naive.tracks[track_id]
                np.testing.assert_allclose(states.means[row], track.means[place], rtol=1e-9, atol=1e-7)
                np.testing.assert_allclose(states.covariances[row], track.covariances[place], rtol=1e-7, atol=1e-8)


# --- the published storage


def test_a_leading_clock_reaches_now_or_leads_by_less_than_a_step_and_never_waits() -> None:
    made = PublishedStorage(euler(), STEP_NS, 20, leads=True, is_stale=False)
    for now_ms, lead_ms in [(0, 0), (20, 20), (33, 40), (34, 50), (50, 60), (60, 70), (200, 200)]:
        made.advance(START_NS + ms(now_ms))
        assert made.present_ns == START_NS + ms(lead_ms)


def test_a_stale_storage_keeps_the_prior_of_an_update_without_delay() -> None:
    made = PublishedStorage(euler(), STEP_NS, 20, leads=False, is_stale=True)
    made.advance(START_NS)
    made.birth(0, prior(START_NS))
    made.update(START_NS, [0], [position(START_NS, 1.0)])
    present = made.states_at(START_NS).means[0, 0]
    assert present > 0.3
    made.advance(START_NS + STEP_NS)
    stored = made.states_at(START_NS)
    assert stored.means[0, 0] == 0.0
    made.update(START_NS, [0], [position(START_NS, 1.0)])  # delayed now: reaches the storage
    assert made.states_at(START_NS).means[0, 0] == pytest.approx(present)
