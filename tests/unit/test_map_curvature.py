"""A yaw rate from the curvature of the map."""

import math
from dataclasses import replace

import numpy as np
import pytest

import fgtrack
from fgtrack.config.motion import MotionConfig
from fgtrack.config.reading import read_config
from fgtrack.config.settings import Config
from fgtrack.core.types import YAW_RATE
from fgtrack.estimation.base import Estimator, Measurement, Start
from fgtrack.models.motion import CTRV

RADIUS_M, SPEED_MPS, STD_M, CURVATURE_STD = 150.0, 60.0, 0.3, 0.001
START = Start(speed_mps=55.0, speed_std_mps=5.0, yaw_rad=0.0, yaw_std_rad=0.2)
MS = 1_000_000


def on_the_circle(curvature_radpm: float | None, num: int = 16) -> list[Measurement]:
    """Positions every 50 ms of a car that turns left, and what a map says of the curvature there."""
    rng, found = np.random.default_rng(4), []
    for k in range(1, num + 1):
        angle = SPEED_MPS * 0.05 * k / RADIUS_M
        x_m, y_m = RADIUS_M * np.array(
            [math.sin(angle), 1.0 - math.cos(angle)]
        ) + STD_M * rng.standard_normal(2)
        values, std, assumed = (
            {"x_m": x_m, "y_m": y_m},
            {"x_m": STD_M, "y_m": STD_M},
            (),
        )
        if curvature_radpm is not None:
            values["curvature_radpm"], std["curvature_radpm"] = (
                curvature_radpm,
                CURVATURE_STD,
            )
            assumed = ("curvature_radpm",)
        found.append(Measurement.of(50 * MS * k, std=std, assumed=assumed, **values))
    return found


def fed(name: str, measurements: list[Measurement]) -> Estimator:
    estimator = fgtrack.estimator(name, CTRV(), START, lag_s=2.0)
    for measurement in measurements:
        assert estimator.update(measurement).innovation is not None
    return estimator


@pytest.mark.parametrize("name", ["ekf-replay", "smoother", "ekf-backward-forward"])
def test_it_gives_the_yaw_rate_that_positions_do_not_show(name: str) -> None:
    """To the standard deviation of the curvature times the speed, from the first measurement on."""
    plain, curved = (
        fed(name, on_the_circle(curvature, num=1))
        for curvature in (None, 1.0 / RADIUS_M)
    )
    at_ns = 50 * MS
    expected, std = SPEED_MPS / RADIUS_M, CURVATURE_STD * 55.0
    assert math.sqrt(plain.state_at(at_ns).covariance[YAW_RATE, YAW_RATE]) > 3.0 * std
    found = curved.state_at(at_ns)
    assert math.sqrt(found.covariance[YAW_RATE, YAW_RATE]) == pytest.approx(
        std, rel=0.2
    )
    assert found.mean[YAW_RATE] == pytest.approx(expected, abs=0.1)


def test_it_is_no_measurement_for_the_nis() -> None:
    [plain], [wrong] = on_the_circle(None, num=1), on_the_circle(0.5, num=1)
    first, second = (
        fgtrack.estimator("ekf-replay", CTRV(), START).update(each)
        for each in (plain, wrong)
    )
    assert second.nis == pytest.approx(first.nis)


def test_a_model_without_a_yaw_rate_is_refused() -> None:
    config = read_config(
        "smoother", ["sensors.radar.curvature_from_map_std_radpm=0.001"]
    )
    with pytest.raises(
        ValueError,
        match=r"sensors.radar.curvature_from_map_std_radpm: needs motion.kind ctrv or ctra",
    ):
        replace(config, motion=MotionConfig("cv", {"velocity": 1.0}))
    assert isinstance(config, Config)
