"""Tracks in a viewer: where they are at every tick, how sure that is, their past as later measurements correct it."""

import math
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from fgtrack.core.time import nanoseconds
from fgtrack.core.types import Detection, DetectionList, FloatArray, IntArray
from fgtrack.io.run import Run, Table
from fgtrack.viewers.ellipse import ellipses
from fgtrack.viewers.look import Look, faded, patch, size
from fgtrack.viewers.shapes import Entity, Line, Objects, Point, Scene, ViewerMessage
from fgtrack.viewers.surroundings import groups

_DEFAULT_LAG_S = 1.0  # of `smoother.lag_s`, where the configuration does not say
_PART = 20  # states of a line of final states; it is sent anew with each of them
_TRAIL_S = 10.0  # how long such a line is shown
_LINE_M = 0.35
_NO_ROWS = np.zeros(0, dtype=np.int64)


def track_messages(run: Run, look: Look) -> Iterator[ViewerMessage]:
    """At every tick the boxes, names and speeds, the 2-sigma ellipses of the positions, and the poses."""
    tracks = _placed(run.tracks)
    states, axes = _detections(tracks, run.objects), ellipses(position_covariances(tracks)).tolist()
    names = ("track_id", "stamp_ns", "status", "speed_mps", "num_measured")
    columns = [tracks[name].tolist() for name in names]
    by_tick = dict(groups(tracks["now_ns"]))
    before: frozenset[str] = frozenset()
    for now_ns in sorted({*run.timing["now_ns"].tolist(), *by_tick}):
        boxes, patches = [], []
        poses: defaultdict[int, list[Detection]] = defaultdict(list)
        for row in by_tick.get(now_ns, _NO_ROWS).tolist():
            track_id, stamp_ns, status, speed_mps, num_measured = (column[row] for column in columns)
            name, colour = f"track {track_id}", look.of_track(track_id)
            facts = {"status": status, "speed": f"{speed_mps:.2f} m/s", "measured": str(num_measured)}
            if class_name := states[row].class_name:
                facts["class"] = class_name
            shapes = look.track(track_id, states[row], speed_mps, status)
            boxes.append(Entity(name, shapes, facts=facts))
            if math.isfinite(axes[row][0]):
                ellipse = patch(_point(states[row]), size(states[row])[2], axes[row], faded(colour, 0.6))
                patches.append(Entity(name, (ellipse,)))
            poses[stamp_ns].append(states[row])
        present = frozenset(one.name for one in boxes)
        gone = tuple(sorted(before - present))
        before = present
        stamp_ns = max(poses, default=now_ns)
        for topic, entities in (("tracks", boxes), ("ellipses", patches)):
            if entities or gone:
                yield Scene(f"{look.prefix}/{topic}", now_ns, stamp_ns, tuple(entities), gone)
        yield from _objects(f"{look.prefix}/tracks", now_ns, poses)


def past_messages(run: Run, look: Look) -> Iterator[Scene]:
    """At every tick the past of each track as it is known then: a line through its lagged states to the present one."""
    lagged = _placed(run.lagged.where(run.lagged["lag_s"] > 0.0))
    tracks = _placed(run.tracks)
    keys = zip(tracks["now_ns"].tolist(), tracks["track_id"].tolist(), strict=True)
    present = dict(zip(keys, _points(tracks), strict=True))
    past_m, track_ids = _points(lagged), lagged["track_id"].tolist()
    before: frozenset[str] = frozenset()
    for now_ns, rows in groups(lagged["now_ns"]):
        lines: defaultdict[int, list[Point]] = defaultdict(list)
        for row in rows[np.argsort(lagged["stamp_ns"][rows], kind="stable")].tolist():
            lines[track_ids[row]].append(past_m[row])
        entities = []
        for track_id, points_m in sorted(lines.items()):
            points_m += [present[now_ns, track_id]] if (now_ns, track_id) in present else []
            if len(points_m) > 1:
                line = Line(tuple(points_m), _LINE_M, look.of_track(track_id))
                entities.append(Entity(f"track {track_id}", (line,)))
        names = frozenset(one.name for one in entities)
        gone = tuple(sorted(before - names))
        before = names
        if entities or gone:
            yield Scene(f"{look.prefix}/past", now_ns, now_ns, tuple(entities), gone)


def smoothed_messages(run: Run, look: Look) -> Iterator[ViewerMessage]:
    """Final states as soon as nothing can change them any more, and lines through those of the last seconds.

    A state is final when its stamp has left the window of `smoother.lag_s`, or when its track has ended.
    """
    final = _placed(run.smoothed.where(run.smoothed["kind"] == "final"))
    states = _detections(final, run.objects)
    stamps_ns, track_ids = final["stamp_ns"].tolist(), final["track_id"].tolist()
    lines: defaultdict[int, list[Point]] = defaultdict(list)
    for log_ns, rows in groups(final_ns(run, final)):
        poses: defaultdict[int, list[Detection]] = defaultdict(list)
        for row in rows[np.argsort(final["stamp_ns"][rows], kind="stable")].tolist():
            poses[stamps_ns[row]].append(states[row])
            lines[track_ids[row]].append(_point(states[row]))
        changed = sorted({track_ids[row] for row in rows.tolist()})
        entities = tuple(entity for track_id in changed for entity in _trail(track_id, lines[track_id], look))
        if entities:
            yield Scene(f"{look.prefix}/smoothed", log_ns, max(poses), entities)
        yield from _objects(f"{look.prefix}/smoothed", log_ns, poses)


def _objects(topic: str, log_ns: int, by_stamp: Mapping[int, list[Detection]]) -> Iterator[Objects]:
    for stamp_ns, objects in sorted(by_stamp.items()):
        yield Objects(topic, DetectionList("tracks", stamp_ns, log_ns, objects, "map"))


def _trail(track_id: int, points_m: list[Point], look: Look) -> Iterator[Entity]:
    """The newest part of a line; parts have a point in common, so the line has no gaps."""
    part = (len(points_m) - 2) // _PART
    part_m = points_m[max(part, 0) * _PART :]
    if len(part_m) > 1:
        line = Line(tuple(part_m), _LINE_M, faded(look.of_track(track_id), 0.7))
        yield Entity(f"track {track_id} part {part}", (line,), lifetime_s=_TRAIL_S)


def final_ns(run: Run, final: Table) -> IntArray:
    """When each row of `final` was known to be final, shape (n,)."""
    lag_s = (run.config.get("smoother") or {}).get("lag_s", _DEFAULT_LAG_S)
    ends = {track_id: int(run.tracks["now_ns"][rows].max()) for track_id, rows in groups(run.tracks["track_id"])}
    left_ns = final["stamp_ns"] + nanoseconds(float(lag_s))
    known_ns = left_ns.copy()
    for track_id, rows in groups(final["track_id"]):
        known_ns[rows] = np.minimum(left_ns[rows], ends.get(track_id, left_ns[rows].max()))
    return np.asarray(np.maximum(known_ns, final["stamp_ns"]))


def _placed(table: Table) -> Table:
    """The rows whose position is a number."""
    return table.where(np.isfinite(table["x_m"]) & np.isfinite(table["y_m"]))


def position_covariances(states: Table) -> FloatArray:
    """Covariances of x and y, shape (n, 2, 2)."""
    xx, xy, yy = (states[name] for name in ("p_x_x", "p_x_y", "p_y_y"))
    return np.stack([np.stack([xx, xy], axis=-1), np.stack([xy, yy], axis=-1)], axis=-2)


def _points(states: Table) -> list[Point]:
    return list(zip(states["x_m"].tolist(), states["y_m"].tolist(), strict=True))


def _point(state: Detection) -> Point:
    assert state.x_m is not None
    assert state.y_m is not None
    return state.x_m, state.y_m


def _detections(states: Table, objects: Table) -> list[Detection]:
    """The pose of each row, with its covariance where that is known, and what `objects` says of its track."""
    names = ("p_x_x", "p_x_y", "p_x_yaw", "p_x_y", "p_y_y", "p_y_yaw", "p_x_yaw", "p_y_yaw", "p_yaw_yaw")
    P = np.stack([states[name] for name in names], axis=-1)
    sure = np.isfinite(P).all(axis=1) & np.isfinite(states["yaw_rad"])
    columns = (states[name].tolist() for name in ("x_m", "y_m", "yaw_rad", "track_id"))
    told = _told(objects)
    return [
        replace(
            told.get(track_id, Detection()),
            x_m=x_m,
            y_m=y_m,
            yaw_rad=yaw_rad if math.isfinite(yaw_rad) else None,
            covariance=tuple(covariance) if known else None,
            object_id=track_id,
        )
        for x_m, y_m, yaw_rad, track_id, covariance, known in zip(*columns, P.tolist(), sure.tolist(), strict=True)
    ]


def _told(objects: Table) -> dict[int, Detection]:
    """Class and size of each track, where known."""
    sizes_m = np.stack([objects[name] for name in ("length_m", "width_m", "height_m")], axis=-1).tolist()
    rows = zip(objects["track_id"].tolist(), sizes_m, objects["class_name"].tolist(), strict=True)
    found = {}
    for track_id, size_m, class_name in rows:
        length_m, width_m, height_m = (one if math.isfinite(one) else None for one in size_m)
        found[track_id] = Detection(
            length_m=length_m, width_m=width_m, height_m=height_m, class_name=class_name or None
        )
    return found
