"""Parts of an input that are read: topics with ego, detections and truth, files of a data set."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Literal

import pydantic
from pydantic import NonNegativeFloat, StringConstraints

from fgtrack.core.types import Frame
from fgtrack.models.sensors import Filter

Path = str | Sequence[str]
"""Names of fields with dots between; several paths are the components of a vector, whose length is meant."""


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
    """Where it is; as a `fields` entry without a conversion."""
    scale: float = 1.0
    """Factor; -1 turns the sign."""
    offset: float = 0.0
    """Added to the scaled number, in its unit: a compass heading in degrees is a yaw by `scale: -1, offset: 90`."""
    degrees: bool = False
    """True if the result is in degrees and has to be radians."""

    def value(self, raw: float) -> float:
        """The converted number."""
        value = self.scale * raw + self.offset
        return math.radians(value) if self.degrees else value


FieldPath = str | Sequence[str] | Field


@dataclass(frozen=True)
class TopicInput:
    """One topic of a recording."""

    topic: str
    """Name of the topic."""
    frame: Frame | None = None
    """Frame of the positions; by default `map` where the header names a fixed frame, else `ego`."""
    fields: Mapping[str, FieldPath] | None = None
    """Paths of the fields, for a type without an adapter.

    `objects` is the list in the message, `stamp` its time (default `header.stamp`), `object_stamp`, `object_id`, the
    measured components (or `latitude_deg` and `longitude_deg`) and what describes an object (`score`, `class_name`,
    sizes) are paths in one object; several
    paths for one component are a vector, whose length is meant: `speed_mps: [velocity.x, velocity.y]`. A quaternion
    gives its yaw. A mapping converts: `{path: angle, scale: -1, offset: 0, degrees: true}`.
    """
    filters: Mapping[str, Filter] = field(default_factory=dict)
    """Which objects are taken: by what a detection has (`score`, `class_name`, `speed_mps` ...), or with `fields` by
    the path of any field in one object: `{rcs_dbsm: {min: -5}, status: {one_of: [1, 3]}}`."""
    scan_s: NonNegativeFloat | None = None
    """For one detection per message: those whose stamps are at most this apart are one scan (0: the same stamp). Null:
    every message is a list of its own."""
    stamp_from: Literal["message", "receipt"] = "message"
    """`receipt`: the stamp is the receipt, where the driver sets none or one of another clock; the delay is then
    unknown and taken as 0."""
    object_id: int | str | None = None
    """Id of the object, of truth with one object per topic. By default the index in the list of topics."""


@dataclass(frozen=True)
class CsvTable:
    """A CSV file, or of a file that holds several things the rows of one."""

    columns: Mapping[str, FieldPath]
    """Column of `stamp`, `receipt` (by default the stamp), `object_id` and of each component, as in `fields`."""
    file: str | None = None
    """Name of the file beside or in the input; by default the input itself."""
    time_unit: Literal["s", "ms", "us", "ns"] = "s"
    """Unit of `stamp` and `receipt`."""
    delimiter: Annotated[str, StringConstraints(min_length=1, max_length=1)] | None = (
        None
    )
    """Character between the cells; by default what the first line has most of: comma, semicolon or tab."""
    frame: Frame | None = None
    """Frame of the positions of detections; by default `ego`. Truth and the ego are in the map."""
    filters: Mapping[str, Filter] = field(default_factory=dict)
    """Which rows are read, by column: `{sensor: {one_of: [radar]}, snr: {min: 6}}`."""
    stamp_from: Literal["message", "receipt"] = "message"
    """As of a topic; `columns` must name `stamp` all the same."""


@dataclass(frozen=True)
class CsvInput:
    """Columns of CSV files."""

    ego: CsvTable | None = None
    """The ego: `x_m`, `y_m`, `yaw_rad` and `speed_mps` must be there."""
    detections: Mapping[str, CsvTable] = field(default_factory=dict)
    """Detections of every sensor; rows of one stamp and receipt are one list."""
    truth: CsvTable | None = None
    """True objects: `x_m`, `y_m`, and where there are several `object_id`."""


@dataclass(frozen=True)
class KittiInput:
    """Parts of a folder of the KITTI tracking data set that are read."""

    sequence: int | str | None = None
    """The sequence, where the input is a folder of several: `6` or `0006`."""
    classes: tuple[str, ...] = ("Car",)
    """Classes of the data set that are read: `Car`, `Pedestrian`, `Cyclist` ..."""
    min_score: Mapping[str, float] = field(default_factory=dict)
    """By sensor, the folder of its detections: those of a lower score are left out."""
    image_width_px: float = 1242.0
    """A box in the image that touches the left or right border is left out: its middle is not that of the car."""
    box_std: float | None = None
    """Standard deviation of the bearing of a box, in widths of the box: nearer is less certain. Null for the `std` of
    the sensor."""


@dataclass(frozen=True)
class NuscenesInput:
    """Parts of results in the form of nuScenes that are read."""

    scene: str | None = None
    """Name or token of the scene, where the results are of several: `scene-0061`."""
    tables: str | None = None
    """Folder of the data set's tables, from the file's folder on; by default the `v1.0-...` beside the file."""
    sensor: str = "detector"
    """Name of the sensor that the boxes are of."""
    classes: tuple[str, ...] = ("car",)
    """Classes that are read, of boxes and of truth; empty for all."""


@dataclass(frozen=True)
class AsterixInput:
    """Editions, times and stations of ASTERIX recordings."""

    editions: Mapping[int, str] = field(default_factory=dict)
    """Edition by category, `{21: "0.23"}`; by default the newest."""
    stamp: Mapping[int, str] = field(default_factory=dict)
    """Item with the stamp by category; by default of 021 the time of reception of the position, 073."""
    receipt: Mapping[int, str] = field(default_factory=dict)
    """Item with the receipt by category; by default of 021 the time of transmission of the report, 077, of the others
    the newest stamp up to the record."""
    stations: Mapping[int, Origin] = field(default_factory=dict)
    """Position of each station, by its SIC, that gives positions relative to itself; by default the origin."""


@dataclass(frozen=True)
class InputConfig:
    """The topics that a replay reads; a recording that fgtrack wrote needs none of it."""

    ego: TopicInput | None = None
    detections: Mapping[str, TopicInput] = field(default_factory=dict)
    """Topic of every sensor."""
    truth: TopicInput | tuple[TopicInput, ...] | None = None
    """Topic of the true objects, or a list of topics with an object each."""
    origin: Origin | None = None
    """Origin of the plane, x_m to the east and y_m to the north, that latitudes and longitudes are placed in; null: the
    first position."""
    message_definitions: tuple[str, ...] = ()
    """`.msg` files, or folders of them, of types that neither the recording nor fgtrack defines."""
    kitti: KittiInput = field(default_factory=KittiInput)
    csv: CsvInput = field(default_factory=CsvInput)
    nuscenes: NuscenesInput = field(default_factory=NuscenesInput)
    asterix: AsterixInput = field(default_factory=AsterixInput)
