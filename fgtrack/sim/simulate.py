"""From a scenario to the messages that a tracker would have received."""

import math
from collections.abc import Sequence

import numpy as np

from fgtrack.core.errors import CallError
from fgtrack.core.geometry import wrap_angles
from fgtrack.core.time import nanoseconds, seconds
from fgtrack.core.types import (
    EGO_COVARIANCE_STATES,
    EGO_ID,
    YAW,
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
from fgtrack.sim.clocks import ClockModel, reported_stamps
from fgtrack.sim.delays import DelayModel
from fgtrack.sim.scanner import Scanner
from fgtrack.sim.scenario import Scenario
from fgtrack.sim.sensor import SimulatedSensor
from fgtrack.sim.vehicles import AnyVehicle, DrawnVehicle, Trajectory

_MOST_STATES = 5e6  # three hours of the default scenario


def simulate(scenario: Scenario, rng: np.random.Generator) -> list[Message]:
    """Messages of `scenario` in order of receipt; at the same receipt truth, ego, sensors in their order.

    Same scenario and same state of `rng`, same messages. Every vehicle and every sensor, and in it the
    delays, the clock errors, the clutter and the detections of each object, draw from a generator of their own:
    another sensor, delay or clock model leaves everything else as it was. A clock changes what is reported as the
    stamp, never when or what was sensed. A message that its delay model loses is not in the list.

    Raises
    ------
    DataError
        If the map cannot be read.
    CallError
        If it does not fit into memory.
    """
    return _Simulation(scenario, rng).messages()


class _Simulation:
    """One run: the generators of everything and the true trajectories."""

    def __init__(self, scenario: Scenario, rng: np.random.Generator) -> None:
        self.scenario = scenario
        count = _num_states(scenario)
        if count > _MOST_STATES:
            raise CallError(
                f"the scenario has some {count:.3g} sightings and states, more than {_MOST_STATES:g} do not fit into "
                "memory: shorten duration_s, or lower rates, vehicles or clutter"
            )
        vehicles_rng, self.ego_rng, self.sensors_rng = rng.spawn(3)
        self.track = _track(scenario)
        path = None if self.track is None else Path.through(self.track.table[:, :2])
        vehicles = (scenario.ego, *scenario.opponents)
        self.ego, *self.opponents = (
            self._trajectory(vehicle, path, child)
            for vehicle, child in zip(vehicles, vehicles_rng.spawn(len(vehicles)), strict=True)
        )

    def messages(self) -> list[Message]:
        """All messages in order of receipt."""
        sensors = self.scenario.sensors
        messages: list[Message] = [*self._truth(), *self._ego_messages()]
        for sensor, rng in zip(sensors, self.sensors_rng.spawn(len(sensors)), strict=True):
            messages += self._scans(sensor, rng)
        messages.sort(key=lambda message: message.receipt_ns)
        return messages

    def _trajectory(self, vehicle: AnyVehicle, path: Path | None, rng: np.random.Generator) -> Trajectory:
        if isinstance(vehicle, DrawnVehicle):
            return vehicle.trajectory(rng, self.scenario.duration_s)
        assert path is not None, "a scenario without a map has no vehicle on a track"
        return vehicle.trajectory(path)

    def _truth(self) -> list[Message]:
        stamps, times = self._whole(self._times(self.scenario.truth_rate_hz))
        rows = [trajectory.states(times).tolist() for trajectory in (self.ego, *self.opponents)]
        return [
            TruthState(stamp, stamp, object_id, *states[index])
            for index, stamp in enumerate(stamps)
            for object_id, states in enumerate(rows, start=EGO_ID)
        ]

    def _ego_messages(self) -> list[Message]:
        settings = self.scenario.ego_messages
        noise_rng, delay_rng = self.ego_rng.spawn(2)
        stamps, times = self._whole(self._times(settings.rate_hz))
        std = [*[settings.position_std_m] * 2, settings.yaw_std_rad, settings.speed_std_mps]
        std += [settings.yaw_rate_std_radps, settings.accel_std_mps2]
        states = self.ego.states(times)
        states += np.array(std) * noise_rng.standard_normal(states.shape)
        states[:, YAW] = wrap_angles(states[:, YAW])
        receipts = _receipts(settings.delay, delay_rng, stamps, times)
        variances = np.square(std[: len(EGO_COVARIANCE_STATES)])
        covariance = tuple(np.diag(variances).ravel().tolist()) if variances.any() else None
        columns = zip(stamps, receipts, *states.T.tolist(), strict=True)
        return [
            EgoState(stamp, receipt, x, y, yaw, speed, yaw_rate, accel, covariance=covariance)
            for stamp, receipt, x, y, yaw, speed, yaw_rate, accel in columns
            if receipt is not None
        ]

    def _scans(self, sensor: SimulatedSensor, rng: np.random.Generator) -> list[Message]:
        times_rng, delay_rng, scanner_rng, clock_rng = rng.spawn(4)
        stamps, times = self._whole(sensor.scan_times(times_rng, self.scenario.duration_s))
        scanner = Scanner(sensor, self.ego.states(times), self.scenario.detection_origin_x_m)
        objects = [trajectory.states(times) for trajectory in self.opponents]
        scans = scanner.scans(scanner_rng, objects, self.track)
        receipts = _receipts(sensor.delay, delay_rng, stamps, times)
        reported = _reported(sensor.clock, clock_rng, stamps, receipts)
        silent = sensor.silent(times)
        return [
            DetectionList(sensor.name, stamp, receipt, detections, sensor.frame)
            for stamp, receipt, detections, quiet in zip(reported, receipts, scans, silent, strict=True)
            if receipt is not None and not quiet
        ]

    def _times(self, rate_hz: float) -> FloatArray:
        return np.arange(math.floor(self.scenario.duration_s * rate_hz + 1e-9) + 1) / rate_hz

    def _whole(self, times_s: FloatArray) -> tuple[list[int], FloatArray]:
        """The stamps of times since the start, and the times again, now of whole nanoseconds."""
        since_start_ns = [nanoseconds(time_s) for time_s in times_s.tolist()]
        stamps = [self.scenario.start_ns + time_ns for time_ns in since_start_ns]
        return stamps, np.array([seconds(time_ns) for time_ns in since_start_ns])


def _num_states(scenario: Scenario) -> float:
    """About how many states of vehicles, sightings and ghosts are drawn."""
    vehicles = 1 + len(scenario.opponents)
    per_s = scenario.ego_messages.rate_hz + scenario.truth_rate_hz * vehicles
    per_s += sum(sensor.rate_hz * (vehicles + sensor.clutter.mean_per_scan) for sensor in scenario.sensors)
    drawn = [one for one in (scenario.ego, *scenario.opponents) if isinstance(one, DrawnVehicle)]
    return scenario.duration_s * (per_s + sum(1.0 / one.step_s for one in drawn))


def _track(scenario: Scenario) -> TrackMap | None:
    if scenario.map is None:
        return None
    return make_oval() if scenario.map == OVAL else TrackMap.read(scenario.map)


def _receipts(delay: DelayModel, rng: np.random.Generator, stamps: list[int], times_s: FloatArray) -> list[int | None]:
    """Receipt of each stamp, None where the message is lost."""
    delays = delay.draw(rng, times_s).tolist()
    return [
        None if math.isnan(delay_s) else stamp + nanoseconds(delay_s)
        for stamp, delay_s in zip(stamps, delays, strict=True)
    ]


def _reported(
    clocks: Sequence[ClockModel], rng: np.random.Generator, stamps: list[int], receipts: list[int | None]
) -> list[int]:
    """Stamp that the sensor reports in place of each of `stamps`; of a lost message it does not matter."""
    sensed_ns: IntArray = np.array(stamps, dtype=np.int64)
    receipts_ns = [stamp if receipt is None else receipt for stamp, receipt in zip(stamps, receipts, strict=True)]
    reported = reported_stamps(clocks, rng, sensed_ns, np.array(receipts_ns, dtype=np.int64))
    return [int(stamp) for stamp in reported]
