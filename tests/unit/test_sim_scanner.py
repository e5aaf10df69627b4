import math

import numpy as np
import pytest
from scipy import stats

from fgtrack.core.types import ACCEL, SPEED, STATE_NAMES, YAW, YAW_RATE, FloatArray
from fgtrack.models.oval import make_oval
from fgtrack.models.sensors import Mount
from fgtrack.sim.scanner import Scanner
from fgtrack.sim.sensor import Clutter, SimulatedSensor

N = 4_000
ALPHA = 1e-4  # of every statistical test here
NO_NOISE = {"x_m": 0.0, "y_m": 0.0}
EGO = np.array([100.0, -50.0, 2.0, 60.0, 0.3, 0.0])


def seen_from(
    x_m: float, y_m: float, yaw_rad: float = 0.0, speed_mps: float = 0.0
) -> FloatArray:
    """State of an object at a place in the detection frame of `EGO`."""
    c, s = math.cos(EGO[YAW]), math.sin(EGO[YAW])
    x_m -= 1.74
    state = np.zeros(len(STATE_NAMES))
    state[:2] = EGO[0] + c * x_m - s * y_m, EGO[1] + s * x_m + c * y_m
    state[YAW], state[SPEED] = EGO[YAW] + yaw_rad, speed_mps
    return state


def scan(
    sensor: SimulatedSensor, *objects: FloatArray, num_scans: int = N, seed: int = 0
) -> tuple[FloatArray, FloatArray]:
    """Detections of standing scenes: the number in each scan, and the values of all, shape (m, k)."""
    scanner = Scanner(sensor, np.tile(EGO, (num_scans, 1)), detection_origin_x_m=-1.74)
    states = [np.tile(state, (num_scans, 1)) for state in objects]
    scans = scanner.scans(np.random.default_rng(seed), states, make_oval())
    assert all(
        d.measured == sensor.components and d.object_id is None
        for ds in scans
        for d in ds
    )
    values = [
        [getattr(d, name) for name in sensor.components] for ds in scans for d in ds
    ]
    return np.array([len(ds) for ds in scans]), np.array(values).reshape(
        -1, len(sensor.components)
    )


def assert_variance(values: FloatArray, std: float) -> None:
    """Chi-square test of the variance of zero-mean normal `values`."""
    chi2 = stats.chi2(len(values))
    assert chi2.ppf(ALPHA) < np.sum(values**2) / std**2 < chi2.ppf(1.0 - ALPHA)


# Geometry


def test_positions_count_from_the_rear_axle() -> None:
    _, z = scan(SimulatedSensor("lidar", NO_NOISE), seen_from(30.0, -4.0), num_scans=3)
    np.testing.assert_allclose(z, [[30.0, -4.0]] * 3, atol=1e-9)
    ahead = EGO.copy()
    ahead[:2] += 10.0 * np.array([math.cos(EGO[YAW]), math.sin(EGO[YAW])])
    np.testing.assert_allclose(
        scan(SimulatedSensor("lidar", NO_NOISE), ahead, num_scans=1)[1],
        [[11.74, 0.0]],
        atol=1e-9,
    )


def test_range_and_bearing_are_relative_to_the_mounted_sensor() -> None:
    sensor = SimulatedSensor(
        "radar",
        {"range_m": 0.0, "bearing_rad": 0.0},
        mount=Mount(x_m=3.0, y_m=1.0, yaw_rad=0.2),
    )
    assert sensor.frame == "sensor"
    _, z = scan(sensor, seen_from(3.0 + 40.0, 1.0 + 30.0), num_scans=1)
    np.testing.assert_allclose(z, [[50.0, math.atan2(30.0, 40.0) - 0.2]], atol=1e-9)


def test_the_range_rate_is_the_derivative_of_the_range() -> None:
    """Also for a sensor off the axis of a turning ego vehicle."""
    sensor = SimulatedSensor(
        "radar",
        {"range_m": 0.0, "range_rate_mps": 0.0},
        mount=Mount(x_m=3.0, y_m=1.0, yaw_rad=0.2),
    )
    t = np.array([-1e-5, 0.0, 1e-5])
    ego, other = (
        np.tile(state, (3, 1)) for state in (EGO, seen_from(30.0, 8.0, 0.4, 50.0))
    )
    for states in (ego, other):
        yaw = states[:, YAW].copy()
        states[:, 0] += (
            t * states[:, SPEED] * np.cos(yaw + states[:, YAW_RATE] * t / 2.0)
        )
        states[:, 1] += (
            t * states[:, SPEED] * np.sin(yaw + states[:, YAW_RATE] * t / 2.0)
        )
        states[:, YAW] += states[:, YAW_RATE] * t
        assert (states[:, ACCEL] == 0.0).all()
    before, now, after = Scanner(sensor, ego, -1.74).scans(
        np.random.default_rng(0), [other], None
    )
    rate = (after[0].range_m - before[0].range_m) / 2e-5  # type: ignore[operator]
    assert now[0].range_rate_mps == pytest.approx(rate, abs=1e-4)


def test_a_sensor_sees_between_its_ranges_and_inside_its_field_of_view_only() -> None:
    sensor = SimulatedSensor(
        "radar",
        NO_NOISE,
        mount=Mount(yaw_rad=math.pi / 2.0),
        field_of_view_rad=1.0,
        min_range_m=5.0,
        max_range_m=50.0,
    )
    for x, y, seen in (
        (0.0, 20.0, True),
        (20.0 * math.sin(0.49), 20.0 * math.cos(0.49), True),
        (20.0 * math.sin(0.51), 20.0 * math.cos(0.51), False),
        (0.0, -20.0, False),
        (20.0, 0.0, False),
        (0.0, 4.9, False),
        (0.0, 50.1, False),
    ):
        assert scan(sensor, seen_from(x, y), num_scans=1)[0].tolist() == [int(seen)]


# Statistics


def test_position_noise_lies_along_and_across_the_line_of_sight() -> None:
    sensor = SimulatedSensor(
        "radar",
        {"x_m": 3.0, "y_m": 0.5, "speed_mps": 0.2},
        mount=Mount(2.0, 1.0, 0.3),
        max_range_m=200.0,
    )
    bearing = 0.7
    _, z = scan(
        sensor,
        seen_from(
            2.0 + 80.0 * math.cos(bearing), 1.0 + 80.0 * math.sin(bearing), 0.0, 65.0
        ),
    )
    error = z[:, :2] - (2.0 + 80.0 * math.cos(bearing), 1.0 + 80.0 * math.sin(bearing))
    along = error @ (math.cos(bearing), math.sin(bearing))
    across = error @ (-math.sin(bearing), math.cos(bearing))
    assert_variance(along, 3.0)
    assert_variance(across, 0.5)
    assert_variance(z[:, 2] - 65.0, 0.2)
    assert abs(np.corrcoef(along, across)[0, 1]) < 5.0 / math.sqrt(N)


def test_a_split_gives_two_detections_a_few_metres_apart_along_the_object() -> None:
    sensor = SimulatedSensor(
        "lidar", NO_NOISE, split_probability=0.1, split_distance_m=(2.0, 4.0)
    )
    counts, z = scan(sensor, seen_from(20.0, 0.0, yaw_rad=0.5))
    assert stats.binomtest(int(np.count_nonzero(counts == 2)), N, 0.1).pvalue > ALPHA
    assert set(counts) == {1, 2}
    first = (np.cumsum(counts) - counts)[counts == 2]
    apart = z[first] - z[first + 1]
    np.testing.assert_allclose(
        (z[first] + z[first + 1]) / 2.0, [[20.0, 0.0]] * len(first), atol=1e-9
    )
    np.testing.assert_allclose(
        np.abs(np.arctan(apart[:, 1] / apart[:, 0])), 0.5, atol=1e-9
    )
    assert stats.kstest(np.hypot(*apart.T), stats.uniform(2.0, 2.0).cdf).pvalue > ALPHA


def test_clutter_is_poisson_in_number_and_uniform_over_the_field_of_view() -> None:
    sensor = SimulatedSensor(
        "radar",
        {"range_m": 1.0, "bearing_rad": 1.0},
        field_of_view_rad=1.2,
        min_range_m=10.0,
        max_range_m=80.0,
        clutter=Clutter(mean_per_scan=0.7),
    )
    counts, z = scan(sensor)
    expected = stats.poisson(0.7).pmf(np.arange(5)) * N
    observed = np.bincount(np.minimum(counts, 4), minlength=5)
    expected[4] = N - expected[:4].sum()
    assert stats.chisquare(observed, expected).pvalue > ALPHA
    assert (
        stats.kstest(z[:, 0] ** 2, stats.uniform(10.0**2, 80.0**2 - 10.0**2).cdf).pvalue
        > ALPHA
    )
    assert stats.kstest(z[:, 1], stats.uniform(-0.6, 1.2).cdf).pvalue > ALPHA


# Times and settings


def test_scans_come_at_their_rate_phase_and_jitter() -> None:
    sensor = SimulatedSensor(
        "lidar", NO_NOISE, rate_hz=20.0, phase_s=0.01, jitter_s=0.004
    )
    times = sensor.scan_times(np.random.default_rng(0), 100.0)
    assert len(times) == 2000
    late = times - 0.01 - np.arange(2000) / 20.0
    assert stats.kstest(late, stats.uniform(0.0, 0.004).cdf).pvalue > ALPHA
    exact = SimulatedSensor("lidar", NO_NOISE, rate_hz=10.0).scan_times(
        np.random.default_rng(0), 1.0
    )
    np.testing.assert_allclose(exact, np.arange(11) / 10.0)
    assert (
        len(
            SimulatedSensor("lidar", NO_NOISE, phase_s=2.0).scan_times(
                np.random.default_rng(0), 1.0
            )
        )
        == 0
    )


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"std": {"colour": 1.0}}, "std: .*colour"),
        ({"std": {"x_m": 1.0}}, "std: must contain components"),
        (
            {"split_distance_m": (4.0, 2.0)},
            r"split_distance_m: must be \(smallest, largest\)",
        ),
        (
            {"clutter": {"speed_mps": (5.0, 0.0)}},
            r"speed_mps: must be \(smallest, largest\)",
        ),
        (
            {"std": {**NO_NOISE, "range_m": 1.0}},
            "std: must contain either positions or range",
        ),
        ({"jitter_s": 0.05}, "jitter_s"),
        ({"max_range_m": math.inf}, "max_range_m"),
        ({"max_range_behind_m": 100.1}, "max_range_behind_m"),
        ({"max_range_behind_m": 0.0}, "max_range_behind_m"),
        ({"detection_probability": 1.1}, "detection_probability"),
        ({"drop_outs": ((2.0, 1.0),)}, "drop_outs"),
    ],
)
def test_a_setting_that_makes_no_sense_is_named(
    settings: dict[str, object], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        SimulatedSensor(**{"name": "lidar", "std": NO_NOISE, **settings})  # type: ignore[arg-type]
