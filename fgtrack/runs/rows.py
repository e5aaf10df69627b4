"""Rows of every table of a run, and their CSV text; an empty cell is None."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import lru_cache
from operator import attrgetter, itemgetter
from typing import Any

from fgtrack.core.cells import guarded
from fgtrack.core.types import (
    DESCRIBING,
    MEASURABLE,
    STATE_NAMES,
    DetectionList,
    EgoState,
    SmoothedReport,
    TickReport,
    TrackReport,
    TrackState,
    TruthState,
    UpdateRecord,
)
from fgtrack.runs.schema import COLUMNS, COVARIANCE_STATES, written_columns

Cell = str | int | float | None
Row = tuple[Cell, ...]
#: Indices of the columns with names from the input, which may need quotes.
_QUOTED = {
    table: [
        index
        for index, name in enumerate(names)
        if name in ("sensor", "class_name", "id")
    ]
    for table, names in COLUMNS.items()
}


def rows(
    report: TickReport,
    process_ns: int,
    num_detections: int,
    smoothed_lag_s: float | None,
) -> Iterator[tuple[str, list[Row]]]:
    """Yield the rows of one tick, table by table.

    `process_ns` is the wall time of the tick, `num_detections` the number of detections
    that it received. `smoothed` gets the final states and the lagged states with the
    lag `smoothed_lag_s`; `lagged` gets the lagged states of every lag. Lagged states of
    tracks that the tick does not report are left out.
    """
    tick = (report.tick, report.now_ns)
    yield "tracks", [_track_row(tick, track) for track in report.tracks]
    yield "updates", [_update_row(report.tick, update) for update in report.updates]
    tracked = {track.track_id for track in report.tracks}
    kept = [
        row for row in report.smoothed if row.lag_s is None or row.track_id in tracked
    ]
    lagged = [row for row in kept if row.lag_s is not None]
    yield (
        "lagged",
        [
            (
                *tick,
                row.lag_s,
                row.track_id,
                row.state.stamp_ns,
                *_state_cells(row.state),
            )
            for row in lagged
        ],
    )
    yield (
        "smoothed",
        smoothed_rows(row for row in kept if row.lag_s in (None, smoothed_lag_s)),
    )
    yield "timing", [(*tick, process_ns, len(report.tracks), num_detections)]


def _track_row(tick: tuple[int, int], track: TrackReport) -> Row:
    cells = _state_cells(track.state)
    ids = (track.state.stamp_ns, track.track_id, track.status.value)
    return (
        *tick,
        *ids,
        *cells[: len(STATE_NAMES)],
        track.num_measured,
        *cells[len(STATE_NAMES) :],
        track.score,
    )


def _update_row(tick: int, update: UpdateRecord) -> Row:
    ids = (
        tick,
        update.sensor,
        update.stamp_ns,
        update.receipt_ns,
        update.index,
        update.disposition.value,
    )
    return (*ids, update.track_id, update.nis, *map(update.innovation.get, MEASURABLE))


def smoothed_rows(reports: Iterable[SmoothedReport]) -> list[Row]:
    """Return the rows of `smoothed` for final and lagged states."""
    return [
        (
            row.track_id,
            row.state.stamp_ns,
            "final" if row.lag_s is None else "lagged",
            *_state_cells(row.state),
        )
        for row in reports
    ]


def detection_rows(message: DetectionList) -> list[Row]:
    """Return the rows of `detections`: the fields of every object of `message`, in the frame of `message`."""
    cells: list[Row] = []
    for index, item in enumerate(message.objects):
        stamp_ns = message.stamp_ns if item.stamp_ns is None else item.stamp_ns
        values = (
            value if value is None or isinstance(value, str) else float(value)
            for value in _values(item)
        )
        cells.append(
            (
                message.sensor,
                stamp_ns,
                message.receipt_ns,
                index,
                message.frame,
                *values,
            )
        )
    return cells


def text(table: str, cells: Sequence[Row]) -> str:
    """Return `cells` as lines of the table's CSV file; floats have 17 significant digits."""
    for index in _QUOTED[table]:
        cells = [
            (*row[:index], _quoted(row[index]), *row[index + 1 :]) for row in cells
        ]
    return "".join([_line(tuple(map(type, row))) % row for row in cells])


def text_header(table: str, is_scored: bool = True) -> bytes:
    """Return the first line of the table's CSV file; `is_scored` as in `RunSink`."""
    return (",".join(written_columns(table, is_scored)) + "\n").encode()


@lru_cache
def _line(kinds: tuple[type, ...]) -> str:
    return ",".join(map(_format, kinds)) + "\n"


def _format(kind: type) -> str:
    if issubclass(kind, float):
        return "%.17g"
    return "%.0s" if kind is type(None) else "%s" if issubclass(kind, str) else "%d"


@lru_cache
def _quoted(name: Cell) -> Cell:
    """Return `name` as a CSV cell, in quotes if necessary, and never as a formula."""
    if name is None:
        return None
    name = guarded(str(name))
    return '"' + name.replace('"', '""') + '"' if set(name) & set(',"\r\n') else name


def _state_cells(state: TrackState) -> Row:
    """Return the cells of the mean and of the covariance's upper triangle; None for states that the model lacks."""
    mean = state.mean.tolist()
    entries: list[Cell] = [*state.covariance.ravel().tolist(), None]
    return (
        *mean,
        *(None,) * (len(STATE_NAMES) - len(mean)),
        *_upper_triangle(len(mean))(entries),
    )


@lru_cache
def _upper_triangle(size: int) -> Callable[[list[Cell]], Row]:
    """Return a function that selects the upper triangle from the row-major covariance of `size` states.

    The last entry of its argument must be None; it stands for states that the model
    lacks.
    """
    kept = range(len(COVARIANCE_STATES))
    indices = [i * size + j if j < size else -1 for i in kept for j in kept[i:]]
    # Any: a tuple, because there are several indices.
    select: Callable[[list[Cell]], Any] = itemgetter(*indices)
    return select


state_cells: Callable[[EgoState | TruthState], Row] = attrgetter(*STATE_NAMES)
"""Returns the state cells of the ego or of a true object."""
_values = attrgetter(*MEASURABLE, *DESCRIBING)
