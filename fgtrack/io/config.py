"""What of an input is read: topics of a recording that hold the ego, detections and truth, parts of a data set."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

from fgtrack.core.types import Frame


@dataclass(frozen=True)
class TopicInput:
    """One topic of a recording."""

    topic: str
    """Name of the topic."""
    type: str | None = None
    """Message type, where the topic has several or must have this one."""
    frame: Frame | None = None
    """Frame of the positions; by default `map` where the header names a fixed frame, else `ego`."""
    fields: Mapping[str, str | Sequence[str]] | None = None
    """Paths of the fields, for a type that fgtrack does not know.

    `objects` is the list in the message, `stamp` its time (default `header.stamp`), `object_stamp`,
    `object_id` and the measured components are paths in one object; several paths for one component are a
    vector, whose length is meant: `speed_mps: [velocity.x, velocity.y]`. A quaternion gives its yaw.
    """


@dataclass(frozen=True)
class KittiInput:
    """What is read of a folder of the KITTI tracking data set."""

    sequence: int | str | None = None
    """The sequence, where the input is a folder of several: `6` or `0006`."""
    classes: tuple[str, ...] = ("Car",)
    """Classes of the data set that are read: `Car`, `Pedestrian`, `Cyclist` ..."""
    min_score: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    """By sensor, the folder of its detections: those of a lower score are left out."""
    image_width_px: float = 1242.0
    """A box in the image that touches the left or right border is left out: its middle is not that of the car."""
    box_std: float | None = None
    """Standard deviation of the bearing of a box, in widths of the box: nearer is less certain. Null for the `std` of
    the sensor."""


@dataclass(frozen=True)
class InputConfig:
    """The topics that a replay reads; a recording that fgtrack wrote needs none of it."""

    ego: TopicInput | None = None
    detections: Mapping[str, TopicInput] = field(default_factory=lambda: MappingProxyType({}))
    """Topic of every sensor."""
    truth: TopicInput | None = None
    message_definitions: tuple[str, ...] = ()
    """`.msg` files, or folders of them, of types that neither the recording nor fgtrack defines."""
    kitti: KittiInput = field(default_factory=KittiInput)
