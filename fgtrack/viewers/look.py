"""How objects, sensors and runs look in a viewer."""

import math
from dataclasses import dataclass

from fgtrack.core.types import Detection
from fgtrack.evaluation.palette import PALETTE, SENSORS
from fgtrack.viewers.shapes import Arrow, Box, Colour, Ellipse, Label, Point, Shape

#: Length, width and height of the box of an object of which no detection tells them: a racing car's.
NOMINAL_SIZE_M = (4.8, 2.0, 1.2)

WHITE: Colour = (1.0, 1.0, 1.0, 1.0)
GREY: Colour = (0.55, 0.55, 0.55, 0.9)

_OPACITY = {"tentative": 0.15, "coasting": 0.3}
_CONFIRMED = 0.5  # so that ellipses and arrows in the box are seen
_SPEED_ARROW_S = 0.25
_LABEL_ABOVE_M = 1.5


@dataclass(frozen=True)
class Look:
    """The topics and the colours of a run."""

    prefix: str = ""
    """Stands before its topics; empty where the run is alone."""
    colour: Colour | None = None
    """Of its tracks; None gives each track one of its own."""

    def of_track(self, track_id: int) -> Colour:
        """Colour of a track."""
        return palette(track_id) if self.colour is None else self.colour

    def of_sensor(self, index: int) -> Colour:
        """Colour of the detections of a sensor."""
        return rgba(SENSORS[index % len(SENSORS)])

    def track(self, track_id: int, state: Detection, speed_mps: float, status: str) -> tuple[Shape, ...]:
        """The box of a track with its number and class, and an arrow to where it is a quarter of a second later."""
        assert state.x_m is not None
        assert state.y_m is not None
        centre_m, yaw_rad = (state.x_m, state.y_m), state.yaw_rad or 0.0
        colour = faded(self.of_track(track_id), _OPACITY.get(status, _CONFIRMED))
        size_m = size(state)
        text = f"{track_id} {state.class_name}" if state.class_name else str(track_id)
        name = Label(centre_m, size_m[2] + _LABEL_ABOVE_M, text, WHITE)
        box = Box(centre_m, yaw_rad, size_m, colour)
        ahead_m = speed_mps * _SPEED_ARROW_S
        if not (math.isfinite(ahead_m) and ahead_m):
            return box, name
        tip_m = centre_m[0] + ahead_m * math.cos(yaw_rad), centre_m[1] + ahead_m * math.sin(yaw_rad)
        return box, name, Arrow(centre_m, tip_m, 0.25, self.of_track(track_id))


def palette(index: int, opacity: float = 1.0) -> Colour:
    """The colour number `index`, from the beginning again after the last one."""
    return rgba(PALETTE[index % len(PALETTE)], opacity)


def rgba(text: str, opacity: float = 1.0) -> Colour:
    """Return the colour `text` (#RRGGBB) as shares of 1."""
    r, g, b = (round(int(text[place : place + 2], 16) / 255.0, 3) for place in (1, 3, 5))
    return r, g, b, opacity


def faded(colour: Colour, opacity: float) -> Colour:
    """`colour` with another opacity."""
    return (*colour[:3], opacity)


def car(centre_m: Point, yaw_rad: float, colour: Colour) -> Box:
    """The box of an object of nominal size."""
    return Box(centre_m, yaw_rad, NOMINAL_SIZE_M, colour)


def size(state: Detection) -> tuple[float, float, float]:
    """Length, width and height of the box of an object; nominal where `state` does not say."""
    told = state.length_m, state.width_m, state.height_m
    length_m, width_m, height_m = (own or nominal for own, nominal in zip(told, NOMINAL_SIZE_M, strict=True))
    return length_m, width_m, height_m


def patch(centre_m: Point, height_m: float, axes: tuple[float, float, float], colour: Colour) -> Ellipse:
    """The ellipse of a covariance, see `ellipses`, just above the box of its track, which is `height_m` high."""
    return Ellipse(centre_m, height_m + 0.05, axes[2], (axes[0], axes[1]), colour)
