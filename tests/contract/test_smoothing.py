"""What the fixed-lag smoothers promise beyond the contract of all estimators, with each solver."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fgtrack.core.time import nanoseconds
from fgtrack.core.types import SmoothedReport, TrackState
from fgtrack.estimation.base import Estimator, Measurement, Start, UpdateStatus
from fgtrack.estimation.failures import Failure
from fgtrack.estimation.object_bank import SingleObject, state_of
from fgtrack.estimation.registry import estimator
from fgtrack.estimation.smoothing.bank import SmootherBank
from fgtrack.estimation.smoothing.gtsam.batch import BatchBank
from fgtrack.estimation.smoothing.gtsam.incremental import IncrementalBank
from fgtrack.models.measurement import SensorPose
from fgtrack.models.motion import CTRA, CTRV, CV, MotionModel
from fgtrack.models.sensors import RobustLoss
from fgtrack.testing.references import dense_joint, difference
from fgtrack.testing.streams import COMPONENTS, MS, START, measured, shuffled

START_NS = START.stamp_ns
LINEAR = (("x_m", "y_m"), ("x_m", "y_m", "speed_mps"), ("x_m", "y_m", "yaw_rad"))
KINDS = ("huber", "cauchy", "tukey", "geman_mcclure", "dcs")
TOLERANCES: dict[type[SmootherBank], float] = {
    SmootherBank: 1e-9,
    IncrementalBank: 1e-9,
    BatchBank: 1e-6,
}


def smoother(
    motion: MotionModel, make: type[SmootherBank], lag_s: float = 0.3
) -> tuple[SingleObject, SmootherBank]:
    bank = make(motion, lag_s, ring_s=10.0, final=True)
    return SingleObject(motion, bank, START), bank


def final(bank: SmootherBank) -> list[TrackState]:
    return [report.state for report in bank.smoothed()]


def fill(
    motion: MotionModel, rng: np.random.Generator, *estimators: Estimator, num: int = 9
) -> None:
    for k in range(1, num + 1):
        measurement = measured(rng, motion, k * 50 * MS)
        for each in estimators:
            each.update(measurement)


def apart(first: Estimator, second: Estimator) -> float:
    stamps_ns = [START_NS + ms * MS for ms in (0, 120, 345, 450, 475, 500, 600)]
    return max(
        max(difference(first.state_at(at), second.state_at(at))) for at in stamps_ns
    )


def arriving(
    motion: MotionModel,
    seed: int,
    names: Sequence[tuple[str, ...]] = LINEAR,
    delay_s: float = 0.2,
    num: int = 50,
) -> list[Measurement]:
    """Measurements of 2 s in the order of their arrival."""
    rng = np.random.default_rng(seed)
    offsets_ns = np.sort(rng.integers(1, 2000, num)) * MS
    order = np.argsort(offsets_ns + rng.uniform(0.0, delay_s, num) * 1e9)
    drawn = [
        measured(rng, motion, int(ns), names[rng.integers(len(names))])
        for ns in offsets_ns
    ]
    return [drawn[index] for index in order.tolist()]


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
        estimator(name, motion, start, lag_s=lag_s, **options)
        for name in ("smoother", "smoother-banded")
    )
    largest = 0.0
    for measurement in measurements:
        before, after = expected.update(measurement), found.update(measurement)
        assert after.status is before.status
        assert found.window_ns == expected.window_ns
        if before.nis is not None and after.nis is not None:
            largest = max(largest, abs(after.nis - before.nis) / (1.0 + before.nis))
        oldest_ns, newest_ns = expected.window_ns
        for at_ns in (
            newest_ns + 50 * MS,
            max(oldest_ns, newest_ns - nanoseconds(past_s)),
        ):
            largest = max(
                largest, *difference(found.state_at(at_ns), expected.state_at(at_ns))
            )
    return largest


@pytest.mark.parametrize("motion", [CTRV(), CTRA()], ids=["ctrv", "ctra"])
@pytest.mark.parametrize("names", [LINEAR, COMPONENTS], ids=["linear", "nonlinear"])
def test_at_any_thresholds_both_solve_the_same_windows(
    motion: MotionModel, names: tuple[tuple[str, ...], ...]
) -> None:
    assert largest_difference(motion, arriving(motion, 0, names)) < 1e-9
    assert (
        largest_difference(motion, arriving(motion, 7, names), max_iterations=4) < 1e-9
    )


def test_so_they_do_with_robust_losses_and_an_unknown_heading() -> None:
    unknown = replace(START, yaw_rad=None, yaw_std_rad=None)
    rng = np.random.default_rng(5)
    lossy = [
        replace(
            m,
            loss=RobustLoss(KINDS[k % 5], 2.0),
            z=m.z + (4.0 if rng.random() < 0.1 else 0.0),
        )
        for k, m in enumerate(arriving(CTRV(), 1, LINEAR[:1]))
    ]
    assert largest_difference(CTRV(), lossy) < 1e-9
    assert largest_difference(CTRV(), arriving(CTRV(), 2, LINEAR[:1]), unknown) < 1e-9
    assert largest_difference(CTRV(), lossy, unknown, initiation="two-point") < 1e-9


@pytest.mark.parametrize("late", ["fuse", "drop"])
def test_so_they_do_with_what_is_older_than_the_window(late: str) -> None:
    for motion in (CV(), CTRV()):
        measurements = arriving(motion, 3, LINEAR[:1], delay_s=0.9)
        assert (
            largest_difference(motion, measurements, lag_s=0.3, late=late, ring_s=0.4)
            < 1e-9
        )


def break_solver(
    bank: SmootherBank, failing: tuple[int, ...], when: str = "after"
) -> list[int]:
    """Let solutions of track 0 raise before or after they are applied; return the numbers of those that were tried."""
    solve, tried = bank.solver.solve, list[int]()

    def solve_or_raise(tracks: Any, *arguments: Any) -> None:
        tried.extend([len(tried) + 1] if 0 in tracks else [])
        raises = 0 in tracks and tried[-1] in failing
        if not raises or when == "after":
            solve(tracks, *arguments)
        if raises:
            raise np.linalg.LinAlgError("the solver gave up")

    bank.solver.solve = solve_or_raise  # type: ignore[method-assign]
    return tried


@pytest.mark.parametrize("when", ["before", "after"])
@pytest.mark.parametrize("make", TOLERANCES)
def test_a_solver_that_gives_up_once_fails_one_measurement_and_the_rest_is_as_if_nothing_had_happened(
    make: type[SmootherBank], when: str
) -> None:
    """The measurement comes ahead, on the newest node, into a segment, beyond the window, or moves the window on."""
    motion, tolerance = CV(), TOLERANCES[make]
    for ms in (500, 475, 450, 345, 120, 1000):
        rng = np.random.default_rng(8)
        (hit, bank), (spared, spared_bank) = (
            smoother(motion, make),
            smoother(motion, make),
        )
        fill(motion, rng, hit, spared)
        left = [state.stamp_ns for state in final(spared_bank)]
        assert [state.stamp_ns for state in final(bank)] == left

        tried = break_solver(bank, (1,), when)
        assert hit.update(measured(rng, motion, ms * MS)).status is UpdateStatus.FAILED
        spared.advance(START_NS + ms * MS)
        assert tried
        assert bank.failures.counts == {Failure.GRAPH_REBUILT: 1}
        assert hit.window_ns == spared.window_ns
        assert apart(hit, spared) < tolerance

        for late_ms in (500, 320, 130, 900, 650):
            measurement = measured(rng, motion, late_ms * MS)
            assert hit.update(measurement).status is spared.update(measurement).status
            assert apart(hit, spared) < tolerance
        assert bank.failures.counts == {Failure.GRAPH_REBUILT: 1}
        for each in (bank, spared_bank):
            each.remove(0)
        for found, expected in zip(final(bank), final(spared_bank), strict=True):
            assert found.stamp_ns == expected.stamp_ns
            assert max(known_apart(found, expected)) < tolerance


@pytest.mark.parametrize("make", [SmootherBank, IncrementalBank])
@pytest.mark.parametrize("what", ["R", "z", "solver"])
def test_of_several_tracks_the_one_that_cannot_be_updated_fails_alone(
    make: type[SmootherBank], what: str
) -> None:
    """By a covariance that is none, by what is no number, and by a solver that gives up once more on it alone."""
    motion, rng = CTRV(), np.random.default_rng(3)
    settings = {"ring_s": 5.0, "relinearise": dict.fromkeys(motion.state_names, 1e9)}
    hit, spared = (make(motion, 0.3, **settings) for _ in range(2))
    for bank in (hit, spared):
        for track_id in range(3):
            bank.birth(track_id, START)
    for ms in (*range(50, 600, 50), 430, 275, 100, 600):
        stamp_ns = START_NS + ms * MS
        measurements = [measured(rng, motion, ms * MS) for _ in range(3)]
        if ms % 50 == 0 and ms not in (100, 600):
            for bank in (hit, spared):
                bank.advance(stamp_ns)
                bank.update(stamp_ns, [0, 1, 2], measurements)
            continue
        expected = [
            result.status
            for result in spared.update(stamp_ns, [1, 2], measurements[1:])
        ]
        broken = {
            "R": {"R": -9.0 * np.eye(2)},
            "z": {"z": np.full(2, np.nan)},
            "solver": {},
        }[what]
        given = [replace(measurements[0], **broken), *measurements[1:]]
        solve = hit.solver.solve
        break_solver(
            hit, (1, 3) if what == "solver" else ()
        )  # the update of all, and that of track 0 alone
        found = [result.status for result in hit.update(stamp_ns, [0, 1, 2], given)]
        hit.solver.solve = solve  # type: ignore[method-assign]
        assert found == [UpdateStatus.FAILED, *expected]
        for before, after in zip(spared.present(), hit.present(), strict=True):
            assert max(known_apart(after, before)) < 1e-6
        for at_ms in (250, 320):
            before, after = (
                state_of(bank, motion, 0, START_NS + at_ms * MS)
                for bank in (spared, hit)
            )
            assert max(difference(after, before)) < 1e-6


@pytest.mark.parametrize("make", TOLERANCES)
def test_final_states_are_the_dense_joint_of_what_had_arrived_when_the_node_left(
    make: type[SmootherBank],
) -> None:
    """Without the measurements that come 1 us after another, which cost digits."""
    motion = CV()
    for seed in range(3):
        stream = shuffled(motion, np.random.default_rng([11, seed]), span_s=2.0)
        (one, bank), arrived, stamps_ns = (
            smoother(motion, make),
            list[Measurement](),
            list[int](),
        )
        for measurement in (
            *(
                m
                for m in stream.measurements
                if (m.stamp_ns - START_NS) % (2 * MS) == 0
            ),
            None,
        ):
            if measurement is None:
                bank.remove(0)
            else:
                one.update(measurement)
            states = final(bank)
            joint = dense_joint(
                motion, START, arrived, [state.stamp_ns for state in states]
            )
            for state in states:
                expected = joint[state.stamp_ns]
                mean, covariance = motion.published(expected.mean, expected.covariance)
                assert (
                    max(
                        known_apart(state, TrackState(state.stamp_ns, mean, covariance))
                    )
                    < TOLERANCES[make]
                )
            stamps_ns += [state.stamp_ns for state in states]
            arrived += [] if measurement is None else [measurement]
        assert stamps_ns == sorted(set(stamps_ns))
        assert set(stamps_ns) <= set(stream.stamps_ns)


def test_final_states_of_a_nonlinear_model_are_near_the_optimum_of_what_had_arrived() -> (
    None
):
    """Nodes that leave, or are solved again anyway, are relinearised earlier: without that the median is 0.010."""
    motion, differences = CTRV(), list[float]()
    for seed in (1, 3):
        rng = np.random.default_rng(seed)
        (one, bank), (whole, every) = (
            smoother(motion, IncrementalBank, 1.0),
            smoother(motion, SmootherBank, 99.0),
        )
        for k in range(1, 90):
            measurement = measured(rng, motion, k * 50 * MS)
            every.converge()
            one.update(measurement)
            differences += [
                max(difference(state, whole.state_at(state.stamp_ns)))
                for state in final(bank)
            ]
            whole.update(measurement)
    assert np.median(differences) < 0.008


def test_robust_weights_follow_the_states_within_an_update() -> None:
    """With one step per update the largest difference is above one standard deviation."""
    motion, differences, rng = CTRV(), list[float](), np.random.default_rng(1)
    exact = {
        "max_iterations": 100,
        "relinearise": dict.fromkeys(motion.state_names, 1e-6),
    }
    one, solved = (
        SingleObject(motion, SmootherBank(motion, 1.0, ring_s=10.0, **given), START)
        for given in ({}, exact)
    )
    late = [measured(rng, motion, k * 50 * MS) for k in range(1, 90)]
    late = [
        replace(
            m,
            z=m.z + (5.0 if rng.random() < 0.15 else 0.0),
            loss=RobustLoss("huber", 1.5),
        )
        for m in late
    ]
    for k in sorted(range(len(late)), key=lambda k: k + rng.uniform(0.0, 6.0)):
        one.update(late[k])
        solved.update(late[k])
        now_ns = max(late[k].stamp_ns, START.stamp_ns)
        differences.append(difference(one.state_at(now_ns), solved.state_at(now_ns))[0])
    assert np.quantile(differences, 0.95) < 0.02
    assert max(differences) < 0.1


def known_apart(found: TrackState, expected: TrackState) -> tuple[float, float]:
    """`difference` of what is known of a kinematic state."""
    known = np.diag(expected.covariance) > 0.0
    parts = (
        TrackState(s.stamp_ns, s.mean[known], s.covariance[known][:, known])
        for s in (found, expected)
    )
    return difference(*parts)


class Alone:
    """As a bank, one bank for each object."""

    def __init__(self, motion: MotionModel, settings: dict[str, Any]) -> None:
        self.make = lambda: SmootherBank(motion, **settings)
        self.banks: dict[int, SmootherBank] = {}
        self.ended: list[SmoothedReport] = []
        self.now_ns = 0

    def advance(self, now_ns: int) -> None:
        self.now_ns = now_ns
        for bank in self.banks.values():
            bank.advance(now_ns)

    def birth(self, track_id: int, start: Start) -> None:
        self.banks[track_id] = self.make()
        self.banks[track_id].birth(0, start)
        self.banks[track_id].advance(self.now_ns)

    def remove(self, track_id: int) -> None:
        bank = self.banks.pop(track_id)
        bank.remove(0)
        self.ended += [
            replace(report, track_id=track_id)
            for report in bank.smoothed()
            if report.lag_s is None
        ]

    def update(
        self,
        stamp_ns: int,
        track_ids: Sequence[int],
        measurements: Sequence[Measurement],
    ) -> list[Any]:
        return [
            self.banks[track_id].update(stamp_ns, [0], [each])[0]
            for track_id, each in zip(track_ids, measurements, strict=True)
        ]

    def present(self) -> list[TrackState]:
        return [bank.present()[0] for bank in self.banks.values()]

    def smoothed(self) -> list[SmoothedReport]:
        reports, self.ended = self.ended, []
        return reports + [
            replace(r, track_id=i)
            for i, bank in self.banks.items()
            for r in bank.smoothed()
        ]


class Traffic:
    """Object lists of tracks that begin, end and are missed, delivered to a bank and to single smoothers."""

    def __init__(
        self, seed: int, motion: MotionModel, make: type[SmootherBank]
    ) -> None:
        self.rng = np.random.default_rng(seed)
        self.motion = motion
        settings: dict[str, Any] = {
            "lag_s": 0.4,
            "ring_s": 0.5,
            "lagged_s": (0.2, 0.4),
            "final": True,
        }
        self.bank, self.alone = make(motion, **settings), Alone(motion, settings)
        self.statuses: set[UpdateStatus] = set()
        self.smoothed: list[tuple[SmoothedReport, SmoothedReport]] = []
        self.largest = 0.0
        self._next_id = 0

    def run(self, latest_ms: int, num: int = 60) -> None:
        now_ns = START_NS
        for k in range(num):
            now_ns += 25 * MS
            self.bank.advance(now_ns)
            self.alone.advance(now_ns)
            if k % 9 == 0 or self.rng.random() < 0.05:
                self._birth(now_ns - int(self.rng.integers(0, 80)) * MS)
            if len(self.bank.track_ids) > 2 and self.rng.random() < 0.05:
                gone = int(self.rng.choice(self.bank.track_ids))
                self.bank.remove(gone)
                self.alone.remove(gone)
            self._list(
                now_ns - int(self.rng.choice([0, 40, 150, 150, 150, latest_ms])) * MS
            )
            for found, expected in zip(
                self.bank.present(), self.alone.present(), strict=True
            ):
                self.largest = max(self.largest, *known_apart(found, expected))
            reports = (
                sorted(each.smoothed(), key=self._order)
                for each in (self.bank, self.alone)
            )
            self.smoothed += zip(*reports, strict=True)

    @staticmethod
    def _order(report: SmoothedReport) -> tuple[float, int, int]:
        return report.lag_s or 0.0, report.track_id, report.state.stamp_ns

    def _birth(self, stamp_ns: int) -> None:
        unknown = self.rng.random() < 0.3
        start = replace(
            START,
            stamp_ns=stamp_ns,
            position_m=self.rng.normal(size=2),
            yaw_rad=None if unknown else 0.4,
        )
        self.bank.birth(self._next_id, start)
        self.alone.birth(self._next_id, start)
        self._next_id += 1

    def _list(self, stamp_ns: int) -> None:
        seen = [
            track_id
            for track_id in self.bank.states_at(stamp_ns).track_ids
            if self.rng.random() < 0.8
        ]
        names = [
            LINEAR[0] if self.motion.linear else LINEAR[self.rng.integers(3)]
            for _ in seen
        ]
        pose = SensorPose(*self.rng.normal(size=2))
        measurements = [
            measured(self.rng, self.motion, stamp_ns - START_NS, each) for each in names
        ]
        measurements = [
            replace(m, pose=pose, loss=RobustLoss("huber", 2.0) if k == 3 else None)
            for k, m in enumerate(measurements)
        ]
        if self.motion.linear and len(seen) > 2 and self.rng.random() < 0.2:
            measurements[1] = replace(
                measurements[1], R=-np.eye(len(measurements[1].z))
            )
        given = stamp_ns, seen, measurements
        for found, expected in zip(
            self.bank.update(*given), self.alone.update(*given), strict=True
        ):
            assert found.status is expected.status
            self.statuses.add(found.status)
            if expected.nis is not None:
                self.largest = max(
                    self.largest, abs(found.nis - expected.nis) / (1.0 + expected.nis)
                )
                np.testing.assert_allclose(
                    found.innovation, expected.innovation, atol=1e-8
                )
                np.testing.assert_allclose(
                    found.innovation_covariance,
                    expected.innovation_covariance,
                    rtol=1e-7,
                    atol=1e-9,
                )


@pytest.mark.parametrize("make", [SmootherBank, IncrementalBank])
@pytest.mark.parametrize("motion", [CTRV(), CV()], ids=["ctrv", "cv"])
def test_a_bank_of_tracks_of_all_ages_is_banks_of_single_ones(
    make: type[SmootherBank], motion: MotionModel
) -> None:
    """Also of both solvers: the single ones are solved by the compiled loops."""
    traffic = Traffic(9, motion, make)
    traffic.run(latest_ms=600 if motion.linear else 450)
    assert traffic.largest < 1e-8
    assert UpdateStatus.OUT_OF_SEQUENCE in traffic.statuses
    assert {
        UpdateStatus.BEYOND_WINDOW,
        UpdateStatus.FAILED,
    } <= traffic.statuses or not motion.linear
    assert len(traffic.smoothed) > 100
    for found, expected in traffic.smoothed:
        assert (found.track_id, found.lag_s, found.state.stamp_ns) == (
            expected.track_id,
            expected.lag_s,
            expected.state.stamp_ns,
        )
        assert max(known_apart(found.state, expected.state)) < 1e-8
