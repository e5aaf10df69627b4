"""The simulator: vehicles on a track or in the open, their detections, and the delays of the detections.

`fgtrack.simulate` runs a `Scenario`. The names below are public.
"""

from typing import TYPE_CHECKING

from fgtrack.core.lazy import lazy_names

#: Module that each public name is loaded from on first use.
_HOMES = {
    "ArrivalClock": "fgtrack.sim.clocks",
    "Clutter": "fgtrack.sim.sensor",
    "ConstantDelay": "fgtrack.sim.delays",
    "DrawnTrajectory": "fgtrack.sim.vehicles",
    "DrawnVehicle": "fgtrack.sim.vehicles",
    "DriftClock": "fgtrack.sim.clocks",
    "EgoMessages": "fgtrack.sim.scenario",
    "GammaDelay": "fgtrack.sim.delays",
    "JitterClock": "fgtrack.sim.clocks",
    "LATE_SCANS": "fgtrack.sim.late_scans",
    "LIDAR_DELAY": "fgtrack.sim.delays",
    "LaneChange": "fgtrack.sim.vehicles",
    "LateScans": "fgtrack.sim.late_scans",
    "LateScansModel": "fgtrack.sim.late_scans",
    "LossyDelay": "fgtrack.sim.delays",
    "MarkovDelay": "fgtrack.sim.delays",
    "MarkovTimeDelay": "fgtrack.sim.delays",
    "NoDelay": "fgtrack.sim.delays",
    "OffsetClock": "fgtrack.sim.clocks",
    "QuantisedClock": "fgtrack.sim.clocks",
    "RADAR_DELAY": "fgtrack.sim.delays",
    "RecordedVehicle": "fgtrack.sim.roads",
    "Scenario": "fgtrack.sim.scenario",
    "SensorDelays": "fgtrack.sim.new_delays",
    "SimulatedSensor": "fgtrack.sim.sensor",
    "TrackVehicle": "fgtrack.sim.vehicles",
    "UniformDelay": "fgtrack.sim.delays",
    "WaypointVehicle": "fgtrack.sim.roads",
    "draw_delays": "fgtrack.sim.delays",
    "draw_late_scans": "fgtrack.sim.late_scans",
    "draw_states": "fgtrack.sim.vehicles",
    "redelay": "fgtrack.sim.new_delays",
    "restamped": "fgtrack.sim.new_delays",
}

__all__ = sorted(_HOMES)

if TYPE_CHECKING:  # the same names for type checkers; a test keeps the two lists equal
    from fgtrack.sim.clocks import ArrivalClock as ArrivalClock
    from fgtrack.sim.clocks import DriftClock as DriftClock
    from fgtrack.sim.clocks import JitterClock as JitterClock
    from fgtrack.sim.clocks import OffsetClock as OffsetClock
    from fgtrack.sim.clocks import QuantisedClock as QuantisedClock
    from fgtrack.sim.delays import LIDAR_DELAY as LIDAR_DELAY
    from fgtrack.sim.delays import RADAR_DELAY as RADAR_DELAY
    from fgtrack.sim.delays import ConstantDelay as ConstantDelay
    from fgtrack.sim.delays import GammaDelay as GammaDelay
    from fgtrack.sim.delays import LossyDelay as LossyDelay
    from fgtrack.sim.delays import MarkovDelay as MarkovDelay
    from fgtrack.sim.delays import MarkovTimeDelay as MarkovTimeDelay
    from fgtrack.sim.delays import NoDelay as NoDelay
    from fgtrack.sim.delays import UniformDelay as UniformDelay
    from fgtrack.sim.delays import draw_delays as draw_delays
    from fgtrack.sim.late_scans import LATE_SCANS as LATE_SCANS
    from fgtrack.sim.late_scans import LateScans as LateScans
    from fgtrack.sim.late_scans import LateScansModel as LateScansModel
    from fgtrack.sim.late_scans import draw_late_scans as draw_late_scans
    from fgtrack.sim.new_delays import SensorDelays as SensorDelays
    from fgtrack.sim.new_delays import redelay as redelay
    from fgtrack.sim.new_delays import restamped as restamped
    from fgtrack.sim.roads import RecordedVehicle as RecordedVehicle
    from fgtrack.sim.roads import WaypointVehicle as WaypointVehicle
    from fgtrack.sim.scenario import EgoMessages as EgoMessages
    from fgtrack.sim.scenario import Scenario as Scenario
    from fgtrack.sim.sensor import Clutter as Clutter
    from fgtrack.sim.sensor import SimulatedSensor as SimulatedSensor
    from fgtrack.sim.vehicles import DrawnTrajectory as DrawnTrajectory
    from fgtrack.sim.vehicles import DrawnVehicle as DrawnVehicle
    from fgtrack.sim.vehicles import LaneChange as LaneChange
    from fgtrack.sim.vehicles import TrackVehicle as TrackVehicle
    from fgtrack.sim.vehicles import draw_states as draw_states

__getattr__, __dir__ = lazy_names(__name__, _HOMES)
