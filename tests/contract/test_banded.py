"""What `smoother-banded` promises beyond the contract: the windows of `smoother`, for all tracks together."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.time import nanoseconds
from fgtrack.core.types import FloatArray, IntArray, SmoothedReport, TrackState
from fgtrack.estimation.banded.bank import BandedBank
from fgtrack.estimation.banded.smoother import BandedSmoother
from fgtrack.estimation.base import Measurement, Start, UpdateStatus
from fgtrack.estimation.factor_graph import SmootherBank
from fgtrack.estimation.registry import estimator
from fgtrack.estimation.smoothing.settings import SmootherSettings
from fgtrack.models.measurement import SensorPose
from fgtrack.models.motion import CTRA, CTRV, CV, MotionModel
from fgtrack.models.sensors import RobustLoss
from fgtrack.testing.references import Difference, dense_joint, difference
from fgtrack.testing.streams import COMPONENTS, MS, START, measured, shuffled

LINEAR = (("x_m", "y_m"), ("x_m", "y_m", "speed_mps"), ("x_m", "y_m", "yaw_rad"))
KINDS = ("huber", "cauchy", "tukey", "geman_mcclure", "dcs")


def arriving(
    motion: MotionModel, seed: int, names: Sequence[tuple[str, ...]] = LINEAR, delay_s: float = 0.2, num: int = 50
) -> list[Measurement]:
    """Measurements of 2 s in the order of their arrival."""
    rng = np.random.default_rng(seed)
    offsets_ns = np.sort(rng.integers(1, 2000, num)) * MS
    order = np.argsort(offsets_ns + rng.uniform(0.0, delay_s, num) * 1e9)
    drawn = [measured(rng, motion, int(ns), names[rng.integers(len(names))]) for ns in offsets_ns]
    return [drawn[place] for place in order.tolist()]


def largest_difference(
    motion: MotionModel,
    measurements: Sequence[Measurement],
    start: Start = START,
    lag_s: float = 0.7,
    past_s: float = 0.13,
    **options: Any,
) -> float:
    """Between `smoother` and `smoother-banded`, after each measurement: present, a state of the past, and NIS."""
    expected, found = (
        estimator(name, motion, start, lag_s=lag_s, **options) for name in ("smoother", "smoother-banded")
    )
    largest = 0.0
    for measurement in measurements:
        before, after = expected.update(measurement), found.update(measurement)
        assert after.status is before.status
        assert found.window_ns == expected.window_ns
        if before.nis is not None and after.nis is not None:
            largest = max(largest, abs(after.nis - before.nis) / (1.0 + before.nis))
        oldest_ns, newest_ns = expected.window_ns
        for at_ns in (newest_ns + 50 * MS, max(oldest_ns, newest_ns - nanoseconds(past_s))):
            largest = max(largest, *difference(found.state_at(at_ns), expected.state_at(at_ns)))
    return largest


# --- the same graph


@pytest.mark.parametrize("motion", [CTRV(), CTRA()], ids=["ctrv", "ctra"])
@pytest.mark.parametrize("names", [LINEAR, COMPONENTS], ids=["linear", "curved"])
def test_at_any_thresholds_the_states_are_those_of_the_incremental_smoother(
    motion: MotionModel, names: tuple[tuple[str, ...], ...]
) -> None:
    for seed in range(2):
        assert largest_difference(motion, arriving(motion, seed, names)) < 1e-9
    assert largest_difference(motion, arriving(motion, 7, names), max_iterations=4) < 1e-9


def test_so_they_are_in_windows_of_many_blocks() -> None:
    for motion in (CTRV(), CV()):
        measurements = arriving(motion, 8, LINEAR if motion == CTRV() else LINEAR[:1], delay_s=0.3, num=110)
        assert largest_difference(motion, measurements, past_s=1.1, lag_s=1.5) < 1e-9


def test_so_they_are_with_robust_losses_and_an_unknown_heading() -> None:
    unknown = replace(START, yaw_rad=None, yaw_std_rad=None)
    rng = np.random.default_rng(5)
    lossy = [
        replace(m, loss=RobustLoss(KINDS[k % 5], 2.0), z=m.z + (4.0 if rng.random() < 0.1 else 0.0))
        for k, m in enumerate(arriving(CTRV(), 1, LINEAR[:1]))
    ]
    assert largest_difference(CTRV(), lossy) < 1e-9
    assert largest_difference(CTRV(), arriving(CTRV(), 2, LINEAR[:1]), unknown) < 1e-9
    assert largest_difference(CTRV(), lossy, unknown, initiation="two-point") < 1e-9


@pytest.mark.parametrize("late", ["fuse", "drop"])
def test_what_is_older_than_the_window_counts_as_it_does_in_the_incremental_smoother(late: str) -> None:
    measurements = arriving(CV(), 3, LINEAR[:1], delay_s=0.9)
    assert largest_difference(CV(), measurements, lag_s=0.3, late=late, ring_s=0.4) < 1e-9


def test_a_whole_window_converges_to_the_minimum_of_both_gtsam_smoothers() -> None:
    motion = CTRV()
    options = {"relinearise": dict.fromkeys(motion.state_names, 1e-7)}
    for seed in range(2):
        stream = shuffled(motion, np.random.default_rng([seed, 4]))
        three = [
            estimator("smoother-banded", motion, START, lag_s=9.0, **options),
            estimator("smoother", motion, START, lag_s=9.0, **options),
            estimator("smoother-batch", motion, START, lag_s=9.0),
        ]
        for one in three:
            for measurement in stream.measurements:
                one.update(measurement)
            one.converge()  # type: ignore[attr-defined]  # smoothers have it
        for at_ns in (START.stamp_ns, *stream.stamps_ns, stream.newest_ns + 100 * MS):
            states = [one.state_at(at_ns) for one in three]
            assert max(*difference(states[0], states[1]), *difference(states[0], states[2])) < 1e-6


def test_a_window_that_has_marginalised_equals_the_incremental_smoother_at_convergence() -> None:
    motion = CTRV()
    options = {"relinearise": dict.fromkeys(motion.state_names, 1e-7), "max_iterations": 30}
    assert largest_difference(motion, arriving(motion, 4, num=30), lag_s=0.5, **options) < 1e-9


# --- outputs


def test_final_states_are_the_dense_joint_of_what_had_arrived_when_the_node_left() -> None:
    motion = CV()
    for seed in range(6):
        stream = shuffled(motion, np.random.default_rng([11, seed]), span_s=2.0)
        found = BandedSmoother(motion, START, 0.3, ring_s=10.0)
        arrived: list[Measurement] = []
        stamps_ns: list[int] = []
        for measurement in (*stream.measurements, None):
            if measurement is not None:
                found.update(measurement)
            states = found.take_rest() if measurement is None else found.take_final()
            joint = dense_joint(motion, START, arrived, [state.stamp_ns for state in states])
            for state in states:
                assert max(difference(state, joint[state.stamp_ns])) < 1e-9
            stamps_ns += [state.stamp_ns for state in states]
            arrived += [] if measurement is None else [measurement]
        assert stamps_ns == sorted(set(stamps_ns))
        assert set(stamps_ns) <= set(stream.stamps_ns)


def test_a_prior_that_says_nothing_costs_no_digits() -> None:
    motion = CV()
    start = replace(START, position_std_m=1e5, speed_std_mps=1e5)
    found = BandedSmoother(motion, start, 9.0)
    measurements = arriving(motion, 6, LINEAR[:1], num=20)
    for measurement in measurements:
        found.update(measurement)
    for state in found.take_rest():
        joint = dense_joint(motion, start, measurements, [state.stamp_ns])
        assert max(difference(state, joint[state.stamp_ns])) < 1e-6


def test_an_option_that_does_not_exist_is_refused() -> None:
    with pytest.raises(CallError, match="unknown option 'lagg_s'; its options are"):
        BandedSmoother(CV(), START, 1.0, lagg_s=1)


def test_late_data_may_be_an_error_and_the_estimator_stays_as_it_was() -> None:
    found = BandedSmoother(CV(), START, 0.3, late="raise")
    rng = np.random.default_rng(0)
    for k in range(1, 12):
        found.update(measured(rng, CV(), k * 50 * MS))
    start_ns, newest_ns = found.window_ns
    before = [repr(found.state_at(stamp_ns)) for stamp_ns in (start_ns, newest_ns)]
    with pytest.raises(DataError, match=r"0\.01 s older than the window: lengthen smoother\.lag_s"):
        found.update(measured(rng, CV(), start_ns - START.stamp_ns - 10 * MS))
    assert [repr(found.state_at(stamp_ns)) for stamp_ns in (start_ns, newest_ns)] == before


# --- many tracks


def apart(found: TrackState, expected: TrackState) -> Difference:
    """`difference` of what is known of a kinematic state."""
    known = np.diag(expected.covariance) > 0.0
    parts = (TrackState(s.stamp_ns, s.mean[known], s.covariance[known][:, known]) for s in (found, expected))
    return difference(*parts)


class Traffic:
    """Object lists of tracks that begin, end and are missed, delivered to two banks alike."""

    def __init__(self, seed: int, settings: SmootherSettings, motion: MotionModel, latest_ms: int) -> None:
        self.latest_ms = latest_ms
        self.rng = np.random.default_rng(seed)
        self.motion = motion
        self.banks = SmootherBank(motion, settings), BandedBank(motion, settings)
        self.statuses: list[UpdateStatus] = []
        self.smoothed: tuple[list[SmoothedReport], list[SmoothedReport]] = [], []
        self.largest = 0.0
        self._next_id = 0

    def run(self, num: int = 60) -> None:
        now_ns = START.stamp_ns
        for k in range(num):
            now_ns += 25 * MS
            for bank in self.banks:
                bank.advance(now_ns)
            if k % 9 == 0 or self.rng.random() < 0.05:
                self._birth(now_ns - int(self.rng.integers(0, 80)) * MS)
            if len(self.banks[0].track_ids) > 2 and self.rng.random() < 0.05:
                gone = int(self.rng.choice(self.banks[0].track_ids))
                for bank in self.banks:
                    bank.remove(gone)
            self._list(now_ns - int(self.rng.choice([0, 40, 150, 150, 150, self.latest_ms])) * MS)
            self._compare()

    def _birth(self, stamp_ns: int) -> None:
        unknown = self.rng.random() < 0.3
        start = replace(START, stamp_ns=stamp_ns, position_m=self.rng.normal(size=2), yaw_rad=None if unknown else 0.4)
        for bank in self.banks:
            bank.birth(self._next_id, start)
        self._next_id += 1

    def _list(self, stamp_ns: int) -> None:
        expected, found = (bank.states_at(stamp_ns) for bank in self.banks)
        assert found.track_ids == expected.track_ids
        self._differ(expected.means, expected.covariances, found.means, found.covariances)
        seen = [track_id for track_id in expected.track_ids if self.rng.random() < 0.8]
        if not seen:
            return
        names = LINEAR[0] if self.motion.linear else LINEAR[self.rng.integers(3)]
        measurements = [measured(self.rng, self.motion, stamp_ns - START.stamp_ns, names) for _ in seen]
        if self.motion.linear and len(seen) > 2 and self.rng.random() < 0.2:  # gtsam's relinearises all after a failure
            measurements[1] = replace(measurements[1], R=-np.eye(len(names)))
        pairs = zip(*(bank.update(stamp_ns, seen, measurements) for bank in self.banks), strict=True)
        for before, after in pairs:
            assert after.status is before.status
            self.statuses.append(after.status)

    def _compare(self) -> None:
        expected, found = (bank.present() for bank in self.banks)
        for before, after in zip(expected, found, strict=True):
            self.largest = max(self.largest, *apart(after, before))
        for reports, bank in zip(self.smoothed, self.banks, strict=True):
            reports += bank.smoothed()

    def _differ(
        self, means: FloatArray, covariances: FloatArray, found_means: FloatArray, found_covariances: FloatArray
    ) -> None:
        for k in range(len(means)):
            sigma = np.sqrt(np.diag(covariances[k]))
            self.largest = max(
                self.largest,
                float((np.abs(found_means[k] - means[k]) / sigma).max()),
                float((np.abs(found_covariances[k] - covariances[k]) / np.outer(sigma, sigma)).max()),
            )


@pytest.mark.parametrize("seed", range(3))
def test_a_bank_of_tracks_of_all_ages_is_a_bank_of_single_smoothers(seed: int) -> None:
    traffic = Traffic(seed, SmootherSettings(lag_s=0.5, ring_s=0.5, lagged_s=(0.2, 0.4)), CTRV(), latest_ms=450)
    traffic.run()
    assert traffic.largest < 1e-9
    expected, found = traffic.smoothed
    assert [(r.track_id, r.lag_s, r.state.stamp_ns) for r in found] == [
        (r.track_id, r.lag_s, r.state.stamp_ns) for r in expected
    ]
    lagged = [(a.state, b.state) for a, b in zip(found, expected, strict=True) if a.lag_s is not None]
    final = [(a.state, b.state) for a, b in zip(found, expected, strict=True) if a.lag_s is None]
    assert len(lagged) > 50
    assert len(final) > 50
    assert max(max(apart(*pair)) for pair in lagged) < 1e-9
    assert max(apart(*pair).mean_sigma for pair in final) < 0.1  # linearised where the window was, not anew
    assert {UpdateStatus.IN_SEQUENCE, UpdateStatus.OUT_OF_SEQUENCE} <= set(traffic.statuses)


def test_in_a_linear_model_the_final_states_are_the_same_as_well() -> None:
    traffic = Traffic(9, SmootherSettings(lag_s=0.4, ring_s=0.5), CV(), latest_ms=600)
    traffic.run()
    expected, found = traffic.smoothed
    assert traffic.largest < 1e-9
    assert max(max(apart(a.state, b.state)) for a, b in zip(found, expected, strict=True)) < 1e-9
    assert {UpdateStatus.BEYOND_WINDOW, UpdateStatus.FAILED} <= set(traffic.statuses)


def test_a_track_whose_window_cannot_be_solved_fails_alone_and_stays_as_it_was(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The solver gives up on track 1 once for all together and once alone, after it has changed the arrays."""
    motion, rng = CTRV(), np.random.default_rng(3)
    hit, spared = (BandedBank(motion, SmootherSettings(lag_s=0.3, ring_s=5.0)) for _ in range(2))
    for bank in (hit, spared):
        for track_id in range(3):
            bank.birth(track_id, START)
    for k in range(1, 12):
        measurements = [measured(rng, motion, 50 * k * MS) for _ in range(3)]
        for bank in (hit, spared):
            bank.advance(START.stamp_ns + 50 * k * MS)
            bank.update(START.stamp_ns + 50 * k * MS, [0, 1, 2], measurements)
    eliminate = hit.windows.solver.eliminate
    for ms in (430, 275, 100, 600):
        stamp_ns = START.stamp_ns + ms * MS
        measurements = [measured(rng, motion, ms * MS) for _ in range(3)]
        expected = spared.update(stamp_ns, [0, 2], measurements[::2])
        calls = []
        period, hits = (3, 2) if ms == 100 else (2, 1)  # one call more behind the window, before its nodes change

        def gives_up(
            tracks: IntArray,
            places: IntArray,
            calls: list[bool] = calls,
            period: int = period,
            hits: int = hits,
        ) -> None:
            """At every update with track 1, but not where the window is built again after that."""
            eliminate(tracks, places)
            if 1 in tracks:
                calls.append(True)
                if len(calls) % period == hits:
                    raise np.linalg.LinAlgError("gave up")

        with monkeypatch.context() as patch:
            patch.setattr(hit.windows.solver, "eliminate", gives_up)
            found = hit.update(stamp_ns, [0, 1, 2], measurements)
        assert found[1].status is UpdateStatus.FAILED
        assert [found[0].status, found[2].status] == [result.status for result in expected]
        for before, after in zip(spared.present(), hit.present(), strict=True):
            assert max(apart(after, before)) < 1e-9
        for at_ms in (70, 120):
            before, after = (bank.state_at(1, START.stamp_ns + at_ms * MS) for bank in (spared, hit))
            assert max(difference(after, before)) < 1e-9
    stamp_ns = START.stamp_ns + 500 * MS
    measurements = [measured(rng, motion, 500 * MS) for _ in range(3)]
    for bank in (hit, spared):
        bank.update(stamp_ns, [0, 1, 2], measurements)
    for before, after in zip(spared.present(), hit.present(), strict=True):
        assert max(apart(after, before)) < 1e-9


def test_sensors_at_two_poses_in_one_list_are_told_apart() -> None:
    motion = CTRV()
    expected, found = SmootherBank(motion, SmootherSettings()), BandedBank(motion, SmootherSettings())
    std = {"range_m": 0.3, "bearing_rad": 0.02}
    measurements = [
        Measurement.of(START.stamp_ns + 50 * MS, range_m=10.0, bearing_rad=0.3, std=std, pose=SensorPose(-6.0, -5.0)),
        Measurement.of(START.stamp_ns + 50 * MS, range_m=10.0, bearing_rad=-0.3, std=std, pose=SensorPose(-6.0, 2.0)),
    ]
    for bank in (expected, found):
        bank.advance(START.stamp_ns + 50 * MS)
        for track_id in range(2):
            bank.birth(track_id, START)
        bank.update(START.stamp_ns + 50 * MS, [0, 1], measurements)
    for before, after in zip(expected.present(), found.present(), strict=True):
        assert max(apart(after, before)) < 1e-9


def test_the_arrays_stay_as_small_as_window_and_ring_need() -> None:
    motion, rng = CTRV(), np.random.default_rng(4)
    bank = BandedBank(motion, SmootherSettings(lag_s=0.3, ring_s=0.3))
    for k in range(1, 301):
        stamp_ns = START.stamp_ns + 25 * k * MS
        bank.advance(stamp_ns)
        if k % 30 == 1:  # one after the other, and one that stays
            for track_id in bank.track_ids[1:]:
                bank.remove(track_id)
            bank.birth(k, replace(START, stamp_ns=stamp_ns))
        seen = [track_id for track_id in bank.track_ids if rng.random() < 0.9]
        bank.states_at(stamp_ns)
        bank.update(stamp_ns, seen, [measured(rng, motion, 25 * k * MS) for _ in seen])
        bank.smoothed()
    nodes = bank.windows.nodes
    assert nodes.stamps_ns.shape == (4, 64)
    assert nodes.rows.shape[:2] == (4 * 64, 4)
    assert len(nodes.terms) <= 4 * 64
    assert max(map(len, nodes.terms.values())) <= 1
    assert len(bank._states) <= 2
