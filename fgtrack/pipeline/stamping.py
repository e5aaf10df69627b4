"""Stamps as they should have been: what a configuration knows of the clocks of sensors."""

from collections.abc import Mapping
from dataclasses import replace

from fgtrack.core.time import nanoseconds
from fgtrack.core.types import DetectionList
from fgtrack.models.sensors import SensorModel
from fgtrack.sim.redelay import restamped

__all__ = ["mended"]


def mended(message: DetectionList, sensors: Mapping[str, SensorModel]) -> DetectionList:
    """`message` with its receipt for a stamp and its clock's offset taken off, where `sensors` say so."""
    sensor = sensors.get(message.sensor)
    if sensor is None or (sensor.stamp_from != "receipt" and sensor.clock_offset_s == 0.0):
        return message
    offset_ns = nanoseconds(sensor.clock_offset_s)
    if sensor.stamp_from == "receipt":
        objects = tuple(item if item.stamp_ns is None else replace(item, stamp_ns=None) for item in message.objects)
        return replace(message, stamp_ns=message.receipt_ns - offset_ns, objects=objects)
    return restamped(message, message.stamp_ns - offset_ns)
