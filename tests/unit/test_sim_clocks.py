from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fgtrack.config.yaml_file import load
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import DetectionList, IntArray, Message
from fgtrack.sim.clocks import (
    AnyClock,
    ArrivalClock,
    DriftClock,
    JitterClock,
    OffsetClock,
    QuantisedClock,
    reported_stamps,
)
from fgtrack.sim.scenario import Scenario
from fgtrack.sim.simulate import simulate

SCENARIOS = Path(__file__).resolve().parents[2] / "configs/scenarios"
START_NS = 1_700_000_000_123_456_789
STAMPS_NS: IntArray = START_NS + np.arange(20_000) * 50_000_000
RECEIPTS_NS: IntArray = STAMPS_NS + 151_000_001
ALL = (
    OffsetClock(-0.25),
    DriftClock(40.0),
    JitterClock(0.002),
    QuantisedClock(0.01),
    ArrivalClock(),
)


def errors_ns(*clocks: AnyClock, seed: int = 0) -> IntArray:
    return (
        reported_stamps(clocks, np.random.default_rng(seed), STAMPS_NS, RECEIPTS_NS)
        - STAMPS_NS
    )


# Each clock


@pytest.mark.parametrize("clock", ALL, ids=lambda clock: clock.kind)
def test_stamps_are_one_per_message_whole_and_the_same_for_the_same_seed(
    clock: AnyClock,
) -> None:
    before = STAMPS_NS.copy()
    errors = errors_ns(clock)
    assert errors.shape == STAMPS_NS.shape
    assert errors.dtype == np.int64
    assert np.any(errors)
    np.testing.assert_array_equal(errors, errors_ns(clock))
    np.testing.assert_array_equal(before, STAMPS_NS)
    nothing = np.empty(0, dtype=np.int64)
    assert reported_stamps(
        [clock], np.random.default_rng(0), nothing, nothing
    ).shape == (0,)


def test_a_drift_grows_by_microseconds_per_second_from_the_first_message() -> None:
    errors = errors_ns(DriftClock(40.0))
    np.testing.assert_array_equal(
        errors, np.arange(20_000) * 2_000
    )  # 40 us/s times 50 ms
    np.testing.assert_array_equal(errors_ns(DriftClock(-40.0)), -errors)


@pytest.mark.parametrize("step_s", [0.01, 0.033])
def test_a_quantised_stamp_is_the_last_tick_of_its_clock(step_s: float) -> None:
    errors = errors_ns(QuantisedClock(step_s))
    step_ns = round(step_s * NS_PER_S)
    np.testing.assert_array_equal((STAMPS_NS + errors) % step_ns, 0)
    assert errors.max() <= 0
    assert errors.min() > -step_ns


# Several


def test_each_clock_reads_what_the_one_before_it_reported() -> None:
    np.testing.assert_array_equal(
        errors_ns(ArrivalClock(), OffsetClock(-0.1)), 51_000_001
    )
    np.testing.assert_array_equal(
        errors_ns(OffsetClock(-0.1), ArrivalClock()), 151_000_001
    )
    late_then_coarse = errors_ns(OffsetClock(0.008), QuantisedClock(0.01))
    np.testing.assert_array_equal((STAMPS_NS + late_then_coarse) % 10_000_000, 0)
    np.testing.assert_array_equal(
        late_then_coarse, 6_543_211
    )  # the clock shows 123.456789 + 8 ms as 130 ms


# In a scenario

SHORT = replace(load(Scenario, SCENARIOS / "single_opponent.yaml"), duration_s=3.0)


def with_clocks(*clocks: AnyClock) -> Scenario:
    lidar, radar = SHORT.sensors
    return replace(SHORT, sensors=(replace(lidar, clock=clocks), radar))


def lists(
    messages: list[Message], sensor: str = "lidar_cluster"
) -> list[DetectionList]:
    return [m for m in messages if isinstance(m, DetectionList) and m.sensor == sensor]


def test_a_clock_changes_the_stamps_of_its_sensor_and_nothing_else() -> None:
    right = simulate(SHORT, np.random.default_rng(0))
    wrong = simulate(with_clocks(JitterClock(0.01)), np.random.default_rng(0))
    stamps = [
        (m.stamp_ns, n.stamp_ns)
        for m, n in zip(lists(right), lists(wrong), strict=True)
    ]
    assert all(a != b for a, b in stamps)
    assert [replace(m, stamp_ns=0) for m in lists(right)] == [
        replace(m, stamp_ns=0) for m in lists(wrong)
    ]
    others = [
        [m for m in messages if m not in lists(messages)] for messages in (right, wrong)
    ]
    assert others[0] == others[1]
