"""Conversion of a recording's topics to fgtrack's messages, as configured."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.time import nanoseconds
from fgtrack.core.types import (
    DESCRIBING,
    MEASURABLE,
    Detection,
    DetectionList,
    Message,
    TruthState,
)
from fgtrack.inputs.errors import TruncatedInput
from fgtrack.inputs.formats import ADAPTERS
from fgtrack.inputs.formats.common import ObjectList, RosMessage, object_id, split
from fgtrack.inputs.formats.ego_motion import with_motion
from fgtrack.inputs.formats.fields import (
    EGO_FIELDS,
    OBJECT_FIELDS,
    RELATIVE_IN_MAP,
    FieldError,
    is_relative_velocity,
    items_by_fields,
    objects_by_fields,
    value_at,
)
from fgtrack.inputs.formats.native import (
    DETECTIONS,
    NATIVE_ADAPTERS,
    TRUTH,
    detections,
)
from fgtrack.inputs.formats.scans import grouped
from fgtrack.inputs.geodetic import GEODETIC, LocalPlane
from fgtrack.inputs.ros.bag import Bag, BagTopic, is_bag
from fgtrack.inputs.ros.bag_files import settings_of
from fgtrack.inputs.ros.ego import computed_motion, ego_states
from fgtrack.inputs.ros.frames import OPTICAL, BagFrames, Pose, moved_detection
from fgtrack.inputs.settings import FieldPath, InputConfig, TopicInput
from fgtrack.inputs.source import FileFormat

DETECTION_FIELDS = frozenset({*MEASURABLE, *DESCRIBING, "object_id"})
"""Fields by which a filter may select, for every message type."""

#: Roles by key, for keys of a topic that apply to some roles only.
_KEYS = {
    "frame": ("detections",),
    "filters": ("detections", "truth"),
    "scan_s": ("detections",),
    "object_id": ("truth",),
}
_POSITION = {
    "latitude_deg": "latitude",
    "longitude_deg": "longitude",
    "z_m": "altitude",
}
FIX_FIELDS: Mapping[str, Mapping[str, FieldPath]] = {
    "sensor_msgs/msg/NavSatFix": _POSITION,
    "geographic_msgs/msg/GeoPointStamped": {
        name: f"position.{path}" for name, path in _POSITION.items()
    },
    "geographic_msgs/msg/GeoPoseStamped": {
        name: f"pose.position.{path}" for name, path in _POSITION.items()
    },
}
"""Fields of one object with latitude and longitude, by message type; the altitude is kept as z_m."""
_FORWARD = Pose(OPTICAL, np.zeros(3))
Convert = Callable[[RosMessage, int], Iterable[Message]]
"""Converts a ROS message and its receipt to messages."""
TopicUse = tuple[BagTopic, str, Convert]
"""A topic, its role in a replay, and its conversion.

Roles are `ego`, `detections SENSOR`, `truth`, and `messages` for fgtrack's own types.
"""


def topic_uses(bag: Bag, config: InputConfig) -> list[TopicUse]:
    """Return the uses of the topics of `bag`, as configured; without configured topics, fgtrack's own types are used.

    Raises `DataError` for a topic that is missing or not configured, and `CallError` if
    `config` does not fit the type of a topic.
    """
    names = {topic.name for topic in bag.topics}
    plane = LocalPlane(config.origin)
    frames = BagFrames(bag, config.ego.topic if config.ego else None)
    truth = config.truth or ()
    if not isinstance(truth, tuple):
        truth = (truth,)
    roles: list[tuple[str, TopicInput, Callable[[BagTopic, TopicInput], Convert]]] = [
        *(
            [("ego", config.ego, partial(_ego, plane=plane, frames=frames))]
            if config.ego
            else []
        ),
        *(
            (
                f"detections {name}",
                item,
                partial(_detections, sensor=name, plane=plane, frames=frames),
            )
            for name, item in config.detections.items()
        ),
        *(
            (
                "truth",
                item,
                partial(_truths, number=number, topics=len(truth), plane=plane),
            )
            for number, item in enumerate(truth)
        ),
    ]
    native = [
        (topic, "messages", _native(topic))
        for topic in bag.topics
        if topic.type in NATIVE_ADAPTERS
    ]
    if native and names.isdisjoint(item.topic for _, item, _ in roles):
        return native
    if not roles:
        if bag.break_off:
            raise TruncatedInput(
                f"{bag.break_off}, and contains no topic of fgtrack: name its topics in the configuration "
                "(input.ego, input.detections)"
            )
        raise DataError(
            f"{bag.path}: is no recording of fgtrack: name its topics in the configuration "
            f"(input.ego, input.detections); it has {_listed(bag)}"
        )
    uses = []
    for role, item, converter in roles:
        for key, roles_with_key in _KEYS.items():
            if role.split()[0] not in roles_with_key and getattr(item, key) not in (
                None,
                {},
                "map",
            ):
                raise CallError(
                    f"topic {item.topic}: {key} applies to {' and '.join(roles_with_key)} only, remove it"
                )
        topic = _find(bag, item)
        convert = converter(topic, item)
        if item.stamp_from == "receipt":
            convert = _at_receipt(convert)
        uses.append((topic, role, convert))
    return uses


def _open(path: Path, config: InputConfig) -> Callable[[], Iterator[Message]]:
    bag = Bag(path, config.message_definitions)
    uses = topic_uses(bag, config)
    windows_ns = {
        name: nanoseconds(each.scan_s)
        for name, each in config.detections.items()
        if each.scan_s is not None
    }
    missing: tuple[str, ...] = ()
    for topic, role, _ in uses:
        if role == "ego" and config.ego is not None:
            missing = computed_motion(topic, config.ego)

    def messages() -> Iterator[Message]:
        read = with_motion(bag_messages(bag, uses), missing)
        return grouped(read, windows_ns) if windows_ns else read

    return messages


FORMAT = FileFormat(
    "a rosbag2 folder, an .mcap, .db3 or ROS 1 .bag file", is_bag, _open, settings_of
)


def bag_messages(bag: Bag, uses: list[TopicUse]) -> Iterator[Message]:
    """Yield the messages of `bag` in receipt order, which is the order of log time.

    Raises `DataError` for a message that does not fit its use.
    """
    own = all(role == "messages" for _, role, _ in uses)
    for topic, log_ns, data in bag.messages({used.name for used, _, _ in uses}, own):
        for convert in [convert for used, _, convert in uses if used is topic]:
            try:
                yield from convert(data, log_ns)
            except (
                FieldError,
                AttributeError,
                TypeError,
                ValueError,
                OverflowError,
            ) as error:
                raise DataError(
                    f"{bag.path}: topic {topic.name} ({topic.type}) at {log_ns} ns: {error}"
                ) from error


def _find(bag: Bag, item: TopicInput) -> BagTopic:
    if not item.topic:
        raise CallError(f"{bag.path}: a topic in `input` has no name: set its `topic`")
    topics = [topic for topic in bag.topics if topic.name == item.topic]
    if len(topics) == 1:
        return topics[0]
    if not topics and bag.break_off:
        raise TruncatedInput(f"{bag.break_off}, before topic {item.topic}")
    problem = "several types of" if topics else "no"
    raise DataError(
        f"{bag.path}: has {problem} topic {item.topic}; it has {_listed(bag)}"
    )


def _listed(bag: Bag) -> str:
    return (
        ", ".join(f"{topic.name} ({topic.type})" for topic in bag.topics) or "no topic"
    )


def _check_fields(
    item: TopicInput, names: frozenset[str], needed: tuple[str, ...] = ()
) -> None:
    fields = item.fields or {}
    given = {*fields, "x_m", "y_m"} if fields.keys() >= set(GEODETIC) else fields
    for name in sorted(set(fields) - names):
        raise CallError(
            f"topic {item.topic}: unknown field {name!r}: there are {', '.join(sorted(names))}"
        )
    for name in needed:
        if name not in given:
            raise CallError(f"topic {item.topic}: fields must contain {name}")


def _native(topic: BagTopic) -> Convert:
    adapter = NATIVE_ADAPTERS[topic.type]
    return lambda message, receipt_ns: (
        message if isinstance(message, Message) else adapter(message, receipt_ns),
    )


def _ego(
    topic: BagTopic, item: TopicInput, plane: LocalPlane, frames: BagFrames
) -> Convert:
    if item.fields is not None:
        _check_fields(item, EGO_FIELDS, ("x_m", "y_m"))
    return ego_states(topic, item, plane, frames)


def _detections(
    topic: BagTopic,
    item: TopicInput,
    sensor: str,
    plane: LocalPlane,
    frames: BagFrames | None = None,
) -> Convert:
    """Return the conversion of a topic of detections; without `frames`, positions stay as in the message."""
    if item.fields is None and topic.type in FIX_FIELDS:
        item = replace(item, fields=FIX_FIELDS[topic.type])
    read = _object_list(topic, item, plane)
    is_geodetic = item.fields is not None and GEODETIC[0] in item.fields

    def convert(message: RosMessage, receipt_ns: int) -> Iterable[Message]:
        listed = read(message)
        is_framed = not is_geodetic and hasattr(message, "header")
        stamp_ns = receipt_ns if listed.stamp_ns is None else listed.stamp_ns
        in_map = is_geodetic or (item.frame or listed.frame) == "map"
        if in_map and is_relative_velocity(item.fields or {}):
            raise FieldError(RELATIVE_IN_MAP)
        objects, left_out = split(listed.objects)
        if item.filters:
            sources = (
                objects
                if item.fields is None
                else items_by_fields(message, item.fields)
            )
            objects, left_out = split(
                _filtered(item, *pair) for pair in zip(objects, sources, strict=True)
            )
        frame = listed.frame or "ego"
        if item.frame == "optical":
            frame = "sensor"
            objects = tuple(moved_detection(each, _FORWARD) for each in objects)
        elif item.frame is not None:
            frame = item.frame
        elif frames is not None and is_framed and listed.frame != "sensor":
            frame, objects = frames.placed(objects, message.header.frame_id, stamp_ns)
        return (
            DetectionList(
                sensor, stamp_ns, receipt_ns, objects, frame, left_out, plane.origin_deg
            ),
        )

    return convert


def _object_list(
    topic: BagTopic, item: TopicInput, plane: LocalPlane
) -> Callable[[RosMessage], ObjectList | DetectionList]:
    if item.fields is not None:
        _check_fields(item, OBJECT_FIELDS)
        return partial(objects_by_fields, fields=item.fields, plane=plane)
    if unknown := item.filters.keys() - DETECTION_FIELDS:
        names = ", ".join(sorted(DETECTION_FIELDS))
        raise CallError(
            f"topic {item.topic}: without `fields`, a filter may use {names}, not {min(unknown)!r}"
        )
    if topic.type == DETECTIONS:
        # A `DetectionList` has all attributes of an `ObjectList`.
        return partial(detections, receipt_ns=0)
    if topic.type not in ADAPTERS:
        known = ", ".join(sorted(name for name in ADAPTERS if "/" in name))
        raise CallError(
            f"topic {topic.name}: objects of type {topic.type} need `fields`; read without are {known}"
        )
    read: Callable[[RosMessage], ObjectList] = ADAPTERS.load(topic.type)
    return read


def _filtered(
    item: TopicInput, detection: Detection, source: RosMessage
) -> Detection | str:
    """Return `detection`, or the first filter that excludes it.

    A filter compares a value of the detection, or a field of `source`, the recorded
    object.
    """
    for name, each in item.filters.items():
        if not each.passes(
            getattr(detection, name)
            if name in DETECTION_FIELDS
            else value_at(source, name)
        ):
            return f"filters.{name}"
    return detection


def _truths(
    topic: BagTopic, item: TopicInput, number: int, topics: int, plane: LocalPlane
) -> Convert:
    """Return the conversion of a topic of truth.

    Each of several topics contains one object, whose id is `object_id`, by default the
    index `number` of the topic.
    """
    if (
        topic.type == TRUTH
        and item.fields is None
        and item.object_id is None
        and not item.filters
    ):
        return _native(topic)
    read = _detections(topic, item, "truth", plane)
    topic_id = None
    if topics > 1 or item.object_id is not None:
        topic_id = object_id(number if item.object_id is None else item.object_id)

    def convert(message: RosMessage, receipt_ns: int) -> Iterable[Message]:
        for each in read(message, receipt_ns):
            states = each.objects if isinstance(each, DetectionList) else ()
            if topic_id is not None and len(states) > 1:
                raise FieldError(
                    "a message with one true object expected: remove object_id and configure a single topic of truth"
                )
            for index, state in enumerate(states):
                if state.x_m is None or state.y_m is None:
                    raise FieldError("truth needs x_m and y_m")
                yield TruthState(
                    each.stamp_ns if state.stamp_ns is None else state.stamp_ns,
                    receipt_ns,
                    next(
                        number
                        for number in (topic_id, state.object_id, index)
                        if number is not None
                    ),
                    *(state.x_m, state.y_m, state.yaw_rad, state.speed_mps),
                )

    return convert


def _at_receipt(convert: Convert) -> Convert:
    def stamped(message: RosMessage, receipt_ns: int) -> Iterable[Message]:
        for each in convert(message, receipt_ns):
            if isinstance(each, DetectionList):
                each = replace(
                    each,
                    objects=[replace(item, stamp_ns=None) for item in each.objects],
                )
            yield replace(each, stamp_ns=receipt_ns)

    return stamped
