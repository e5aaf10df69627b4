"""The likelihood of noise against a dense joint Gaussian, the contaminated update against quadrature, and a fit."""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import compress
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from fgtrack.config.reading import read_config
from fgtrack.core.geometry import rotation, wrap_angle
from fgtrack.core.linalg import mahalanobis_squared
from fgtrack.core.time import NS_PER_S, nanoseconds
from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement, Start
from fgtrack.estimation.birth import initial_state
from fgtrack.models.correlated_errors import split_error
from fgtrack.models.measurement import SensorPose, measurement_model
from fgtrack.models.motion import CTRV, CV
from fgtrack.models.sensors import SensorModel
from fgtrack.noise.likelihood import contaminated
from fgtrack.noise.likelihood.fit import Likelihood, Problem
from fgtrack.noise.likelihood.reference import filtered, with_mixed_marked
from fgtrack.noise.likelihood.series import NoiseSpace, Observation, Series
from fgtrack.noise.measurements import _WideGate, observation
from fgtrack.noise.parameters import ConfigNoise
from fgtrack.noise.tune import _REJECTED, _Tuning

START = Start(
    position_m=(3.0, -2.0),
    yaw_rad=0.3,
    yaw_std_rad=0.2,
    speed_mps=8.0,
    speed_std_mps=2.0,
)
SPACE = NoiseSpace(
    ("velocity",),
    lambda std: CV.from_std_per_step(std, 1.0),
    {"lidar": ("x_m", "y_m"), "radar": ("x_m", "y_m")},
)
#: Of the velocity, of x and y of each sensor, and odds of outliers too small to count.
VALUES = np.array([0.8, 0.5, 0.3, 1.5, 1.0, 1e-60, 1e-60])


def unsettled(series: Series) -> Series:
    """The series whose first innovations count, too."""
    return replace(series, settle_s=0.0, settle_steps=0)


#: The same sensors, and objects that turn.
TURNING = replace(
    SPACE,
    motion_names=("position", "yaw", "speed", "yaw_rate"),
    motion=lambda std: CTRV.from_std_per_step(std, 1.0),
)


def observed(
    sensor: str, stamp_s: float, z: Sequence[float], turn_rad: float = 0.0
) -> Observation:
    """x and y of a sensor whose axes are turned."""
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    measurement = Measurement.of(
        nanoseconds(stamp_s), x_m=z[0], y_m=z[1], std={"x_m": 1.0, "y_m": 1.0}
    )
    measurement = measurement.seen_by(SPACE.motion_model(VALUES))
    nothing = np.zeros((2, 2))
    return Observation(
        sensor, measurement, (0, 1), (), np.array([[c, -s], [s, c]]), nothing, nothing
    )


def drawn(
    rng: np.random.Generator, values: FloatArray, num: int, outliers: float = 0.0
) -> Series:
    """A track drawn from the model, seen by both sensors in turn, at equal stamps now and then."""
    motion = SPACE.motion_model(values)
    x, P = initial_state(motion, START)
    x = rng.multivariate_normal(x, P)
    before_s, seen = 0.0, []
    for k in range(num):
        stamp_s = 0.1 * (k - k % 7 % 2)
        x = rng.multivariate_normal(
            motion.predict(x, stamp_s - before_s),
            motion.process_noise(x, stamp_s - before_s),
        )
        before_s, sensor, turn_rad = stamp_s, k % 2, 0.01 * k
        std = values[1 + 2 * sensor : 3 + 2 * sensor] * (
            5.0 if rng.random() < outliers else 1.0
        )
        along, across = std * rng.standard_normal(2)
        c, s = np.cos(turn_rad), np.sin(turn_rad)
        z = x[:2] + np.array([c * along - s * across, s * along + c * across])
        seen.append(observed(("lidar", "radar")[sensor], stamp_s, z.tolist(), turn_rad))
    return Series(START, seen)


def dense(series: Series, values: FloatArray) -> float:
    """Log density of all measurements together: joint Gaussian, built state by state."""
    motion = SPACE.motion_model(values)
    mean, P = initial_state(motion, START)
    means, F_all = [], []
    before_s = 0.0
    blocks: list[FloatArray] = []
    for one in series.observations:
        stamp_s = one.measurement.stamp_ns / NS_PER_S
        F = motion.jacobian(mean, stamp_s - before_s)
        P = F @ P @ F.T + motion.process_noise(mean, stamp_s - before_s)
        mean, before_s = F @ mean, stamp_s
        means.append(mean[:2])
        F_all.append(F)
        blocks.append(P)
    n = len(means)
    joint = np.zeros((2 * n, 2 * n))
    for i in range(n):
        across = blocks[i]
        for j in range(i, n):
            across = across if j == i else F_all[j] @ across
            joint[2 * j : 2 * j + 2, 2 * i : 2 * i + 2] = across[:2, :2]
            joint[2 * i : 2 * i + 2, 2 * j : 2 * j + 2] = across[:2, :2].T
    for i, one in enumerate(series.observations):
        std = values[1:3] if one.sensor == "lidar" else values[3:5]
        joint[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] += (
            one.axes @ np.diag(std**2) @ one.axes.T
        )
    z = np.concatenate([one.measurement.z for one in series.observations])
    return float(multivariate_normal(np.concatenate(means), joint).logpdf(z))


def test_the_likelihood_of_a_linear_model_is_that_of_the_joint_gaussian_at_any_parameters() -> (
    None
):
    rng = np.random.default_rng(0)
    tracks = [drawn(rng, VALUES, 30), drawn(rng, VALUES, 17)]
    likelihood = Likelihood(
        Problem(list(map(unsettled, tracks)), SPACE, VALUES),
        VALUES,
        np.ones(7, dtype=bool),
    )
    rows = VALUES * np.exp(0.5 * rng.standard_normal((4, 7)))
    rows[:, 5:] = 1e-60
    expected = [sum(dense(track, row) for track in tracks) for row in rows]
    assert likelihood.totals(rows) == pytest.approx(expected, abs=1e-6)


def test_what_has_settled_counts_and_what_lies_in_the_limits() -> None:
    track = drawn(np.random.default_rng(1), VALUES, 30)
    track = replace(track, settle_s=0.5, settle_steps=8)
    stamps_s = [one.measurement.stamp_ns / NS_PER_S for one in track.observations]
    assert np.flatnonzero(track.counted).tolist() == [
        k for k in range(8, 30) if stamps_s[k] >= 0.5
    ]
    inside = replace(track, from_ns=nanoseconds(1.0), until_ns=nanoseconds(2.0))
    assert np.flatnonzero(inside.counted).tolist() == [
        k for k in range(8, 30) if 1.0 <= stamps_s[k] < 2.0
    ]


def test_the_contaminated_update_has_the_moments_of_the_exact_posterior() -> None:
    P, H, R, y, odds = (
        np.array([[2.0]]),
        np.array([[1.0]]),
        np.array([[0.25]]),
        np.array([2.6]),
        0.1,
    )
    found = contaminated.update(P, H, y, R, np.zeros((1, 1)), np.array(odds))
    x = np.linspace(-60.0, 60.0, 400_001)
    share = float(contaminated.outlier_share(np.array(odds)))
    weights = np.array([1.0 - share, *(share * contaminated.PARTS)])
    sigmas = np.sqrt(R[0, 0]) * contaminated.SCALES
    density = (weights / sigmas * np.exp(-0.5 * ((y - x[:, None]) / sigmas) ** 2)).sum(
        axis=1
    ) / np.sqrt(2.0 * np.pi)
    density *= np.exp(-0.5 * x * x / P[0, 0]) / np.sqrt(2.0 * np.pi * P[0, 0])
    step = x[1] - x[0]
    evidence = density.sum() * step
    mean = (x * density).sum() * step / evidence
    assert found.log_likelihood == pytest.approx(np.log(evidence), abs=1e-6)
    assert found.step[0] == pytest.approx(mean, abs=1e-6)
    assert found.covariance[0, 0] == pytest.approx(
        ((x - mean) ** 2 * density).sum() * step / evidence, abs=1e-6
    )
    assert 0.0 < found.outlier < 1.0


@pytest.mark.parametrize("outliers", [0.03, pytest.param(0.0, marks=pytest.mark.slow)])
def test_the_maximum_is_near_the_truth_whatever_the_outliers(outliers: float) -> None:
    rng = np.random.default_rng(2)
    tracks = [drawn(rng, VALUES, 120, outliers) for _ in range(8)]
    start = np.array([2.0, 1.0, 1.0, 1.0, 1.0, 0.01, 0.01])
    problem = Problem(tracks, SPACE, start)
    values, likelihood = problem.maximum(start, np.ones(7, dtype=bool))
    errors = np.log(values[:5] / VALUES[:5])
    std = likelihood.log_std(np.log(values))[:5]
    assert (np.abs(errors) < 3.0 * std).all(), (errors, std)
    assert (np.abs(errors[1:]) < 0.15).all()
    assert (std < [0.15, 0.06, 0.06, 0.06, 0.06]).all()
    assert contaminated.outlier_share(values[5:]) == pytest.approx(
        [outliers] * 2, abs=0.03
    )


def moved(one: Observation, by_m: float) -> Observation:
    """The observation of something that is `by_m` further along x."""
    return replace(
        one,
        measurement=replace(one.measurement, z=np.add(one.measurement.z, [by_m, 0.0])),
    )


def test_what_a_track_fuses_of_another_object_says_nothing_of_the_noise() -> None:
    values = np.array([*VALUES[:5], 0.02, 0.02])
    track = drawn(np.random.default_rng(7), values, 300, outliers=0.05)
    assert with_mixed_marked(track, SPACE, values) == track
    seen = list(track.observations)
    seen[100:130] = [moved(one, 9.0) for one in seen[100:130]]
    found = with_mixed_marked(replace(track, observations=seen), SPACE, values)
    assert set(range(100, 125)) <= found.mixed <= set(range(75, 165))
    assert set(np.flatnonzero(~unsettled(found).counted).tolist()) == found.mixed


def test_a_nonlinear_model_is_linearised_about_the_filter() -> None:
    """At the parameters of the trajectory the likelihood is that of the filter itself."""
    track = drawn(np.random.default_rng(3), VALUES, 40)
    seen = [
        replace(one, measurement=one.measurement.seen_by(CTRV()))
        for one in track.observations
    ]
    values = np.array([0.1, 0.1, 0.5, 0.2, *VALUES[1:5], 0.01, 0.01])
    track = unsettled(replace(track, observations=seen))
    likelihood = Likelihood(
        Problem([track], TURNING, values), values, np.ones(10, dtype=bool)
    )
    steps = filtered(track, TURNING, values)
    assert likelihood.totals(values[None])[0] == pytest.approx(
        sum(step.update.log_likelihood for step in steps), abs=1e-8
    )


#: The LiDAR measures x. Its y is assumed, as from a map, with a noise that is not a parameter.
HALF_ASSUMED = replace(SPACE, sensors={"lidar": ("x_m",), "radar": ("x_m", "y_m")})
ASSUMED_STD_M = 0.9


def half_assumed(track: Series) -> Series:
    """The track where the LiDAR's x is measured and its y is assumed."""
    seen = [
        replace(
            one,
            measurement=replace(one.measurement, R=ASSUMED_STD_M**2 * np.eye(2)),
            measured=(0,),
            assumed=(1,),
            axes=np.eye(1),
            own=np.zeros((1, 1)),
            other_errors=np.zeros((1, 1)),
        )
        if one.sensor == "lidar"
        else one
        for one in track.observations
    ]
    return unsettled(replace(track, observations=seen))


def filtered_by_hand(series: Series, values: FloatArray) -> float:
    """Log density of all measured components, each given all earlier components, measured or assumed."""
    motion, total = SPACE.motion_model(values), 0.0
    (x, P), before_s = initial_state(motion, START), 0.0
    for one in series.observations:
        stamp_s = one.measurement.stamp_ns / NS_PER_S
        F = motion.jacobian(x, stamp_s - before_s)
        P = F @ P @ F.T + motion.process_noise(x, stamp_s - before_s)
        x, before_s = F @ x, stamp_s
        std = values[1:2] if one.sensor == "lidar" else values[2:4]
        parts = [(np.arange(len(std)), one.axes @ np.diag(std**2) @ one.axes.T, True)]
        if one.assumed:
            parts.append((np.array([1]), np.array([[ASSUMED_STD_M**2]]), False))
        for rows, R, is_measured in parts:
            H = np.eye(4)[rows]
            y, S = one.measurement.z[rows] - H @ x, H @ P @ H.T + R
            total += (
                float(multivariate_normal(np.zeros(len(rows)), S).logpdf(y))
                if is_measured
                else 0.0
            )
            K = P @ H.T @ np.linalg.inv(S)
            x, P = x + K @ y, P - K @ S @ K.T
    return total


def test_assumed_components_move_the_state_and_have_no_part_in_the_likelihood() -> None:
    rng = np.random.default_rng(8)
    tracks = [half_assumed(drawn(rng, VALUES, num)) for num in (30, 17)]
    values = np.array([0.8, 0.5, 1.5, 1.0, 1e-60, 1e-60])
    likelihood = Likelihood(
        Problem(tracks, HALF_ASSUMED, values), values, np.ones(6, dtype=bool)
    )
    rows = values * np.exp(0.5 * rng.standard_normal((4, 6)))
    rows[:, 4:] = 1e-60
    expected = [sum(filtered_by_hand(track, row) for track in tracks) for row in rows]
    assert likelihood.totals(rows) == pytest.approx(expected, abs=1e-6)
    for row, total in zip(rows, expected, strict=True):
        steps = [
            step for track in tracks for step in filtered(track, HALF_ASSUMED, row)
        ]
        assert sum(step.update.log_likelihood for step in steps) == pytest.approx(
            total, abs=1e-6
        )


def turning(seed: int, num: int) -> tuple[FloatArray, Series]:
    """Parameters and a track of CTRV that heads away from the direction that its start has, which is none."""
    values, rng = (
        np.array([0.1, 0.05, 0.5, 0.1, *VALUES[1:5], 0.01, 0.01]),
        np.random.default_rng(seed),
    )
    motion = TURNING.motion_model(values)
    x, seen = np.array([3.0, -2.0, 2.5, 20.0, 0.1]), []
    for k in range(num):
        sensor = ("lidar", "radar")[k % 2]
        z = x[:2] + values[4 + 2 * (k % 2) : 6 + 2 * (k % 2)] * rng.standard_normal(2)
        one = observed(sensor, 0.05 * k, z.tolist())
        seen.append(replace(one, measurement=one.measurement.seen_by(motion)))
        x = rng.multivariate_normal(
            motion.predict(x, 0.05), motion.process_noise(x, 0.05)
        )
    start = Start(
        position_m=seen[0].measurement.z, position_std_m=1.5, speed_std_mps=30.0
    )
    return values, Series(start, seen[1:])


def test_a_track_of_unknown_direction_is_linearised_along_its_first_positions() -> None:
    values, track = turning(5, 200)
    opened = track.initiated(TURNING.motion_model(values), "regression")
    assert 3 < opened.num_initial < 30
    steps = filtered(opened, TURNING, values)
    for step, about in zip(steps, opened.nominal[:-1], strict=False):
        assert np.array_equal(step.about, about)
    assert abs(wrap_angle(steps[opened.num_initial].after[2] - 2.5)) < 0.3
    counted = list(compress(steps, opened.counted))
    assert len(counted) > 150
    assert np.mean(
        [mahalanobis_squared(one.y, one.update.S) for one in counted]
    ) == pytest.approx(2.0, abs=0.4)
    assert track.initiated(TURNING.motion_model(values), "one-point") is track
    likelihood = Likelihood(
        Problem([unsettled(opened)], TURNING, values), values, np.ones(10, dtype=bool)
    )
    expected = sum(step.update.log_likelihood for step in steps[opened.num_initial :])
    assert likelihood.totals(values[None])[0] == pytest.approx(expected, abs=1e-8)


def test_innovations_count_from_where_the_direction_is_known() -> None:
    values, track = turning(6, 100)
    opened = track.initiated(TURNING.motion_model(values), "regression")
    first = int(np.argmax(opened.counted))
    since_s = (
        opened.observations[first].measurement.stamp_ns - opened.initiated_ns
    ) / NS_PER_S
    assert (
        opened.initiated_ns
        == opened.observations[opened.num_initial - 1].measurement.stamp_ns
    )
    assert first >= opened.num_initial + 5
    assert 1.0 <= since_s < 1.05


def test_time_correlated_errors_are_in_the_state_and_their_noise_is_fixed() -> None:
    """In a linear model the likelihood at any parameters is that of a filter with these."""
    noise = ConfigNoise(
        read_config(
            None,
            [
                "estimator=ekf-replay",
                "motion={kind: cv, std_per_s: {velocity: 0.8}}",
                "sensors.lidar={std: {x_m: 0.5, y_m: 0.3}, correlation: {share: 0.7, time_s: 2.0}}",
                "sensors.radar={std: {x_m: 1.5, y_m: 1.0}}",
                "sensors.lidar_cluster={std: {x_m: 1.5, y_m: 1.0}}",
            ],
        )
    )
    config, rng = noise.config, np.random.default_rng(4)
    model = config.motion_model()
    seen = []
    for one in drawn(rng, VALUES, 40).observations:
        sensor, pose = config.sensors[one.sensor], SensorPose(-20.0, 5.0)
        x_m, y_m = one.measurement.z - [pose.x_m, pose.y_m]
        turn = (
            np.eye(2)
            if sensor.std["x_m"] == sensor.std["y_m"]
            else rotation(math.atan2(y_m, x_m))
        )
        R = turn @ sensor.noise(("x_m", "y_m")) @ turn.T
        plain = measurement_model(("x_m", "y_m"), model)
        erring, white = split_error(one.sensor, sensor, plain, R, model.state_names)
        measurement = replace(one.measurement, model=erring, R=white, pose=pose)
        seen.append(observation(one.sensor, sensor, measurement, own=False))
        assert seen[-1].tuned == (one.sensor != "lidar")
    problem = Problem([unsettled(Series(START, seen))], noise.space, noise.values)
    likelihood = Likelihood(
        problem, noise.values, np.ones(len(noise.values), dtype=bool)
    )
    rows = noise.values * np.exp(0.4 * rng.standard_normal((3, len(noise.values))))
    rows[:, -3:] = 1e-60
    expected = [
        sum(
            step.update.log_likelihood
            for step in filtered(problem.series[0], noise.space, row)
        )
        for row in rows
    ]
    assert likelihood.totals(rows) == pytest.approx(expected, abs=1e-7)
    counts = dict(zip(noise.keys, problem.counts().tolist(), strict=True))
    assert (counts["sensors.lidar.std.x_m"], counts["sensors.radar.std.x_m"]) == (0, 20)


def test_noise_that_grows_with_range_is_not_laid_to_the_standard_deviations() -> None:
    sensor = SensorModel(
        std={"x_m": 0.5, "y_m": 0.3}, std_growth={"x_m": 0.02, "y_m": 0.01}
    )
    turn = rotation(math.atan2(30.0, 40.0))
    grown = turn @ np.diag([1.0, 0.25]) @ turn.T  # at 50 m
    R = turn @ np.diag([0.25, 0.09]) @ turn.T + grown
    measurement = Measurement(
        0, measurement_model(("x_m", "y_m"), CV()), np.array([40.0, 30.0]), R
    )
    assert observation(
        "lidar", sensor, measurement, own=False
    ).other_errors == pytest.approx(grown)


def test_a_limit_is_the_last_value_that_the_data_do_not_reject() -> None:
    """The log-likelihood falls by the squared logarithm from its maximum at 1."""
    fit = _Tuning.__new__(_Tuning)
    likelihood = SimpleNamespace(totals=lambda rows: -(np.log(rows[:, 1]) ** 2))
    values = np.array([7.0, 1.0])
    reach = math.exp(math.sqrt(_REJECTED))
    for configured, nearest in ((100.0, reach), (1e-2, 1.0 / reach), (2.0, 2.0)):
        fit._configured = np.array([7.0, configured])
        limit = fit._limit(likelihood, values, 1)
        assert limit == pytest.approx(nearest, rel=0.12)
        assert np.log(limit) ** 2 <= _REJECTED


def test_a_bearing_is_as_uncertain_across_as_the_track_is_far_from_the_sensor() -> None:
    bearing = Measurement.of(
        0, std=0.02, pose=SensorPose(1.0, 2.0, 0.5), bearing_rad=0.3
    )
    candidate = SimpleNamespace(position_covariance=None, measurement=bearing)
    means = np.array([[4.0, 6.0, 0.0, 0.0], [1.0, -8.0, 0.0, 0.0]])
    stds_m = _WideGate(None, 4.0)._stds_m(candidate, means)
    assert stds_m.tolist() == pytest.approx([0.02 * 5.0, 0.02 * 10.0])
