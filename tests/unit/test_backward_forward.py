import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement, Start
from fgtrack.estimation.filters.ekf import correct
from fgtrack.estimation.filters.propagation import ExactPropagator
from fgtrack.karle2023.backward_forward import BackwardForwardBank
from fgtrack.karle2023.euler import EulerCtrv
from fgtrack.models.measurement import SensorPose, measurement_model
from fgtrack.models.motion import CTRV

STEP_NS = 10_000_000
START_NS = 1_600_000_000_000_000_000
DENSITY = np.array([4e-4, 4e-4, 9e-4, 1e-2, 2.5e-3])
POSITION = measurement_model(("x_m", "y_m"), CTRV())
BEARING = measurement_model(("bearing_rad",), CTRV())


def euler() -> EulerCtrv:
    return EulerCtrv(CTRV(), DENSITY)


def bank(storage_steps: int = 50) -> BackwardForwardBank:
    made = BackwardForwardBank(euler(), STEP_NS, storage_steps)
    made.advance(START_NS)
    return made


def prior(
    stamp_ns: int, x_m: float = 0.0, y_m: float = 0.0, yaw_rad: float | None = 0.2
) -> Start:
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


def test_the_present_lies_between_grid_stamps_and_its_yaw_is_wrapped() -> None:
    made = bank()
    made.birth(0, prior(START_NS, yaw_rad=math.pi - 1e-4))
    made.advance(START_NS + 14_000_000)
    [state] = made.present()
    assert state.stamp_ns == made.present_ns == START_NS + 14_000_000
    grid = made.states_at(START_NS + 10_000_000)
    means, _ = euler().propagate(grid.means, grid.covariances, np.array([1]), 0.004)
    same(state.mean[:2], means[0, :2])
    assert state.mean[2] == pytest.approx(-math.pi - 1e-4 + 0.0014)


def test_a_full_storage_forgets_the_oldest_states_alone() -> None:
    short, long = bank(storage_steps=4), bank(storage_steps=50)
    for made in (short, long):
        made.birth(0, prior(START_NS))
        for step in range(1, 20):
            made.advance(START_NS + step * STEP_NS)
            made.update(made.present_ns, [0], [position(made.present_ns, 0.4 * step)])
    for back in range(4):
        mine, theirs = (
            made.states_at(made.present_ns - back * STEP_NS) for made in (short, long)
        )
        assert np.array_equal(mine.means, theirs.means)
    assert short.states_at(short.present_ns - 4 * STEP_NS).track_ids == ()


def test_a_measurement_that_cannot_be_fused_fails_alone_and_changes_nothing() -> None:
    made = bank()
    for track_id in range(3):
        made.birth(track_id, prior(START_NS))
    before = made.present()
    bad = Measurement(START_NS, POSITION, np.array([math.nan, 0.0]), np.eye(2))
    results = made.update(
        START_NS, [0, 1, 2], [position(START_NS, 1.0), bad, position(START_NS, 2.0)]
    )
    assert [result.status for result in results] == [
        "in_sequence",
        "failed",
        "in_sequence",
    ]
    assert (results[1].innovation, results[1].nis) == (None, None)
    after = made.present()
    assert np.array_equal(before[1].mean, after[1].mean)
    assert not np.array_equal(before[0].mean, after[0].mean)
    assert not np.array_equal(before[2].mean, after[2].mean)


def measured(rng: np.random.Generator, stamp_ns: int, x: FloatArray) -> Measurement:
    """A position, or a bearing from anywhere."""
    if rng.random() < 0.6:
        return position(stamp_ns, *(x[:2] + rng.normal(scale=0.3, size=2)))
    pose = SensorPose(*rng.normal(scale=100.0, size=2).tolist(), rng.uniform(-3.0, 3.0))
    return Measurement(
        stamp_ns,
        BEARING,
        BEARING.predict(x, pose) + 0.01 * rng.normal(size=1),
        1e-3 * np.eye(1),
        pose,
    )


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

    def step(
        self, mean: FloatArray, covariance: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        means, covariances = self.propagator.propagate(
            mean[None], covariance[None], np.array([1]), STEP_NS / 1e9
        )
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

    def birth(
        self, track_id: int, mean: FloatArray, covariance: FloatArray, stamp_ns: int
    ) -> None:
        start_ns = (
            self.grid_ns - max(round((self.grid_ns - stamp_ns) / STEP_NS), 0) * STEP_NS
        )
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

    def update(
        self,
        stamp_ns: int,
        track_ids: Sequence[int],
        measurements: Sequence[Measurement],
    ) -> list[tuple[FloatArray, float]]:
        """Fuse and return innovations and NIS."""
        places, results = self.nearest(stamp_ns), []
        for track_id, m in zip(track_ids, measurements, strict=True):
            track, place = self.tracks[track_id], places[track_id]
            mean = track.means[place][None]
            done = correct(
                mean,
                track.covariances[place][None],
                *m.model.linearised(m.z[None], mean, m.pose),
                m.R[None],
            )
            steps = len(track.means) - 1 - place
            del (
                track.stamps_ns[place + 1 :],
                track.means[place:],
                track.covariances[place:],
            )
            track.means.append(self.propagator.wrap(done.mean)[0])
            track.covariances.append(done.covariance[0])
            for _ in range(steps):
                self.grow(track)
            results.append((done.innovation[0], float(done.nis[0])))
        return results


@settings(deadline=None, max_examples=15)
@given(seed=st.integers(0, 2**32 - 1), length=st.sampled_from([1, 2, 7, 25, 150]))
def test_any_history_of_operations_is_that_of_a_bank_of_lists(
    seed: int, length: int
) -> None:
    """Births, updates anywhere in the window, cut storage, long stretches and removals keep tracks apart."""
    rng = np.random.default_rng(seed)
    made = BackwardForwardBank(euler(), STEP_NS, length)
    made.advance(START_NS)
    naive = NaiveBank(euler(), length, START_NS)
    next_id = 0
    for _ in range(25):
        stamp_ns = made.present_ns - int(
            rng.integers(-STEP_NS, max(length - 1, 1) * STEP_NS)
        )
        match rng.choice(
            ["advance", "birth", "birth", "update", "update", "remove"],
            p=[0.3, 0.2, 0.1, 0.2, 0.1, 0.1],
        ):
            case "advance":
                now_ns = made.present_ns + int(rng.integers(0, 2 * length)) * STEP_NS
                made.advance(now_ns)
                naive.advance(now_ns)
            case "birth":
                given_prior = prior(
                    stamp_ns,
                    *rng.normal(scale=100.0, size=2),
                    yaw_rad=rng.uniform(-3.0, 3.0),
                )
                made.birth(next_id, given_prior)
                mean = np.array(
                    [*given_prior.position_m, given_prior.yaw_rad, 40.0, 0.1]
                )
                naive.birth(
                    next_id, mean, np.diag([0.1, 0.1, 0.09, 4.0, 0.04]), stamp_ns
                )
                next_id += 1
            case "update":
                places = naive.nearest(stamp_ns)
                ids = [i for i in places if rng.random() < 0.7]
                rng.shuffle(ids)
                measurements = [
                    measured(rng, stamp_ns, naive.tracks[i].means[places[i]])
                    for i in ids
                ]
                results = made.update(stamp_ns, ids, measurements)
                for result, (y, nis) in zip(
                    results, naive.update(stamp_ns, ids, measurements), strict=True
                ):
                    np.testing.assert_allclose(
                        result.innovation, y, rtol=1e-7, atol=1e-7
                    )
                    assert result.nis == pytest.approx(nis, rel=1e-6)
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
                np.testing.assert_allclose(
                    states.means[row], track.means[place], rtol=1e-9, atol=1e-7
                )
                np.testing.assert_allclose(
                    states.covariances[row],
                    track.covariances[place],
                    rtol=1e-7,
                    atol=1e-8,
                )


def test_a_copy_of_a_bank_goes_on_alone() -> None:
    original = bank()
    original.birth(7, Start(stamp_ns=START_NS, yaw_rad=0.0, speed_mps=20.0))
    clone = copy.deepcopy(original)
    before = original.states_at(START_NS).means.copy()
    clone.update(
        START_NS,
        [7],
        [Measurement(START_NS, POSITION, np.array([1.0, 1.0]), 0.1 * np.eye(2))],
    )
    np.testing.assert_array_equal(original.states_at(START_NS).means, before)
    assert not np.array_equal(clone.states_at(START_NS).means, before)
