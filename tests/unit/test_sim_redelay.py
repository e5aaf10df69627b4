from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from support.messages import START_NS, drive, exact, message_lists

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.types import Detection, DetectionList, EgoState, Message, TruthState
from fgtrack.inputs.errors import TruncatedInput
from fgtrack.sim.clocks import OffsetClock
from fgtrack.sim.delays import (
    ConstantDelay,
    GammaDelay,
    LossyDelay,
    MarkovDelay,
    NoDelay,
    UniformDelay,
)
from fgtrack.sim.new_delays import OTHERS, SensorDelays, redelay

MS = 1_000_000
LATE = SensorDelays(UniformDelay(0.0, 0.4))
DRIVE = drive(200)


def redelayed(
    messages: list[Message], seed: int = 0, **delays: SensorDelays
) -> list[Message]:
    return list(redelay(messages, delays, np.random.default_rng(seed))[0])


def lists(messages: list[Message], sensor: str) -> list[DetectionList]:
    found = [m for m in messages if isinstance(m, DetectionList) and m.sensor == sensor]
    return sorted(found, key=lambda m: m.stamp_ns)


def delays_s(messages: list[Message], sensor: str) -> list[float]:
    return [(m.receipt_ns - m.stamp_ns) / 1e9 for m in lists(messages, sensor)]


# What changes, and what does not


@given(messages=message_lists(), seed=st.integers(0, 9))
def test_messages_come_in_order_of_the_new_receipt_and_none_is_lost_or_changed(
    messages: list[Message], seed: int
) -> None:
    found = list(redelay(messages, {OTHERS: LATE}, np.random.default_rng(seed))[0])
    receipts = [m.receipt_ns for m in found]
    assert receipts == sorted(receipts)
    untouched = [m for m in messages if not isinstance(m, DetectionList)]
    assert exact([m for m in found if not isinstance(m, DetectionList)]) == exact(
        untouched
    )
    old, new = (
        [replace(m, receipt_ns=0) for m in ms if isinstance(m, DetectionList)]
        for ms in (messages, found)
    )
    assert sorted(exact(new)) == sorted(exact(old))
    assert all(
        0 <= m.receipt_ns - m.stamp_ns <= 400 * MS
        for m in found
        if isinstance(m, DetectionList)
    )


def test_drawn_delays_follow_their_model_in_the_order_of_the_stamps() -> None:
    stamps = [START_NS + k * 50 * MS for k in range(4000)]
    lidar = [DetectionList("lidar", stamp, stamp, ()) for stamp in stamps]
    shuffled: list[Message] = [
        lidar[k] for k in np.random.default_rng(1).permutation(4000)
    ]
    model = GammaDelay(0.09, 0.151, 0.191)
    drawn = delays_s(redelayed(shuffled, lidar=SensorDelays(model)), "lidar")
    assert (
        stats.kstest(
            drawn, stats.gamma(model.shape, loc=0.09, scale=model.scale_s).cdf
        ).pvalue
        > 1e-4
    )


def test_losses_are_counted_by_sensor_whether_drawn_alone_or_by_the_delay_model() -> (
    None
):
    delays = {
        "lidar": SensorDelays(loss_probability=0.5),
        "radar": SensorDelays(
            MarkovDelay(ConstantDelay(0.1), LossyDelay(1.0), 0.2, 0.3)
        ),
    }
    result, num_lost = redelay(DRIVE, delays, np.random.default_rng(0))
    found = list(result)
    for sensor in delays:
        assert 5 < num_lost[sensor] < 35
        assert num_lost[sensor] + len(lists(found, sensor)) == len(lists(DRIVE, sensor))
    assert set(delays_s(found, "radar")) == {0.1}
    assert all(m in DRIVE for m in lists(found, "lidar"))


# Clocks


def test_a_clock_changes_the_stamp_and_not_when_it_arrives() -> None:
    found = redelayed(
        DRIVE, lidar=SensorDelays(ConstantDelay(0.2), clock=(OffsetClock(0.5),))
    )
    for old, new in zip(lists(DRIVE, "lidar"), lists(found, "lidar"), strict=True):
        assert (new.stamp_ns - old.stamp_ns, new.receipt_ns - old.stamp_ns) == (
            500 * MS,
            200 * MS,
        )
        assert new.objects == old.objects


def test_detections_with_stamps_of_their_own_follow_their_list() -> None:
    items = (
        Detection(x_m=1.0, y_m=1.0, stamp_ns=START_NS - 7),
        Detection(x_m=2.0, y_m=1.0),
    )
    moved = redelayed(
        [DetectionList("lidar", START_NS, START_NS, items)],
        lidar=SensorDelays(clock=(OffsetClock(0.5),)),
    )
    assert isinstance(moved[0], DetectionList)
    assert [item.stamp_ns for item in moved[0].objects] == [
        START_NS - 7 + 500 * MS,
        None,
    ]


# Round trips


def test_at_the_same_receipt_what_keeps_it_comes_first_then_sensor_by_sensor() -> None:
    at = (START_NS, START_NS)
    radar = [DetectionList("radar", START_NS - k, START_NS, ()) for k in (0, 2)]
    untouched = [
        EgoState(*at, 0.0, 0.0, 0.0, 0.0),
        TruthState(*at, 0, 0.0, 0.0),
        DetectionList("camera", *at, ()),
    ]
    lidar = DetectionList("lidar", *at, ())
    messages = [radar[0], untouched[0], lidar, radar[1], *untouched[1:]]
    found = redelayed(
        messages, lidar=SensorDelays(NoDelay()), radar=SensorDelays(ConstantDelay(2e-9))
    )
    assert found[:-1] == [*untouched, lidar, radar[1]]
    assert found[-1] == replace(radar[0], receipt_ns=START_NS + 2)


# Memory and damage


def broken(count: int, error: DataError) -> Iterator[Message]:
    yield from DRIVE[:count]
    raise error


@pytest.mark.parametrize("error", [TruncatedInput("breaks off"), DataError("is bad")])
def test_an_input_that_breaks_off_gives_everything_before_the_break(
    error: DataError,
) -> None:
    result, _ = redelay(broken(500, error), {"lidar": LATE}, np.random.default_rng(0))
    found: list[Message] = []
    with pytest.raises(DataError) as raised:
        found.extend(result)
    assert raised.value is error
    assert found == redelayed(DRIVE[:500], lidar=LATE)


def test_a_sensor_that_is_not_there_is_named() -> None:
    with pytest.raises(
        CallError,
        match="sensor 'sonar' is not in the input, whose sensors are: lidar, radar",
    ):
        redelay(DRIVE, {"sonar": LATE}, np.random.default_rng(0))
    with pytest.raises(ValueError, match="loss_probability"):
        SensorDelays(loss_probability=1.5)
