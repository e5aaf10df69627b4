"""An interrupt before any line of a tick loses no detection, and counts none twice."""

import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from types import FrameType
from typing import Any

import pytest

from fgtrack.config.settings import Config
from fgtrack.core.types import Detection, DetectionList, EgoState
from fgtrack.models.sensors import SensorModel
from fgtrack.pipeline.live import Tracker

MS = 1_000_000
START_NS = 1_600_000_000_000_000_000
#: Modules that hand detections on. All others are called by them, and hold none.
HOLDERS = (
    "pipeline/live.py",
    "pipeline/message_checks.py",
    "tracking/inbox.py",
    "tracking/list_update.py",
    "tracking/publication.py",
    "tracking/track_starts.py",
    "tracking/tracker.py",
    "tracking/tracks.py",
)
PUBLISHED_HOLDER = ("karle2023/tracker_parts.py",)


Line = tuple[str, int]


class Interrupt:
    """Raises `KeyboardInterrupt` before line number `at` that runs in `files`; -1 for never."""

    def __init__(self, files: tuple[str, ...], at: int = -1) -> None:
        self.at, self.files = at, files
        self.lines = list[Line]()
        """Lines so far, in order."""

    @contextmanager
    def watching(self) -> Iterator[None]:
        sys.settrace(self._called)
        try:
            yield
        finally:
            sys.settrace(None)

    def _called(self, frame: FrameType, event: str, _: Any) -> Any:
        return self._line if frame.f_code.co_filename.endswith(self.files) else None

    def _line(self, frame: FrameType, event: str, _: Any) -> Any:
        if event == "line":
            self.lines.append((frame.f_code.co_filename, frame.f_lineno))
            if len(self.lines) - 1 == self.at:
                raise KeyboardInterrupt
        return self._line


def first_and_last(lines: list[Line]) -> list[int]:
    """Numbers of the lines that run for the first or the last time."""
    first = {line: k for k, line in reversed([*enumerate(lines)])}
    last = {line: k for k, line in enumerate(lines)}
    return sorted({*first.values(), *last.values()})


def tracker(**settings: object) -> Tracker:
    """A tracker of a sensor that sees in the map, and of one that waits for the ego; `one_slot` as published."""
    sensors = {
        "lidar": SensorModel(std={"x_m": 0.3, "y_m": 0.3}, copies_s=1.0),
        "radar": SensorModel(std={"x_m": 0.3, "y_m": 0.3}, stamp_from="object"),
    }
    config = Config().replace({"estimator": "ekf-replay", **settings})
    return Tracker(config.__class__(**{**vars(config), "sensors": sensors}))


def messages(k: int) -> list[DetectionList | EgoState]:
    """Messages of tick `k`: births, repeated and heard ones, wrong values, unknown sensors, lists that wait."""
    now_ns = START_NS + 100 * MS * k
    cars = tuple(
        Detection(20.0 + k, 30.0 * row, id=f"car {row}", stamp_ns=now_ns - row * MS)
        for row in range(2)
    )
    own = DetectionList("lidar", now_ns - 50 * MS, now_ns, cars, "map")
    heard = replace(own, stamp_ns=now_ns - 60 * MS, objects=cars[:1])
    wrong = (Detection(x_m=float("nan"), y_m=1.0), Detection(x_m="one", y_m=2.0))  # type: ignore[arg-type]
    return [
        EgoState(now_ns - 20 * MS, now_ns, 0.0, 0.0, 0.0, 0.0),
        own,
        own,
        heard,
        DetectionList("radar", now_ns, now_ns, cars, "ego"),
        DetectionList("radar", now_ns - 10 * MS, now_ns, (*wrong, cars[0]), "ego"),
        DetectionList("sonar", now_ns, now_ns, cars, "map"),
        replace(own, stamp_ns=-1),
    ]


def lengths(sent: list[DetectionList | EgoState]) -> Counter[str]:
    """Numbers of detections by sensor."""
    result = Counter[str]()
    for message in sent:
        if isinstance(message, DetectionList):
            result[message.sensor] += len(message.objects)
    return result


def counted(one: Tracker) -> dict[str, int]:
    return {sensor: sum(counts.values()) for sensor, counts in one.counts.items()}


def end(one: Tracker) -> None:
    one.tick(START_NS + 300 * MS)
    one.finish()


@pytest.mark.long
@pytest.mark.parametrize(
    ("is_published", "stride"),
    [
        pytest.param(False, 1, id="clean", marks=pytest.mark.slow),
        pytest.param(False, 5, id="clean, every fifth line"),
        pytest.param(True, 1, id="one_slot"),
    ],
)
def test_an_interrupt_before_any_line_loses_no_detection(
    is_published: bool, stride: int
) -> None:
    one = tracker(**({"defects": ["one_slot"]} if is_published else {}))
    sent = [message for k in range(4) for message in messages(k)]
    for k in range(3):
        for message in messages(k):
            one.receive(message)
        one.tick(START_NS + 100 * MS * k)
    begun, files = one.checkpoint(), PUBLISHED_HOLDER if is_published else HOLDERS

    def interrupted(at: int) -> Interrupt:
        one.restore(begun)
        for message in messages(3):
            one.receive(message)
        interrupt = Interrupt(files, at)
        with suppress(KeyboardInterrupt), interrupt.watching():
            end(one)
        return interrupt

    lines = interrupted(-1).lines
    chosen = first_and_last(lines)
    assert len(chosen) > (20 if is_published else 300)
    assert counted(one) == lengths(sent)
    for at in chosen[::stride]:
        interrupted(at)
        one.tick(START_NS + 400 * MS)
        one.finish()
        assert counted(one) == lengths(sent), lines[at]
