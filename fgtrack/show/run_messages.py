"""Messages that show a run: map, ego, truth, tracks with uncertainty, lagged states, detections."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from heapq import merge
from itertools import chain, groupby, pairwise
from operator import attrgetter, itemgetter
from typing import Any

import numpy as np

from fgtrack.core.time import seconds
from fgtrack.core.types import (
    EGO_ID,
    FUSED,
    LATE,
    STATE_NAMES,
    Detection,
    Disposition,
    EgoState,
    FloatArray,
    IntArray,
)
from fgtrack.evaluation.placement import (
    DetectionsInMap,
    detections_in_map,
    road_lines,
    update_rows,
)
from fgtrack.inputs.ros.bag_writer import topic_part
from fgtrack.models.track_map import TrackMap
from fgtrack.runs import NO_TRACK, Columns, Run
from fgtrack.show.palette import PALETTE, SENSORS
from fgtrack.show.shapes import Colour, Entity, Point, Scene, Shape, ViewerMessage
from fgtrack.show.states import (
    NOMINAL_SIZE_M,
    ellipses,
    final_ns,
    groups,
    track_positions,
    with_position,
)

Messages = Iterator[ViewerMessage]
_WHITE = (1.0, 1.0, 1.0, 1.0)
_GREY = (0.55, 0.55, 0.55, 0.9)
_OPACITY = {"tentative": 0.15, "coasting": 0.3}
_CONFIRMED = 0.5  # ellipses and arrows inside the box remain visible
_SPEED_ARROW_S = 0.25
_LETTER_M, _LABEL_ABOVE_M = 1.2, 1.5
_MAP_LINE_M, _TRACK_LINE_M = 0.3, 0.35
_DEVIATIONS = 2.0  # half axes of an ellipse, in standard deviations
_SHOWN_S = 0.5  # display time of a list, unless a later list of its sensor replaces it
_DOT_M, _BEARING_M = 1.0, 150.0
# Entries of the covariance of x, y and yaw, row by row.
_COVARIANCE = (
    *("p_x_x", "p_x_y", "p_x_yaw"),
    *("p_x_y", "p_y_y", "p_y_yaw"),
    *("p_x_yaw", "p_y_yaw", "p_yaw_yaw"),
)
_POSE = ("x_m", "y_m", "yaw_rad", *_COVARIANCE)
# Number of times whose messages are made together.
_BLOCK_TIMES = 256
_USED = (*FUSED, Disposition.MERGED)


@dataclass(frozen=True)
class RunLayer:
    """Topic prefix of a run, and colour of its tracks."""

    prefix: str = ""
    colour: str | None = None
    """#RRGGBB; None for a different colour of each track."""

    def of_track(self, track_id: int, opacity: float = 1.0) -> Colour:
        """Return the colour of a track."""
        return rgba(self.colour or PALETTE[track_id % len(PALETTE)], opacity)


@lru_cache(maxsize=256)
def rgba(text: str, opacity: float = 1.0) -> Colour:
    """Return the colour #RRGGBB as numbers from 0 to 1."""
    r, g, b = (round(value / 255.0, 3) for value in bytes.fromhex(text[1:]))
    return r, g, b, opacity


def map_messages(maps: dict[str, TrackMap], at_ns: int) -> Messages:
    """Yield a single message with the bounds and the reference line of each road."""
    entities = list[Entity]()
    for name, road in maps.items():
        lines = zip(road_lines(road), (0.9, 0.9, 0.3), strict=True)
        shapes = tuple(
            _line(points.tolist(), _MAP_LINE_M, (*_GREY[:3], alpha))
            for points, alpha in lines
        )
        entities.append(Entity(name, shapes))
    if entities:
        yield ViewerMessage(at_ns, at_ns, "/map", Scene(tuple(entities), latched=True))


def ego_messages(ego: Columns, at_ns: int) -> Messages:
    """Yield the box of the ego in its own frame, once, and its state at every receipt."""
    rows = np.flatnonzero(
        np.isfinite(np.stack([ego[name] for name in STATE_NAMES[:3]])).all(axis=0)
    )
    if len(rows):
        box = Entity(
            "ego", (_box((0.0, 0.0), 0.0, NOMINAL_SIZE_M, _WHITE),), frame="ego"
        )
        yield ViewerMessage(at_ns, at_ns, "/ego", Scene((box,), latched=True))
    states = np.nan_to_num(np.stack([ego[name] for name in STATE_NAMES], axis=-1))
    stamps_ns = ego["stamp_ns"]
    receipts_ns = ego["receipt_ns"]
    for row in rows[np.argsort(receipts_ns[rows], kind="stable")].tolist():
        stamp_ns = int(stamps_ns[row])
        receipt_ns = int(receipts_ns[row])
        yield ViewerMessage(
            receipt_ns,
            stamp_ns,
            "/ego",
            EgoState(stamp_ns, receipt_ns, *states[row].tolist()),
        )


def truth_messages(truth: Columns) -> Messages:
    """Yield boxes and poses of the true objects at every stamp, without the ego."""
    table = with_position(truth.where(truth["object_id"] != EGO_ID))
    table = _in_memory(table, "stamp_ns", "object_id", "x_m", "y_m", "yaw_rad")
    before: set[str] = set()
    for rows in _blocks(table["stamp_ns"], np.unique(table["stamp_ns"])):
        yield from _merged(_truth_messages(table.where(rows), before))


def _truth_messages(table: Columns, before: set[str]) -> Iterator[Messages]:
    """Yield the two streams of the rows of `table`; `before` as in `_scenes`."""
    states = [
        Detection(x_m, y_m, _known(yaw_rad), object_id=object_id)
        for object_id, x_m, y_m, yaw_rad in _rows(
            table, "object_id", "x_m", "y_m", "yaw_rad"
        )
    ]

    def box(row: int) -> Entity:
        return Entity(
            f"object {states[row].object_id}",
            (_box(*_pose(states[row]), (*_WHITE[:3], 0.35)),),
        )

    yield _scenes("/truth", groups(table["stamp_ns"]), box, before)
    yield _objects("/truth", table["stamp_ns"], table["stamp_ns"], states)


def run_messages(run: Run, layer: RunLayer) -> Iterator[Messages]:
    """Yield the streams of messages that show a single run, each in order of log times."""
    yield _tick_messages(run, layer)
    yield _past_messages(run, layer)
    # A state is shown when it has become final.
    final = with_position(
        run.tables["smoothed"].where(run.tables["smoothed"]["kind"] == "final")
    )
    states = _states(final, run.tables["objects"])
    yield _objects(
        f"{layer.prefix}/smoothed", final_ns(run, final), final["stamp_ns"], states
    )
    yield _detection_messages(run, layer)
    yield _outcome_messages(run, layer)


def _tick_messages(run: Run, layer: RunLayer) -> Messages:
    """Yield the messages of all ticks, of which some hundred are in memory at a time."""
    timing = run.tables["timing"]
    names = ("now_ns", "stamp_ns", "track_id", "status", "speed_mps", *_POSE)
    tracks = _in_memory(run.tables["tracks"], *names)
    times_ns = np.union1d(timing["now_ns"], tracks["now_ns"])
    before = _Before()
    blocks = zip(
        _blocks(tracks["now_ns"], times_ns),
        _blocks(timing["now_ns"], times_ns),
        strict=True,
    )
    for rows, ticks in blocks:
        piece = run.with_tables(tracks=tracks.where(rows), timing=timing.where(ticks))
        yield from _merged(_track_messages(piece, layer, before))


@dataclass
class _Before:
    """Names of the entities in the last scenes."""

    boxes: set[str] = field(default_factory=set)
    patches: set[str] = field(default_factory=set)


def _blocks(values_ns: IntArray, times_ns: IntArray) -> Iterator[IntArray]:
    """Yield, for each `_BLOCK_TIMES` of the ascending `times_ns`, the rows whose value is among them."""
    order = np.argsort(values_ns, kind="stable")
    edges = np.searchsorted(values_ns[order], times_ns[::_BLOCK_TIMES])
    for first, end in pairwise([*edges.tolist(), len(order)]):
        yield order[first:end]


def _merged(streams: Iterator[Messages]) -> Messages:
    """Return the messages of `streams` in order of log times."""
    return merge(*streams, key=attrgetter("log_ns"))


def _track_messages(run: Run, layer: RunLayer, before: _Before) -> Iterator[Messages]:
    """Yield three streams of messages over all ticks: boxes with names and speeds, 2-sigma ellipses of the positions,
    and poses.
    """
    tracks = with_position(run.tables["tracks"])
    states = _states(tracks, run.tables["objects"])
    axes = ellipses(tracks, _DEVIATIONS).tolist()
    facts = list(_rows(tracks, "track_id", "status", "speed_mps"))
    rows_at = dict.fromkeys(
        run.tables["timing"]["now_ns"].tolist(), np.zeros(0, dtype=np.int64)
    )
    ticks = sorted(
        (rows_at | dict(groups(tracks["now_ns"]))).items(), key=itemgetter(0)
    )

    def box(row: int) -> Entity:
        track_id, status, speed_mps = facts[row]
        at_m, yaw_rad, size_m = _pose(states[row])
        name = f"{track_id} {states[row].class_name or ''}".strip()
        shapes = [
            _box(
                at_m,
                yaw_rad,
                size_m,
                layer.of_track(track_id, _OPACITY.get(status, _CONFIRMED)),
            ),
            Shape(
                "text",
                _WHITE,
                (0.0, 0.0, _LETTER_M),
                at_m,
                size_m[2] + _LABEL_ABOVE_M,
                text=name,
            ),
        ]
        if math.isfinite(speed_mps) and speed_mps:
            turned_rad = yaw_rad if speed_mps > 0.0 else yaw_rad + math.pi
            shapes.append(
                _arrow(
                    at_m,
                    turned_rad,
                    abs(speed_mps) * _SPEED_ARROW_S,
                    0.25,
                    layer.of_track(track_id),
                )
            )
        return Entity(f"track {track_id}", tuple(shapes))

    def patch(row: int) -> Entity | None:
        long_m, short_m, yaw_rad = axes[row]
        at_m, _, (*_, above_m) = _pose(states[row])
        track_id = facts[row][0]
        size_m = (2.0 * long_m, 2.0 * short_m, 0.02)
        shape = Shape(
            "cylinder",
            layer.of_track(track_id, 0.6),
            size_m,
            at_m,
            above_m + 0.05,
            yaw_rad,
        )
        return Entity(f"track {track_id}", (shape,)) if math.isfinite(long_m) else None

    yield _scenes(f"{layer.prefix}/tracks", ticks, box, before.boxes)
    yield _scenes(f"{layer.prefix}/ellipses", ticks, patch, before.patches)
    yield _objects(
        f"{layer.prefix}/tracks", tracks["now_ns"], tracks["stamp_ns"], states
    )


def _past_messages(run: Run, layer: RunLayer) -> Messages:
    """Yield, for every tick, the past of each track: a line through its lagged states up to the present state."""
    lagged = with_position(run.tables["lagged"])
    present = with_position(run.tables["tracks"])
    lagged = lagged.where(lagged["lag_s"] > 0.0)
    present = present.where(np.isin(present["now_ns"], lagged["now_ns"]))
    names = ("now_ns", "track_id", "stamp_ns", "x_m", "y_m")
    now_ns, ids, stamps_ns, x_m, y_m = (
        np.concatenate([lagged[name], present[name]]) for name in names
    )
    order = np.lexsort((stamps_ns, ids, now_ns))
    edges = np.flatnonzero(np.diff(now_ns[order]) | np.diff(ids[order])) + 1
    lines = [rows for rows in np.split(order, edges) if len(rows) > 1]

    def line(k: int) -> Entity:
        track_id = int(ids[lines[k][0]])
        points_m = np.stack([x_m[lines[k]], y_m[lines[k]]], axis=-1)
        return Entity(
            f"track {track_id}",
            (_line(points_m.tolist(), _TRACK_LINE_M, layer.of_track(track_id)),),
        )

    return _scenes(
        f"{layer.prefix}/past",
        groups(now_ns[[rows[0] for rows in lines]]) if lines else (),
        line,
    )


def _detection_messages(run: Run, layer: RunLayer) -> Messages:
    """Yield, for each received list, its detections, arrows to their tracks, and their poses.

    Unused detections are grey. An arrow leads from a detection to the position of its
    track at the tick that fused it. The arrow is opaque for an out-of-sequence
    detection, and faint otherwise.
    """
    table = _in_memory(run.tables["detections"], "receipt_ns", "sensor", "stamp_ns")
    where = detections_in_map(run)
    rows = update_rows(run)
    # Row -1 selects the empty text at the end.
    dispositions = np.append(run.tables["updates"]["disposition"].astype(np.str_), "")
    # NaN without a position or a track.
    off_m = track_positions(run, rows) - where.position_m
    colours = {
        name: rgba(SENSORS[k % len(SENSORS)])
        for k, name in enumerate(np.unique(table["sensor"]).tolist())
    }
    receipts_ns = table["receipt_ns"]
    for block in _blocks(receipts_ns, np.unique(receipts_ns)):
        yield from _list_messages(
            table.where(block),
            where.of(block),
            off_m[block],
            dispositions[rows[block]].tolist(),
            colours,
            layer,
        )


def _list_messages(
    table: Columns,
    where: DetectionsInMap,
    off_m: FloatArray,
    fates: Sequence[str],
    colours: Mapping[str, Colour],
    layer: RunLayer,
) -> Messages:
    """Yield the messages of the lists in `table`; `off_m` (n, 2) leads from each detection to its track."""
    lengths_m = np.hypot(*off_m.T).tolist()
    yaws_rad = np.arctan2(off_m[:, 1], off_m[:, 0]).tolist()
    positions_m: list[Point] = list(map(tuple, where.position_m.tolist()))
    keys = list(_rows(table, "receipt_ns", "sensor", "stamp_ns"))
    for key, group in groupby(
        sorted(range(len(keys)), key=keys.__getitem__), key=keys.__getitem__
    ):
        receipt_ns, sensor, stamp_ns = key
        mine = list(group)
        colour = colours[sensor]
        late = receipt_ns > stamp_ns
        marks = [
            _mark(where, row, colour if fates[row] in _USED else _GREY) for row in mine
        ]
        arrows = [
            _arrow(
                positions_m[row],
                yaws_rad[row],
                lengths_m[row],
                0.3,
                (*colour[:3], 1.0 if fates[row] in LATE else 0.3),
            )
            for row in mine
            if late and fates[row] in FUSED and lengths_m[row] > 0.0
        ]
        states = tuple(
            Detection(*positions_m[row], _known(float(where.yaw_rad[row])))
            for row in mine
            if math.isfinite(sum(positions_m[row]))
        )
        scene = Scene((Entity(sensor, tuple(filter(None, marks)), _SHOWN_S),))
        yield ViewerMessage(receipt_ns, stamp_ns, f"{layer.prefix}/detections", scene)
        if arrows:
            scene = Scene((Entity(sensor, tuple(arrows), _SHOWN_S),))
            yield ViewerMessage(receipt_ns, stamp_ns, f"{layer.prefix}/arrivals", scene)
        if states:
            yield ViewerMessage(
                receipt_ns,
                stamp_ns,
                f"{layer.prefix}/detections/{topic_part(sensor)}",
                states,
            )


def _mark(where: DetectionsInMap, row: int, colour: Colour) -> Shape | None:
    """Return a sphere at the position of a detection, or a line of sight for a bearing alone.

    None without an ego pose.
    """
    x_m, y_m = where.position_m[row].tolist()
    if math.isfinite(x_m + y_m):
        return Shape(
            "sphere", colour, (_DOT_M, _DOT_M, _DOT_M), (x_m, y_m), _DOT_M / 2.0
        )
    from_x_m, from_y_m = where.sensor_m[row].tolist()
    bearing_rad = float(where.bearing_rad[row])
    if not math.isfinite(from_x_m + from_y_m + bearing_rad):
        return None
    end_m = (
        from_x_m + _BEARING_M * math.cos(bearing_rad),
        from_y_m + _BEARING_M * math.sin(bearing_rad),
    )
    return _line([(from_x_m, from_y_m), end_m], 0.15, (*colour[:3], 0.5))


def _outcome_messages(run: Run, layer: RunLayer) -> Messages:
    """Yield the rows of `updates.csv` at their receipts."""
    names = (
        "receipt_ns",
        "stamp_ns",
        "sensor",
        "index",
        "disposition",
        "track_id",
        "nis",
    )
    updates = _in_memory(run.tables["updates"], *names)
    receipts_ns = np.unique(updates["receipt_ns"])
    rows = chain.from_iterable(
        _rows(updates.where(block), *names)
        for block in _blocks(updates["receipt_ns"], receipts_ns)
    )
    for receipt_ns, stamp_ns, sensor, index, disposition, track_id, nis in rows:
        values = {
            "sensor": sensor,
            "index": index,
            "disposition": disposition,
            "nis": _known(nis),
        }
        values |= {
            "track_id": None if track_id == NO_TRACK else track_id,
            "delay_s": seconds(receipt_ns - stamp_ns),
        }
        yield ViewerMessage(receipt_ns, stamp_ns, f"{layer.prefix}/outcomes", values)


def _scenes(
    topic: str,
    rows_at: Iterable[tuple[int, IntArray]],
    entity: Callable[[int], Entity | None],
    before: set[str] | None = None,
) -> Messages:
    """Yield a scene for each time, with the entities of its rows.

    An entity of the scene before that is missing in this scene is removed. `before`
    are the names in the scene before the first, and afterwards in the last.
    """
    before = set() if before is None else before
    for at_ns, rows in rows_at:
        entities = tuple(
            item for row in rows.tolist() if (item := entity(row)) is not None
        )
        names = {item.name for item in entities}
        if entities or before:
            yield ViewerMessage(
                at_ns, at_ns, topic, Scene(entities, tuple(sorted(before - names)))
            )
        before.clear()
        before.update(names)


def _objects(
    topic: str, log_ns: IntArray, stamps_ns: IntArray, states: Sequence[Detection]
) -> Messages:
    """Yield a message with the states for each pair of log time and stamp."""
    times = list(zip(log_ns.tolist(), stamps_ns.tolist(), strict=True))
    for (log, stamp), rows in groupby(
        sorted(range(len(times)), key=times.__getitem__), key=times.__getitem__
    ):
        yield ViewerMessage(log, stamp, topic, tuple(states[row] for row in rows))


def _states(states: Columns, objects: Columns) -> list[Detection]:
    """Return the pose of each row with its covariance, and the class and size of its track if known."""
    described = {
        track_id: {
            "length_m": _known(length_m),
            "width_m": _known(width_m),
            "height_m": _known(height_m),
            "class_name": name,
        }
        for track_id, length_m, width_m, height_m, name in _rows(
            objects, "track_id", "length_m", "width_m", "height_m", "class_name"
        )
    }
    result = []
    for x_m, y_m, yaw_rad, track_id, *covariance in _rows(
        states, "x_m", "y_m", "yaw_rad", "track_id", *_COVARIANCE
    ):
        P = tuple(covariance) if math.isfinite(yaw_rad + sum(covariance)) else None
        result.append(
            Detection(
                x_m,
                y_m,
                _known(yaw_rad),
                covariance=P,
                object_id=track_id,
                **described.get(track_id, {}),
            )
        )
    return result


def _in_memory(table: Columns, *names: str) -> Columns:
    """Return the columns `names` of `table` in memory.

    A long column of a Parquet file would be read again for each block of rows.
    """
    return Columns({name: table[name] for name in names})


def _rows(
    table: Columns, *names: str
) -> Iterator[tuple[Any, ...]]:  # Any: values of a row
    return zip(*(table[name].tolist() for name in names), strict=True)


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _pose(state: Detection) -> tuple[Point, float, tuple[float, float, float]]:
    """Return position, yaw, and size (length, width, height) of an object; nominal values if unknown."""
    length_m, width_m, height_m = NOMINAL_SIZE_M
    size_m = (
        state.length_m or length_m,
        state.width_m or width_m,
        state.height_m or height_m,
    )
    return (state.x_m or 0.0, state.y_m or 0.0), state.yaw_rad or 0.0, size_m


def _box(
    centre_m: Point, yaw_rad: float, size_m: tuple[float, float, float], colour: Colour
) -> Shape:
    return Shape("cube", colour, size_m, centre_m, size_m[2] / 2.0, yaw_rad)


def _arrow(
    tail_m: Point, yaw_rad: float, length_m: float, width_m: float, colour: Colour
) -> Shape:
    return Shape(
        "arrow", colour, (length_m, width_m, width_m), tail_m, width_m, yaw_rad
    )


def _line(points_m: Iterable[Sequence[float]], width_m: float, colour: Colour) -> Shape:
    return Shape(
        "line",
        colour,
        (width_m, 0.0, 0.0),
        points_m=[(x_m, y_m) for x_m, y_m in points_m],
    )
