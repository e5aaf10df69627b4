"""The covariance of a new track is the whole covariance of its first detection, in every frame."""

from itertools import permutations

import numpy as np
import pytest

import fgtrack
from fgtrack.core.errors import CallError
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import Frame
from fgtrack.estimation.base import Measurement, Start
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.filters.ekf import correct_one
from fgtrack.estimation.registry import ESTIMATORS, estimator
from fgtrack.models.correlated_errors import split_error, with_correlated_errors
from fgtrack.models.measurement import SensorPose, measured_position, measurement_model
from fgtrack.models.motion import CTRA, CTRV, CV, MotionModel
from fgtrack.models.road import Road
from fgtrack.models.sensors import Correlation, SensorModel
from fgtrack.tracking.birth import Birth
from fgtrack.tracking.preprocess import Candidate

NOW_NS = 1000 * NS_PER_S
VALUES = {"x_m": 12.0, "y_m": 3.0, "yaw_rad": 0.2, "speed_mps": 4.0}
NAMES = tuple(VALUES)
SUBSETS = (
    ("x_m", "y_m"),
    ("x_m", "y_m", "yaw_rad"),
    ("x_m", "y_m", "speed_mps"),
    ("y_m", "speed_mps", "x_m", "yaw_rad"),
    ("yaw_rad", "y_m", "x_m"),
)


def drawn(size: int, seed: int = 3) -> np.ndarray:
    """A covariance with correlations between all entries."""
    root = np.random.default_rng(seed).normal(size=(size, size))
    return 0.1 * root @ root.T + 0.02 * np.eye(size)


def first_track(
    detection: fgtrack.Detection, frame: Frame, names: tuple[str, ...]
) -> fgtrack.TrackReport:
    """The track that one detection of a mounted sensor starts."""
    lidar = {
        "std": dict.fromkeys(names, 1.0),
        "mount": {"x_m": 2.0, "y_m": -1.0, "yaw_rad": 0.7},
    }
    options = {"sensors": {"lidar": lidar}, "ego.detection_origin_x_m": 1.5}
    tracker = fgtrack.Tracker("open_space", estimator="ekf-replay", set=options)
    for ago_ns in (20_000_000, 10_000_000, 0):
        tracker.receive(
            fgtrack.EgoState(NOW_NS - ago_ns, NOW_NS - ago_ns, 10.0, 20.0, 1.1, 0.0)
        )
    tracker.receive(fgtrack.DetectionList("lidar", NOW_NS, NOW_NS, [detection], frame))
    [track] = tracker.tick(NOW_NS).tracks
    return track


@pytest.mark.parametrize("names", SUBSETS, ids=",".join)
@pytest.mark.parametrize(
    ("frame", "turn_rad"), [("map", 0.0), ("ego", 1.1), ("sensor", 1.8)]
)
def test_every_measured_entry_keeps_its_correlations(
    frame: Frame, turn_rad: float, names: tuple[str, ...]
) -> None:
    C = drawn(4)
    track = first_track(
        fgtrack.Detection(**VALUES, covariance=tuple(C.ravel())), frame, names
    )
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    J = np.eye(4)
    J[:2, :2] = [[c, -s], [s, c]]
    measured = [k for k, name in enumerate(NAMES) if name in names]
    expected = (J @ C @ J.T)[np.ix_(measured, measured)]
    np.testing.assert_allclose(
        track.covariance[np.ix_(measured, measured)], expected, rtol=1e-12, atol=1e-13
    )
    others = [k for k in range(5) if k not in measured]
    assert not track.covariance[np.ix_(measured, others)].any()


@pytest.mark.parametrize(
    "order", list(permutations(("yaw_rad", "speed_mps", "range_m", "bearing_rad")))[::5]
)
def test_a_range_and_a_bearing_share_their_errors_with_yaw_and_speed(
    order: tuple[str, ...],
) -> None:
    values = {"yaw_rad": 0.2, "speed_mps": 4.0, "range_m": 40.0, "bearing_rad": 0.3}
    C = 1e-3 * drawn(4, seed=5)
    detection = fgtrack.Detection(**values, covariance=tuple(C.ravel()))
    track = first_track(detection, "sensor", order)

    def state(offsets: np.ndarray) -> np.ndarray:
        yaw_rad, speed_mps, range_m, bearing_rad = (
            np.array(list(values.values())) + offsets
        )
        at_rad = bearing_rad + 1.8
        return np.array(
            [range_m * np.cos(at_rad), range_m * np.sin(at_rad), yaw_rad, speed_mps]
        )

    J = np.array([(state(1e-5 * e) - state(-1e-5 * e)) / 2e-5 for e in np.eye(4)]).T
    np.testing.assert_allclose(
        track.covariance[:4, :4], J @ C @ J.T, rtol=1e-7, atol=1e-9
    )
    assert abs(track.covariance[0, 3]) > 1e-3


def test_the_yaw_of_the_ego_is_an_error_of_position_and_yaw_together() -> None:
    """An ego that is off by 0.02 rad puts an object 100 m ahead off by 2 m, and turns it by as much."""
    covariance = tuple(np.diag([0.0, 0.0, 0.02**2, 0.0, 0.0]).ravel())
    tracker = fgtrack.Tracker(
        "open_space",
        set={"sensors": {"lidar": {"std": {"x_m": 0.1, "y_m": 0.1, "yaw_rad": 0.01}}}},
    )
    for ago_ns in (20_000_000, 10_000_000, 0):
        stamp_ns = NOW_NS - ago_ns
        tracker.receive(
            fgtrack.EgoState(
                stamp_ns, stamp_ns, 0.0, 0.0, 0.0, 0.0, covariance=covariance
            )
        )
    seen = [fgtrack.Detection(x_m=100.0, y_m=0.0, yaw_rad=0.0)]
    tracker.receive(fgtrack.DetectionList("lidar", NOW_NS, NOW_NS, seen, "ego"))
    [track] = tracker.tick(NOW_NS).tracks
    assert track.covariance[1, 2] == pytest.approx(100.0 * 0.02**2, rel=1e-6)


@pytest.mark.parametrize("correlation", [0.9999, -0.99999999])
def test_a_detection_that_is_almost_singular_starts_a_track(correlation: float) -> None:
    std = np.array([0.3, 0.2, 0.05, 1.5])
    C = np.diag(std**2)
    C[0, 2] = C[2, 0] = correlation * std[0] * std[2]
    C[1, 3] = C[3, 1] = -correlation * std[1] * std[3]
    track = first_track(
        fgtrack.Detection(**VALUES, covariance=tuple(C.ravel())), "sensor", NAMES
    )
    assert np.linalg.eigvalsh(track.covariance)[0] > 0.0


@pytest.mark.parametrize(
    "motion", [CTRV(), CTRA(), CV()], ids=lambda motion: type(motion).__name__
)
def test_the_start_is_a_gaussian_of_what_was_measured(motion: MotionModel) -> None:
    """A Cartesian velocity comes from speed and yaw: compared are moments of samples, with errors of a few degrees."""
    C = np.diag([1.0, 1.0, 0.05**2, 1.0])
    C[0, 2] = C[2, 0] = 0.02
    C[1, 3] = C[3, 1] = -0.5
    C[2, 3] = C[3, 2] = 0.02
    start = Start(
        position_covariance=C[:2, :2],
        position_cross={"yaw_rad": tuple(C[:2, 2]), "speed_mps": tuple(C[:2, 3])},
        yaw_cross={"speed_mps": C[2, 3]},
        yaw_rad=0.6,
        yaw_std_rad=0.05,
        speed_mps=20.0,
        speed_std_mps=1.0,
    )
    _, P = initial_state(motion, start)
    drawn_states = np.random.default_rng(1).multivariate_normal(
        [0.0, 0.0, 0.6, 20.0], C, 400_000
    )
    if motion.cartesian:
        yaws, speeds = drawn_states[:, 2].copy(), drawn_states[:, 3].copy()
        drawn_states[:, 2], drawn_states[:, 3] = (
            speeds * np.cos(yaws),
            speeds * np.sin(yaws),
        )
    expected = np.cov(drawn_states.T)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(P[:4, :4] / scale, expected / scale, atol=0.02)


@pytest.mark.parametrize(
    "motion", [CTRV(), CV()], ids=lambda motion: type(motion).__name__
)
@pytest.mark.parametrize(
    "components",
    [NAMES, ("yaw_rad", "speed_mps", "range_m", "bearing_rad")],
    ids=",".join,
)
def test_correlated_errors_of_yaw_and_speed_begin_as_opposites(
    components: tuple[str, ...], motion: MotionModel
) -> None:
    """The same as an object of which nothing was known before that detection."""
    std = {
        "x_m": 1.0,
        "y_m": 2.0,
        "yaw_rad": 0.02,
        "speed_mps": 1.5,
        "range_m": 1.0,
        "bearing_rad": 0.01,
    }
    sensor = SensorModel(
        {name: std[name] for name in components}, correlation=Correlation(0.8, 10.0)
    )
    coloured, pose = (
        with_correlated_errors(motion, {"lidar": sensor}),
        SensorPose(3.0, -2.0, 0.4),
    )
    values = {
        "x_m": 40.0,
        "y_m": 30.0,
        "yaw_rad": 0.5,
        "speed_mps": 12.0,
        "range_m": 50.0,
        "bearing_rad": 0.3,
    }
    z, R = np.array([values[name] for name in components]), sensor.noise(components)
    plain = measurement_model(components, coloured)
    model, white = split_error("lidar", sensor, plain, R, coloured.state_names)
    first = measured_position(components, z, R, pose)
    assert first is not None
    candidate = Candidate(0, (), Measurement(0, model, z, white, pose), *first)
    start = Birth().prior(candidate, Road(), None, ego_in_pit=False)
    assert start is not None
    x, P = initial_state(coloured, start)
    vague = np.diag(
        np.r_[1e6, 1e6, [1e6, 1e6] if motion.cartesian else [1e3, 1e6], np.diag(P)[4:]]
    )
    _, expected, *_ = correct_one(x, vague, Measurement(0, model, z, white, pose))
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(P / scale, expected / scale, atol=2e-3)
    assert abs((P / scale)[2:4, -3:]).max() > 0.3


@pytest.mark.parametrize("name", list(ESTIMATORS))
def test_every_estimator_begins_with_the_crosses_of_its_start(name: str) -> None:
    start = Start(
        position_cross={"yaw_rad": (0.05, -0.04), "speed_mps": (0.6, 0.2)},
        yaw_cross={"speed_mps": 0.1},
        yaw_rad=0.3,
        yaw_std_rad=0.2,
        speed_std_mps=2.0,
    )
    P = estimator(name, CTRV(), start).state_at(0).covariance
    assert (P[0, 2], P[1, 2]) == pytest.approx((0.05, -0.04), rel=1e-4)
    assert (P[0, 3], P[1, 3], P[2, 3]) == pytest.approx((0.6, 0.2, 0.1), rel=1e-4)


def test_the_published_start_has_no_correlations() -> None:
    C = drawn(4)
    measurement = Measurement(
        0, measurement_model(NAMES, CTRV()), np.array(list(VALUES.values())), C
    )
    fixed = Birth(kind="fixed").prior(
        Candidate(0, (), measurement, measurement.z[:2], C[:2, :2]), Road(), None, False
    )
    assert fixed is not None
    assert not any((fixed.position_cross, fixed.yaw_cross, fixed.speed_cross))


@pytest.mark.parametrize("entry", ["position_cross", "yaw_cross", "speed_cross"])
def test_a_cross_covariance_with_an_unknown_entry_is_named(entry: str) -> None:
    start = Start(
        yaw_rad=0.0,
        **{entry: {"lidar.x_m": (0.1, 0.1) if entry == "position_cross" else 0.1}},
    )
    with pytest.raises(
        CallError, match=r"cross-covariance: the state has no lidar\.x_m"
    ):
        initial_state(CTRV(), start)


def test_of_an_unknown_direction_a_velocity_has_no_correlation() -> None:
    start = Start(position_cross={"speed_mps": (0.5, 0.5)}, speed_std_mps=3.0)
    _, P = initial_state(CV(), start)
    assert not P[:2, 2:].any()
    _, P = initial_state(CTRV(), start)
    assert (P[0, 3], P[1, 3]) == (0.5, 0.5)
