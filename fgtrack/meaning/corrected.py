"""Stamps corrected as the settings of sensors and of the ego specify."""

from collections.abc import Mapping
from dataclasses import replace

from fgtrack.config.settings import Config
from fgtrack.core.time import nanoseconds
from fgtrack.core.types import DetectionList, EgoState, Message
from fgtrack.models.sensors import SensorModel

__all__ = ["corrected", "corrected_ego", "corrected_message"]


def corrected_message(message: Message, config: Config) -> Message:
    """Return `message` with the stamp that `config` specifies; the truth is unchanged."""
    if isinstance(message, EgoState):
        return corrected_ego(message, config.ego.clock_offset_s)
    if isinstance(message, DetectionList):
        return corrected(message, config.sensors)
    return message


def corrected_ego(ego: EgoState, clock_offset_s: float) -> EgoState:
    """Return `ego` with its stamp minus the clock offset."""
    if clock_offset_s == 0.0:
        return ego
    return replace(ego, stamp_ns=ego.stamp_ns - nanoseconds(clock_offset_s))


def corrected(
    message: DetectionList, sensors: Mapping[str, SensorModel]
) -> DetectionList:
    """Return `message` with the stamp that `sensors` specifies: its receipt, or its stamp minus the clock offset.

    A clock offset is also subtracted from the receipt.
    """
    sensor = sensors.get(message.sensor)
    if sensor is None or (
        sensor.stamp_from != "receipt" and sensor.clock_offset_s == 0.0
    ):
        return message
    from fgtrack.sim.new_delays import restamped

    offset_ns = nanoseconds(sensor.clock_offset_s)
    if sensor.stamp_from == "receipt":
        objects = tuple(
            item if item.stamp_ns is None else replace(item, stamp_ns=None)
            for item in message.objects
        )
        return replace(
            message, stamp_ns=message.receipt_ns - offset_ns, objects=objects
        )
    return restamped(message, message.stamp_ns - offset_ns)
