"""Messages that show a run, for any file format: each has the time it is known at, and the time it is of."""

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
    """A shape that stands or lies on the ground."""

    kind: Literal["arrow", "cube", "cylinder", "line", "sphere", "text"]
    colour: Colour
    size_m: tuple[float, float, float]
    """Length along the yaw, width, height; of a line its width, of a text the height of its letters."""
    at_m: Point = (0.0, 0.0)
    """Its centre; of an arrow its tail."""
    height_m: float = 0.0
    """Height of the centre above the ground."""
    yaw_rad: float = 0.0
    points_m: Sequence[Point] = ()
    """Points of a line."""
    text: str = ""


@dataclass(frozen=True, slots=True)
class Entity:
    """Shapes that belong together; a later entity of the same name on the same topic replaces them."""

    name: str
    shapes: tuple[Shape, ...]
    lifetime_s: float | None = None
    """Time in seconds for which it is shown from its log time on; None until it is replaced or removed."""
    frame: Literal["map", "ego"] = "map"


@dataclass(frozen=True, slots=True)
class Scene:
    """Entities that appear or change, and names of those that are removed."""

    entities: tuple[Entity, ...] = ()
    removed: tuple[str, ...] = ()
    latched: bool = False
    """True if it is sent once, so that late subscribers must get it too."""


@dataclass(frozen=True, slots=True)
class ViewerMessage:
    """A message of a topic."""

    log_ns: int
    """When its content is known: receipt or tick."""
    stamp_ns: int
    """When its content was measured, or is valid."""
    topic: str
    content: (
        Scene
        | tuple[Detection, ...]
        | EgoState
        | Mapping[str, float | int | str | None]
    )
    """Shapes, objects in the map, the ego, or the outcome of a detection."""
