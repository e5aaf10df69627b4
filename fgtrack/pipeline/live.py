"""The tracker in a running system: messages in as they arrive, tracks out when they are wanted."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Self

from fgtrack.core.types import (
    DetectionList,
    Disposition,
    EgoState,
    SmoothedReport,
    TickReport,
    TrackReport,
    UpdateRecord,
)
from fgtrack.pipeline.build import build_tracker
from fgtrack.pipeline.config import Config
from fgtrack.pipeline.shipped import read_config, settings_of
from fgtrack.tracking.inbox import records


class Tracker:
    """Tracks objects from object lists that arrive late, in a running system.

    `receive` takes messages in the order of their arrival, `tick` processes what came since the last one. What cannot
    be used never raises: it is counted in `refused`, and every detection ends in exactly one disposition of `counts`.

    Parameters
    ----------
    config
        Settings of the tracker. Raises `CallError` where they cannot be built.
    """

    def __init__(self, config: Config) -> None:
        self.config = config
        self._tracker = build_tracker(config)
        self._refused: Counter[str] = Counter()
        self._records: list[UpdateRecord] = []
        self._counts: dict[str, Counter[Disposition]] = {}
        self._last = TickReport(-1, 0, (), ())

    @classmethod
    def from_config(
        cls,
        config: str | Path | Config | None = None,
        *,
        map: str | Path | None = None,  # noqa: A002 - the name of the option
        pit_map: str | Path | None = None,
        estimator: str | None = None,
        set: Mapping[str, object] | None = None,  # noqa: A002 - the name of the option
    ) -> Self:
        """A tracker with a shipped configuration by name, one from a YAML file, or a `Config`; see `fgtrack.replay`."""
        return cls(read_config(config, settings_of(set), track_map=map, pit_map=pit_map, estimator=estimator))

    @property
    def refused(self) -> Mapping[str, int]:
        """Messages and ticks that were not used, by reason."""
        return self._refused + self._tracker.refused_ego

    @property
    def counts(self) -> Mapping[str, Mapping[str, int]]:
        """Number of detections by sensor and disposition, of all ticks so far."""
        return {
            sensor: {str(disposition): count for disposition, count in counter.items()}
            for sensor, counter in self._counts.items()
        }

    def receive(self, message: EgoState | DetectionList) -> None:
        """Take a message in the order of arrival.

        The detections of a sensor that the configuration does not know are `invalid` at the next tick; one that is
        named in `ignore_sensors` is ignored.
        """
        if isinstance(message, DetectionList) and message.sensor not in self.config.sensors:
            if message.sensor not in self.config.ignore_sensors:
                self._refused[f"sensor {message.sensor!r} has no model"] += 1
                self._records += records(message, Disposition.INVALID)
            return
        self._tracker.receive(message)

    def tick(self, now_ns: int) -> TickReport:
        """Process everything received, and bring all tracks to `now_ns`.

        A tick before the last one is refused: it gives the tracks of the last one, without updates, and what was
        received waits for the next.
        """
        if self._last.tick >= 0 and now_ns < self._last.now_ns:
            self._refused["tick before the last one"] += 1
            return replace(self._last, updates=(), smoothed=())
        report = self._tracker.tick(now_ns)
        if self._records:
            report = replace(report, updates=(*self._records, *report.updates))
            self._records = []
        for update in report.updates:
            self._counts.setdefault(update.sensor, Counter())[update.disposition] += 1
        self._last = report
        return report

    def state_at(self, track_id: int, stamp_ns: int) -> TrackReport:
        """A track at any stamp in or after its window; ahead of the last tick it is predicted.

        Raises `CallError` for a track that does not exist and a stamp before its window.
        """
        return self._tracker.state_at(track_id, stamp_ns)

    def finish(self) -> tuple[SmoothedReport, ...]:
        """End all tracks; gives the smoothed states that were still inside a window."""
        return self._tracker.finish()
