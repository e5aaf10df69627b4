"""fgtrack's own messages in a recording: every field of the core types, to the bit."""

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
#: Fields that hold numbers in a list, and those that hold a text.
LISTS, TEXTS = frozenset({"covariance", "outline_m"}), frozenset({"class_name", "id"})


def _given(message: RosMessage) -> dict[str, RosMessage]:
    """Fields behind `present` that were given."""
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
    """Names behind `present`; their order is that of the recording, whatever wrote it."""
    names = [field.name for field in fields(kind)]
    return tuple(names[names.index("present") + 1 :])


def ego(message: RosMessage, receipt_ns: int) -> EgoState:
    """The ego's state of a `fgtrack_msgs/Ego`."""
    covariance: RosMessage = getattr(
        message, "covariance", ()
    )  # recordings of 0.1.0 have none
    return EgoState(
        stamp_ns(message.header.stamp),
        receipt_ns,
        **{name: getattr(message, name) for name in STATE_NAMES},
        in_pit=message.in_pit if message.has_in_pit else None,
        covariance=tuple(covariance.tolist()) if len(covariance) else None,
    )


def detections(message: RosMessage, receipt_ns: int) -> DetectionList:
    """The object list of a `fgtrack_msgs/DetectionList`."""
    objects = tuple(Detection(**_given(item)) for item in message.objects)
    stamp = stamp_ns(message.header.stamp)
    origin_deg: RosMessage = getattr(
        message, "origin_deg", ()
    )  # recordings of 0.3.0 have none
    own = tuple(origin_deg.tolist()) if len(origin_deg) else None
    return DetectionList(
        message.sensor,
        stamp,
        receipt_ns,
        objects,
        message.header.frame_id,
        origin_deg=own,
    )


def truth(message: RosMessage, receipt_ns: int) -> TruthState:
    """The true state of a `fgtrack_msgs/Truth`."""
    return TruthState(
        stamp_ns(message.header.stamp),
        receipt_ns,
        message.object_id,
        message.x_m,
        message.y_m,
        ignored=getattr(message, "ignored", False),  # recordings of 0.1.0 have none
        **_given(message),
    )


#: What reads fgtrack's own message types, by type name.
NATIVE_ADAPTERS: dict[str, Callable[[RosMessage, int], Message]] = {
    EGO: ego,
    DETECTIONS: detections,
    TRUTH: truth,
}
