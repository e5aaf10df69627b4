"""Settings of the inputs: topics or files with ego, detections and truth."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Literal

import pydantic
from pydantic import NonNegativeFloat, StringConstraints

from fgtrack.core.types import Frame
from fgtrack.models.sensors import Filter

Path = str | Sequence[str]
"""Path of a field: names joined by dots. Several paths are the components of a vector, whose length is read."""


@dataclass(frozen=True)
class Origin:
    """A position on Earth (WGS84)."""

    latitude_deg: Annotated[float, pydantic.Field(ge=-90.0, le=90.0)]
    """North of the equator."""
    longitude_deg: Annotated[float, pydantic.Field(ge=-180.0, le=180.0)]
    """East of Greenwich."""


@dataclass(frozen=True)
class Field:
    """A number of a message, and how it is converted: `scale` times the number, plus `offset`."""

    path: str | Sequence[str]
    """Path of the number, as a `fields` entry without a conversion."""
    scale: float = 1.0
    """Factor; -1 changes the sign."""
    offset: float = 0.0
    """Added after scaling, in the same unit. `scale: -1, offset: 90` converts a compass heading in degrees to a yaw."""
    degrees: bool = False
    """True if the result is in degrees and is to be converted to radians."""
    unknown: tuple[float, ...] = ()
    """Recorded numbers that mean "unknown", for example `[102.3]` for a speed in AIS tables; the value is missing."""
    least: Mapping[str, float] = field(default_factory=dict)
    """Least recorded numbers of other fields with which the value counts, by path; otherwise it is missing.

    `{SOG: 1}`: the course of a ship is random at rest, so it counts from 1 knot.
    """

    def value(self, raw: float) -> float:
        """Return the converted number."""
        value = self.scale * raw + self.offset
        return math.radians(value) if self.degrees else value


FieldPath = str | Sequence[str] | Field


@dataclass(frozen=True)
class TopicInput:
    """One topic of a recording."""

    topic: str = ""
    """Name of the topic. Empty: the draft of a recording names it, and the other keys stay as given."""
    frame: Frame | Literal["optical"] | None = None
    """Frame of the positions; `optical` is a sensor frame with x to the right, y down and z forward.

    Null: the header's `frame_id`. The ego odometry's `frame_id` is the map, its
    `child_frame_id` the ego; other frames are transformed by tf. Of the frames without
    a transform, `map`, `world` and `odom` are the map, the others the ego.
    """
    fields: Mapping[str, FieldPath] | None = None
    """Paths of the fields, for a message type without an adapter.

    `objects` is the path of the list in the message, `stamp` the path of its time
    (default `header.stamp`). All other entries are paths in one object: `object_stamp`,
    `object_id`, the measured components (or `latitude_deg` and `longitude_deg`), and
    descriptions (`score`, `class_name`, sizes). Several paths for one component are a
    vector, whose length is read: `speed_mps: [velocity.x, velocity.y]`. Two paths for
    `range_rate_mps` are a velocity relative to the ego, along the axes of the
    positions; its component along the line of sight is read. A quaternion gives its
    yaw. A mapping converts a number: `{path: angle, scale: -1, offset: 0, degrees:
    true}`.
    """
    filters: Mapping[str, Filter] = field(default_factory=dict)
    """Conditions for the objects that are read, by field of a detection (`score`, `class_name`, `speed_mps` ...).

    With `fields`, also by the path of any field in one object: `{rcs_dbsm: {min: -5},
    status: {one_of: [1, 3]}}`.
    """
    scan_s: NonNegativeFloat | None = None
    """Merges messages with one detection each: stamps at most `scan_s` apart make one scan (0: equal stamps).

    Null: every message is a list.
    """
    stamp_from: Literal["message", "receipt"] = "message"
    """`receipt`: use the receipt as the stamp, if the driver sets no stamp or uses another clock.

    The delay is then unknown and taken as 0.
    """
    object_id: int | str | None = None
    """Id of the object of a truth topic with one object; by default the index in the list of topics."""


@dataclass(frozen=True)
class CsvTable:
    """A CSV file, or some rows of a file that contains several sensors or kinds."""

    columns: Mapping[str, FieldPath] = field(default_factory=dict)
    """Columns of `stamp`, `receipt` (by default the stamp), `object_id` and each component, as in `fields`.

    Two columns of a time are whole seconds and nanoseconds, which are added: `stamp:
    [header.stamp.sec, header.stamp.nanosec]`; or a date and a time of day. Four columns
    of `yaw_rad` are a quaternion x, y, z, w.
    """
    file: str | None = None
    """Name of the file next to the input or inside it; by default the input itself."""
    time_unit: Literal["s", "ms", "us", "ns"] = "s"
    """Unit of `stamp` and `receipt`."""
    delimiter: Annotated[str, StringConstraints(min_length=1, max_length=1)] | None = (
        None
    )
    """Character between the cells; by default the most frequent in the first line: comma, semicolon or tab."""
    frame: Frame | None = None
    """Frame of the positions of detections; by default `ego`. Truth and the ego are in the map."""
    filters: Mapping[str, Filter] = field(default_factory=dict)
    """Conditions for the rows that are read, by column: `{sensor: {one_of: [radar]}, snr: {min: 6}}`."""
    stamp_from: Literal["message", "receipt"] = "message"
    """As for a topic; `columns` must contain `stamp` nevertheless."""


@dataclass(frozen=True)
class CsvInput:
    """CSV files of ego, detections and truth."""

    ego: CsvTable | None = None
    """The ego; `x_m` and `y_m` are required. Without `yaw_rad` or `speed_mps`, successive positions give them."""
    detections: Mapping[str, CsvTable] = field(default_factory=dict)
    """Detections by sensor; rows with equal stamp and receipt make one list."""
    truth: CsvTable | None = None
    """True objects: `x_m`, `y_m`, and `object_id` if there are several."""


@dataclass(frozen=True)
class KittiInput:
    """Contents of a folder of the KITTI tracking data set that are read."""

    sequence: int | str | None = None
    """Sequence to read if the input is a folder of several: `6` or `0006`."""
    classes: tuple[str, ...] = ("Car",)
    """Classes of the data set that are read: `Car`, `Pedestrian`, `Cyclist` ..."""
    min_score: Mapping[str, float] = field(default_factory=dict)
    """Lowest score that is read, by sensor (the folder of its detections)."""
    image_width_px: float = 1242.0
    """Width of the image. A box that touches the left or right border is left out: its centre is not the car's."""
    box_std: float | None = None
    """Standard deviation of the bearing of a box as a share of the box's width; null for the `std` of the sensor.

    A near object has a wide box, and so a less certain bearing.
    """


@dataclass(frozen=True)
class NuscenesInput:
    """Contents of results in the nuScenes format that are read."""

    scene: str | None = None
    """Name or token of the scene if the results contain several: `scene-0061`."""
    tables: str | None = None
    """Folder of the data set's tables, relative to the results file or to the working folder.

    Null: `v1.0-...` next to the file.
    """
    sensor: str = "detector"
    """Name of the sensor of the boxes."""
    classes: tuple[str, ...] = ("car",)
    """Classes of boxes and of truth that are read; empty for all."""


@dataclass(frozen=True)
class AsterixInput:
    """Editions, times and stations of ASTERIX recordings."""

    editions: Mapping[int, str] = field(default_factory=dict)
    """Edition by category, `{21: "0.23"}`; by default the newest."""
    stamp: Mapping[int, str] = field(default_factory=dict)
    """Item with the stamp, by category; by default the time of the position.

    This is item 073 of category 021 (else 071, else 030), item 070 of category 062, and
    item 140 of the other categories.
    """
    receipt: Mapping[int, str] = field(default_factory=dict)
    """Item with the receipt, by category; by default item 077 of category 021, the transmission of the report.

    For other categories the default is the newest stamp up to the record.
    """
    stations: Mapping[int, Origin] = field(default_factory=dict)
    """Position of each station that reports relative positions, by its SIC; by default the origin."""


@dataclass(frozen=True)
class InputConfig:
    """Topics and files that a replay reads; a recording of fgtrack needs none of these settings."""

    ego: TopicInput | None = None
    detections: Mapping[str, TopicInput] = field(default_factory=dict)
    """Topic by sensor."""
    truth: TopicInput | tuple[TopicInput, ...] | None = None
    """Topic of the true objects, or a list of topics with one object each."""
    origin: Origin | None = None
    """Origin of the local plane for latitudes and longitudes: x_m to the east, y_m to the north.

    Null: the first position.
    """
    message_definitions: tuple[str, ...] = ()
    """`.msg` files, or folders of them, for types that neither the recording nor fgtrack defines."""
    kitti: KittiInput = field(default_factory=KittiInput)
    csv: CsvInput = field(default_factory=CsvInput)
    nuscenes: NuscenesInput = field(default_factory=NuscenesInput)
    asterix: AsterixInput = field(default_factory=AsterixInput)
