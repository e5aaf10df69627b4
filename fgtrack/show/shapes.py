"""Messages that show a run, independent of the file format. Each has a log time and a stamp."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from fgtrack.core.types import Detection, EgoState

Point = tuple[float, float]
"""x and y in metres."""

Colour = tuple[float, float, float, float]
"""Red, green, blue and opacity, each from 0 to 1."""


@dataclass(frozen=True, slots=True)
class Shape:
    """A shape on the ground."""

    kind: Literal["arrow", "cube", "cylinder", "line", "sphere", "text"]
    colour: Colour
    size_m: tuple[float, float, float]
    """Length along the yaw, width, height. A line has a width only, and a text a letter height."""
    at_m: Point = (0.0, 0.0)
    """Centre of the shape; of an arrow its tail."""
    height_m: float = 0.0
    """Height of the centre above the ground."""
    yaw_rad: float = 0.0
    points_m: Sequence[Point] = ()
    """Points of a line."""
    text: str = ""


@dataclass(frozen=True, slots=True)
class Entity:
    """Shapes that belong together. A later entity with the same name and topic replaces them."""

    name: str
    shapes: tuple[Shape, ...]
    lifetime_s: float | None = None
    """Display time [s] from the log time; None until it is replaced or removed."""
    frame: Literal["map", "ego"] = "map"


@dataclass(frozen=True, slots=True)
class Scene:
    """Entities that appear or change, and the names of removed entities."""

    entities: tuple[Entity, ...] = ()
    removed: tuple[str, ...] = ()
    latched: bool = False
    """True if the scene is sent once and must also reach late subscribers."""


@dataclass(frozen=True, slots=True)
class ViewerMessage:
    """Message of a topic."""

    log_ns: int
    """Time at which the content was available: receipt or tick."""
    stamp_ns: int
    """Time of the content: when it was measured, or is valid."""
    topic: str
    content: (
        Scene
        | tuple[Detection, ...]
        | EgoState
        | Mapping[str, float | int | str | None]
    )
    """Shapes, objects in the map, the ego, or the outcome of a detection."""
