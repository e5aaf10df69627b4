"""Decisions on frames and mounts: from header frames and tf, from the motion of objects, from other sensors."""

from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import replace
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np

from fgtrack.config.settings import Config
from fgtrack.core.types import DetectionList, FloatArray, Message
from fgtrack.inputs.geodetic import GEODETIC
from fgtrack.inputs.settings import CsvTable, InputConfig, TopicInput
from fgtrack.meaning.decision import Decision
from fgtrack.meaning.frames import FrameTest, frame_of, is_optical
from fgtrack.meaning.mounts import MountEstimate, Mounts, Pose2, estimated_mounts
from fgtrack.meaning.sample import Sample
from fgtrack.meaning.tracklets import Points, points_of

if TYPE_CHECKING:
    from fgtrack.inputs.ros.bag import Bag
    from fgtrack.inputs.ros.frames import BagFrames, FrameUse

__all__ = ["frame_decisions", "mount_decisions", "mounts_of", "plain_mount"]

#: Messages of a topic whose header frames and heights are read.
_MESSAGES = 50
_WORDS = {"map": "the map", "ego": "the ego's frame", "sensor": "the sensor's frame"}


def frame_decisions(sample: Sample) -> Iterator[Decision]:
    """Yield a decision on the frame of each sensor whose frame the user has not given."""
    points, motion = points_of(sample.messages, sample.config.ego.detection_origin_m)
    headers = _HeaderFrames(sample)
    for name in _sensors(sample):
        path = sample.input_path(name)
        if path is None or not sample.is_open((*path, "frame")):
            continue
        item = _mapping(sample, name)
        if item is None or _is_geodetic(item):
            continue
        test = None
        is_polar = name in points and points[name].is_polar
        # Ranges and bearings in a table are measured from the sensor, whatever the motion.
        if name in points and not (isinstance(item, CsvTable) and is_polar):
            test = frame_of(points[name], motion)
        if isinstance(item, TopicInput):
            yield from _topic_frame(name, path, headers, points.get(name), test)
        elif item.frame is None:
            yield from _table_frame(name, path, points.get(name), test)


def _sensors(sample: Sample) -> list[str]:
    """Return the names of the sensors with lists, in their order."""
    names = {item.sensor for item in sample.messages if isinstance(item, DetectionList)}
    return sorted(names)


def _mapping(sample: Sample, name: str) -> TopicInput | CsvTable | None:
    inputs = sample.config.input
    return inputs.detections.get(name) or inputs.csv.detections.get(name)


def _is_geodetic(item: TopicInput | CsvTable) -> bool:
    fields = item.fields if isinstance(item, TopicInput) else item.columns
    return fields is not None and GEODETIC[0] in fields


class _HeaderFrames:
    """Header frames of the topics of a bag; they are read when they are needed."""

    def __init__(self, sample: Sample) -> None:
        self._sample = sample
        self._bag: Bag | None = None
        self._frames: BagFrames | None = None

    def of(
        self, name: str
    ) -> "tuple[str, FrameUse, tuple[float, float, float] | None] | None":
        """Return the header frame of a sensor, its use, and its mount by tf; None without a header."""
        # Readers of bags are imported for bags alone.
        from fgtrack.inputs.ros.bag import Bag
        from fgtrack.inputs.ros.frames import BagFrames

        inputs = self._sample.config.input
        if self._bag is None:
            self._bag = Bag(self._sample.path, inputs.message_definitions)
            self._frames = BagFrames(
                self._bag, inputs.ego.topic if inputs.ego else None
            )
        assert self._frames is not None
        topic = inputs.detections[name].topic
        for _, _, message in self._bag.messages({topic}):
            if not hasattr(message, "header"):
                return None
            frame = str(message.header.frame_id)
            return frame, self._frames.use(frame), self._frames.mount(frame)
        return None

    def heights(self, name: str) -> FloatArray:
        """Return positions x, y, z of the first messages of a sensor in their own frame, shape (n, 3)."""
        rows = []
        config = self._sample.config
        path = self._sample.input_path(name)
        if path is not None:
            item = replace(config.input.detections[name], frame="sensor")
            config = replace(
                config,
                input=InputConfig(
                    detections={name: item},
                    message_definitions=config.input.message_definitions,
                ),
            )
            for message in islice(self._sample.read(config), _MESSAGES):
                if isinstance(message, DetectionList):
                    rows += [
                        (each.x_m, each.y_m, each.z_m)
                        for each in message.objects
                        if None not in (each.x_m, each.y_m, each.z_m)
                    ]
        return np.array(rows, dtype=float).reshape(-1, 3)


def _topic_frame(
    name: str,
    path: tuple[str, ...],
    headers: _HeaderFrames,
    points: Points | None,
    test: FrameTest | None,
) -> Iterator[Decision]:
    """Yield the decision on the frame of a topic: from the odometry or tf, else from a test.

    The name of the header frame is the first guess of a test.
    """
    header = headers.of(name)
    if header is None:
        if points is not None and test is not None:
            yield from _table_frame(name, path, points, test)
        return
    frame_id, use, mount = header
    key = (*path, "frame")
    if use.evidence == "odometry":
        reason = f"its frame {frame_id} is {_WORDS[use.frame]} in the ego's odometry"
        yield Decision(name, "frame", {key: use.frame}, "tested", reason)
    elif (
        use.evidence == "tf"
        and points is not None
        and points.is_polar
        and mount is not None
    ):
        x_m, y_m, yaw_rad = mount
        settings = {
            key: "sensor",
            ("sensors", name, "mount"): plain_mount(Pose2(yaw_rad, x_m, y_m)),
        }
        yield Decision(
            name, "mount", settings, "tested", f"tf gives the mount of {frame_id}"
        )
    elif use.evidence == "tf":
        yield Decision(
            name,
            "frame",
            {},
            "tested",
            f"tf transforms {frame_id} into {_WORDS[use.frame]}",
        )
    elif use.evidence == "name" and (
        test is None or test.in_map in (None, use.frame == "map")
    ):
        reason = f"by the name {frame_id}"
        sure = test is not None and test.in_map is not None
        if sure and test is not None:
            reason = f"{reason}; {test.reason}"
        yield Decision(
            name, "frame", {key: use.frame}, "tested" if sure else "assumed", reason
        )
    else:
        yield from _unknown_frame(name, path, frame_id, headers, test)


def _unknown_frame(
    name: str,
    path: tuple[str, ...],
    frame_id: str,
    headers: _HeaderFrames,
    test: FrameTest | None,
) -> Iterator[Decision]:
    """Yield the decision on the frame of a topic whose header frame is connected to neither the ego nor the map."""
    key = (*path, "frame")
    question = f"in which frame is {frame_id}? Set {'.'.join(key)} (map, ego, sensor or optical)"
    if test is not None and test.is_contradictory:
        yield Decision(name, "frame", {}, "open", test.reason, question)
        return
    if test is not None and test.in_map:
        yield Decision(name, "frame", {key: "map"}, "tested", test.reason)
        return
    optical = is_optical(headers.heights(name))
    if optical or (optical is None and "optical" in frame_id.lower()):
        reason = f"{frame_id} is an optical frame: " + (
            "y is the axis along which objects hardly move"
            if optical
            else "by its name"
        )
        yield Decision(
            name, "frame", {key: "optical"}, "tested" if optical else "assumed", reason
        )
        return
    reason = f"nothing connects {frame_id} to the ego or the map"
    yield Decision(name, "frame", {key: "sensor"}, "assumed", reason)


def _table_frame(
    name: str, path: tuple[str, ...], points: Points | None, test: FrameTest | None
) -> Iterator[Decision]:
    """Yield the decision on the frame of a table without frames."""
    key = (*path, "frame")
    question = (
        f"in which frame are its positions? Set {'.'.join(key)} (map, ego or sensor)"
    )
    if points is None:
        return
    if points.is_polar:
        reason = "ranges and bearings are measured from the sensor"
        yield Decision(name, "frame", {key: "sensor"}, "assumed", reason)
    elif test is None:
        return
    elif test.is_contradictory:
        yield Decision(name, "frame", {}, "open", test.reason, question)
    elif test.in_map is not None:
        yield Decision(
            name, "frame", {key: "map" if test.in_map else "ego"}, "tested", test.reason
        )
    else:
        reason = f"positions without a frame; {test.reason}"
        yield Decision(name, "frame", {key: "ego"}, "assumed", reason)


def mount_decisions(sample: Sample) -> Iterator[Decision]:
    """Yield a decision on the mount of each sensor on the ego.

    The mount is estimated, or assumed if it is not observable. The decision stays open in
    four cases:

    - the header frame is unknown, and no test shows the yaw of the sensor;
    - the sensor measures ranges and bearings beside other sensors, and nothing shows its mount;
    - positions of sensors are in different frames, and nothing shows which frame is the ego's;
    - the traffic past the ego is more probable for another yaw than the assumed one.

    A lever arm that nothing shows is an open question, too. If all sensors share it, they
    are used as if it were 0, unless the yaw is unknown as well. Beside sensors with
    another reference they are left out: their objects are displaced.

    Positions of a single sensor, or of sensors that agree, may be assumed in the ego's
    frame. A sensor that measures ranges and bearings may be assumed ahead if the ego
    does not move past objects.
    """
    paths = {
        name: path
        for name in _sensors(sample)
        if (path := sample.input_path(name)) is not None
        and sample.is_open(("sensors", name, "mount"))
    }
    if not paths:
        return
    headers = _HeaderFrames(sample)
    shown = {name for name in _sensors(sample) if _shows_ego(sample, name, headers)}
    mounts = mounts_of(sample.messages, sample.config, shown)
    doubts = _doubts(sample, mounts, shown)
    displaced = {
        reference
        for reference in mounts.references.values()
        if reference not in shown
        and reference not in doubts
        and _is_arm_open(sample, mounts, reference)
    }
    used = _used_beside(mounts, displaced, doubts)
    for name, path in paths.items():
        if name in mounts.in_map:
            continue
        reference = mounts.references.get(name, name)
        if name in doubts:
            question = _question(sample, name)
            yield Decision(name, "mount", {}, "open", doubts[name], question)
        elif reference in displaced and reference != used:
            why = f"its lever arm is unknown beside other sensors: {mounts[name].words}"
            yield _unanswered(sample, name, why)
        elif name in mounts:
            is_provisional = reference == used
            yield from _mount_decision(sample, mounts, name, path, is_provisional)
        elif _has_unknown_header(sample, name):
            yield _unanswered(
                sample, name, "it has no positions that the tests can use"
            )


def _shows_ego(sample: Sample, name: str, headers: _HeaderFrames) -> bool:
    """True if a header, or a setting of the user, puts the positions of a sensor into the ego's frame."""
    path = sample.input_path(name)
    item = _mapping(sample, name)
    if path is None or item is None or item.frame not in (None, "ego"):
        return False
    if not sample.is_open((*path, "frame")):
        return True
    return isinstance(item, TopicInput) and headers.of(name) is not None


def _doubts(sample: Sample, mounts: Mounts, shown: Set[str]) -> dict[str, str]:
    """Return the sensors whose mount stays open, each with the reason: nothing shows the mount of their reference."""
    groups: dict[str, list[str]] = {}
    for item in mounts.sensors:
        reference = mounts.references.get(item.sensor, item.sensor)
        groups.setdefault(reference, []).append(item.sensor)
    result: dict[str, str] = {}
    for reference, members in groups.items():
        is_mounted = _is_mounted(sample, reference)
        is_known = is_mounted or reference in mounts.in_map or reference in shown
        if is_known or mounts[reference].is_sure_of_yaw:
            continue
        why = _doubt(sample, mounts, members, shown)
        if why is not None:
            result |= {
                name: why
                for name in members
                if name not in shown and not _is_mounted(sample, name)
            }
    return result


def _doubt(
    sample: Sample, mounts: Mounts, members: Sequence[str], shown: Set[str]
) -> str | None:
    """Return the reason against the assumption that the reference of `members` is in the ego's frame.

    None if no reason is against it.
    """
    reference = mounts.references.get(members[0], members[0])
    root = mounts[reference]
    if root.traffic == "contradicts":
        return f"{reference}: {root.why}"
    if root.is_off:
        return f"the yaw of {reference} is known too roughly: {root.words}"
    others = [name for name in members if name != reference]
    off = [name for name in others if mounts[name].is_off]
    against = "; ".join(f"against {reference}, {mounts[name]}" for name in off)
    if _mapping_frame(sample, reference) == "ego":
        in_ego = [name for name in others if _mapping_frame(sample, name) == "ego"]
        rivals = [name for name in in_ego if name in off]
        agreeing = [
            name for name in in_ego if name not in off and mounts[name].is_sure_of_yaw
        ]
        if len(rivals) > len(agreeing):
            return f"nothing shows which sensor is in the ego's frame: {against}"
    elif off:
        return f"nothing shows the mount of {reference}: {against}"
    elif len(members) < len(mounts.sensors):
        return (
            f"nothing shows it: {root.why}, and too few of its detections "
            "are common with other sensors"
        )
    elif root.traffic == "undecided":
        return f"nothing shows it: {root.why}"
    return None


def _is_mounted(sample: Sample, name: str) -> bool:
    """True if the settings contain the mount of a sensor."""
    sensor = sample.config.sensors.get(name)
    return sensor is not None and sensor.mount is not None


def mounts_of(
    messages: Sequence[Message], config: Config, shown: Set[str] = frozenset()
) -> Mounts:
    """Estimate the mounts of all sensors from the first minutes of `messages`, compared with those in `config`.

    References are sensors in the map, then sensors with a configured mount, then
    sensors with positions in the ego frame, first those that a header or the user
    has put there (`shown`). If the axes of a reference are turned, the next reference is
    a sensor whose axes are not.
    """
    used = [
        item
        for item in messages
        if not isinstance(item, DetectionList)
        or item.sensor not in config.ignore_sensors
    ]
    points, motion = points_of(used, config.ego.detection_origin_m)
    frames = {
        item.sensor: item.frame for item in used if isinstance(item, DetectionList)
    }
    assumed = {}
    for name in points:
        mount = config.sensors[name].mount if name in config.sensors else None
        if mount is not None and frames[name] == "sensor":
            assumed[name] = Pose2(mount.yaw_rad, mount.x_m, mount.y_m)
    size = {name: len(points[name].points_m) for name in points}
    in_ego = [
        name for name in points if frames[name] == "ego" and not points[name].is_polar
    ]
    known = [name for name in points if frames[name] == "map" or name in assumed]
    in_ego.sort(key=lambda name: (name not in shown, -size[name], name))
    found = estimated_mounts(points, motion, assumed, [*known, *in_ego])
    straight = _straight_instead(found, in_ego, shown)
    if not straight:
        return found
    in_ego.sort(key=lambda name: name not in straight)
    return estimated_mounts(points, motion, assumed, [*known, *in_ego])


def _straight_instead(
    found: Mounts, in_ego: Sequence[str], shown: Set[str]
) -> list[str]:
    """Return a sensor for each group whose reference has other axes than the ego.

    The axes of the returned sensor are the axes of the ego.
    """
    result = []
    for reference in in_ego:
        is_reference = found.references.get(reference) == reference
        if reference in shown or not is_reference or found[reference].is_straight:
            continue
        straight = (
            name
            for name in in_ego
            if found.references.get(name) == reference
            and found[name].is_straight
            and found[name].is_sure_of_yaw
        )
        result += list(straight)[:1]
    return result


def _unanswered(sample: Sample, name: str, why: str) -> Decision:
    """Open decision on the mount of a sensor in an unknown frame."""
    return Decision(name, "mount", {}, "open", why, _question(sample, name))


def _question(sample: Sample, name: str) -> str:
    """Return the question for the mount of a sensor, with the keys that answer it."""
    mount = f"sensors.{name}.mount (x_m, y_m, yaw_rad)"
    path = sample.input_path(name)
    if path is None or _mapping_frame(sample, name) != "ego":
        return f"where is it mounted? Set {mount}"
    frame = ".".join((*path, "frame"))
    return f"is it in the ego's frame? Set {frame}: ego, or {frame}: sensor and {mount}"


def _mount_decision(
    sample: Sample,
    mounts: Mounts,
    name: str,
    path: tuple[str, ...],
    is_provisional: bool,
) -> Iterator[Decision]:
    """Yield the decision on the mount of one sensor; `is_provisional` if its reference has an assumed lever arm."""
    item = mounts[name]
    reference = mounts.references.get(name, name)
    is_placed = mounts.is_placed(name)
    against = "" if reference == name else f"against {reference}: "
    if against and is_provisional:
        against = f"against {reference}, whose lever arm is assumed: "
    if _is_read_in_ego(sample, name):
        # The recording itself puts the sensor into the ego, so nothing is changed.
        if item.is_off and is_placed and reference != name:
            reason = (
                f"its header puts it into the ego's frame, but {against}{item.words}"
            )
            yield Decision(
                name, "mount", {}, "assumed", reason, _question(sample, name)
            )
        return
    is_guess = not item.is_sure_of_yaw and _has_unknown_header(sample, name)
    if is_provisional and reference == name and not is_guess:
        yield _assumed_arm(sample, item, path)
    elif item.is_off and is_placed:
        settings = _mounted_settings(sample, item, path)
        question = None
        if not item.is_known:
            question = (
                f"components without an interval are assumed; {_question(sample, name)}"
            )
        elif item.rough_components:
            rough = " and ".join(item.rough_components)
            question = f"{rough} known roughly; {_question(sample, name)}"
        reason = f"{against}{item.words}"
        yield Decision(
            name, "mount", settings, "tested", reason, question, is_provisional
        )
    elif item.is_sure_of_yaw and is_placed:
        reason = f"no mount is significant, {against}{item.words}"
        question = (
            None
            if item.is_known
            else f"its lever arm is assumed to be 0; {_question(sample, name)}"
        )
        yield Decision(name, "mount", {}, "tested", reason, question, is_provisional)
    elif _has_unknown_header(sample, name):
        yield _unanswered(sample, name, f"its frame is unknown: {item.why}")
    else:
        reason = f"at the origin of the ego, its axis ahead: {item.why}"
        yield Decision(name, "mount", {}, "assumed", reason, _question(sample, name))


def _is_arm_open(sample: Sample, mounts: Mounts, reference: str) -> bool:
    """True if the lever arm of a reference, which all its sensors share, is neither given nor estimated exactly.

    Positions x, y count as positions in the ego's frame, unless their axes are turned. A
    sensor on an ego that hardly moves has its own frame.
    """
    if reference in mounts.in_map or _is_mounted(sample, reference):
        return False
    if _is_read_in_ego(sample, reference):
        return False
    item = mounts[reference]
    is_in_ego = _mapping_frame(sample, reference) in (None, "ego")
    if item.traffic == "none" or (is_in_ego and not item.is_off):
        return False
    return not item.has_exact_arm


def _used_beside(
    mounts: Mounts, displaced: Set[str], doubts: Mapping[str, str]
) -> str | None:
    """Return the reference in `displaced` whose sensors are used; None if other sensors are used.

    This is the reference with the most detections.

    None if sensors with a known reference are used.
    """
    placed = set(mounts.references.values()) - displaced - set(doubts)
    if placed or not displaced:
        return None
    followers = list(mounts.references.values())
    return max(
        sorted(displaced),
        key=lambda name: (followers.count(name), mounts[name].num_in_tracklets),
    )


def _assumed_arm(
    sample: Sample, item: MountEstimate, path: tuple[str, ...]
) -> Decision:
    """Return the open decision on the lever arm of a reference, which is used as if the lever arm were assumed."""
    question = (
        "all objects are displaced by the error of its assumed mount; "
        f"{_question(sample, item.sensor)}"
    )
    settings = _mounted_settings(sample, item, path) if item.is_off else {}
    return Decision(item.sensor, "mount", settings, "open", item.words, question, True)


def _mounted_settings(
    sample: Sample, item: MountEstimate, path: tuple[str, ...]
) -> dict[tuple[str, ...], object]:
    """Return the settings with an estimated mount."""
    is_optical = _mapping_frame(sample, item.sensor) == "optical"
    return {
        ("sensors", item.sensor, "mount"): plain_mount(item.pose),
        (*path, "frame"): "optical" if is_optical else "sensor",
    }


def _is_read_in_ego(sample: Sample, name: str) -> bool:
    """True if the header of a topic names the ego, or tf transforms it into the ego."""
    item = _mapping(sample, name)
    return isinstance(item, TopicInput) and item.frame in (None, "ego")


def _mapping_frame(sample: Sample, name: str) -> str | None:
    item = _mapping(sample, name)
    return None if item is None else item.frame


def _has_unknown_header(sample: Sample, name: str) -> bool:
    """True if a topic is read in the frame of a sensor, because its header names an unknown frame."""
    item = _mapping(sample, name)
    path = sample.input_path(name)
    is_open = path is not None and sample.is_open((*path, "frame"))
    return (
        is_open and isinstance(item, TopicInput) and item.frame in ("sensor", "optical")
    )


def plain_mount(pose: Pose2) -> dict[str, float]:
    """Return the rounded values of a mount by name."""
    return {
        "x_m": round(pose.x_m, 2),
        "y_m": round(pose.y_m, 2),
        "yaw_rad": round(pose.yaw_rad, 4),
    }
