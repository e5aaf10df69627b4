from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from support.tracking import message, ms

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import Detection, DetectionList, IntArray, Message
from fgtrack.models.sensors import SensorModel
from fgtrack.pipeline.load import load
from fgtrack.sim.clocks import (
    AnyClock,
    ArrivalClock,
    DriftClock,
    JitterClock,
    OffsetClock,
    QuantisedClock,
    reported_stamps,
)
from fgtrack.sim.delays import ConstantDelay, LossyDelay
from fgtrack.sim.scenario import Scenario
from fgtrack.sim.simulate import simulate
from fgtrack.tracking.inbox import QueueInbox

SCENARIOS = Path(__file__).resolve().parents[2] / "configs/scenarios"
START_NS = 1_700_000_000_123_456_789
STAMPS_NS: IntArray = START_NS + np.arange(20_000) * 50_000_000
RECEIPTS_NS: IntArray = STAMPS_NS + 151_000_001
ALL = (OffsetClock(-0.25), DriftClock(40.0), JitterClock(0.002), QuantisedClock(0.01), ArrivalClock())


def errors_ns(*clocks: AnyClock, seed: int = 0) -> IntArray:
    return reported_stamps(clocks, np.random.default_rng(seed), STAMPS_NS, RECEIPTS_NS) - STAMPS_NS


# Each clock


def test_no_clock_is_a_right_clock() -> None:
    np.testing.assert_array_equal(errors_ns(), 0)


@pytest.mark.parametrize("clock", ALL, ids=lambda clock: clock.kind)
def test_stamps_are_one_per_message_whole_and_the_same_for_the_same_seed(clock: AnyClock) -> None:
    before = STAMPS_NS.copy()
    errors = errors_ns(clock)
    assert errors.shape == STAMPS_NS.shape
    assert errors.dtype == np.int64
    assert np.any(errors)
    np.testing.assert_array_equal(errors, errors_ns(clock))
    np.testing.assert_array_equal(before, STAMPS_NS)
    nothing = np.empty(0, dtype=np.int64)
    assert reported_stamps([clock], np.random.default_rng(0), nothing, nothing).shape == (0,)


def test_an_offset_is_the_same_everywhere() -> None:
    assert set(errors_ns(OffsetClock(-0.25)).tolist()) == {-250_000_000}


def test_a_drift_grows_by_microseconds_per_second_from_the_first_message() -> None:
    errors = errors_ns(DriftClock(40.0))
    np.testing.assert_array_equal(errors, np.arange(20_000) * 2_000)  # 40 us/s times 50 ms
    np.testing.assert_array_equal(errors_ns(DriftClock(-40.0)), -errors)


def test_jitter_is_normal_and_without_memory() -> None:
    errors = errors_ns(JitterClock(0.002)) / 2e6
    assert stats.kstest(errors, stats.norm.cdf).pvalue > 1e-4
    assert abs(np.mean(errors[1:] * errors[:-1])) < 4.0 / np.sqrt(len(errors))


@pytest.mark.parametrize("step_s", [0.01, 0.1, 1.0, 0.033])
def test_a_quantised_stamp_is_the_last_tick_of_its_clock(step_s: float) -> None:
    errors = errors_ns(QuantisedClock(step_s))
    step_ns = round(step_s * NS_PER_S)
    np.testing.assert_array_equal((STAMPS_NS + errors) % step_ns, 0)
    assert errors.max() <= 0
    assert errors.min() > -step_ns


def test_a_sensor_without_stamps_reports_the_receipt() -> None:
    np.testing.assert_array_equal(errors_ns(ArrivalClock()), RECEIPTS_NS - STAMPS_NS)


# Several


def test_each_clock_reads_what_the_one_before_it_reported() -> None:
    np.testing.assert_array_equal(errors_ns(ArrivalClock(), OffsetClock(-0.1)), 51_000_001)
    np.testing.assert_array_equal(errors_ns(OffsetClock(-0.1), ArrivalClock()), 151_000_001)
    late_then_coarse = errors_ns(OffsetClock(0.008), QuantisedClock(0.01))
    np.testing.assert_array_equal((STAMPS_NS + late_then_coarse) % 10_000_000, 0)
    np.testing.assert_array_equal(late_then_coarse, 6_543_211)  # the clock shows 123.456789 + 8 ms as 130 ms


def test_other_clocks_before_or_after_one_leave_its_errors() -> None:
    jitter = errors_ns(JitterClock(0.002))
    np.testing.assert_array_equal(errors_ns(JitterClock(0.002), OffsetClock(1.0)) - jitter, NS_PER_S)
    both = errors_ns(JitterClock(0.002), JitterClock(0.002))
    after_offset = errors_ns(OffsetClock(1.0), JitterClock(0.002)) - NS_PER_S
    np.testing.assert_array_equal(both - jitter, after_offset)
    assert stats.pearsonr(jitter, both - jitter).pvalue > 1e-4


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: OffsetClock(offset_s=1e6), "offset_s"),
        (lambda: OffsetClock(offset_s=float("nan")), "offset_s"),
        (lambda: DriftClock(drift_ppm=2e6), "drift_ppm"),
        (lambda: JitterClock(std_s=-0.1), "std_s"),
        (lambda: QuantisedClock(step_s=0.0), "step_s"),
        (lambda: QuantisedClock(step_s=1e-10), "step_s"),
    ],
)
def test_a_setting_that_makes_no_sense_is_named(make: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()  # type: ignore[operator]


# In a scenario

SHORT = replace(load(Scenario, SCENARIOS / "single_opponent.yaml"), duration_s=3.0)


def with_clocks(*clocks: AnyClock) -> Scenario:
    lidar, radar = SHORT.sensors
    return replace(SHORT, sensors=(replace(lidar, clock=clocks), radar))


def lists(messages: list[Message], sensor: str = "lidar_cluster") -> list[DetectionList]:
    return [m for m in messages if isinstance(m, DetectionList) and m.sensor == sensor]


def test_a_clock_changes_the_stamps_of_its_sensor_and_nothing_else() -> None:
    right = simulate(SHORT, np.random.default_rng(0))
    wrong = simulate(with_clocks(JitterClock(0.01)), np.random.default_rng(0))
    stamps = [(m.stamp_ns, n.stamp_ns) for m, n in zip(lists(right), lists(wrong), strict=True)]
    assert all(a != b for a, b in stamps)
    assert [replace(m, stamp_ns=0) for m in lists(right)] == [replace(m, stamp_ns=0) for m in lists(wrong)]
    others = [[m for m in messages if m not in lists(messages)] for messages in (right, wrong)]
    assert others[0] == others[1]


def test_arrival_stamps_of_a_scenario_are_its_receipts() -> None:
    wrong = lists(simulate(with_clocks(ArrivalClock()), np.random.default_rng(0)))
    assert wrong
    assert all(m.stamp_ns == m.receipt_ns for m in wrong)


def test_lost_messages_leave_the_stamps_of_the_others() -> None:
    def stamps(loss: float) -> list[int]:
        lidar = replace(SHORT.sensors[0], delay=LossyDelay(loss, ConstantDelay(0.1)), clock=(JitterClock(0.01),))
        return [m.stamp_ns for m in lists(simulate(replace(SHORT, sensors=(lidar,)), np.random.default_rng(0)))]

    some, everything = stamps(0.5), stamps(0.0)
    assert 10 < len(some) < 50
    assert set(some) < set(everything)


def test_the_scenario_with_wrong_clocks_has_them() -> None:
    scenario = replace(load(Scenario, SCENARIOS / "wrong_clock.yaml"), duration_s=3.0)
    lidar, radar = scenario.sensors
    assert [clock.kind for clock in lidar.clock] == ["offset", "drift", "jitter", "quantised"]
    right = replace(scenario, sensors=(replace(lidar, clock=()), replace(radar, clock=())))
    wrong, sensed = (simulate(one, np.random.default_rng(0)) for one in (scenario, right))
    errors_s = [(a.stamp_ns - b.stamp_ns) / NS_PER_S for a, b in zip(lists(wrong), lists(sensed), strict=True)]
    assert np.mean(errors_s) == pytest.approx(0.0195, abs=4.0 * 0.002 / np.sqrt(len(errors_s)) + 1e-4)
    assert {m.receipt_ns - m.stamp_ns for m in lists(wrong, "radar")} == {60_000_000}


# What the tracker does with it


@pytest.mark.parametrize(
    ("offset_s", "refused"), [(1.05, []), (1.051, ["invalid"]), (-0.25, []), (-0.251, ["too_old"])]
)
def test_the_inbox_takes_a_stamp_after_its_receipt_up_to_a_limit(offset_s: float, refused: list[str]) -> None:
    inbox = QueueInbox({"lidar": SensorModel(std={"x_m": 0.3, "y_m": 0.3}, max_delay_s=0.3)}, max_future_s=1.0)
    sensed = message(Detection(x_m=10.0, y_m=1.0), delay_ms=50.0)
    stamp_ns = int(OffsetClock(offset_s).read(np.random.default_rng(0), np.array([sensed.stamp_ns]), RECEIPTS_NS)[0])
    assert stamp_ns == sensed.stamp_ns + ms(1000.0 * offset_s)
    assert [record.disposition.value for record in inbox.put(replace(sensed, stamp_ns=stamp_ns))] == refused
