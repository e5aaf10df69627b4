"""The default scenario: an oval at racing speed with the sensors and delays of Karle et al. 2023."""

from fgtrack.models.sensors import Mount
from fgtrack.sim.delays import GammaDelay
from fgtrack.sim.scenario import Scenario
from fgtrack.sim.sensor import Clutter, SimulatedSensor
from fgtrack.sim.vehicles import LaneChange, TrackVehicle

#: Delays of the paper, section IV-B: mean and 90 % quantile.
LIDAR_DELAY = GammaDelay(min_s=0.09, mean_s=0.151, q90_s=0.191)
RADAR_DELAY = GammaDelay(min_s=0.03, mean_s=0.062, q90_s=0.089)


def paper_scenario() -> Scenario:
    """One car to overtake and one that overtakes; noise, misses and clutter are plausible for the sensors."""
    ego = TrackVehicle(
        arc_m=100.0,
        lateral_m=-2.0,
        speed=((0.0, 65.0), (14.0, 70.0), (40.0, 68.0), (60.0, 66.0)),
        lane_changes=(LaneChange(3.0, 4.0, 2.5), LaneChange(22.0, 4.0, -2.0)),
    )
    overtaken = TrackVehicle(arc_m=175.0, lateral_m=-2.5, speed=((0.0, 63.0), (20.0, 65.0), (60.0, 64.0)))
    overtaking = TrackVehicle(
        arc_m=45.0,
        lateral_m=-3.0,
        speed=((0.0, 66.0), (25.0, 69.0), (45.0, 73.0), (60.0, 68.0)),
        lane_changes=(LaneChange(24.0, 5.0, 3.5), LaneChange(54.0, 4.0, -2.5)),
    )
    lidar = SimulatedSensor(
        name="lidar_cluster",
        std={"x_m": 0.3, "y_m": 0.3},
        jitter_s=0.003,
        min_range_m=2.0,
        max_range_m=98.0,
        detection_probability=0.9,
        clutter=Clutter(mean_per_scan=0.3),
        split_probability=0.03,
        outlier_probability=0.01,
        outlier_factor=5.0,
        drop_outs=((17.0, 17.6),),
        delay=LIDAR_DELAY,
    )
    radar = SimulatedSensor(
        name="radar",
        std={"x_m": 1.0, "y_m": 1.0, "speed_mps": 0.2},
        phase_s=0.023,
        jitter_s=0.003,
        mount=Mount(x_m=3.0),
        field_of_view_rad=1.4,
        min_range_m=3.0,
        max_range_m=105.0,
        detection_probability=0.85,
        clutter=Clutter(mean_per_scan=0.3, region="track", speed_mps=(10.0, 80.0)),
        outlier_probability=0.01,
        outlier_factor=3.0,
        drop_outs=((31.0, 31.5),),
        delay=RADAR_DELAY,
    )
    return Scenario(ego=ego, opponents=(overtaken, overtaking), sensors=(lidar, radar))
