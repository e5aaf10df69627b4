"""Detections in a viewer: where they were, what became of them, and how far the object has gone since."""

import math
from collections.abc import Iterator
from itertools import groupby
from operator import itemgetter

import numpy as np

from fgtrack.core.time import seconds
from fgtrack.core.types import FUSED, LATE, Detection, DetectionList, Disposition
from fgtrack.evaluation.placement import Placed, placed, update_rows
from fgtrack.io.ros.bag_writer import token
from fgtrack.io.run import NO_TRACK, Run
from fgtrack.viewers.look import GREY, Look, faded
from fgtrack.viewers.shapes import Arrow, Dot, Entity, Facts, Line, Objects, Point, Scene, Shape, ViewerMessage

_SHOWN_S = 0.5  # how long a list is shown that no later one of its sensor replaces
_DOT_M = 1.0
_BEARING_M = 150.0  # length of the line of sight of a detection without a range
_COUNTED = (*FUSED, Disposition.MERGED)


def detection_messages(run: Run, look: Look) -> Iterator[ViewerMessage]:
    """At every receipt of a list: its detections, grey where none was used, and arrows to their objects.

    An arrow leads from where a detection was sensed to where its track is at the tick that fused it. It is strong where
    the detection came out of sequence, and faint where it did not.
    """
    table, updates = run.detections, run.updates
    where, became = placed(run), update_rows(run)
    sensors = {name: k for k, name in enumerate(np.unique(table["sensor"]).tolist())}
    keys = list(zip(*(table[name].tolist() for name in ("receipt_ns", "sensor", "stamp_ns")), strict=True))
    order = sorted(range(len(keys)), key=keys.__getitem__)
    now_at = track_positions(run)
    told = updates["disposition"].tolist()
    dispositions = [told[row] if row >= 0 else "" for row in became.tolist()]
    for (receipt_ns, sensor, stamp_ns), group in groupby(order, key=keys.__getitem__):
        colour = look.of_sensor(sensors[sensor])
        shapes: list[Shape] = []
        arrows: list[Shape] = []
        objects = []
        for row in group:
            disposition = dispositions[row]
            shapes += _shape(where, row, colour if disposition in _COUNTED else GREY)
            x_m, y_m = where.position_m[row].tolist()
            if not math.isfinite(x_m + y_m):
                continue
            yaw_rad = float(where.yaw_rad[row])
            objects.append(Detection(x_m, y_m, yaw_rad if math.isfinite(yaw_rad) else None))
            end_m = None
            if disposition in FUSED:
                end_m = now_at.get((int(updates["tick"][became[row]]), int(updates["track_id"][became[row]])))
            if end_m is not None and receipt_ns > stamp_ns and end_m != (x_m, y_m):
                arrows.append(Arrow((x_m, y_m), end_m, 0.3, faded(colour, 1.0 if disposition in LATE else 0.3)))
        topic = f"{look.prefix}/detections"
        yield Scene(topic, receipt_ns, stamp_ns, (Entity(sensor, tuple(shapes), _SHOWN_S),))
        yield Objects(f"{topic}/{token(sensor)}", DetectionList(sensor, stamp_ns, receipt_ns, objects, "map"))
        if arrows:
            yield Scene(f"{look.prefix}/arrivals", receipt_ns, stamp_ns, (Entity(sensor, tuple(arrows), _SHOWN_S),))


def outcome_messages(run: Run, look: Look) -> Iterator[Facts]:
    """What became of every detection, as `updates.csv` has it, at its receipt."""
    updates = run.updates
    names = ("receipt_ns", "stamp_ns", "sensor", "index", "disposition", "track_id", "nis")
    rows = zip(*(updates[name].tolist() for name in names), strict=True)
    for receipt_ns, stamp_ns, sensor, index, disposition, track_id, nis in sorted(rows, key=itemgetter(0)):
        values = {
            "sensor": sensor,
            "index": index,
            "disposition": disposition,
            "track_id": None if track_id == NO_TRACK else track_id,
            "delay_s": seconds(receipt_ns - stamp_ns),
            "nis": nis if math.isfinite(nis) else None,
        }
        yield Facts(f"{look.prefix}/outcomes", receipt_ns, stamp_ns, values)


def _shape(where: Placed, row: int, colour: tuple[float, float, float, float]) -> list[Shape]:
    """A ball where a detection was, or a line of sight where only its direction is known."""
    x_m, y_m = where.position_m[row].tolist()
    if math.isfinite(x_m + y_m):
        return [Dot((x_m, y_m), _DOT_M, colour)]
    (from_x_m, from_y_m), bearing_rad = where.sensor_m[row].tolist(), float(where.bearing_rad[row])
    if not math.isfinite(from_x_m + from_y_m + bearing_rad):
        return []
    end_m = from_x_m + _BEARING_M * math.cos(bearing_rad), from_y_m + _BEARING_M * math.sin(bearing_rad)
    return [Line(((from_x_m, from_y_m), end_m), 0.15, faded(colour, 0.5))]


def track_positions(run: Run) -> dict[tuple[int, int], Point]:
    """Positions of the tracks by tick and track."""
    names = ("tick", "track_id", "x_m", "y_m")
    rows = zip(*(run.tracks[name].tolist() for name in names), strict=True)
    return {(tick, track_id): (x_m, y_m) for tick, track_id, x_m, y_m in rows if math.isfinite(x_m + y_m)}
