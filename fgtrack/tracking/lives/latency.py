"""Latency of each source of messages, and the stamps up to which the lists of each sensor have come.

The watermark of a sensor is the stamp up to which its lists have come, or should have come. It is learned from the
stamps and receipts of the messages alone, so that equal messages give equal watermarks. Times of tracks are compared
at watermarks: what a sensor has not reported yet is no evidence that it saw nothing.
"""

from bisect import bisect_left, bisect_right, insort
from collections import deque
from collections.abc import Iterable, Mapping
from typing import ClassVar

import numpy as np

from fgtrack.core.linalg import kernels
from fgtrack.core.state import Snapshot, Stateful
from fgtrack.core.time import NS_PER_S, nanoseconds
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.models.sensors import NUM_LIMITS, SensorModel
from fgtrack.tracking.ego.trajectory import EgoPose

NEWEST = 1000
"""Number of newest delays of which statistics are published."""
NEVER, FOREVER = -(2**62), 2**62
_RECENT = (
    100  # newest delays, and times between two stamps, that decide which are usual
)
_UNUSUAL = 50  # of so many the longest one is unusual
_MAX_FUTURE_NS = NS_PER_S  # see `fgtrack.tracking.inbox`


class Durations(Stateful):
    """The newest durations of one kind. The longest of each fifty durations counts as unusual."""

    STATE: ClassVar[tuple[str, ...]] = (
        "arrived_ns",
        "_ascending_ns",
        "_limit_ns",
        "_usual_ns",
    )

    def __init__(self) -> None:
        self.arrived_ns: deque[int] = deque(maxlen=_RECENT)
        """In order of arrival."""
        self._ascending_ns: list[int] = []
        self._limit_ns: int | None = None  # of `_usual_ns`; None after a new duration
        self._usual_ns: int | None = None

    def add(self, duration_ns: int) -> None:
        """Add the newest duration; the oldest of a hundred is forgotten."""
        ascending_ns = self._ascending_ns
        if len(ascending_ns) == _RECENT:
            del ascending_ns[bisect_left(ascending_ns, self.arrived_ns[0])]
        self.arrived_ns.append(duration_ns)
        insort(ascending_ns, duration_ns)
        self._limit_ns = None

    def usual_ns(self, most_ns: int = FOREVER) -> int | None:
        """Return the longest usual duration among the durations up to `most_ns`; None if all durations are longer."""
        if most_ns != self._limit_ns:
            ascending_ns = self._ascending_ns
            count = bisect_right(ascending_ns, most_ns)
            row = count - 1 - count // _UNUSUAL
            self._usual_ns = ascending_ns[row] if count else None
            self._limit_ns = most_ns
        return self._usual_ns

    @property
    def shortest_ns(self) -> int:
        """The shortest duration."""
        return self._ascending_ns[0]


class Delays(Stateful):
    """Delays of the messages of one source: receipt minus stamp."""

    STATE: ClassVar[tuple[str, ...]] = (
        "messages",
        "newest_ns",
        "newest_receipt_ns",
        "_recent",
        "_gaps",
        "_newest_stamp_ns",
        "_processed_ns",
    )

    def __init__(self) -> None:
        self.messages = 0
        """Number of all messages."""
        self.newest_ns: deque[int] = deque(maxlen=NEWEST)
        """Delays of the newest messages, in order of arrival."""
        self.newest_receipt_ns: int | None = None
        """Newest receipt; None before the first message."""
        self._recent = Durations()  # delays
        self._gaps = Durations()  # times between two stamps
        self._newest_stamp_ns = self._processed_ns = NEVER

    def add(
        self, stamp_ns: int, receipt_ns: int, newest_stamp_ns: int | None = None
    ) -> None:
        """Learn the delay of a message. `stamp_ns` and `newest_stamp_ns` are the oldest and newest stamps of its
        detections.
        """
        self.messages += 1
        stamp_ns, receipt_ns = (
            int(stamp_ns),
            int(receipt_ns),
        )  # a live host may give numbers of another library
        delay_ns = receipt_ns - stamp_ns
        self.newest_ns.append(delay_ns)
        self.newest_receipt_ns = (
            receipt_ns
            if self.newest_receipt_ns is None
            else max(self.newest_receipt_ns, receipt_ns)
        )
        if delay_ns < -_MAX_FUTURE_NS:
            return  # refused: its stamp is wrong
        self._recent.add(delay_ns)
        newest_ns = stamp_ns if newest_stamp_ns is None else int(newest_stamp_ns)
        if newest_ns > self._newest_stamp_ns:
            if self._newest_stamp_ns != NEVER:
                self._gaps.add(newest_ns - self._newest_stamp_ns)
            self._newest_stamp_ns = newest_ns

    def processed(self, stamp_ns: int) -> None:
        """Note that a list with this stamp has been processed."""
        self._processed_ns = max(self._processed_ns, stamp_ns)

    def usual_ns(self, most_ns: int = FOREVER) -> int:
        """Return the longest usual delay among the delays up to `most_ns`; `most_ns` if all delays are longer.

        The delay of the newest message counts as usual, so a changed delay takes effect at once.
        """
        usual_ns = self._recent.usual_ns(most_ns)
        if usual_ns is None:
            return most_ns
        newest_ns = self._recent.arrived_ns[-1]
        return max(
            usual_ns, newest_ns if newest_ns <= most_ns else self._recent.shortest_ns
        )

    def watermark_ns(self, now_ns: int, most_ns: int) -> int:
        """Return the stamp up to which all lists are processed, or should have come, at `now_ns`.

        Lists should come within their usual delay. Lists with delays above `most_ns` are not awaited. While no list is
        overdue, by the usual time between two stamps, the watermark is the newest processed stamp: no list lies between
        this stamp and the next list. Returns `FOREVER` before the first message.
        """
        if not self._recent.arrived_ns:
            return FOREVER
        due_ns, processed_ns = now_ns - self.usual_ns(most_ns), self._processed_ns
        if due_ns <= processed_ns:
            return due_ns
        is_pending = self._newest_stamp_ns > processed_ns
        next_ns = min(due_ns, self._newest_stamp_ns) if is_pending else due_ns
        is_overdue = next_ns > processed_ns + (self._gaps.usual_ns() or 0)
        return due_ns if is_overdue else processed_ns


class Watermarks(Stateful):
    """Delays of all sources, and the watermarks of the sensors."""

    STATE: ClassVar[tuple[str, ...]] = ("delays",)

    def __init__(
        self, sensors: Mapping[str, SensorModel], sources: Iterable[str] = ()
    ) -> None:
        """`sources` are the names of further sources, for example the ego, whose delays are learned too."""
        self.delays = {name: Delays() for name in (*sensors, *sources)}
        """Delays by name of the source."""
        self._of_sensors = [self.delays[name] for name in sensors]
        limits_s = [sensor.max_delay_s for sensor in sensors.values()]
        self._limits_ns = [
            FOREVER if limit_s is None else nanoseconds(limit_s) for limit_s in limits_s
        ]

    def restore(self, snapshot: Snapshot) -> None:
        """See `Stateful.restore`; the delays are shared, so they stay the same objects."""
        for name, delays in self.delays.items():
            delays.restore(snapshot["delays"][name])

    def at(self, now_ns: int, oldest_ns: int) -> IntArray:
        """Return the watermark of each sensor at `now_ns`, shape (sensors,); see `Delays.watermark_ns`.

        No track awaits lists before `oldest_ns`, which are too old for every track, nor lists with a delay above
        `max_delay_s`, which are refused.
        """
        reach_ns = now_ns - oldest_ns
        pairs = zip(self._of_sensors, self._limits_ns, strict=True)
        return np.array(
            [
                one.watermark_ns(now_ns, min(reach_ns, limit_ns))
                for one, limit_ns in pairs
            ],
            dtype=np.int64,
        )


class Views:
    """Test for the sensors that could show an object: they give positions, and the object is in their field of view."""

    def __init__(
        self,
        sensors: Mapping[str, SensorModel],
        detection_origin_m: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """`detection_origin_m`: origin of the ego frame of detections, seen from the ego reference point."""
        self._sensors = list(sensors.values())
        self._placing = np.array(
            [sensor.gives_position for sensor in self._sensors], dtype=bool
        )
        self.scanning = np.array(
            [sensor.gives_position and sensor.scan for sensor in self._sensors],
            dtype=bool,
        )
        """True for each sensor whose lists show which objects are hidden, shape (sensors,)."""
        limited = [
            k
            for k, one in enumerate(self._sensors)
            if one.gives_position and one.has_view_limits
        ]
        self._limited = np.array(limited, dtype=np.int64)
        limits = [self._sensors[k].view_limits(detection_origin_m) for k in limited]
        self._limits = np.array(limits).reshape(-1, NUM_LIMITS)

    def of(self, positions_m: FloatArray, ego: EgoPose | None) -> BoolArray:
        """Return, for objects at `positions_m` (m, 2), True for each sensor that could show the object, shape (m,
        sensors).

        `ego` is the pose of the ego in the map. Without a pose, all objects are in view.
        """
        views = np.empty((len(positions_m), len(self._placing)), dtype=bool)
        views[:] = self._placing
        if ego is not None and len(self._limited):
            pose = np.array([[ego.x_m, ego.y_m, ego.yaw_rad]])
            kernels("fgtrack.models.view_kernels").look(
                positions_m, pose, self._limits, self._limited, views
            )
        return views

    def at_birth(
        self, position_m: FloatArray | None, ego: EgoPose | None, sensor: int
    ) -> BoolArray:
        """Return True for each sensor that could show a new object, shape (sensors,).

        `sensor` is the index of the sensor that has just shown the object; its entry is True. Without a position, the
        object is in view of all sensors that give positions.
        """
        views = (
            self._placing.copy()
            if position_m is None
            else self.of(position_m[None], ego)[0]
        )
        views[sensor] = True
        return views
