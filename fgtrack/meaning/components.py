"""Components of detections that carry no information, by the motion of the objects."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from fgtrack.core.types import Detection, DetectionList, Message
from fgtrack.meaning.motions import Motions, Scans, motions, straight_paths
from fgtrack.meaning.orientations import yaw_meaning
from fgtrack.meaning.scans import scans_of
from fgtrack.meaning.velocities import VelocityKind, meaning_of
from fgtrack.models.sensors import Mount

__all__ = ["uninformative"]

_TESTED = ("yaw_rad", "speed_mps", "range_rate_mps")
#: Kinds of a velocity in the order of a test, by component; the first one is the use.
_KINDS: Mapping[str, Sequence[VelocityKind]] = {
    "speed_mps": ("absolute", "radial", "radial over ground", "relative speed"),
    "range_rate_mps": ("radial", "absolute", "radial over ground", "relative speed"),
}
#: A velocity that differs by more than this share of its own size is not used as its component.
_TOLERANCE = 0.5


def uninformative(
    messages: Sequence[Message], mounts: Mapping[str, Mount] | None = None
) -> dict[str, dict[str, str]]:
    """Return the components that are no measurements by sensor, with the reason.

    These are constant or random orientations, and velocities that contradict the motion
    of the objects. `mounts` contains the known mounts by sensor.
    """
    measured: dict[str, set[str]] = {}
    for message in messages:
        if isinstance(message, DetectionList):
            names = measured.setdefault(message.sensor, set())
            for item in message.objects:
                names.update(item.measured)
    result: dict[str, dict[str, str]] = {}
    for sensor, names in sorted(measured.items()):
        tested = [name for name in _TESTED if name in names]
        if not tested:
            continue
        mount = (mounts or {}).get(sensor)
        scans = scans_of(messages, sensor, _values(tested), mount)
        if scans is not None and (reasons := _reasons(scans, tested)):
            result[sensor] = reasons
    return result


def _values(names: Sequence[str]) -> Callable[[Detection], list[float | None]]:
    """Return a function that reads the components `names`.

    The sign of a speed depends on the heading, so it is dropped.
    """

    def read(item: Detection) -> list[float | None]:
        values = [getattr(item, name) for name in names]
        return [
            abs(value) if name == "speed_mps" and value is not None else value
            for name, value in zip(names, values, strict=True)
        ]

    return read


def _reasons(scans: Scans, names: Sequence[str]) -> dict[str, str]:
    """Return why components, the columns of the values in `scans`, are no measurements, by name."""
    paths = straight_paths(scans)
    reasons: dict[str, str] = {}
    for k, name in enumerate(names):
        only = replace(scans, values=[each[:, k : k + 1] for each in scans.values])
        if name == "yaw_rad":
            yaw = yaw_meaning(only, paths)
            if yaw is not None and not yaw.is_measurement:
                reasons[name] = yaw.reason
        else:
            text = _contradiction(motions(only, paths), name)
            if text is not None:
                reasons[name] = text
    return reasons


def _contradiction(found: Motions, name: str) -> str | None:
    """Return why a velocity is not used; None if it agrees with the motion or is not tested."""
    kinds = _KINDS[name]
    meaning = meaning_of(found, kinds)
    is_usual = (meaning.kind, meaning.scale) == (kinds[0], 1.0)
    if meaning.certainty == "assumed" or is_usual:
        return None
    if meaning.kind is None:
        truth = found.in_map_mps if name == "speed_mps" else found.radial_mps[:, None]
        typical_mps = math.sqrt(float(np.square(truth).sum(axis=1).mean()))
        if meaning.misfit_mps < _TOLERANCE * typical_mps:
            return None  # a noisy velocity is a measurement too
    return meaning.reason
