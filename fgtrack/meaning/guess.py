"""Guesses which fields of unknown tables and messages contain which components, from names and values."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fgtrack.core.geometry import may_be_radians
from fgtrack.core.time import NS_PER_S, NS_PER_UNIT, epoch_unit
from fgtrack.core.types import FloatArray
from fgtrack.inputs.settings import Field, FieldPath
from fgtrack.models.measurement import ANGULAR

__all__ = [
    "Guess",
    "agreeing_with_motion",
    "guesses",
    "is_time",
    "time_unit",
    "words_of",
]

#: Factor to SI by unit, for the units of lengths and speeds at the end of a name.
_SCALES = {
    "m": {"km": 1e3, "cm": 1e-2, "mm": 1e-3},
    "mps": {
        "kmh": 1.0 / 3.6,
        "kph": 1.0 / 3.6,
        "mph": 0.44704,
        "kn": 0.514444,
        "kts": 0.514444,
        "knots": 0.514444,
    },
}
_DEGREES = ("deg", "degs", "degree", "degrees", "degps", "dps")
_UNITS = {
    "m",
    "s",
    "ms",
    "us",
    "ns",
    "mps",
    "mps2",
    "rad",
    "radps",
    *_DEGREES,
    *_SCALES["m"],
    *_SCALES["mps"],
}
#: Units of several words, as regular expressions.
_UNIT_TEXTS = {
    r"\bkm\s*/\s*h(r|our)?\b": "kmh",
    r"\bmi\s*/\s*h\b": "mph",
    r"\bdeg\s*/\s*s(ec)?\b": "degps",
    r"\brad\s*/\s*s(ec)?\b": "radps",
    r"\bm\s*/\s*s(ec)?\s*(\^?2|²)": "mps2",
    r"\bm\s*/\s*s(ec)?\b": "mps",
}
#: Words that mark the uncertainty of a value; fields with these words are ignored.
_SKIPPED = frozenset(
    (
        "std",
        "sigma",
        "stddev",
        "var",
        "variance",
        "cov",
        "covariance",
        "error",
        "err",
        "rms",
        "uncertainty",
        "accuracy",
    )
)
#: Words of durations, which are no times.
_OF_DURATION = frozenset(("delta", "dt", "elapsed", "duration", "age"))
#: Words that mark a velocity, a position, a size, or a vector that is not read.
_OF_VELOCITY = frozenset(
    ("velocity", "vel", "v", "speed", "twist", "vrel", "vabs", "linear")
)
_OF_POSITION = frozenset(("distance", "dist", "displacement", "offset", "d", "rel"))
_OF_SIZE = frozenset(
    ("size", "dimension", "dimensions", "extent", "extents", "scale", "shape")
)
_OF_OTHER = frozenset(
    (
        "acceleration",
        "accel",
        "acc",
        "a",
        "angular",
        "orientation",
        "quaternion",
        "rotation",
        "q",
    )
)
#: Axes of a vehicle by their names, beside a word of a velocity or of a position.
_VEHICLE_AXES = {
    "long": "x",
    "longitudinal": "x",
    "lat": "y",
    "lateral": "y",
}
#: Words before `id` that identify something else than an object.
_OF_OTHER_IDS = frozenset(
    (
        "frame",
        "class",
        "type",
        "category",
        "label",
        "sensor",
        "camera",
        "radar",
        "lidar",
        "channel",
        "message",
        "msg",
        "scan",
        "list",
        "sequence",
        "source",
    )
)
_AXES = {
    "x": ("x_m", "velocity x", "length_m"),
    "y": ("y_m", "velocity y", "width_m"),
    "z": ("z_m", "", "height_m"),
}
#: Regular expression of the end of a name, by component; the first match counts.
_NAMES = {
    "receipt": "receipt|received|receive|recv|seen|arrival|arrived|rx|"
    "(receipt|received|receive|recv|arrival|rx|log|network|sub)_(time|stamp|timestamp)",
    "stamp": "stamp|timestamp|datetime|time|t|epoch|secs?|seconds|utc|date",
    "yaw_rate_radps": "yaw_?rate|turn_rate|heading_rate|omega|angular_(velocity_)?z|gyro_z",
    "range_rate_mps": "range_?rate|doppler|rdot|vr|vrel|(radial|doppler|closing|relative|rel|approach)_"
    "(velocity|vel|speed)|(velocity|vel|speed|v)_(radial|doppler|relative|rel)",
    "yaw_rad": "yaw|heading|hdg|psi|theta|course|cog|orientation|(yaw|heading)_angle",
    "bearing_rad": "bearing|azimuth|az|angle|phi|(bearing|azimuth)_angle",
    "range_m": "range|distance|dist|rho|r",
    "speed_mps": "speed|velocity|vel|v|sog",
    "velocity x": "(vx|dx_dt|vlong)(_rel|_abs)?",
    "velocity y": "(vy|dy_dt|vlat)(_rel|_abs)?",
    "latitude_deg": "lat|latitude",
    "longitude_deg": "lon|lng|long|longitude",
    "x_m": "px|tx|east|easting|e|dx|longitudinal|utm_x",
    "y_m": "py|ty|north|northing|n|dy|lateral|utm_y",
    "length_m": "length|l",
    "width_m": "width|w",
    "height_m": "height|h",
    "score": "score|confidence|prob|probability",
    "id": "icao|icao24|hex|mmsi|(icao|mode_?s)_?address|station_?id",
    "object_id": "id|uid|uuid|(track|object|obj|target|car|vehicle)_?id|track|object|target",
    "class_name": "class|class_name|label|category|type|kind|classification",
}
#: Range of latitudes around 0 from which they are positions in m.
_LOCAL_DEG = 2.0
#: Names of the components of a quaternion: a common part, an optional word, and the axis.
_QUATERNION = re.compile(
    r"(.*?)(?:q(?:uat(?:ernion)?)?|orientation|rotation|rot)[._ /]?([xyzw])",
    re.IGNORECASE,
)
#: Larger latitudes are integers in 1e-7 degrees, as in messages of vehicles and of autopilots.
_LARGEST_DEG = 90.0
_TINY_DEG = 1e-7
#: Plausible periods of a source.
_PERIOD_S = (5e-4, 20.0)
#: Smallest distance of two positions from which a course is computed.
_MOVED_M = 0.05
#: Fewest steps with a course from which conventions are judged.
_FEWEST_STEPS = 10
#: Smallest mean cosine of course minus heading that confirms a convention.
_AGREEMENT = 0.8
#: Half of the relative difference of mph and knots.
_SPEED_TOLERANCE = 0.07
_SPEED_SCALES = {"mps": 1.0, "kmh": 1.0 / 3.6, "mph": 0.44704, "knots": 0.514444}


@dataclass(frozen=True)
class Guess:
    """Probable field of a component, and the reason for the guess."""

    path: FieldPath
    reason: str


def words_of(name: str) -> list[str]:
    """Return the words in the name of a column or in the path of a field, in lower case; units have one word
    (`km/h`: `kmh`).
    """
    text = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower().replace("°", "deg")
    for pattern, unit in _UNIT_TEXTS.items():
        text = re.sub(pattern, f" {unit} ", text)
    return [word for word in re.split(r"[^a-z0-9]+", text) if word]


def guesses(values: Mapping[str, Sequence[float]]) -> dict[str, Guess]:
    """Guess the field of each component from `values`: samples by field name, empty for a field with text.

    Returns guesses by component, as named in `columns` of a table or in `fields` of a
    topic.
    """
    guessed: dict[str, Guess] = {}
    for name, samples in values.items():
        component, unit = _component(name)
        if component is not None and component not in guessed:
            guessed[component] = _converted(component, unit, name, samples)
    _without_degrees(guessed, values)
    _with_tiny_degrees(guessed, values)
    if (quaternion := _quaternion(values)) is not None and not values.get(
        _name(guessed["yaw_rad"]) if "yaw_rad" in guessed else ""
    ):
        guessed["yaw_rad"] = quaternion
    vx = guessed.pop("velocity x", None)
    vy = guessed.pop("velocity y", None)
    if vx and vy and guessed.keys().isdisjoint(("speed_mps", "range_rate_mps")):
        names = [_name(vx), _name(vy)]
        scale = vx.path.scale if isinstance(vx.path, Field) else 1.0
        guessed["speed_mps"] = Guess(
            names if scale == 1.0 else Field(names, scale), "length of the velocity"
        )
    return guessed


def _without_degrees(
    guessed: dict[str, Guess], values: Mapping[str, Sequence[float]]
) -> None:
    """Turn `lat` and `long` into y and x in the frame of the vehicle if their values are no degrees on Earth."""
    names = [
        _name(guessed[key]) if key in guessed else ""
        for key in ("latitude_deg", "longitude_deg")
    ]
    if "x_m" in guessed or words_of(names[1])[-1:] != ["long"]:
        return
    lat = [one for one in values.get(names[0], ()) if math.isfinite(one)]
    if lat and min(lat) < 0.0 < max(lat) and max(lat) - min(lat) > _LOCAL_DEG:
        reason = "around 0, so it is no position on Earth"
        guessed["y_m"] = Guess(names[0], reason)
        guessed["x_m"] = Guess(names[1], reason)
        del guessed["latitude_deg"], guessed["longitude_deg"]


def _with_tiny_degrees(
    guessed: dict[str, Guess], values: Mapping[str, Sequence[float]]
) -> None:
    """Convert latitude and longitude from 1e-7 degrees if the latitudes do not exist on Earth."""
    if not {"latitude_deg", "longitude_deg"} <= guessed.keys():
        return
    latitudes = values.get(_name(guessed["latitude_deg"]), ())
    largest = max((abs(each) for each in latitudes if math.isfinite(each)), default=0.0)
    if _LARGEST_DEG < largest < _LARGEST_DEG / _TINY_DEG:
        for key in ("latitude_deg", "longitude_deg"):
            name = _name(guessed[key])
            guessed[key] = Guess(Field(name, _TINY_DEG), "integers in 1e-7 degrees")


def _quaternion(values: Mapping[str, Sequence[float]]) -> Guess | None:
    """Return a guess of the heading from four fields of a quaternion; None without such fields."""
    fields: dict[str, dict[str, str]] = {}
    for name in values:
        if match := _QUATERNION.fullmatch(name):
            fields.setdefault(match[1], {})[match[2].lower()] = name
    for found in fields.values():
        if len(found) == 4:
            return Guess([found[axis] for axis in "xyzw"], "yaw of the quaternion")
    return None


def is_time(name: str) -> bool:
    """True if the name of a field is that of a stamp or a receipt."""
    return _component(name)[0] in ("stamp", "receipt")


def time_unit(name: str, samples: Sequence[float]) -> tuple[str, str]:
    """Return the unit of the times `samples`, and the reason: their size, their name, or the period between them."""
    unit = epoch_unit(samples[0]) if len(samples) else None
    if unit is not None:
        return unit, f"{samples[0]:.10g} {unit} since 1970 is a date in this century"
    last = (words_of(name) or [""])[-1]
    if last in NS_PER_UNIT:
        return last, "by its name"
    gaps = np.diff(np.unique(np.asarray(samples, dtype=np.float64)))
    for unit, ns in NS_PER_UNIT.items():
        if (
            len(gaps)
            and _PERIOD_S[0]
            <= (period_s := float(np.median(gaps)) * ns / NS_PER_S)
            <= _PERIOD_S[1]
        ):
            return unit, f"the period is then {period_s:.3g} s"
    return "s", "uncertain: check the unit"


def agreeing_with_motion(
    guessed: Mapping[str, Guess], values: Mapping[str, FloatArray], unit: str
) -> dict[str, Guess]:
    """Return `guessed` with the conventions of heading and speed that the positions confirm.

    `values` contains the samples, shape (rows,), by field name. `unit` is the unit of
    the stamps. Conventions are compared with the course and the distance from position
    to position.
    """
    if not {"stamp", "x_m", "y_m"} <= guessed.keys():
        return dict(guessed)
    t_s, x_m, y_m = (values[_name(guessed[name])] for name in ("stamp", "x_m", "y_m"))
    gap_s = np.diff(t_s) * NS_PER_UNIT[unit] / NS_PER_S
    dx_m = np.diff(x_m)
    dy_m = np.diff(y_m)
    step_m = np.hypot(dx_m, dy_m)
    moved = (step_m > _MOVED_M) & (gap_s > 0.0)
    if moved.sum() < _FEWEST_STEPS:
        return dict(guessed)
    changed = dict(guessed)
    if "yaw_rad" in guessed and not isinstance(guessed["yaw_rad"].path, list):
        raw = values[_name(guessed["yaw_rad"])][:-1][moved]
        changed["yaw_rad"] = _heading(
            guessed["yaw_rad"], raw, np.arctan2(dy_m, dx_m)[moved]
        )
    if "speed_mps" in guessed:
        changed["speed_mps"] = _speed(
            guessed["speed_mps"],
            values[_name(guessed["speed_mps"])][:-1][moved],
            step_m[moved] / gap_s[moved],
        )
    return changed


def _speed(guess: Guess, raw: FloatArray, step_mps: FloatArray) -> Guess:
    """Return the guess of the speed in the unit that agrees with the distance travelled; `guess` if no other unit
    agrees.
    """
    path = guess.path if isinstance(guess.path, Field) else Field(guess.path)
    if not isinstance(path.path, str):
        return guess
    ratio = float(np.median(raw) / np.median(step_mps))
    if abs(ratio * path.scale - 1.0) < _SPEED_TOLERANCE:
        return guess
    for name, scale in _SPEED_SCALES.items():
        if abs(ratio * scale - 1.0) < _SPEED_TOLERANCE:
            reason = f"{ratio:.3g} times the distance travelled per second: {name}"
            return Guess(path.path if scale == 1.0 else Field(path.path, scale), reason)
    return guess


def _heading(guess: Guess, raw: FloatArray, course_rad: FloatArray) -> Guess:
    """Return the guess of the heading with the convention that agrees best with the course; `guess` if none agrees."""
    degrees = isinstance(guess.path, Field) and guess.path.degrees
    quarter = 90.0 if degrees else 0.5 * math.pi
    options = [
        Field(_name(guess), degrees=degrees),
        Field(_name(guess), scale=-1.0, offset=quarter, degrees=degrees),
    ]
    agreement = [
        float(np.mean(np.cos(course_rad - [option.value(each) for each in raw])))
        for option in options
    ]
    best = int(agreement[1] > agreement[0])
    if agreement[best] < _AGREEMENT:
        return Guess(
            guess.path,
            f"{guess.reason}; does not agree with the direction of travel: check it",
        )
    how = "a compass, clockwise from north" if best else "counter-clockwise from east"
    path = guess.path if not best else options[1]
    return Guess(
        path, f"{guess.reason}; {how}, as it agrees with the direction of travel"
    )


def _component(name: str) -> tuple[str | None, str]:
    """Return the component that a field's name stands for (None if it is not read), and the unit in the name."""
    # `pose_with_covariance` is a part of the path to a value, not an uncertainty.
    words = words_of(re.sub("with_?covariance", "", name, flags=re.IGNORECASE))
    if not words or _SKIPPED & set(words):
        return None, ""
    unit = words[-1] if words[-1] in _UNITS else ""
    base = words[: -1 if unit else None]
    if not base:
        if unit in NS_PER_UNIT:
            return "stamp", unit
        return ("speed_mps" if unit in _SCALES["mps"] else None), unit
    axis = None
    others = set(base[:-1])
    if base[-1] in _VEHICLE_AXES and others & (_OF_VELOCITY | _OF_POSITION):
        base = [*base[:-1], _VEHICLE_AXES[base[-1]]]
    if base[-1] in _AXES:
        axis = base[-1]
    elif base[0] in _AXES and base[-1] in _OF_VELOCITY:
        axis = base[0]
    if axis is not None:
        context = set(base) - {axis}
        kind = 1 if context & _OF_VELOCITY else 2 if context & _OF_SIZE else 0
        return (None if context & _OF_OTHER else _AXES[axis][kind] or None), unit
    text = "_".join(base)
    if len(base[-1]) == 1 and len(base) > 1:
        return None, unit
    if base[-1] == "id" and _OF_OTHER_IDS & set(base[-2:-1]):
        return None, unit
    for component, names in _NAMES.items():
        if re.fullmatch(f"(?:.*_)?(?:{names})", text):
            is_duration = component == "stamp" and _OF_DURATION & set(base)
            return None if is_duration else component, unit
    return None, unit


def _converted(component: str, unit: str, name: str, samples: Sequence[float]) -> Guess:
    """Return the guess of a component from the field `name`, with the conversion that its unit and its values
    require.
    """
    finite = [value for value in samples if math.isfinite(value)]
    spread = f"{min(finite):.4g} to {max(finite):.4g}" if finite else "no numbers"
    if component in ("stamp", "receipt", "object_id", "id", "class_name"):
        return Guess(name, "by its name")
    is_rate = component in ("speed_mps", "range_rate_mps", "velocity x", "velocity y")
    scale = _SCALES["mps" if is_rate else "m"].get(unit, 1.0)
    if component in ANGULAR and (
        unit in _DEGREES
        or not may_be_radians(min(finite, default=0.0), max(finite, default=0.0))
    ):
        return Guess(Field(name, degrees=True), f"{spread}: degrees")
    if component == "yaw_rate_radps" and unit in _DEGREES:
        return Guess(Field(name, degrees=True), f"{spread}: degrees by its name")
    if scale != 1.0:
        return Guess(Field(name, scale), f"{spread} {unit}")
    return Guess(name, spread)


def _name(guess: Guess) -> str:
    path = guess.path.path if isinstance(guess.path, Field) else guess.path
    return path if isinstance(path, str) else path[0]
