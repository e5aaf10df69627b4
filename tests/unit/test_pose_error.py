"""The error of the ego in the noise of its detections."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.tracking import StraightRoad, batch

from fgtrack.core.types import Detection, FloatArray, Frame
from fgtrack.estimation.base import Measurement
from fgtrack.models.correlated_errors import total_error, with_correlated_errors
from fgtrack.models.motion import CTRV, CV, MotionModel
from fgtrack.models.road import Road
from fgtrack.models.sensors import Correlation, Mount, SensorModel
from fgtrack.tracking.detections import ConnectedMerge, NoMerge
from fgtrack.tracking.ego.trajectory import EgoPose
from fgtrack.tracking.preprocess import Candidates, Preprocess

MOUNT = Mount(2.0, 1.0, 0.7)
ORIGIN_M = (-1.74, 0.3)
EGO = EgoPose(100.0, 50.0, 1.1, 20.0, 0.4)
ROOT = (
    np.random.default_rng(8).normal(size=(5, 5))
    * np.array([0.3, 0.3, 0.01, 0.2, 0.02])[:, None]
)
P = ROOT @ ROOT.T
PLACE = {"x_m": 30.0, "y_m": -12.0}
SEEN = {"range_m": 40.0, "bearing_rad": 0.3}
STD = {
    "x_m": 0.3,
    "y_m": 0.2,
    "yaw_rad": 0.1,
    "speed_mps": 0.5,
    "range_m": 0.4,
    "bearing_rad": 0.01,
}
STD["range_rate_mps"] = 0.1
CASES = (
    PLACE,
    {**PLACE, "yaw_rad": 0.2, "speed_mps": 15.0},
    {**PLACE, "range_rate_mps": 3.0},
    SEEN,
    {"bearing_rad": 0.3},
    {**SEEN, "range_rate_mps": 3.0},
    {"yaw_rad": -0.4, **SEEN},
)


def candidates(
    ego: EgoPose | None,
    *seen: dict[str, float],
    frame: Frame = "ego",
    road: Road | None = None,
    motion: MotionModel | None = None,
) -> Candidates:
    sensor = SensorModel(std={name: STD[name] for name in seen[0]}, mount=MOUNT)
    if road is not None:
        sensor = replace(sensor, yaw_from_map_std_rad=0.3)
    merge = ConnectedMerge(5.1) if len(seen) > 1 else NoMerge()
    preprocess = Preprocess(road or Road(), merge, motion or CTRV(), ORIGIN_M)
    return preprocess(
        batch(*(Detection(**values) for values in seen), frame=frame), sensor, ego
    )[0]


def noise_at(found: Candidates, x: FloatArray) -> FloatArray:
    """R of the first candidate at the states `x` (p, n)."""
    first = np.zeros(len(x), dtype=int)
    return (
        found.groups[0]
        .seen_at(first, x, np.zeros((1, x.shape[-1], x.shape[-1])), first)
        .R
    )


def innovation(measurement: Measurement, x: FloatArray) -> FloatArray:
    return measurement.model.residual(
        measurement.z, measurement.model.predict(x, measurement.pose)
    )


def by_the_ego(
    x: FloatArray, seen: Sequence[dict[str, float]], frame: Frame, **more
) -> FloatArray:
    """Derivative of the innovation by the five entries of the ego, as central differences."""
    columns = []
    for entry, step in enumerate((1e-3, 1e-3, 1e-6, 1e-4, 1e-5)):
        ends = [list(EGO[:5]), list(EGO[:5])]
        ends[0][entry] += step
        ends[1][entry] -= step
        ahead, back = (
            innovation(
                candidates(EgoPose(*end), *seen, frame=frame, **more)[0].measurement, x
            )
            for end in ends
        )
        columns.append((ahead - back) / (2.0 * step))
    return np.stack(columns, axis=1)


@pytest.mark.parametrize("frame", ["ego", "sensor"])
@pytest.mark.parametrize("seen", CASES, ids=lambda seen: ",".join(seen))
@pytest.mark.parametrize("motion", [CTRV(), CV()], ids=["ctrv", "cv"])
def test_the_noise_grows_by_the_numeric_derivative(
    seen: dict[str, float], frame: Frame, motion: MotionModel
) -> None:
    """Of all components together, signs and correlations included, at a state that is not where the detection is."""
    x = np.zeros(motion.dim)
    x[:4] = (130.0, 70.0, 2.0, 15.0) if motion.dim == 5 else (130.0, 70.0, -6.0, 13.0)
    plain = candidates(EGO, seen, frame=frame, motion=motion)[0]
    found = candidates(EGO._replace(covariance=P), seen, frame=frame, motion=motion)
    J = by_the_ego(x, [seen], frame, motion=motion)
    assert np.abs(J).max() > 0.5
    R = noise_at(found, np.array([x, x + 1.0]))
    np.testing.assert_allclose(
        R[0] - plain.measurement.R, J @ P @ J.T, rtol=1e-5, atol=1e-9
    )
    np.testing.assert_allclose(R[1], noise_at(found, x[None] + 1.0)[0], rtol=1e-12)
    np.testing.assert_array_equal(found[0].measurement.z, plain.measurement.z)


def test_ten_milliradians_at_sixty_metres_are_sixty_centimetres_across() -> None:
    covariance = np.diag([0.0, 0.0, 1e-4, 0.0, 0.0])
    [found] = candidates(
        EGO._replace(yaw_rad=0.0, covariance=covariance), {"x_m": 61.74, "y_m": 0.0}
    )
    np.testing.assert_allclose(
        np.diag(found.measurement.R), [0.3**2 + 0.003**2, 0.2**2 + 0.6**2]
    )
    assert found.position_covariance is not None
    np.testing.assert_array_equal(found.position_covariance, found.measurement.R)


def test_it_does_not_average_out_in_a_merge() -> None:
    near = {"x_m": 31.0, "y_m": -12.0}
    [plain] = candidates(EGO, PLACE, near)
    [found] = candidates(EGO._replace(covariance=P), PLACE, near)
    middle = {"x_m": 30.5, "y_m": -12.0}
    J = by_the_ego(np.zeros(5), [middle], "ego")
    np.testing.assert_allclose(
        found.measurement.R - plain.measurement.R, J @ P @ J.T, rtol=1e-6, atol=1e-9
    )


def test_a_heading_from_the_map_is_not_turned_by_the_ego() -> None:
    [found] = candidates(EGO._replace(covariance=P), PLACE, road=StraightRoad())
    assert found.measurement.R[2] == pytest.approx([0.0, 0.0, 0.09])
    assert found.measurement.R[0, 0] > 0.1


def test_a_bearing_alone_knows_the_error_of_the_yaw_and_at_a_state_that_of_the_place() -> (
    None
):
    covariance = np.diag([0.25, 0.25, 1e-4, 0.0, 0.0])
    found = candidates(
        EGO._replace(covariance=covariance), {"bearing_rad": 0.3}, frame="sensor"
    )
    assert found[0].measurement.R[0] == pytest.approx([1e-4 + 1e-4], rel=1e-5)
    pose = found[0].measurement.pose
    at = np.array([pose.x_m + 10.0, pose.y_m, 0.0, 0.0, 0.0])
    assert (
        float(noise_at(found, at[None])[0, 0, 0])
        > 1e-4 + 0.0025 + 1e-4 * (1.0 - 0.4) ** 2
    )


@pytest.mark.parametrize("covariance", [None, P])
def test_positions_in_the_map_and_an_ego_without_covariance_are_left_as_they_are(
    covariance: FloatArray | None,
) -> None:
    ego = EGO._replace(covariance=covariance)
    found = [candidates(ego, PLACE, frame="map"), candidates(None, PLACE, frame="map")]
    found += [candidates(ego, PLACE)] if covariance is None else []
    for each in found:
        assert each.groups[0].error is None
        np.testing.assert_array_equal(
            noise_at(each, np.zeros((1, 5)))[0], each[0].measurement.R
        )


@given(yaw=st.floats(-3.1, 3.1))
def test_a_yaw_comes_to_the_map_with_a_range_and_a_bearing_too(yaw: float) -> None:
    [found] = candidates(EGO, {"yaw_rad": yaw, **SEEN}, frame="sensor")
    assert math.remainder(
        found.values["yaw_rad"] - yaw - EGO.yaw_rad - MOUNT.yaw_rad, math.tau
    ) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("seen", [PLACE, SEEN], ids=lambda seen: ",".join(seen))
def test_a_lasting_error_of_the_sensor_and_that_of_the_ego_stand_side_by_side(
    seen: dict[str, float],
) -> None:
    lasting = SensorModel(
        std={name: STD[name] for name in seen}, mount=MOUNT, correlation=Correlation()
    )
    motion = with_correlated_errors(CTRV(), {"lidar": lasting})
    plain = candidates(EGO._replace(covariance=P), seen)
    preprocess = Preprocess(Road(), NoMerge(), motion, ORIGIN_M)
    found, _ = preprocess(batch(Detection(**seen)), lasting, EGO._replace(covariance=P))
    x = np.array([130.0, 70.0, 2.0, 15.0, 0.1, 0.5, -0.5])
    whole = total_error(found[0].measurement.model, noise_at(found, x[None])[0])
    np.testing.assert_allclose(whole, noise_at(plain, x[None, :5])[0], rtol=1e-12)
    np.testing.assert_allclose(
        found[0].position_covariance, plain[0].position_covariance, rtol=1e-12
    )
