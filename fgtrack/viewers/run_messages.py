"""Messages that show a run: map, ego, truth, tracks and how sure they are, their corrected past, detections."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from operator import itemgetter
from typing import Any

import numpy as np

from fgtrack.core.time import seconds
from fgtrack.core.types import EGO_ID, FUSED, LATE, STATE_NAMES, Detection, Disposition, EgoState, IntArray
from fgtrack.evaluation.palette import PALETTE, SENSORS
from fgtrack.evaluation.placement import Placed, placed, update_rows
from fgtrack.evaluation.roads import road_lines
from fgtrack.io.ros.bag_writer import token
from fgtrack.io.run import NO_TRACK, Run, Table
from fgtrack.models.track_map import TrackMap
from fgtrack.viewers.shapes import Colour, Entity, Point, Scene, Shape, ViewerMessage
from fgtrack.viewers.states import NOMINAL_SIZE_M, ellipses, final_ns, groups, located, track_positions

Messages = Iterator[ViewerMessage]

_OBJECT = ("track_id", "length_m", "width_m", "height_m", "class_name")

_WHITE, _GREY = (1.0, 1.0, 1.0, 1.0), (0.55, 0.55, 0.55, 0.9)
_OPACITY = {"tentative": 0.15, "coasting": 0.3}
_CONFIRMED = 0.5  # so that ellipses and arrows in the box are seen
_SPEED_ARROW_S = 0.25
_LETTER_M, _LABEL_ABOVE_M = 1.2, 1.5
_MAP_LINE_M, _TRACK_LINE_M = 0.3, 0.35
_DEVIATIONS = 2.0  # of an ellipse
_SHOWN_S = 0.5  # of a list that no later one of its sensor replaces
_DOT_M, _BEARING_M = 1.0, 150.0
_USED = (*FUSED, Disposition.MERGED)


@dataclass(frozen=True)
class Look:
    """Prefix of the topics of a run, and the colour of its tracks."""

    prefix: str = ""
    colour: str | None = None
    """#RRGGBB; None for a colour of each track."""

    def of_track(self, track_id: int, opacity: float = 1.0) -> Colour:
        """Colour of a track."""
        return rgba(self.colour or PALETTE[track_id % len(PALETTE)], opacity)


def rgba(text: str, opacity: float = 1.0) -> Colour:
    """Return the colour #RRGGBB as shares of 1."""
    r, g, b = (round(value / 255.0, 3) for value in bytes.fromhex(text[1:]))
    return r, g, b, opacity


def map_messages(maps: dict[str, TrackMap], at_ns: int) -> Messages:
    """Bounds and reference line of each road, once."""
    opacities = {name: zip(road_lines(road), (0.9, 0.9, 0.3), strict=True) for name, road in maps.items()}
    entities = [
        Entity(name, tuple(_line(points.tolist(), _MAP_LINE_M, (*_GREY[:3], alpha)) for points, alpha in lines))
        for name, lines in opacities.items()
    ]
    shown = tuple(one for one in entities if one.shapes)
    if shown:
        yield ViewerMessage(at_ns, at_ns, "/map", Scene(shown, latched=True))


def ego_messages(ego: Table, at_ns: int) -> Messages:
    """The box of the ego in its own frame, once, and its state at every receipt."""
    rows = np.flatnonzero(np.isfinite(np.stack([ego[name] for name in STATE_NAMES[:3]])).all(axis=0))
    rows = rows[np.argsort(ego["receipt_ns"][rows], kind="stable")]
    if len(rows):
        box = Entity("ego", (_box((0.0, 0.0), 0.0, NOMINAL_SIZE_M, _WHITE),), frame="ego")
        yield ViewerMessage(at_ns, at_ns, "/ego", Scene((box,), latched=True))
    states = np.nan_to_num(np.stack([ego[name][rows] for name in STATE_NAMES], axis=-1)).tolist()
    times = zip(ego["stamp_ns"][rows].tolist(), ego["receipt_ns"][rows].tolist(), strict=True)
    for (stamp_ns, receipt_ns), state in zip(times, states, strict=True):
        yield ViewerMessage(receipt_ns, stamp_ns, "/ego", EgoState(stamp_ns, receipt_ns, *state))


def truth_messages(truth: Table) -> Iterator[Messages]:
    """Boxes and poses of the true objects at every stamp; the ego is not among them."""
    table = located(truth.where(truth["object_id"] != EGO_ID))
    states = [
        Detection(x_m, y_m, _known(yaw_rad), object_id=object_id)
        for object_id, x_m, y_m, yaw_rad in _rows(table, "object_id", "x_m", "y_m", "yaw_rad")
    ]

    def box(row: int) -> Entity:
        shape = _box(_point(states[row]), states[row].yaw_rad or 0.0, NOMINAL_SIZE_M, (*_WHITE[:3], 0.35))
        return Entity(f"object {states[row].object_id}", (shape,))

    steps = ((stamp_ns, stamp_ns, [box(row) for row in rows.tolist()]) for stamp_ns, rows in groups(table["stamp_ns"]))
    yield _scenes("/truth", steps)
    yield _objects("/truth", table["stamp_ns"], table["stamp_ns"], states)


def run_messages(run: Run, look: Look) -> Iterator[Messages]:
    """Streams of the messages that show a run alone, each in the order of log times."""
    yield from _track_messages(run, look)
    yield _past_messages(run, look)
    # Final states appear as soon as nothing can change them any more.
    final = located(run.tables["smoothed"].where(run.tables["smoothed"]["kind"] == "final"))
    states = _states(final, run.tables["objects"])
    yield _objects(f"{look.prefix}/smoothed", final_ns(run, final), final["stamp_ns"], states)
    yield from _detection_messages(run, look)
    yield _outcome_messages(run, look)


def _track_messages(run: Run, look: Look) -> Iterator[Messages]:
    """At every tick boxes, numbers and speeds, the 2-sigma ellipses of the positions, and the poses."""
    tracks = located(run.tables["tracks"])
    states, axes = _states(tracks, run.tables["objects"]), ellipses(tracks, _DEVIATIONS).tolist()
    facts = list(_rows(tracks, "track_id", "status", "speed_mps"))
    rows_at = dict.fromkeys(run.tables["timing"]["now_ns"].tolist(), np.zeros(0, dtype=np.int64))
    rows_at |= dict(groups(tracks["now_ns"]))

    def steps(entity: Callable[[int], Entity | None]) -> Iterator[tuple[int, int, list[Entity]]]:
        for now_ns, rows in sorted(rows_at.items(), key=itemgetter(0)):
            entities = [one for row in rows.tolist() if (one := entity(row)) is not None]
            yield now_ns, int(tracks["stamp_ns"][rows].max()) if len(rows) else now_ns, entities

    def box(row: int) -> Entity:
        track_id, status, speed_mps = facts[row]
        state, at_m, size_m = states[row], _point(states[row]), _size(states[row])
        yaw_rad, name = state.yaw_rad or 0.0, f"{track_id} {state.class_name or ''}".strip()
        shapes = [
            _box(at_m, yaw_rad, size_m, look.of_track(track_id, _OPACITY.get(status, _CONFIRMED))),
            Shape("text", _WHITE, (0.0, 0.0, _LETTER_M), at_m, size_m[2] + _LABEL_ABOVE_M, text=name),
        ]
        if math.isfinite(speed_mps) and speed_mps:
            turned_rad = yaw_rad if speed_mps > 0.0 else yaw_rad + math.pi
            shapes.append(_arrow(at_m, turned_rad, abs(speed_mps) * _SPEED_ARROW_S, 0.25, look.of_track(track_id)))
        return Entity(f"track {track_id}", tuple(shapes))

    def patch(row: int) -> Entity | None:
        long_m, short_m, yaw_rad = axes[row]
        size_m, height_m = (2.0 * long_m, 2.0 * short_m, 0.02), _size(states[row])[2] + 0.05
        colour = look.of_track(facts[row][0], 0.6)
        shape = Shape("cylinder", colour, size_m, _point(states[row]), height_m, yaw_rad)
        return Entity(f"track {facts[row][0]}", (shape,)) if math.isfinite(long_m) else None

    yield _scenes(f"{look.prefix}/tracks", steps(box))
    yield _scenes(f"{look.prefix}/ellipses", steps(patch))
    yield _objects(f"{look.prefix}/tracks", tracks["now_ns"], tracks["stamp_ns"], states)


def _past_messages(run: Run, look: Look) -> Messages:
    """At every tick the past of each track as known then: a line through its lagged states to the present one."""
    lagged, present = located(run.tables["lagged"]), located(run.tables["tracks"])
    lagged = lagged.where(lagged["lag_s"] > 0.0)
    present = present.where(np.isin(present["now_ns"], lagged["now_ns"]))
    names = ("now_ns", "track_id", "stamp_ns", "x_m", "y_m")
    states = Table({name: np.concatenate([lagged[name], present[name]]) for name in names})
    order = np.lexsort((states["stamp_ns"], states["track_id"]))
    states = Table({name: column[order] for name, column in states.items()})
    points_m = np.stack([states["x_m"], states["y_m"]], axis=-1)

    def steps() -> Iterator[tuple[int, int, list[Entity]]]:
        for now_ns, rows in groups(states["now_ns"]):
            lines = {track_id: rows[mine] for track_id, mine in groups(states["track_id"][rows])}
            entities = [
                Entity(f"track {k}", (_line(points_m[mine].tolist(), _TRACK_LINE_M, look.of_track(k)),))
                for k, mine in lines.items()
                if len(mine) > 1
            ]
            yield now_ns, now_ns, entities

    return _scenes(f"{look.prefix}/past", steps())


def _detection_messages(run: Run, look: Look) -> Iterator[Messages]:
    """At every receipt of a list its detections, grey where not used, their poses, and arrows to their tracks now.

    An arrow leads from where a detection was sensed to where its track is at the tick that fused it. It is strong where
    the detection came out of sequence, and faint where it did not.
    """
    table, updates, where, update_of = run.tables["detections"], run.tables["updates"], placed(run), update_rows(run)
    fates = [updates["disposition"][row] if row >= 0 else "" for row in update_of.tolist()]
    keys = list(_rows(table, "receipt_ns", "sensor", "stamp_ns"))
    order = sorted(range(len(keys)), key=keys.__getitem__)
    lists = [(key, list(rows)) for key, rows in groupby(order, key=keys.__getitem__)]
    names = np.unique(table["sensor"]).tolist()
    colours = {name: rgba(SENSORS[k % len(SENSORS)]) for k, name in enumerate(names)}
    positions_m: list[Point] = list(map(tuple, where.position_m.tolist()))
    ends_m = track_positions(run, update_of).tolist()

    def scenes(topic: str, shape: Callable[[int, Colour], Shape | None], is_sparse: bool) -> Messages:
        for (receipt_ns, sensor, stamp_ns), rows in lists:
            shapes = tuple(one for row in rows if (one := shape(row, colours[sensor])) is not None)
            if shapes or not is_sparse:
                entity = Entity(sensor, shapes, _SHOWN_S)
                yield ViewerMessage(receipt_ns, stamp_ns, f"{look.prefix}/{topic}", Scene((entity,)))

    def mark(row: int, colour: Colour) -> Shape | None:
        return _mark(where, row, colour if fates[row] in _USED else _GREY)

    def arrival(row: int, colour: Colour) -> Shape | None:
        receipt_ns, _, stamp_ns = keys[row]
        (x_m, y_m), (end_x_m, end_y_m) = positions_m[row], ends_m[row]
        length_m = math.hypot(end_x_m - x_m, end_y_m - y_m)  # NaN without a position or a track
        if fates[row] not in FUSED or receipt_ns <= stamp_ns or not length_m > 0.0:
            return None
        colour = (*colour[:3], 1.0 if fates[row] in LATE else 0.3)
        return _arrow((x_m, y_m), math.atan2(end_y_m - y_m, end_x_m - x_m), length_m, 0.3, colour)

    yield scenes("detections", mark, is_sparse=False)
    for sensor in names:
        mine = np.flatnonzero((table["sensor"] == sensor) & np.isfinite(where.position_m).all(axis=1))
        states = [Detection(*positions_m[row], _known(float(where.yaw_rad[row]))) for row in mine.tolist()]
        topic = f"{look.prefix}/detections/{token(sensor)}"
        yield _objects(topic, table["receipt_ns"][mine], table["stamp_ns"][mine], states)
    yield scenes("arrivals", arrival, is_sparse=True)


def _mark(where: Placed, row: int, colour: Colour) -> Shape | None:
    """A ball where a detection was, or a line of sight where only its direction is known."""
    x_m, y_m = where.position_m[row].tolist()
    if math.isfinite(x_m + y_m):
        return Shape("sphere", colour, (_DOT_M, _DOT_M, _DOT_M), (x_m, y_m), _DOT_M / 2.0)
    (from_x_m, from_y_m), bearing_rad = where.sensor_m[row].tolist(), float(where.bearing_rad[row])
    if not math.isfinite(from_x_m + from_y_m + bearing_rad):
        return None
    end_m = from_x_m + _BEARING_M * math.cos(bearing_rad), from_y_m + _BEARING_M * math.sin(bearing_rad)
    return _line([(from_x_m, from_y_m), end_m], 0.15, (*colour[:3], 0.5))


def _outcome_messages(run: Run, look: Look) -> Messages:
    """Rows of `updates.csv` at their receipts."""
    names = ("receipt_ns", "stamp_ns", "sensor", "index", "disposition", "track_id", "nis")
    for receipt_ns, stamp_ns, sensor, index, disposition, track_id, nis in sorted(
        _rows(run.tables["updates"], *names), key=itemgetter(0)
    ):
        values = {"sensor": sensor, "index": index, "disposition": disposition, "nis": _known(nis)}
        values |= {"track_id": None if track_id == NO_TRACK else track_id, "delay_s": seconds(receipt_ns - stamp_ns)}
        yield ViewerMessage(receipt_ns, stamp_ns, f"{look.prefix}/outcomes", values)


def _scenes(topic: str, steps: Iterable[tuple[int, int, list[Entity]]]) -> Messages:
    """Scenes of log time, stamp and entities; those of the step before that are not in this one are removed."""
    before: set[str] = set()
    for log_ns, stamp_ns, entities in steps:
        names = {one.name for one in entities}
        gone, before = tuple(sorted(before - names)), names
        if entities or gone:
            yield ViewerMessage(log_ns, stamp_ns, topic, Scene(tuple(entities), gone))


def _objects(topic: str, log_ns: IntArray, stamps_ns: IntArray, states: Sequence[Detection]) -> Messages:
    """The states of every log time and stamp."""
    times = list(zip(log_ns.tolist(), stamps_ns.tolist(), strict=True))
    for (log, stamp), rows in groupby(sorted(range(len(times)), key=times.__getitem__), key=times.__getitem__):
        yield ViewerMessage(log, stamp, topic, tuple(states[row] for row in rows))


def _states(states: Table, objects: Table) -> list[Detection]:
    """Pose of each row with its covariance, and class and size of its track, where known."""
    described = {
        track_id: Detection(
            length_m=_known(length_m), width_m=_known(width_m), height_m=_known(height_m), class_name=name
        )
        for track_id, length_m, width_m, height_m, name in _rows(objects, *_OBJECT)
    }
    names = ("p_x_x", "p_x_y", "p_x_yaw", "p_x_y", "p_y_y", "p_y_yaw", "p_x_yaw", "p_y_yaw", "p_yaw_yaw")
    result = []
    for x_m, y_m, yaw_rad, track_id, *covariance in _rows(states, "x_m", "y_m", "yaw_rad", "track_id", *names):
        P = tuple(covariance) if math.isfinite(yaw_rad + sum(covariance)) else None
        pose = {"x_m": x_m, "y_m": y_m, "yaw_rad": _known(yaw_rad), "covariance": P, "object_id": track_id}
        result.append(replace(described.get(track_id, Detection()), **pose))
    return result


def _rows(table: Table, *names: str) -> Iterator[tuple[Any, ...]]:  # Any: values of a row
    return zip(*(table[name].tolist() for name in names), strict=True)


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _point(state: Detection) -> Point:
    return state.x_m or 0.0, state.y_m or 0.0


def _size(state: Detection) -> tuple[float, float, float]:
    """Length, width and height of an object; nominal where unknown."""
    length_m, width_m, height_m = NOMINAL_SIZE_M
    return state.length_m or length_m, state.width_m or width_m, state.height_m or height_m


def _box(centre_m: Point, yaw_rad: float, size_m: tuple[float, float, float], colour: Colour) -> Shape:
    return Shape("cube", colour, size_m, centre_m, size_m[2] / 2.0, yaw_rad)


def _arrow(tail_m: Point, yaw_rad: float, length_m: float, width_m: float, colour: Colour) -> Shape:
    return Shape("arrow", colour, (length_m, width_m, width_m), tail_m, width_m, yaw_rad)


def _line(points_m: Iterable[Sequence[float]], width_m: float, colour: Colour) -> Shape:
    return Shape("line", colour, (width_m, 0.0, 0.0), points_m=[(x_m, y_m) for x_m, y_m in points_m])
