"""Scenarios of several objects: scans with false detections, the questions to a method, and the truth."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fgtrack.config.reading import read_scenario
from fgtrack.core.geometry import rotation, wrap_angles
from fgtrack.core.time import NS_PER_S, nanoseconds
from fgtrack.core.types import (
    EGO_ID,
    DetectionList,
    EgoState,
    FloatArray,
    Message,
    TruthState,
)
from fgtrack.models.sensors import in_view
from fgtrack.pipeline.public import simulate
from fgtrack.sim.late_scans import LATE_SCANS, draw_late_scans
from fgtrack.sim.sensor import SimulatedSensor

CROWD_LAGS_S = (0.0, 1.0)
"""Times of the questions before the present."""


@dataclass(frozen=True)
class CrowdSensor:
    """A sensor of positions in the map."""

    std_m: float
    """Standard deviation of x and of y."""
    detection_probability: float
    clutter_per_m2: float
    """Mean number of false detections in a scan for each m^2."""
    field_of_view_rad: float = 2.0 * np.pi
    """Opening angle, centred on the axis of the vehicle."""
    max_range_m: float | None = None
    """Range; None if the sensor sees the whole area."""
    max_range_behind_m: float | None = None
    """Range behind the vehicle; None if it equals `max_range_m`."""


@dataclass(frozen=True)
class Scan:
    """Positions that a sensor measured at one time; an empty scan means that nothing was detected."""

    receipt_ns: int
    stamp_ns: int
    sensor: str
    points_m: FloatArray
    """Positions in the map, shape (n, 2)."""
    pose: FloatArray
    """Position x, y and yaw of the vehicle with the sensor at the stamp, shape (3,)."""


@dataclass(frozen=True)
class CrowdQuery:
    """Question for all tracks at a stamp, from the scans that have been received."""

    num_known: int
    """Number of scans that are known."""
    stamp_ns: int
    lag_s: float


Positions = Mapping[int, FloatArray]
"""Position (2,) in the map of each object or track by its id."""


@dataclass(frozen=True)
class CrowdProblem:
    """A scenario of several objects that was drawn."""

    scenario: str
    start_ns: int
    speed_mps: float
    """Standard deviation of a component of the velocity of an object that appears."""
    acceleration_density_m2ps3: float
    """Density of the white noise of the acceleration."""
    sensors: Mapping[str, CrowdSensor]
    scans: tuple[Scan, ...]
    queries: tuple[CrowdQuery, ...]
    truth: tuple[Positions, ...]
    """True positions of the objects in view for each query."""
    ego: tuple[EgoState, ...] = ()
    """True states of the vehicle with the sensors; empty if the sensors are at rest."""
    whole: "CrowdProblem | None" = None
    """Problem that was cut off; None if it is this problem."""

    @property
    def max_delay_s(self) -> float:
        """Longest time from the stamp of a scan to its receipt, also of scans that were cut off."""
        if self.whole is not None:
            return self.whole.max_delay_s
        return max(scan.receipt_ns - scan.stamp_ns for scan in self.scans) / NS_PER_S

    def cut_after(self, num_known: int) -> "CrowdProblem":
        """Return the problem with its first `num_known` scans, and the queries that they answer."""
        count = sum(query.num_known <= num_known for query in self.queries)
        return replace(
            self,
            scans=self.scans[:num_known],
            queries=self.queries[:count],
            truth=self.truth[:count],
            whole=self,
        )


@dataclass(frozen=True)
class Crowd:
    """A scenario of several objects."""

    about: str
    """Scenario in one line."""
    gate_m: float
    """Cut-off distance of the metrics."""
    draw: Callable[[str, int], CrowdProblem]
    """Draws the scenario with its name and a seed."""


def _simulated(scenario: str, duration_s: float) -> Callable[[str, int], CrowdProblem]:
    """Return a function that draws a shipped scenario of the simulator, with its positions in the map."""

    def drawn(name: str, seed: int) -> CrowdProblem:
        settings = read_scenario(scenario, duration_s=duration_s)
        messages = list(simulate(settings, seed=seed))
        start_ns = settings.start_ns
        ego = _Path([each for each in _truth(messages) if each.object_id == EGO_ID])
        ahead_m = settings.detection_origin_x_m
        lists = [each for each in messages if isinstance(each, DetectionList)]
        scans = tuple(_in_map(each, ego, ahead_m) for each in lists)
        moments_ns = [
            start_ns + nanoseconds(time_s) for time_s in np.arange(1.0, duration_s, 0.5)
        ]
        queries = _queries(scans, moments_ns, start_ns)
        paths = {
            object_id: _Path(
                [each for each in _truth(messages) if each.object_id == object_id]
            )
            for object_id in range(len(settings.opponents))
        }
        truth = tuple(
            {
                object_id: path.at(query.stamp_ns)[:2]
                for object_id, path in paths.items()
                if _is_in_view(
                    path.at(query.stamp_ns)[:2],
                    ego.at(query.stamp_ns),
                    settings.sensors,
                )
            }
            for query in queries
        )
        sensors = {
            sensor.name: CrowdSensor(
                max(sensor.std["x_m"], sensor.std["y_m"]),
                sensor.detection_probability,
                sensor.clutter.mean_per_scan / _LANES_M2,
                sensor.field_of_view_rad,
                sensor.max_range_m,
                sensor.max_range_behind_m,
            )
            for sensor in settings.sensors
        }
        return CrowdProblem(
            name, start_ns, 40.0, 50.0, sensors, scans, queries, truth, _ego(messages)
        )

    return drawn


_LANES_M2 = 200.0 * 15.0
"""Area of the track in which clutter lies."""


def _truth(messages: Sequence[Message]) -> list[TruthState]:
    return [each for each in messages if isinstance(each, TruthState)]


def _ego(messages: Sequence[Message]) -> tuple[EgoState, ...]:
    return tuple(
        EgoState(
            each.stamp_ns,
            each.stamp_ns,
            each.x_m,
            each.y_m,
            each.yaw_rad or 0.0,
            each.speed_mps or 0.0,
            each.yaw_rate_radps or 0.0,
        )
        for each in _truth(messages)
        if each.object_id == EGO_ID
    )


class _Path:
    """True x, y and yaw of a vehicle at any stamp, interpolated."""

    def __init__(self, states: Sequence[TruthState]) -> None:
        self._stamps_ns = np.array([each.stamp_ns for each in states])
        yaws_rad = np.unwrap(np.array([each.yaw_rad for each in states]))
        self._rows = np.column_stack(
            [[each.x_m for each in states], [each.y_m for each in states], yaws_rad]
        )

    def at(self, stamp_ns: int) -> FloatArray:
        return np.array(
            [np.interp(stamp_ns, self._stamps_ns, column) for column in self._rows.T]
        )


def _in_map(scan: DetectionList, ego: _Path, ahead_m: float) -> Scan:
    """Return the positions of a list, which are relative to a point on the ego's axis, in the map."""
    pose = ego.at(scan.stamp_ns)
    points_m = np.array(
        [[each.x_m, each.y_m] for each in scan.objects], dtype=np.float64
    )
    points_m = points_m.reshape(-1, 2) + np.array([ahead_m, 0.0])
    points_m = points_m @ rotation(pose[2]).T + pose[:2]
    return Scan(scan.receipt_ns, scan.stamp_ns, scan.sensor, points_m, pose)


def _is_in_view(
    point_m: FloatArray, ego: FloatArray, sensors: Sequence[SimulatedSensor]
) -> bool:
    dx, dy = point_m - ego[:2]
    range_m, bearing_rad = np.hypot(dx, dy), wrap_angles(np.arctan2(dy, dx) - ego[2])
    return any(
        bool(
            in_view(
                range_m,
                bearing_rad,
                sensor.field_of_view_rad,
                min_range_m=sensor.min_range_m,
                max_range_m=sensor.max_range_m,
                max_range_behind_m=sensor.max_range_behind_m,
            )
        )
        for sensor in sensors
    )


def _queries(
    scans: Sequence[Scan], moments_ns: Sequence[int], start_ns: int
) -> tuple[CrowdQuery, ...]:
    """Return the queries at the moments: each asks for the present and for the past."""
    receipts_ns = np.array([scan.receipt_ns for scan in scans])
    return tuple(
        CrowdQuery(
            int(np.searchsorted(receipts_ns, moment_ns, "right")),
            moment_ns - nanoseconds(lag_s),
            lag_s,
        )
        for moment_ns in moments_ns
        for lag_s in CROWD_LAGS_S
        if moment_ns - nanoseconds(lag_s) >= start_ns
    )


def _late_scans(name: str, seed: int) -> CrowdProblem:
    """Draw the benchmark of Garcia-Fernandez and Yi 2021; a scan is received at the newest stamp so far."""
    scene = draw_late_scans(np.random.default_rng(seed), lags_s=CROWD_LAGS_S)
    start_ns = NS_PER_S
    stamps_ns = [start_ns + nanoseconds(time_s) for time_s in scene.stamps_s]
    scans = tuple(
        Scan(stamps_ns[last], stamps_ns[k], "sensor", scene.points_m[k], np.zeros(3))
        for k, last in zip(scene.received, scene.newest, strict=True)
    )
    queries, truth = [], []
    for k in sorted(set(scene.newest) - {0}):
        num_known = 1 + max(n for n, last in enumerate(scene.newest) if last == k)
        for lag_s in CROWD_LAGS_S:
            time_s = float(scene.stamps_s[k] - lag_s)
            if time_s < 0.0:
                continue
            stamp_ns = stamps_ns[k] - nanoseconds(lag_s)
            queries.append(CrowdQuery(num_known, stamp_ns, lag_s))
            truth.append(
                {
                    n: path[time_s]
                    for n, path in enumerate(scene.paths)
                    if time_s in path
                }
            )
    return CrowdProblem(
        name,
        start_ns,
        3.0,
        LATE_SCANS.acceleration_density_m2ps3,
        {"sensor": _SENSOR},
        scans,
        tuple(queries),
        tuple(truth),
    )


_SENSOR = CrowdSensor(
    LATE_SCANS.std_m, LATE_SCANS.detection_probability, LATE_SCANS.clutter_per_m2
)


CROWDS: Mapping[str, Crowd] = {
    "race": Crowd(
        "the default race: two cars, clutter and split detections, 40 s",
        5.0,
        _simulated("default", 40.0),
    ),
    "dense": Crowd(
        "ten cars in three lanes around the ego, 10 s", 5.0, _simulated("dense", 10.0)
    ),
    "oos-mtt": Crowd(
        "objects appear and disappear among ten false detections a scan; every fifth scan is late",
        10.0,
        _late_scans,
    ),
}
"""Shipped scenarios of several objects by name."""
