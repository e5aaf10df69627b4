"""What the runs of a recording share: the map, the ego, the truth."""

from collections.abc import Iterator, Sequence

import numpy as np

from fgtrack.core.types import EGO_ID, STATE_NAMES, Detection, DetectionList, EgoState, FloatArray, IntArray
from fgtrack.evaluation.roads import road_lines
from fgtrack.io.run import Run, Table
from fgtrack.models.track_map import TrackMap
from fgtrack.viewers.look import GREY, WHITE, car, faded
from fgtrack.viewers.shapes import EgoMotion, Entity, Line, Objects, Scene, ViewerMessage


def start_ns(run: Run) -> int:
    """The earliest time of the run: of a tick, a receipt or the truth; 0 where it holds nothing."""
    columns = (run.timing["now_ns"], run.ego["receipt_ns"], run.detections["receipt_ns"], run.truth["stamp_ns"])
    return min((int(column.min()) for column in columns if len(column)), default=0)


def map_scene(maps: dict[str, TrackMap], excluded: Sequence[FloatArray], at_ns: int) -> Iterator[Scene]:
    """The bounds of the road and its reference line, and the `excluded_lines`, told once."""
    colours = (GREY, GREY, faded(GREY, 0.3))
    entities = []
    for name, one in maps.items():
        lines = [_line(points_m, 0.3, colour) for points_m, colour in zip(road_lines(one), colours, strict=True)]
        entities.append(Entity(name, tuple(lines)))
    if excluded:
        entities.append(Entity("excluded", tuple(_line(points_m, 0.3, faded(GREY, 0.6)) for points_m in excluded)))
    if entities:
        yield Scene("/map", at_ns, at_ns, tuple(entities), lasting=True)


def ego_messages(ego: Table, at_ns: int) -> Iterator[ViewerMessage]:
    """The box of the ego in its own frame, told once, and its motion at every receipt."""
    rows = np.flatnonzero(np.isfinite(np.stack([ego[name] for name in STATE_NAMES[:3]])).all(axis=0))
    rows = rows[np.argsort(ego["receipt_ns"][rows], kind="stable")]
    if not len(rows):
        return
    yield Scene("/ego", at_ns, at_ns, (Entity("ego", (car((0.0, 0.0), 0.0, WHITE),), frame="ego"),), lasting=True)
    times = zip(ego["stamp_ns"][rows].tolist(), ego["receipt_ns"][rows].tolist(), strict=True)
    states = np.stack([np.nan_to_num(ego[name][rows]) for name in STATE_NAMES], axis=-1).tolist()
    for (stamp_ns, receipt_ns), state in zip(times, states, strict=True):
        yield EgoMotion(EgoState(stamp_ns, receipt_ns, **dict(zip(STATE_NAMES, state, strict=True))))


def truth_messages(truth: Table) -> Iterator[ViewerMessage]:
    """True poses of the objects at every stamp; the ego is not among them."""
    table = truth.where((truth["object_id"] != EGO_ID) & np.isfinite(truth["x_m"]) & np.isfinite(truth["y_m"]))
    before: frozenset[str] = frozenset()
    colour = faded(WHITE, 0.35)
    for stamp_ns, rows in groups(table["stamp_ns"]):
        objects, entities = [], []
        part = [table[name][rows].tolist() for name in ("object_id", "x_m", "y_m", "yaw_rad")]
        for object_id, x_m, y_m, yaw_rad in zip(*part, strict=True):
            known = yaw_rad == yaw_rad
            objects.append(Detection(x_m, y_m, yaw_rad if known else None, object_id=object_id))
            entities.append(Entity(f"object {object_id}", (car((x_m, y_m), yaw_rad if known else 0.0, colour),)))
        names = frozenset(one.name for one in entities)
        yield Scene("/truth", stamp_ns, stamp_ns, tuple(entities), tuple(sorted(before - names)))
        yield Objects("/truth", DetectionList("truth", stamp_ns, stamp_ns, objects, "map"))
        before = names


def groups(keys: IntArray) -> Iterator[tuple[int, IntArray]]:
    """Every value of `keys`, shape (n,), in rising order, with its rows in their order."""
    order = np.argsort(keys, kind="stable")
    values, starts = np.unique(keys[order], return_index=True)
    if len(values):
        yield from zip(values.tolist(), np.split(order, starts[1:]), strict=True)


def _line(points_m: FloatArray, width_m: float, colour: tuple[float, float, float, float]) -> Line:
    return Line(tuple((x_m, y_m) for x_m, y_m in points_m.tolist()), width_m, colour)
