"""In or out of sequence is relative to the newest stamp that a track has fused, whatever the latency."""

from collections import Counter

import numpy as np
import pytest

import fgtrack
from fgtrack.core.time import NS_PER_S
from fgtrack.estimation.base import Estimator, Measurement, Start, UpdateStatus
from fgtrack.estimation.registry import ESTIMATORS, estimator, estimator_bank
from fgtrack.models.motion import CTRV, CV
from fgtrack.testing.references import dense_joint, difference

SMOOTHERS = ("smoother", "smoother-banded", "smoother-batch")
START = Start(
    position_m=(0.0, 0.0),
    yaw_rad=0.0,
    yaw_std_rad=0.3,
    speed_mps=5.0,
    speed_std_mps=2.0,
)
REFUSED = (UpdateStatus.TOO_OLD,)
LATE = (UpdateStatus.OUT_OF_SEQUENCE, UpdateStatus.BEYOND_WINDOW)


def measured(stamp_s: float, error_m: float = 0.0) -> Measurement:
    return Measurement.of(
        round(stamp_s * NS_PER_S),
        x_m=5.0 * stamp_s + error_m,
        y_m=0.1 * np.sin(7.0 * stamp_s),
        std=0.3,
    )


def received(one: Estimator, stamp_s: float, latency_s: float) -> UpdateStatus:
    """Status of a measurement that comes when the clock shows its stamp plus the latency."""
    one.advance(round((stamp_s + latency_s) * NS_PER_S))
    return one.update(measured(stamp_s)).status


@pytest.mark.parametrize("latency_s", [0.0, 0.3, 0.9, 1.1, 2.5])
@pytest.mark.parametrize("name", list(ESTIMATORS))
def test_latency_alone_makes_no_measurement_out_of_sequence(
    name: str, latency_s: float
) -> None:
    one, statuses = estimator(name, CTRV(), START), Counter[UpdateStatus]()
    for k in range(1, 30):
        statuses[received(one, 0.1 * k, latency_s)] += 1
    assert statuses.keys() <= {UpdateStatus.IN_SEQUENCE, *REFUSED}
    if name in SMOOTHERS or latency_s == 0.0:
        assert statuses[UpdateStatus.IN_SEQUENCE] == 29


@pytest.mark.parametrize(
    ("lag_s", "ring_s"), [(0.2, 2.0), (0.5, 1.0), (1.0, 0.5), (0.0, 3.0)]
)
@pytest.mark.parametrize("name", SMOOTHERS)
def test_a_smoother_refuses_only_what_is_older_than_its_ring(
    name: str, lag_s: float, ring_s: float
) -> None:
    one = estimator(name, CTRV(), START, lag_s=lag_s, ring_s=ring_s)
    rng = np.random.default_rng(4)
    newest_s, seen = 0.0, Counter[UpdateStatus]()
    for k in range(1, 60):
        stamp_s = round(
            0.1 * k - rng.choice([0.0, 0.05, 0.3 * ring_s, 0.8 * ring_s]), 3
        )
        one.advance(round((0.1 * k + lag_s + 0.5 * ring_s) * NS_PER_S))
        begin_ns, _ = one.window_ns
        start_ns = begin_ns + round(ring_s * NS_PER_S)
        stamp_ns = measured(stamp_s).stamp_ns
        status = one.update(measured(stamp_s, 1e-3 * k)).status  # no two are identical
        if stamp_ns < begin_ns:
            assert status is UpdateStatus.TOO_OLD
        elif stamp_s >= newest_s:
            assert status is UpdateStatus.IN_SEQUENCE
        elif begin_ns > 0:
            assert status is (
                UpdateStatus.OUT_OF_SEQUENCE
                if stamp_ns >= start_ns
                else UpdateStatus.BEYOND_WINDOW
            )
        if status not in REFUSED:
            newest_s = max(newest_s, stamp_s)
        assert one.window_ns[1] == round(newest_s * NS_PER_S)
        seen[status] += 1
    assert seen[UpdateStatus.IN_SEQUENCE] > 5
    assert seen[UpdateStatus.BEYOND_WINDOW] > 0
    assert seen[UpdateStatus.TOO_OLD] > 0


@pytest.mark.parametrize("latency_s", [0.5, 1.5, 2.9])
@pytest.mark.parametrize("name", SMOOTHERS)
def test_what_comes_in_order_behind_the_window_is_fused_exactly(
    name: str, latency_s: float
) -> None:
    one, motion = estimator(name, CV(), START), CV()
    fused = list[Measurement]()
    for k in range(1, 20):
        assert received(one, 0.1 * k, latency_s) is UpdateStatus.IN_SEQUENCE
        fused.append(measured(0.1 * k))
    now_ns = round((1.9 + latency_s) * NS_PER_S)
    expected = dense_joint(motion, START, fused, [now_ns])[now_ns]
    assert max(difference(one.state_at(now_ns), expected, motion)) < 1e-7


@pytest.mark.parametrize("name", SMOOTHERS)
def test_of_two_tracks_each_has_its_own_newest_stamp(name: str) -> None:
    bank = estimator_bank(name, CTRV(), 0.2, {"ring_s": 3.0})
    bank.advance(0)
    for track in (0, 1):
        bank.birth(track, START)
    bank.advance(round(1.5 * NS_PER_S))
    assert (
        bank.update(round(0.6 * NS_PER_S), [0], [measured(0.6)])[0].status
        is UpdateStatus.IN_SEQUENCE
    )
    statuses = [
        each.status
        for each in bank.update(round(0.4 * NS_PER_S), [0, 1], [measured(0.4)] * 2)
    ]
    assert statuses == [UpdateStatus.BEYOND_WINDOW, UpdateStatus.IN_SEQUENCE]


@pytest.mark.parametrize("name", SMOOTHERS)
def test_a_tracker_with_a_latency_above_the_lag_reports_lists_in_sequence(
    name: str,
) -> None:
    tracker = fgtrack.Tracker("open_space", estimator=name, set={"smoother.lag_s": 0.5})
    for k in range(40):
        stamp_ns = 1000 * NS_PER_S + k * NS_PER_S // 20
        now_ns = stamp_ns + round(0.9 * NS_PER_S)
        position = fgtrack.Detection(x_m=20.0 + 0.5 * k, y_m=1.0)
        tracker.receive(
            fgtrack.DetectionList("radar", stamp_ns, now_ns, [position], frame="map")
        )
        tracker.tick(now_ns)
    assert tracker.counts["radar"] == {"birth": 1, "in_sequence": 39}
