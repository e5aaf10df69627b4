"""The KITTI tracking data set: detections of road users, the ego's motion, and labelled truth at 10 Hz.

Geiger, Lenz, Urtasun, "Are we ready for autonomous driving? The KITTI vision benchmark
suite", CVPR 2012. The folders `oxts/ calib/ label_02/` contain a text file for each
sequence. Every other folder with a file of this name contains the detections of a
sensor, whose name is the folder's name; docs/recordings.md describes the forms.
Conventions that the data set does not specify:

- Frame k is at k x 0.1036 s (`PERIOD_NS`) and received without delay.
- Labels are relative to the ego. The truth uses the ego's dead-reckoned position instead of the reported position.
- The map begins at the ego's first position, in the Mercator projection of the development kit.
- The ego frame is the frame of the inertial unit, levelled by its roll and pitch.
- A bearing starts at camera 2 and is relative to the ego's heading: the sensor's `mount` has no yaw.
- A box at the left or right border of the image shows a part of a car, so its centre is not the car's. It is left out.
- As in the data set's own evaluation, neighbouring classes (a van for a car) are ignored, and `DontCare` regions with
  everything behind them as seen from camera 2.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.geometry import wrap_angle
from fgtrack.core.types import Detection, DetectionList, Frame, Message, TruthState
from fgtrack.inputs.formats.common import reported_as, split
from fgtrack.inputs.formats.kitti_view import CALIB, OXTS, View, lines_of, read_views
from fgtrack.inputs.settings import InputConfig, KittiInput
from fgtrack.inputs.source import FileFormat

_TYPES = (
    "Car",
    "Van",
    "Truck",
    "Pedestrian",
    "Person_sitting",
    "Cyclist",
    "Tram",
    "Misc",
)
CLASS_NAMES: Mapping[str, str] = {name.lower(): name for name in _TYPES}
"""Types of the data set, by the class names of detections."""

_LABELS = "label_02"
#: Fields of class, image box, score and box in space, by the number of fields in a line.
_FORMS = {
    6: (slice(0), slice(1, 5), slice(5, 6), slice(0)),
    15: (slice(1, 2), slice(2, 6), slice(6, 7), slice(7, 14)),
    17: (slice(2, 3), slice(6, 10), slice(0), slice(10, 17)),
    18: (slice(2, 3), slice(6, 10), slice(17, 18), slice(10, 17)),
}
#: Classes by their numbers in AB3DMOT's files.
_CLASSES = {"1": "Pedestrian", "2": "Car", "3": "Cyclist"}
_NEIGHBOURS: Mapping[str, str] = {"Car": "Van", "Pedestrian": "Person_sitting"}
_BORDER_PX = 2.0
#: A box without a position is at -1000.
_NOWHERE_M = -999.0
#: A region begins at the distance where this share of a car of this height fills the region's height.
_CAR_HEIGHT_M = 1.5
_INSIDE = 0.5
#: Distance from camera 2 to the far end of a region.
_FAR_M = 150.0


def read_sequence(
    folder: Path, sequence: str, settings: KittiInput
) -> Iterator[Message]:
    """Yield the messages of `sequence` in receipt order; in a frame the truth, then the ego, then the detections.

    Raises `DataError` if a file is missing; for a damaged line, after all messages of
    earlier frames.
    """
    views, error = read_views(folder, sequence)
    damages = [] if error is None else [(len(views), error)]
    labels = folder / _LABELS / f"{sequence}.txt"
    truth = (
        _by_frame(labels, views, partial(_truth, settings), damages)
        if labels.exists()
        else {}
    )
    sensors = {
        file.parent.name: _by_frame(
            file, views, partial(_detection, settings, file.parent.name), damages
        )
        for file in sorted(folder.glob(f"*/{sequence}.txt"))
        if file.parent.name not in (OXTS, CALIB, _LABELS)
    }
    in_image = {
        name: _in_image(folder / name, frames) for name, frames in sensors.items()
    }
    end, damage = min(damages, key=itemgetter(0), default=(len(views), None))
    for frame, view in enumerate(views[:end]):
        states = [state for state in truth.get(frame, ()) if state is not None]
        regions = [state for state in states if state.outline_m is not None]
        yield from [state for state in states if state.outline_m is None]
        yield from [
            replace(state, object_id=-2 - index) for index, state in enumerate(regions)
        ]
        yield view.ego
        for sensor, frames in sensors.items():
            objects, left_out = split(frames.get(frame, ()))
            refers_to: Frame = "sensor" if in_image[sensor] else "ego"
            yield DetectionList(
                sensor,
                view.ego.stamp_ns,
                view.ego.receipt_ns,
                objects,
                refers_to,
                left_out,
            )
    if damage is not None:
        raise damage


def _by_frame(
    file: Path,
    views: list[View],
    parse: Callable[[View, list[str]], Any],
    damages: list[tuple[int, DataError]],
) -> Mapping[int, list[Any]]:
    """Return the results of `parse` for the lines of `file`, by frame.

    Frame and error of a damaged line are added to `damages`.
    """
    latest = 0
    by_frame = defaultdict(list)
    try:
        for where, fields in lines_of(file):
            # The tracker counts values that are not finite.
            with reported_as(where), np.errstate(all="ignore"):
                frame = int(fields[0])
                latest = max(latest, frame)
                if not 0 <= frame < len(views):
                    raise ValueError(
                        f"frame {frame} does not exist, {OXTS} has {len(views)} frames"
                    )
                by_frame[frame].append(parse(views[frame], fields))
    except DataError as error:
        damages.append((latest, error))
    return by_frame


def _in_image(detector: Path, frames: Mapping[int, list[Detection | str]]) -> bool:
    """True if the detections of a file are bearings from the camera, False if they have positions.

    Raises `DataError` if a file has both.
    """
    kinds = {
        item.x_m is None
        for items in frames.values()
        for item in items
        if isinstance(item, Detection)
    }
    if len(kinds) > 1:
        raise DataError(
            f"{detector}: some boxes have a position, others only a box in the image: put each kind into its own folder"
        )
    return kinds == {True}


def view_of_sequence(path: Path) -> list[View]:
    """Return the ego at every frame of a sequence; `path` is its folder, or its file in `oxts/`.

    Raises the exceptions of `read_sequence`.
    """
    views, error = read_views(*_folder_and_sequence(path))
    if error is not None:
        raise error
    return views


def _folder_and_sequence(
    path: Path, named: int | str | None = None
) -> tuple[Path, str]:
    """Return folder and name of a sequence.

    `path` is the folder, or a file of `oxts/`; `named` is the number or name of the sequence in a folder with several.

    Raises `CallError` if the sequence must be named, or does not exist.
    """
    if path.is_file():
        return path.parent.parent, path.stem
    known = sorted(file.stem for file in (path / OXTS).glob("*.txt"))
    sequence = f"{named:04d}" if isinstance(named, int) else named or known[0]
    if sequence not in known or (named is None and len(known) > 1):
        raise CallError(
            f"{path}: contains the sequences {', '.join(known)}: set input.kitti.sequence, or give the file of one, "
            f"{path / OXTS}/{known[0]}.txt"
        )
    return path, sequence


def is_sequence(path: Path) -> bool:
    """True if `path` is a folder of the data set, or a file in its `oxts/`."""
    folder = path.parent.parent if path.is_file() and path.parent.name == OXTS else path
    return any((folder / OXTS).glob("*.txt")) and (folder / CALIB).is_dir()


def _sequences(path: Path, config: InputConfig) -> Sequence[Path]:
    """Return the files of `oxts/` in a folder with several sequences of which none is named, else `path`."""
    if path.is_file() or config.kitti.sequence is not None:
        return (path,)
    known = sorted((path / OXTS).glob("*.txt"))
    return known if len(known) > 1 else (path,)


def _files(path: Path) -> Iterator[Path]:
    """Yield the files of a sequence, or of all sequences in a folder."""
    if path.is_file():
        return path.parent.parent.glob(f"*/{path.stem}.txt")
    return path.glob("*/*.txt")


FORMAT = FileFormat(
    "a KITTI tracking folder (oxts/, calib/) or the oxts/NNNN.txt of a sequence in it",
    is_sequence,
    lambda path, config: partial(
        read_sequence, *_folder_and_sequence(path, config.kitti.sequence), config.kitti
    ),
    recordings=_sequences,
    files=_files,
)


def _truth(settings: KittiInput, view: View, fields: list[str]) -> TruthState | None:
    """True state of a label's object, or of an ignored region; None for classes that are not read."""
    kind = fields[2]
    ego = view.ego
    if kind == "DontCare":
        return _region(view, *map(float, fields[6:10]))
    ignored = kind in {_NEIGHBOURS.get(name) for name in settings.classes}
    if not ignored and kind not in settings.classes:
        return None
    x_m, y_m, z_m, turned_rad = map(float, fields[13:17])
    position_m, yaw_rad = view.pose(x_m, y_m, z_m, turned_rad)
    x_m, y_m = view.in_map(position_m).tolist()
    yaw_rad = wrap_angle(yaw_rad + ego.yaw_rad)
    return TruthState(
        ego.stamp_ns, ego.receipt_ns, int(fields[1]), x_m, y_m, yaw_rad, ignored=ignored
    )


def _region(
    view: View, left_px: float, top_px: float, right_px: float, bottom_px: float
) -> TruthState:
    near_m = (
        _CAR_HEIGHT_M * _INSIDE * view.projection[1, 1] / max(bottom_px - top_px, 1.0)
    )
    near_m = min(near_m, 0.5 * _FAR_M)
    far_m = _FAR_M
    v_px = 0.5 * (top_px + bottom_px)
    sides = np.array([view.bearing_rad(u_px, v_px) for u_px in (left_px, right_px)])
    rays = np.column_stack([np.cos(sides), np.sin(sides)])
    camera_m = view.position_m(
        (-np.linalg.solve(view.projection[:, :3], view.projection[:, 3])).tolist()
    )
    corners = view.in_map(camera_m[:2] + np.vstack([near_m * rays, far_m * rays[::-1]]))
    x_m, y_m = corners.mean(axis=0).tolist()
    outline_m = tuple(corners.ravel().tolist())
    return TruthState(
        view.ego.stamp_ns,
        view.ego.receipt_ns,
        -2,
        x_m,
        y_m,
        ignored=True,
        outline_m=outline_m,
    )


def _detection(
    settings: KittiInput, sensor: str, view: View, fields: list[str]
) -> Detection | str:
    """Return the detection of a line, or the setting that excludes it. Raises `ValueError` for a malformed line."""
    if len(fields) not in _FORMS:
        raise ValueError(
            f"it has {len(fields)} fields instead of 6 (a box in the image), 15 (AB3DMOT), 17 or 18 (KITTI)"
        )
    kinds, image, scores, space = (fields[part] for part in _FORMS[len(fields)])
    kind = _CLASSES.get(kinds[0], kinds[0]) if kinds else ""
    score = float(scores[0]) if scores else None
    if kind and kind not in settings.classes:
        return "input.kitti.classes"
    if score is not None and score < settings.min_score.get(sensor, -math.inf):
        return "input.kitti.min_score"
    box = partial(Detection, score=score, class_name=kind.lower() or None)
    if space and not float(space[3]) < _NOWHERE_M:
        height_m, width_m, length_m = map(float, space[:3])
        position_m, yaw_rad = view.pose(*map(float, space[3:]))
        x_m, y_m, bottom_m = position_m.tolist()
        z_m = bottom_m + 0.5 * height_m
        return box(
            x_m,
            y_m,
            yaw_rad,
            z_m=z_m,
            length_m=length_m,
            width_m=width_m,
            height_m=height_m,
        )
    left_px, top_px, right_px, bottom_px = map(float, image)
    if left_px < _BORDER_PX or right_px > settings.image_width_px - 1.0 - _BORDER_PX:
        return "input.kitti.image_width_px"
    v_px = 0.5 * (top_px + bottom_px)
    covariance = None
    if settings.box_std is not None:
        width_rad = view.bearing_rad(left_px, v_px) - view.bearing_rad(right_px, v_px)
        covariance = ((settings.box_std * width_rad) ** 2,)
    return box(
        bearing_rad=view.bearing_rad(0.5 * (left_px + right_px), v_px),
        covariance=covariance,
    )
