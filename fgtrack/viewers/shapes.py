"""What a viewer shows, whatever the file: each message has the time at which it was known and the time it is about."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from fgtrack.core.types import DetectionList, EgoState

Point = tuple[float, float]
"""x and y in metres."""

Colour = tuple[float, float, float, float]
"""Red, green, blue and opacity, each from 0 to 1."""


@dataclass(frozen=True, slots=True)
class Box:
    """An upright box that stands on the ground."""

    centre_m: Point
    yaw_rad: float
    size_m: tuple[float, float, float]
    """Length along the yaw, width, height."""
    colour: Colour


@dataclass(frozen=True, slots=True)
class Ellipse:
    """A flat ellipse."""

    centre_m: Point
    height_m: float
    """Above the ground."""
    yaw_rad: float
    """Direction of the long axis."""
    axes_m: Point
    """Whole length of the long axis, and of the short one."""
    colour: Colour


@dataclass(frozen=True, slots=True)
class Arrow:
    """An arrow on the ground."""

    tail_m: Point
    tip_m: Point
    width_m: float
    colour: Colour


@dataclass(frozen=True, slots=True)
class Line:
    """Points that are joined, at least two; a closed line ends at its first point."""

    points_m: tuple[Point, ...]
    width_m: float
    colour: Colour


@dataclass(frozen=True, slots=True)
class Dot:
    """A ball."""

    centre_m: Point
    diameter_m: float
    colour: Colour


@dataclass(frozen=True, slots=True)
class Label:
    """Text that faces the viewer, above a point."""

    point_m: Point
    height_m: float
    text: str
    colour: Colour


Shape = Box | Ellipse | Arrow | Line | Dot | Label


@dataclass(frozen=True, slots=True)
class Entity:
    """Shapes that belong together; a later one of this name on the same topic takes their place."""

    name: str
    shapes: tuple[Shape, ...]
    lifetime_s: float | None = None
    """How long it is shown after it was known; None until it is replaced or removed."""
    facts: Mapping[str, str] = field(default_factory=dict)
    """What a viewer tells of it when it is chosen."""
    frame: Literal["map", "ego"] = "map"
    """The frame in which the shapes are given. Those in the frame of the ego move with it."""


@dataclass(frozen=True, slots=True)
class Scene:
    """Entities that appear, change or go."""

    topic: str
    log_ns: int
    """When it was known: the receipt, or the tick."""
    stamp_ns: int
    """What it is about."""
    entities: tuple[Entity, ...] = ()
    removed: tuple[str, ...] = ()
    """Names of entities that are not shown any more."""
    lasting: bool = False
    """Whether it is told once and holds for good, so that who listens later must get it too."""


@dataclass(frozen=True, slots=True)
class Objects:
    """States of objects in the map, known at the receipt of the list."""

    topic: str
    objects: DetectionList

    @property
    def log_ns(self) -> int:
        """When it was known."""
        return self.objects.receipt_ns

    @property
    def stamp_ns(self) -> int:
        """What it is about."""
        return self.objects.stamp_ns


@dataclass(frozen=True, slots=True)
class EgoMotion:
    """Pose and motion of the ego."""

    ego: EgoState

    @property
    def log_ns(self) -> int:
        """When it was known."""
        return self.ego.receipt_ns

    @property
    def stamp_ns(self) -> int:
        """What it is about."""
        return self.ego.stamp_ns


@dataclass(frozen=True, slots=True)
class Facts:
    """Numbers and words to plot; a value that is not known is None."""

    topic: str
    log_ns: int
    stamp_ns: int
    values: Mapping[str, float | int | str | None]


ViewerMessage = Scene | Objects | EgoMotion | Facts
