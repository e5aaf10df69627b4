"""A message type."""

from fgtrack import Detection, ObjectList


def read_blips(message):
    """`example_msgs/Blips`: ranges and bearings of a sensor with one stamp in ns."""
    pairs = zip(message.ranges_m.tolist(), message.bearings_rad.tolist(), strict=True)
    blips = tuple(Detection(range_m=range_m, bearing_rad=bearing_rad) for range_m, bearing_rad in pairs)
    return ObjectList(message.stamp_ns, "sensor", blips)
