"""Result file of a run for a KITTI sequence, for the evaluation of the data set and of AB3DMOT.

Each line is a track in a frame: `frame track type truncated occluded alpha left top
right bottom h w l x y z rotation_y score` (Geiger, Lenz and Urtasun 2012, development
kit of the tracking benchmark). Position and heading come from the track. The score is
the existence probability of the track, if it has one. Size, height and class, and else
the score, come from the detections that it has fused so far. The image box is the
projection of the 3D box into camera 2.
"""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.geometry import rotation, wrap_angle
from fgtrack.core.output import check_no_overlap, write_file
from fgtrack.core.time import NS_PER_S
from fgtrack.evaluation.matching import confirmed
from fgtrack.evaluation.placement import update_rows
from fgtrack.evaluation.settings import evaluation_settings
from fgtrack.evaluation.truth import ego_states
from fgtrack.inputs.formats.kitti import CLASS_NAMES, is_sequence, view_of_sequence
from fgtrack.inputs.formats.kitti_view import PERIOD_NS, Box, View
from fgtrack.runs import NO_TRACK, Run

_MEANS = ["height_m", "width_m", "length_m", "score"]
_BOX = [*_MEANS[:3], "z_m"]
DataFrame = Any  # of pandas, which is untyped


def write_kitti_result(
    run: Run, sequence: Path, out: Path, *, overwrite: bool = False
) -> tuple[int, int, int]:
    """Write the tracks of `run` at the frames of `sequence` to the file `out`.

    `sequence` is the sequence's file in `oxts/`, or a folder with one sequence. Returns
    the numbers of boxes, of tracks with a box, and of tracks without a size.

    Raises `CallError` if `sequence` is another file, or if `out` exists or lies in an
    input. Raises `DataError` if no detection has a size.
    """
    if not is_sequence(sequence):
        raise CallError(
            f"{sequence}: not a sequence of the KITTI data set, give its oxts/NNNN.txt"
        )
    check_no_overlap(out, [sequence, *(() if run.path is None else (run.path,))])
    views = _with_ego_positions(run, view_of_sequence(sequence))
    states = _states(run, len(views))
    without = set(states["track_id"][states["length_m"].isna()])
    lines = []
    tracks = set()
    for state in states.dropna(subset=_BOX).to_dict("records"):
        if (line := _line(state, views[state["frame"]])) is not None:
            lines.append(line)
            tracks.add(state["track_id"])
    if not lines and without:
        raise DataError(
            f"{run.path}: no detection of its tracks has a size for a box (detections.csv): replay detections with "
            "length_m, width_m, height_m and z_m"
        )
    write_file(out, "".join(lines), overwrite)
    return len(lines), len(tracks), len(without - tracks)


def _with_ego_positions(run: Run, views: list[View]) -> list[View]:
    """Return `views` with the ego positions of ego.csv, the frame of the tracks."""
    frames_ns = np.arange(len(views)) * PERIOD_NS
    positions = ego_states(run.tables["ego"], frames_ns)[:, :2].tolist()
    return [
        view
        if math.isnan(x_m)
        else view._replace(ego=replace(view.ego, x_m=x_m, y_m=y_m))
        for view, (x_m, y_m) in zip(views, positions, strict=True)
    ]


def _states(run: Run, num_frames: int) -> DataFrame:
    """Return the tracks at the newest tick of every frame, predicted to the frame, with their boxes.

    The boxes come from the detections fused so far.
    """
    timing = run.timing.assign(
        frame=-(-run.timing["now_ns"] // PERIOD_NS)
    ).drop_duplicates("frame", keep="last")
    timing = timing[timing["frame"].between(0, num_frames - 1)][["tick", "frame"]]
    tracks = (
        run.tracks[confirmed(run.tables["tracks"])]
        if evaluation_settings(run).confirmed_only
        else run.tracks
    )
    states = (
        tracks.fillna(0.0)
        .assign(score=tracks["score"])
        .merge(timing, on="tick")
        .sort_values("tick", kind="stable")
    )
    ahead_s = (states["frame"] * PERIOD_NS - states["now_ns"]) / NS_PER_S
    turned_rad = ahead_s * states["yaw_rate_radps"]
    way_m = ahead_s * states["speed_mps"]
    middle_rad = states["yaw_rad"] + 0.5 * turned_rad
    moved = {
        "x_m": states["x_m"] + way_m * np.cos(middle_rad),
        "y_m": states["y_m"] + way_m * np.sin(middle_rad),
    }
    states = states.assign(**moved, yaw_rad=states["yaw_rad"] + turned_rad)
    states = pd.merge_asof(
        states, _boxes(run), on="tick", by="track_id", suffixes=("", "_of_detections")
    )
    return states.assign(
        score=states["score"].fillna(states.pop("score_of_detections"))
    )


def _boxes(run: Run) -> DataFrame:
    """Return the box of each track by tick, from the detections that the track has fused so far.

    Size and score are means, the class is the most frequent one, and the height is the
    last one.
    """
    rows = update_rows(run)
    updates = run.updates.iloc[rows[rows >= 0]][["tick", "track_id"]].reset_index(
        drop=True
    )
    boxes = (
        run.detections[rows >= 0][[*_BOX, "score", "class_name"]]
        .reset_index(drop=True)
        .join(updates)
    )
    boxes = (
        boxes[boxes["track_id"] != NO_TRACK]
        .sort_values("tick", kind="stable")
        .reset_index(drop=True)
    )
    boxes.loc[boxes[_BOX].isna().any(axis=1), [*_MEANS, "z_m"]] = np.nan
    kinds = pd.get_dummies(boxes["class_name"]).drop(columns="", errors="ignore")
    kinds = (
        kinds.assign(car=kinds.get("car", False)).groupby(boxes["track_id"]).cumsum()
    )
    groups = boxes.groupby("track_id")
    boxes[_MEANS] = groups[_MEANS].expanding().mean().droplevel(0)
    boxes["z_m"] = groups["z_m"].ffill()
    boxes["score"] = boxes["score"].fillna(1.0)
    return boxes.assign(class_name=kinds.idxmax(axis=1).where(kinds.any(axis=1), "car"))


def _line(state: dict[str, Any], view: View) -> str | None:
    """Return the line of a track; None if it is outside the image of camera 2."""
    ego = view.ego
    height_m = state["height_m"]
    in_ego_m = np.array([state["x_m"] - ego.x_m, state["y_m"] - ego.y_m]) @ rotation(
        ego.yaw_rad
    )
    bottom_m = np.append(in_ego_m, state["z_m"] - 0.5 * height_m)
    position_m, turned_rad = view.rectified(bottom_m, state["yaw_rad"] - ego.yaw_rad)
    right_m, down_m, forward_m = position_m.tolist()
    box = Box(
        height_m,
        state["width_m"],
        state["length_m"],
        right_m,
        down_m,
        forward_m,
        turned_rad,
    )
    image = box.image_px(view.projection)
    if image is None:
        return None
    numbers = (
        wrap_angle(turned_rad - math.atan2(box.x_m, box.z_m)),
        *image,
        *box,
        state["score"],
    )
    name = f"{state['frame']} {state['track_id']}"
    kind = CLASS_NAMES.get(state["class_name"], state["class_name"])
    return f"{name} {kind} -1 -1 {' '.join(f'{value:.6f}' for value in numbers)}\n"
