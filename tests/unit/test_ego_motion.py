"""Speed, heading and yaw rate of the ego from its successive poses."""

import math
from dataclasses import replace

import numpy as np
import pytest

from fgtrack.core.types import EgoState
from fgtrack.inputs.formats.ego_motion import (
    EgoMotion,
    completed_states,
    missing_motion,
)
from fgtrack.inputs.settings import CsvInput, CsvTable, InputConfig
from fgtrack.inputs.source import open_input

MISSING = {"yaw_rad": math.nan, "speed_mps": math.nan, "yaw_rate_radps": 0.0}


def circle(speed_mps=10.0, rate_radps=0.2, hz=10.0, count=100, start_s=0.0):
    """States on a circle, without noise, driven from rest at `start_s`."""
    states = []
    for k in range(count):
        t_s = k / hz
        driven_s = max(t_s - start_s, 0.0)
        yaw_rad = rate_radps * driven_s
        radius_m = speed_mps / rate_radps
        states.append(
            EgoState(
                round(t_s * 1e9),
                round(t_s * 1e9),
                radius_m * math.sin(yaw_rad),
                radius_m * (1.0 - math.cos(yaw_rad)),
                math.remainder(yaw_rad, math.tau),
                speed_mps if driven_s > 0.0 else 0.0,
                rate_radps if driven_s > 0.0 else 0.0,
            )
        )
    return states


def errors(found, true):
    return [
        max(
            abs(math.remainder(getattr(a, name) - getattr(b, name), math.tau))
            if name == "yaw_rad"
            else abs(getattr(a, name) - getattr(b, name))
            for a, b in zip(found, true, strict=True)
        )
        for name in ("yaw_rad", "speed_mps", "yaw_rate_radps")
    ]


@pytest.mark.parametrize("hz", [1.0, 5.0, 10.0, 50.0, 200.0])
@pytest.mark.parametrize("speed_mps", [-3.0, 2.0, 10.0, 40.0])
def test_speed_and_yaw_rate_follow_from_poses(hz, speed_mps):
    true = circle(speed_mps, hz=hz)
    given = [replace(each, speed_mps=math.nan, yaw_rate_radps=0.0) for each in true]
    motion = EgoMotion(missing_motion(("x_m", "y_m", "yaw_rad")))
    found = [motion.completed(each) for each in given]
    assert math.isnan(found[0].speed_mps)
    yaw, speed, rate = errors(found[1:], true[1:])
    assert yaw == 0.0
    assert speed < 0.01 * abs(speed_mps)
    assert rate < 1e-9


@pytest.mark.parametrize("hz", [2.0, 10.0, 50.0])
@pytest.mark.parametrize("rate_radps", [1e-6, 0.2, -0.4])
def test_the_heading_follows_from_positions_also_on_a_bend(hz, rate_radps):
    true = circle(12.0, rate_radps, hz)
    given = [replace(each, **MISSING) for each in true]
    found = completed_states(given, missing_motion(("x_m", "y_m")))
    begin = max(int(hz), 4)
    yaw, speed, rate = errors(found[begin:], true[begin:])
    assert yaw < 0.02
    assert speed < 0.2
    assert rate < 0.05


def test_a_parked_ego_has_the_heading_in_which_it_drives_off():
    true = circle(10.0, 1e-6, start_s=3.0)
    given = [replace(each, **MISSING) for each in true]
    found = completed_states(given, missing_motion(("x_m", "y_m")))
    assert all(math.isfinite(each.yaw_rad + each.speed_mps) for each in found)
    assert abs(found[0].yaw_rad) < 1e-3
    streamed = EgoMotion(missing_motion(("x_m", "y_m")))
    assert math.isnan(streamed.completed(given[0]).yaw_rad)


def test_noise_at_rest_turns_no_heading():
    rng = np.random.default_rng(4)
    moving = [replace(each, **MISSING) for each in circle(10.0, 1e-6, count=30)]
    last = moving[-1]
    resting = [
        replace(last, stamp_ns=last.stamp_ns + k * 10**8, x_m=last.x_m + dx, y_m=dy)
        for k, (dx, dy) in enumerate(rng.normal(0.0, 0.05, (100, 2)).tolist(), 1)
    ]
    motion = EgoMotion(missing_motion(("x_m", "y_m")))
    found = [motion.completed(each) for each in [*moving, *resting]]
    assert all(abs(each.yaw_rad) < 0.2 for each in found[40:])
    assert abs(np.mean([each.speed_mps for each in found[40:]])) < 0.05


def test_a_high_rate_of_noisy_positions_makes_no_noisier_heading():
    """The turn is taken from courses that lie apart: 2 cm at 100 Hz are 2 rad/s between neighbouring courses."""
    rng = np.random.default_rng(0)
    motion = EgoMotion(missing_motion(("x_m", "y_m")))
    yaws_rad = []
    for k, (dx_m, dy_m) in enumerate(rng.normal(0.0, 0.02, (600, 2)).tolist()):
        stamp_ns = k * 10_000_000
        given = EgoState(stamp_ns, stamp_ns, 0.1 * k + dx_m, dy_m, math.nan, math.nan)
        yaws_rad.append(motion.completed(given).yaw_rad)
    assert np.std(yaws_rad[200:]) < 0.04


def test_nothing_is_computed_if_heading_and_speed_are_measured():
    assert missing_motion(("x_m", "y_m", "yaw_rad", "speed_mps")) == ()
    state = circle()[3]
    assert EgoMotion(()).completed(state) is state


def test_a_table_with_quaternions_and_without_speed_is_an_ego(tmp_path):
    true = circle(8.0, hz=20.0)
    text = "time,px,py,qx,qy,qz,qw\n" + "".join(
        f"{each.stamp_ns / 1e9},{each.x_m},{each.y_m},0,0,"
        f"{2.0 * math.sin(each.yaw_rad / 2)},{2.0 * math.cos(each.yaw_rad / 2)}\n"
        for each in true
    )
    (tmp_path / "ego.csv").write_text(text)
    columns = {
        "stamp": "time",
        "x_m": "px",
        "y_m": "py",
        "yaw_rad": ["qx", "qy", "qz", "qw"],
    }
    config = InputConfig(csv=CsvInput(ego=CsvTable(columns)))
    found = list(open_input(tmp_path / "ego.csv", config).messages())
    yaw, speed, rate = errors(found[1:], true[1:])
    assert yaw < 1e-9
    assert speed < 0.05
    assert rate < 1e-6
