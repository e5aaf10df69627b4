"""Base of the sinks of a run, which collect table rows, counts of the dispositions, and meta data."""

from abc import ABC, abstractmethod
from collections import Counter, defaultdict, deque
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import asdict, astuple, dataclass, field
from time import monotonic

from fgtrack.core.types import (
    DetectionList,
    Disposition,
    EgoState,
    FinalTrack,
    ObjectReport,
    Revision,
    SmoothedReport,
    TickReport,
    TruthState,
)
from fgtrack.inputs.geodetic import GEODETIC
from fgtrack.runs.rows import Row, detection_rows, rows, smoothed_rows, state_cells
from fgtrack.runs.schema import COLUMNS, NO_TRACK, RUN_FORMAT

#: Number of the first columns of `detections` that name a detection: sensor, stamp, receipt and index.
_KEY = 4
PERIOD_S = 0.2
"""Wall time between two writes of rows. Writing each row by itself would take as long as formatting it."""


@dataclass
class ReceivedLists:
    """Number and receipts of the lists of one sensor, empty ones included, and its two longest gaps."""

    first_receipt_ns: int
    count: int = 0
    last_receipt_ns: int | None = None
    longest_gaps_ns: list[tuple[int, int]] = field(default_factory=list)
    """Receipts before and after the two longest gaps, the longest first."""

    def add(self, receipt_ns: int) -> None:
        """Count a list."""
        self.count += 1
        if self.last_receipt_ns is not None:
            gaps = [*self.longest_gaps_ns, (self.last_receipt_ns, receipt_ns)]
            gaps.sort(key=lambda gap: gap[0] - gap[1])
            self.longest_gaps_ns = gaps[:2]
        self.last_receipt_ns = receipt_ns

    def as_meta(self) -> dict[str, object]:
        """Return the fields as in meta.json."""
        return {
            **asdict(self),
            "longest_gaps_ns": list(map(list, self.longest_gaps_ns)),
        }


class RunSink(ABC):
    """Sink of a run: receives the results of a replay tick by tick. Subclasses store the rows.

    `meta` is the content of `meta.json` at the start. The table `smoothed` gets the
    final states and the lagged states with the lag `smoothed_lag_s`; `lagged` gets the
    lagged states of every lag.
    """

    def __init__(
        self,
        config_text: str = "",
        meta: Mapping[str, object] | None = None,
        smoothed_lag_s: float | None = None,
    ) -> None:
        self._config_text = config_text
        self._meta: dict[str, object] = {
            "format": RUN_FORMAT,
            **(meta or {}),
            "complete": False,
        }
        self._smoothed_lag_s = smoothed_lag_s
        self._counts: dict[str, Counter[Disposition]] = defaultdict(Counter)
        # Counts by sensor and excluding setting: of the tracker, and of the reader.
        self._out_of_bounds: dict[str, Counter[str]] = defaultdict(Counter)
        self._left_out: dict[str, Counter[str]] = defaultdict(Counter)
        self._lists: dict[str, ReceivedLists] = {}
        # Newest reports on the objects of tracks that have not ended.
        self._objects: dict[int, ObjectReport] = {}
        # Rows of detections without a record yet, by sensor, stamp, receipt and index; duplicates share a key.
        self._waiting: dict[Row, deque[Row]] = defaultdict(deque)
        # Rows that are not appended yet.
        self._rows: dict[str, list[Row]] = {table: [] for table in COLUMNS}
        self._due_s = 0.0

    @property
    def is_scored(self) -> bool:
        """True if tracks have existence probabilities; if False, the table `tracks` lacks this column."""
        return bool(self._meta.get("is_scored"))

    def write_tick(
        self, report: TickReport, process_ns: int, num_detections: int
    ) -> None:
        """Add the rows of one tick to the tables, as in `rows`; the rows of the first tick are appended immediately."""
        for record in report.updates:
            self._counts[record.sensor][record.disposition] += 1
            if record.reason is not None:
                self._out_of_bounds[record.sensor][record.reason] += 1
            self._take(
                (record.sensor, record.stamp_ns, record.receipt_ns, record.index)
            )
        self._end_objects({track.track_id for track in report.tracks})
        self._objects |= {
            track.track_id: track.object
            for track in report.tracks
            if track.object is not None
        }
        for table, cells in rows(
            report, process_ns, num_detections, self._smoothed_lag_s
        ):
            self._rows[table] += (
                cells
                if self.is_scored or table != "tracks"
                else [row[:-1] for row in cells]
            )
        if monotonic() >= self._due_s:
            self._append_rows()

    def write_smoothed(self, reports: Sequence[SmoothedReport]) -> None:
        """Add rows to the table `smoothed`; there may be none."""
        self._rows["smoothed"] += smoothed_rows(reports)

    def write_decisions(
        self, revisions: Iterable[Revision], tracks: Iterable[FinalTrack] = ()
    ) -> None:
        """Add rows to the tables `revisions` and `final_tracks`; there may be none."""
        self._rows["revisions"] += [
            (
                each.tick,
                each.sensor,
                each.stamp_ns,
                each.receipt_ns,
                each.index,
                NO_TRACK if each.old_track_id is None else each.old_track_id,
                NO_TRACK if each.track_id is None else each.track_id,
            )
            for each in revisions
        ]
        self._rows["final_tracks"] += [
            (*each[:3], int(each.is_confirmed), each.probability) for each in tracks
        ]

    def write_truth(self, truth: TruthState) -> None:
        """Add a row to the table `truth`, or for an ignored object to `ignored`."""
        if truth.ignored:
            outline = (
                None
                if truth.outline_m is None
                else " ".join(map(repr, map(float, truth.outline_m)))
            )
            self._rows["ignored"].append(
                (
                    truth.stamp_ns,
                    truth.object_id,
                    float(truth.x_m),
                    float(truth.y_m),
                    outline,
                )
            )
        else:
            self._rows["truth"].append(
                (truth.stamp_ns, truth.object_id, *state_cells(truth))
            )

    def write_ego(self, ego: EgoState) -> None:
        """Add a row to the table `ego`."""
        self._rows["ego"].append((ego.stamp_ns, ego.receipt_ns, *state_cells(ego)))

    def write_detections(self, message: DetectionList) -> None:
        """Keep the rows of `message` for the table `detections`, and count the objects that the reader left out.

        The row of a detection follows when its record is written, so both tables have the same order.
        """
        known = self._lists.get(message.sensor)
        if known is None:
            known = self._lists[message.sensor] = ReceivedLists(message.receipt_ns)
        known.add(message.receipt_ns)
        for row in detection_rows(message):
            self._waiting[row[:_KEY]].append(row)
        if message.origin_deg is not None:
            self._meta.setdefault(
                "origin", dict(zip(GEODETIC, message.origin_deg, strict=True))
            )
        if message.left_out:
            self._left_out[message.sensor].update(message.left_out)

    def finish(self, meta: Mapping[str, object]) -> dict[str, object]:
        """Complete the run with `meta`, the counts by sensor and the digest; return the content of `meta.json`."""
        self._end_objects(set())
        for rows_of_key in self._waiting.values():  # received, but never processed
            self._rows["detections"] += rows_of_key
        self._append_rows()
        counts = {
            sensor: {
                disposition.value: counter[disposition] for disposition in Disposition
            }
            for sensor, counter in sorted(self._counts.items())
        }
        bounds = {
            "out_of_bounds": _by_reason(self._out_of_bounds),
            "left_out": _by_reason(self._left_out),
        }
        self._meta |= {
            "counts": counts,
            "lists": {
                sensor: one.as_meta() for sensor, one in sorted(self._lists.items())
            },
            **bounds,
            "complete": True,
            **meta,
            "digest": self._digest(),
        }
        return dict(self._meta)

    def _take(self, key: Row) -> None:
        """Move the row of the detection `key`, if it waits, to the table `detections`."""
        if waiting := self._waiting.get(key):
            self._rows["detections"].append(waiting.popleft())
            if not waiting:
                del self._waiting[key]

    def _end_objects(self, alive: Set[int]) -> None:
        """Add rows to the table `objects` for tracks that have ended: those not in `alive`."""
        ended = sorted(self._objects.keys() - alive)
        self._rows["objects"] += [
            (track_id, *astuple(self._objects.pop(track_id))) for track_id in ended
        ]

    def _append_rows(self) -> None:
        self._due_s = monotonic() + PERIOD_S
        for table, cells in self._rows.items():
            if cells:
                self._append(table, cells)
                self._rows[table] = []

    @abstractmethod
    def _append(self, table: str, rows: Sequence[Row]) -> None:
        """Append `rows` to `table`."""

    @abstractmethod
    def _digest(self) -> str:
        """SHA-256 of the bytes of tracks.csv followed by updates.csv, in hex."""


def _by_reason(counts: Mapping[str, Counter[str]]) -> dict[str, dict[str, int]]:
    return {
        sensor: dict(sorted(counter.items()))
        for sensor, counter in sorted(counts.items())
    }
