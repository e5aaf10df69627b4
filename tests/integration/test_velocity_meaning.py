"""Velocities of drafted tables are read by their agreement with the positions, whatever their columns are called."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from fgtrack.inputs.formats.fields import paths_of
from fgtrack.inputs.settings import Field, FieldPath
from fgtrack.meaning.decision import Decision
from fgtrack.meaning.draft import opened

Columns = Callable[[np.ndarray, np.ndarray, np.ndarray], Sequence[float]]
"""Cells from the position, the velocity relative to the ego and the velocity over ground, all in the ego frame."""

KMH = 3.6
KNOTS = 1.943846


def write(folder: Path, names: str, cells: Columns, ego_mps: float = 9.0) -> Path:
    """A folder with an ego on a bend and a radar with three cars, for 20 s."""
    rng = np.random.default_rng(3)
    ego = ["time,x,y,yaw,speed"]
    radar = [names]
    rate = 0.06
    for k in range(200):
        t = 0.1 * k
        yaw = rate * t
        x, y = ego_mps / rate * np.array([math.sin(yaw), 1.0 - math.cos(yaw)])
        ego.append(f"{1e9 + t:.3f},{x},{y},{yaw},{ego_mps}")
        for x0, y0, heading, speed in (
            (20.0, 4.0, 0.2, 11.0),
            (55.0, -15.0, 1.4, 6.0),
            (80.0, 6.0, 3.0, 8.0),
        ):
            c, s = math.cos(yaw), math.sin(yaw)
            to_ego = np.array([[c, s], [-s, c]])
            velocity = speed * np.array([math.cos(heading), math.sin(heading)])
            at = to_ego @ (np.array([x0, y0]) + velocity * t - [x, y])
            over_ground = to_ego @ velocity
            seen = at + rng.normal(0.0, 0.2, 2)
            noise = rng.normal(0.0, 0.1, 2)
            row = cells(seen, over_ground - [ego_mps, 0.0] + noise, over_ground + noise)
            radar.append(",".join(map(str, [round(1e9 + t, 3), *row])))
    (folder / "ego.csv").write_text("\n".join(ego) + "\n")
    (folder / "radar.csv").write_text("\n".join(radar) + "\n")
    return folder


def read(path: Path) -> tuple[dict[str, FieldPath], Decision]:
    draft = opened(path)
    [decision] = [each for each in draft.decisions if each.what == "velocity"]
    return dict(draft.config.input.csv.detections["radar"].columns), decision


@pytest.mark.parametrize(
    ("names", "cells", "component", "paths", "scale"),
    [
        (
            "t,DistLong,DistLat,VrelLong,VrelLat",
            lambda at, rel, over: (*at, *rel),
            "range_rate_mps",
            ["VrelLong", "VrelLat"],
            1.0,
        ),
        (
            "t,x,y,vx,vy",
            lambda at, rel, over: (*at, *rel),
            "range_rate_mps",
            ["vx", "vy"],
            1.0,
        ),
        (
            "t,x,y,vx,vy",
            lambda at, rel, over: (*at, *over),
            "speed_mps",
            ["vx", "vy"],
            1.0,
        ),
        (
            "t,x,y,vx_rel,vy_rel",
            lambda at, rel, over: (*at, *(KMH * rel)),
            "range_rate_mps",
            ["vx_rel", "vy_rel"],
            1.0 / KMH,
        ),
        (
            "t,x,y,rel_vel_x,rel_vel_y",
            lambda at, rel, over: (*at, *over),
            "speed_mps",
            ["rel_vel_x", "rel_vel_y"],
            1.0,
        ),
        (
            "t,x,y,speed",
            lambda at, rel, over: (*at, KNOTS * np.hypot(*over)),
            "speed_mps",
            ["speed"],
            1.0 / KNOTS,
        ),
        (
            "t,x,y,speed",
            lambda at, rel, over: (*at, at @ rel / np.hypot(*at)),
            "range_rate_mps",
            ["speed"],
            1.0,
        ),
        (
            "t,range,azimuth,doppler_velocity",
            lambda at, rel, over: (
                np.hypot(*at),
                math.atan2(at[1], at[0]),
                at @ rel / np.hypot(*at),
            ),
            "range_rate_mps",
            ["doppler_velocity"],
            1.0,
        ),
        (
            "t,x,y,closing_speed_kmh",
            lambda at, rel, over: (*at, -KMH * (at @ rel) / np.hypot(*at)),
            "range_rate_mps",
            ["closing_speed_kmh"],
            -1.0 / KMH,
        ),
        (
            "t,dx,dy,vrel_x,vrel_y",
            lambda at, rel, over: (*at, *-rel),
            "range_rate_mps",
            ["vrel_x", "vrel_y"],
            -1.0,
        ),
    ],
)
def test_a_velocity_is_read_as_it_agrees_with_the_positions(
    tmp_path: Path,
    names: str,
    cells: Columns,
    component: str,
    paths: list[str],
    scale: float,
) -> None:
    mapping, decision = read(write(tmp_path, names, cells))
    found = {"speed_mps", "range_rate_mps"} & mapping.keys()
    assert found == {component}
    path = mapping[component]
    assert paths_of(path) == paths
    assert (path.scale if isinstance(path, Field) else 1.0) == pytest.approx(scale)
    assert "m/s" in decision.reason


@pytest.mark.parametrize(
    ("names", "cells"),
    [
        ("t,x,y,rel_speed", lambda at, rel, over: (*at, np.hypot(*rel))),
        ("t,x,y,vx,vy", lambda at, rel, over: (*at, at[0] % 7.0, at[1] % 5.0)),
        (
            "t,x,y,doppler",
            lambda at, rel, over: (*at, at @ over / np.hypot(*at)),
        ),
    ],
)
def test_a_velocity_that_cannot_be_used_is_left_out_with_a_reason(
    tmp_path: Path, names: str, cells: Columns
) -> None:
    mapping, decision = read(write(tmp_path, names, cells))
    assert {"speed_mps", "range_rate_mps"}.isdisjoint(mapping)
    assert "not used" in decision.reason


def test_the_mapping_of_the_user_stays(tmp_path: Path) -> None:
    from fgtrack.config.settings import Config
    from fgtrack.inputs.settings import CsvInput, CsvTable, InputConfig

    write(tmp_path, "t,x,y,vx,vy", lambda at, rel, over: (*at, *rel))
    radar = CsvTable(
        {"stamp": "t", "x_m": "x", "y_m": "y", "speed_mps": ["vx", "vy"]}, "radar.csv"
    )
    ego = CsvTable(
        {
            "stamp": "time",
            "x_m": "x",
            "y_m": "y",
            "yaw_rad": "yaw",
            "speed_mps": "speed",
        },
        "ego.csv",
    )
    config = Config(input=InputConfig(csv=CsvInput(ego, {"radar": radar})))
    draft = opened(tmp_path, config)
    assert draft.config.input.csv.detections["radar"].columns == radar.columns
