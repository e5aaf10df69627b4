import tracemalloc
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from fgtrack.config.reading import read_scenario
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import DetectionList, EgoState, Message, TruthState
from fgtrack.sim.delays import NoDelay
from fgtrack.sim.scenario import EgoMessages, Scenario
from fgtrack.sim.sensor import Clutter, SimulatedSensor
from fgtrack.sim.simulate import message_stream, simulate
from fgtrack.sim.vehicles import DrawnVehicle, TrackVehicle

DEFAULT = read_scenario("default")
SHORT = replace(DEFAULT, duration_s=5.0)


def run(scenario: Scenario, seed: int = 0) -> list[Message]:
    return simulate(scenario, np.random.default_rng(seed))


def scans_of(messages: list[Message], sensor: str) -> list[DetectionList]:
    scans = [m for m in messages if isinstance(m, DetectionList) and m.sensor == sensor]
    return sorted(scans, key=lambda scan: scan.stamp_ns)


# Scenarios


def test_settings_of_a_scenario_that_make_no_sense_are_named() -> None:
    drawn, driven = (
        DrawnVehicle(0.0, 0.0, 0.0, 9.0),
        TrackVehicle(0.0, speed=((0.0, 9.0),)),
    )
    lidar = SimulatedSensor("lidar", {"x_m": 1.0, "y_m": 1.0})
    on_track = replace(lidar, clutter=Clutter(1.0, region="track"))
    for make, message in (
        (lambda: Scenario(drawn, sensors=(lidar, lidar)), "sensors: names must differ"),
        (lambda: Scenario(driven, map=None), "map: a vehicle"),
        (lambda: Scenario(drawn, opponents=(driven,), map=None), "map: a vehicle"),
        (
            lambda: Scenario(drawn, sensors=(on_track,), map=None),
            "map: a vehicle or clutter",
        ),
        (lambda: EgoMessages(speed_std_mps=-1.0), "speed_std_mps"),
    ):
        with pytest.raises(ValueError, match=message):
            make()


# Messages


def test_messages_come_in_order_of_receipt_and_scans_overtake_each_other() -> None:
    messages = run(SHORT)
    receipts = [message.receipt_ns for message in messages]
    assert receipts == sorted(receipts)
    detection_stamps = [m.stamp_ns for m in messages if isinstance(m, DetectionList)]
    assert detection_stamps != sorted(detection_stamps)
    assert all(
        message.receipt_ns >= message.stamp_ns >= SHORT.start_ns for message in messages
    )
    assert all(
        type(message.stamp_ns) is int and type(message.receipt_ns) is int
        for message in messages
    )


def test_truth_holds_every_object_at_every_stamp() -> None:
    truth = [message for message in run(SHORT) if isinstance(message, TruthState)]
    stamps = [SHORT.start_ns + k * NS_PER_S // 100 for k in range(501)]
    for object_id in (-1, 0, 1):
        assert [
            state.stamp_ns for state in truth if state.object_id == object_id
        ] == stamps
    assert len(truth) == 3 * len(stamps)
    assert all(state.receipt_ns == state.stamp_ns for state in truth)


def test_ego_messages_are_truth_with_noise_and_delay() -> None:
    messages = run(DEFAULT)
    ego = [m for m in messages if isinstance(m, EgoState)]
    truth = {
        m.stamp_ns: m
        for m in messages
        if isinstance(m, TruthState) and m.object_id == -1
    }
    settings = DEFAULT.ego_messages
    for name, std in (
        ("x_m", settings.position_std_m),
        ("y_m", settings.position_std_m),
        ("speed_mps", settings.speed_std_mps),
        ("yaw_rate_radps", settings.yaw_rate_std_radps),
        ("accel_mps2", settings.accel_std_mps2),
    ):
        error = np.array(
            [getattr(m, name) - getattr(truth[m.stamp_ns], name) for m in ego]
        )
        chi2 = stats.chi2(len(error))
        assert chi2.ppf(1e-4) < np.sum(error**2) / std**2 < chi2.ppf(1.0 - 1e-4)
    assert {m.receipt_ns - m.stamp_ns for m in ego} == {2_000_000}
    variances = [0.02**2, 0.02**2, 0.001**2, 0.05**2, 0.002**2]
    assert {m.covariance for m in ego} == {tuple(np.diag(variances).ravel().tolist())}
    exact = replace(
        settings,
        **dict.fromkeys([name for name in vars(settings) if "_std_" in name], 0.0),
    )
    silent = run(replace(DEFAULT, ego_messages=exact, duration_s=0.1))
    assert {m.covariance for m in silent if isinstance(m, EgoState)} == {None}


def test_delays_of_the_default_scenario_are_those_of_the_paper() -> None:
    messages = run(replace(DEFAULT, duration_s=300.0, truth_rate_hz=0.1, opponents=()))
    for name, mean_s, q90_s in (
        ("lidar_cluster", 0.151, 0.191),
        ("radar", 0.062, 0.089),
    ):
        delays = np.array(
            [(s.receipt_ns - s.stamp_ns) / NS_PER_S for s in scans_of(messages, name)]
        )
        assert abs(delays.mean() - mean_s) < 4.0 * delays.std() / np.sqrt(len(delays))
        assert (
            stats.binomtest(
                int(np.count_nonzero(delays <= q90_s)), len(delays), 0.9
            ).pvalue
            > 1e-4
        )


def test_a_scan_that_saw_nothing_is_sent_and_a_silent_sensor_sends_nothing() -> None:
    lidar = SimulatedSensor(
        "lidar", {"x_m": 1.0, "y_m": 1.0}, rate_hz=10.0, drop_outs=((1.0, 2.0),)
    )
    scans = scans_of(run(replace(SHORT, opponents=(), sensors=(lidar,))), "lidar")
    assert all(scan.objects == () for scan in scans)
    times = [(scan.stamp_ns - SHORT.start_ns) / NS_PER_S for scan in scans]
    assert times == [k / 10 for k in range(51) if not 10 <= k < 20]


def test_equal_receipts_are_ordered_truth_ego_sensors() -> None:
    lidar = SimulatedSensor("lidar", {"x_m": 1.0, "y_m": 1.0}, rate_hz=10.0)
    radar = replace(lidar, name="radar")
    scenario = replace(
        SHORT,
        sensors=(radar, lidar),
        opponents=SHORT.opponents[:1],
        ego_messages=EgoMessages(delay=NoDelay()),
    )
    first = [m for m in run(scenario) if m.receipt_ns == SHORT.start_ns]
    assert [getattr(m, "sensor", type(m)) for m in first] == [
        TruthState,
        TruthState,
        EgoState,
        "radar",
        "lidar",
    ]


def test_blocks_of_the_truth_do_not_change_a_message(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scenario = replace(read_scenario("race"), duration_s=1.5)
    messages = simulate(scenario, np.random.default_rng(3))
    monkeypatch.setattr("fgtrack.sim.simulate._BLOCK", 7)
    assert simulate(scenario, np.random.default_rng(3)) == messages


def test_a_stream_makes_its_messages_when_they_are_used() -> None:
    """The messages of a stream take less than half of the memory of the list."""

    def peak_bytes(used: Callable[[Iterator[Message]], object]) -> int:
        tracemalloc.start()
        used(message_stream(scenario, np.random.default_rng(0)))
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return peak

    scenario = replace(read_scenario("race"), duration_s=60.0)
    peak_bytes(list)  # imports modules
    consumed = peak_bytes(lambda messages: deque(messages, maxlen=0))
    assert consumed < 0.5 * peak_bytes(list)
