"""The default scenario: an oval at racing speed with the sensors and delays of Karle et al. 2023.

`configs/scenarios/default.yaml` is the same scenario and names the source of each number.
"""

from fgtrack.models.sensors import Mount
from fgtrack.sim.delays import GammaDelay
from fgtrack.sim.scenario import Scenario
from fgtrack.sim.sensor import Clutter, SimulatedSensor
from fgtrack.sim.vehicles import LaneChange, TrackVehicle

#: Delays of the paper, section IV-B: mean and 90 % quantile.
LIDAR_DELAY = GammaDelay(min_s=0.09, mean_s=0.151, q90_s=0.191)
RADAR_DELAY = GammaDelay(min_s=0.03, mean_s=0.062, q90_s=0.089)


def paper_scenario() -> Scenario:
    """One car to follow and overtake, then one that overtakes and is followed.

    Geometry and detections are those of the paper's data (section III-H); noise and clutter are such that the
    residuals of the baseline are those of its table I.
    """
    ego = TrackVehicle(
        arc_m=100.0,
        lateral_m=-2.0,
        speed=(
            *((4.0, 52.0), (10.0, 57.0), (15.5, 57.0), (20.5, 66.0), (28.0, 66.0)),
            *((32.0, 60.0), (40.0, 60.0), (45.0, 64.0), (47.0, 64.0), (53.0, 70.0)),
        ),
        lane_changes=(LaneChange(16.0, 4.0, 2.0), LaneChange(27.0, 4.0, -2.0)),
    )
    overtaken = TrackVehicle(arc_m=140.0, lateral_m=-2.5, speed=((3.0, 52.0), (9.0, 57.0)))
    overtaking = TrackVehicle(
        arc_m=0.0,
        lateral_m=2.5,
        speed=(
            *((4.0, 52.0), (10.0, 57.0), (17.0, 57.0), (24.0, 70.0)),
            *((39.0, 70.0), (44.0, 64.0), (46.0, 64.0), (52.0, 70.0)),
        ),
        lane_changes=(LaneChange(41.0, 4.0, -2.0),),
    )
    lidar = SimulatedSensor(
        name="lidar_cluster",
        std={"x_m": 0.3, "y_m": 0.1},
        jitter_s=0.003,
        min_range_m=2.0,
        max_range_m=98.0,
        max_range_behind_m=57.0,
        detection_probability=0.9,
        clutter=Clutter(mean_per_scan=0.002, region="track"),
        split_probability=0.03,
        outlier_probability=0.01,
        outlier_factor=5.0,
        drop_outs=((17.0, 17.6),),
        delay=LIDAR_DELAY,
    )
    radar = SimulatedSensor(
        name="radar",
        std={"x_m": 0.8, "y_m": 0.4, "speed_mps": 1.0},
        phase_s=0.023,
        jitter_s=0.003,
        mount=Mount(x_m=3.0),
        field_of_view_rad=1.57,
        min_range_m=3.0,
        max_range_m=105.0,
        detection_probability=0.5,
        clutter=Clutter(mean_per_scan=0.006, region="track", speed_mps=(0.0, 5.0)),
        outlier_probability=0.01,
        outlier_factor=3.0,
        drop_outs=((52.0, 52.5),),
        delay=RADAR_DELAY,
    )
    return Scenario(ego=ego, opponents=(overtaken, overtaking), sensors=(lidar, radar))
