"""Adapters of fgtrack's own message types: every field of the core types, exact to the bit."""

from collections.abc import Callable
from dataclasses import fields
from functools import cache

from fgtrack.core.types import (
    DESCRIBING,
    MEASURABLE,
    STATE_NAMES,
    Detection,
    DetectionList,
    EgoState,
    Message,
    TruthState,
)
from fgtrack.inputs.formats.common import RosMessage, stamp_ns

EGO, DETECTIONS, TRUTH = (
    f"fgtrack_msgs/msg/{name}" for name in ("Ego", "DetectionList", "Truth")
)
#: Optional fields in the order of the bits of `present`.
DETECTION_OPTIONAL = (*MEASURABLE, "covariance", "stamp_ns", "object_id", *DESCRIBING)
TRUTH_OPTIONAL = (*STATE_NAMES[2:], "outline_m")
#: Fields with a list of numbers.
LISTS = frozenset({"covariance", "outline_m"})
#: Fields with a text.
TEXTS = frozenset({"class_name", "id"})


def _given(message: RosMessage) -> dict[str, RosMessage]:
    """Return the values of the optional fields whose bits are set in `present`."""
    names = _optional(message.__class__)
    given = {
        name: getattr(message, name)
        for bit, name in enumerate(names)
        if message.present >> bit & 1
    }
    return {
        name: tuple(value.tolist()) if name in LISTS else value
        for name, value in given.items()
    }


@cache
def _optional(kind: RosMessage) -> tuple[str, ...]:
    """Return the names of the fields after `present`, in the order of the recording's definition."""
    names = [field.name for field in fields(kind)]
    return tuple(names[names.index("present") + 1 :])


def ego(message: RosMessage, receipt_ns: int) -> EgoState:
    """Return the state of the ego from a `fgtrack_msgs/Ego`."""
    # Recordings of fgtrack 0.1.0 have no covariance.
    covariance: RosMessage = getattr(message, "covariance", ())
    return EgoState(
        stamp_ns(message.header.stamp),
        receipt_ns,
        **{name: getattr(message, name) for name in STATE_NAMES},
        in_pit=message.in_pit if message.has_in_pit else None,
        covariance=tuple(covariance.tolist()) if len(covariance) else None,
    )


def detections(message: RosMessage, receipt_ns: int) -> DetectionList:
    """Return the object list from a `fgtrack_msgs/DetectionList`."""
    objects = tuple(Detection(**_given(item)) for item in message.objects)
    stamp = stamp_ns(message.header.stamp)
    # Recordings of fgtrack 0.3.0 have no origin.
    origin_deg: RosMessage = getattr(message, "origin_deg", ())
    origin = tuple(origin_deg.tolist()) if len(origin_deg) else None
    return DetectionList(
        message.sensor,
        stamp,
        receipt_ns,
        objects,
        message.header.frame_id,
        origin_deg=origin,
    )


def truth(message: RosMessage, receipt_ns: int) -> TruthState:
    """True state from a `fgtrack_msgs/Truth`."""
    return TruthState(
        stamp_ns(message.header.stamp),
        receipt_ns,
        message.object_id,
        message.x_m,
        message.y_m,
        # Recordings of fgtrack 0.1.0 have no `ignored`.
        ignored=getattr(message, "ignored", False),
        **_given(message),
    )


#: Adapters of fgtrack's own message types, by type name.
NATIVE_ADAPTERS: dict[str, Callable[[RosMessage, int], Message]] = {
    EGO: ego,
    DETECTIONS: detections,
    TRUTH: truth,
}
