"""Simulates the messages that a tracker would receive in a scenario."""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from heapq import merge

import numpy as np

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.geometry import wrap_angles
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import (
    EGO_COVARIANCE_STATES,
    EGO_ID,
    STATE_NAMES,
    YAW,
    BoolArray,
    DetectionList,
    EgoState,
    FloatArray,
    IntArray,
    Message,
    TruthState,
)
from fgtrack.models.oval import OVAL, make_oval
from fgtrack.models.path import Path
from fgtrack.models.track_map import TrackMap
from fgtrack.sim.clocks import reported_stamps
from fgtrack.sim.delays import AnyDelay, draw_delays
from fgtrack.sim.roads import (
    AnyVehicle,
    RecordedVehicle,
    TimedPath,
    WaypointVehicle,
)
from fgtrack.sim.scanner import Scanner
from fgtrack.sim.scenario import Scenario
from fgtrack.sim.sensor import SimulatedSensor
from fgtrack.sim.vehicles import DrawnVehicle

States = Callable[[FloatArray], FloatArray]
"""Returns the true states of a vehicle, shape (n, 6), at times since the start, shape (n,); NaN while it is absent."""
#: Number of stamps whose true states are computed together.
_BLOCK = 256
PathReader = Callable[[RecordedVehicle], TimedPath]
"""Reads the path of a recorded vehicle."""


def _no_paths(vehicle: RecordedVehicle) -> TimedPath:
    raise CallError(
        f"{vehicle.file}: a recorded path is read by `fgtrack.simulate` alone"
    )


def simulate(
    scenario: Scenario, rng: np.random.Generator, read_path: PathReader = _no_paths
) -> list[Message]:
    """Return the messages of `message_stream` as a list."""
    return list(message_stream(scenario, rng, read_path))


def message_stream(
    scenario: Scenario, rng: np.random.Generator, read_path: PathReader = _no_paths
) -> Iterator[Message]:
    """Return the messages of `scenario` in order of receipt; at equal receipts the truth, the ego, then the sensors.

    Every vehicle and every sensor has its own random generators. A sensor has separate
    generators for delays, clock errors, clutter and the detections of each object. So a
    change of a sensor, a delay or a clock model leaves the other draws unchanged. A
    clock model changes the reported stamp, never the measurement. Lost messages are
    left out, and so is a vehicle before and after its recorded path. `read_path` reads
    recorded paths.

    All numbers of the ego and of the sensors are drawn at the start. The messages are
    made when they are used: their objects would take ten times the memory.

    Raises `DataError` if the map or a path cannot be read, and if the ego's recorded path
    does not cover the whole duration.
    """
    vehicles_rng, ego_rng, sensors_rng = rng.spawn(3)
    track = None
    if scenario.map is not None:
        track = make_oval() if scenario.map == OVAL else TrackMap.read(scenario.map)
    path = None if track is None else Path.through(track.table[:, :2])
    vehicles = (scenario.ego, *scenario.opponents)
    ego, *opponents = (
        _states_of(vehicle, path, child, scenario.duration_s, read_path)
        for vehicle, child in zip(
            vehicles, vehicles_rng.spawn(len(vehicles)), strict=True
        )
    )
    if np.isnan(ego(np.array([0.0, scenario.duration_s]))).any():
        raise DataError(
            f"ego: its recorded path must cover the scenario from 0 to {scenario.duration_s:g} s, "
            "change start_s or duration_s"
        )
    children = sensors_rng.spawn(len(scenario.sensors))
    sources = [
        _truth(scenario, [ego, *opponents]),
        _ego_messages(scenario, ego, ego_rng),
        *(
            _scans(scenario, sensor, ego, opponents, track, child)
            for sensor, child in zip(scenario.sensors, children, strict=True)
        ),
    ]
    return merge(*sources, key=lambda message: message.receipt_ns)


def _states_of(
    vehicle: AnyVehicle,
    path: Path | None,
    rng: np.random.Generator,
    duration_s: float,
    read_path: PathReader,
) -> States:
    if isinstance(vehicle, DrawnVehicle):
        return vehicle.trajectory(rng, duration_s).states
    if isinstance(vehicle, WaypointVehicle):
        return vehicle.states
    if isinstance(vehicle, RecordedVehicle):
        return read_path(vehicle).states
    assert path is not None, "`Scenario` requires a map for a vehicle on a track"
    return partial(vehicle.states, path)


def _truth(scenario: Scenario, vehicles: Sequence[States]) -> Iterator[Message]:
    """Yield the truth by ascending stamp; the states are computed in blocks."""
    stamps_ns, times_s = _stamps(scenario, scenario.truth_rate_hz)
    for first in range(0, len(stamps_ns), _BLOCK):
        block = slice(first, first + _BLOCK)
        rows = [vehicle(times_s[block]).tolist() for vehicle in vehicles]
        for index, stamp_ns in enumerate(stamps_ns[block].tolist()):
            for object_id, states in enumerate(rows, start=EGO_ID):
                if not math.isnan(states[index][0]):
                    yield TruthState(stamp_ns, stamp_ns, object_id, *states[index])


def _ego_messages(
    scenario: Scenario, ego: States, rng: np.random.Generator
) -> Iterator[Message]:
    """Draw the states of the ego, and return its messages by ascending receipt."""
    settings = scenario.ego_messages
    noise_rng, delay_rng = rng.spawn(2)
    stamps_ns, times_s = _stamps(scenario, settings.rate_hz)
    std = [*[settings.position_std_m] * 2, settings.yaw_std_rad, settings.speed_std_mps]
    std += [settings.yaw_rate_std_radps, settings.accel_std_mps2]
    states = ego(times_s)
    states += np.array(std) * noise_rng.standard_normal(states.shape)
    states[:, YAW] = wrap_angles(states[:, YAW])
    receipts_ns, lost = _receipts(settings.delay, delay_rng, stamps_ns, times_s)
    variances = np.square(std[: len(EGO_COVARIANCE_STATES)])
    covariance = tuple(np.diag(variances).ravel().tolist()) if variances.any() else None
    return (
        EgoState(
            int(stamps_ns[row]),
            int(receipts_ns[row]),
            **dict(zip(STATE_NAMES, states[row].tolist(), strict=True)),
            in_pit=None,
            covariance=covariance,
        )
        for row in _by_receipt(receipts_ns, lost)
    )


def _scans(
    scenario: Scenario,
    sensor: SimulatedSensor,
    ego: States,
    opponents: Sequence[States],
    track: TrackMap | None,
    rng: np.random.Generator,
) -> Iterator[Message]:
    """Draw the detections of `sensor`, and return its messages by ascending receipt."""
    times_rng, delay_rng, scanner_rng, clock_rng = rng.spawn(4)
    stamps_ns, times_s = _stamps(
        scenario, sensor.scan_times(times_rng, scenario.duration_s)
    )
    scanner = Scanner(sensor, ego(times_s), scenario.detection_origin_x_m)
    scans = scanner.scans(
        scanner_rng, [opponent(times_s) for opponent in opponents], track
    )
    receipts_ns, lost = _receipts(sensor.delay, delay_rng, stamps_ns, times_s)
    reported_ns = reported_stamps(sensor.clock, clock_rng, stamps_ns, receipts_ns)
    is_missing = lost | sensor.silent(times_s)
    return (
        DetectionList(
            sensor.name,
            int(reported_ns[row]),
            int(receipts_ns[row]),
            scans[row],
            sensor.frame,
        )
        for row in _by_receipt(receipts_ns, is_missing)
    )


def _by_receipt(receipts_ns: IntArray, is_missing: BoolArray) -> Iterator[int]:
    """Yield the rows of the messages that are not missing, by ascending receipt, in their order at equal receipts."""
    order = np.argsort(receipts_ns, kind="stable")
    for row in order[~is_missing[order]]:
        yield int(row)


def _stamps(
    scenario: Scenario, times: FloatArray | float
) -> tuple[IntArray, FloatArray]:
    """Return stamps and times since the start in whole nanoseconds, for given times or for a rate."""
    if isinstance(times, float):
        times = np.arange(math.floor(scenario.duration_s * times + 1e-9) + 1) / times
    since_start_ns = np.rint(times * NS_PER_S).astype(np.int64)
    return scenario.start_ns + since_start_ns, since_start_ns / NS_PER_S


def _receipts(
    delay: AnyDelay, rng: np.random.Generator, stamps_ns: IntArray, times_s: FloatArray
) -> tuple[IntArray, BoolArray]:
    """Return the receipt of each stamp, and a mask of lost messages."""
    delays_s = draw_delays(delay, rng, times_s)
    delays_ns = np.rint(np.nan_to_num(delays_s) * NS_PER_S).astype(np.int64)
    return stamps_ns + delays_ns, np.isnan(delays_s)
