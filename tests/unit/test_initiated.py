"""Initiation around estimators that know nothing of it, and its setting in a configuration."""

from dataclasses import replace

import numpy as np
import pytest
from support.directions import PERIOD_NS, START, positions
from support.examples import slow

import fgtrack
from fgtrack.config.motion import InitiationConfig, MotionConfig
from fgtrack.config.settings import Config, MapConfig
from fgtrack.core.geometry import wrap_angle
from fgtrack.core.types import YAW
from fgtrack.estimation.base import Estimator, Measurement, Start
from fgtrack.estimation.filters.track_initiation import MOST_MEASUREMENTS, Initiated
from fgtrack.estimation.registry import ESTIMATORS, Claims, start_estimator
from fgtrack.karle2023.backward_forward import BackwardForwardBank
from fgtrack.models.motion import CTRV, MotionModel
from fgtrack.pipeline.build import build_bank
from fgtrack.testing import estimator_checks

NAMES = [
    name for name in ESTIMATORS if name not in ("smoother-batch", "as-current", "drop")
]


@pytest.mark.parametrize("name", NAMES)
def test_every_estimator_finds_the_direction(name: str) -> None:
    """Against yaw 0, where one-point initiation leaves a filter linearised."""
    order = [0, 2, 1, *range(3, 12)]
    measurements = [positions(3.0, 12)[k] for k in order]
    off_rad = {}
    for method in ("one-point", "two-point", "regression"):
        estimator = fgtrack.estimator(name, CTRV(), START, initiation=method)
        for measurement in measurements:
            estimator.update(measurement)
        off_rad[method] = abs(
            wrap_angle(estimator.state_at(12 * PERIOD_NS).mean[YAW] - 3.0)
        )
    assert max(off_rad["two-point"], off_rad["regression"]) < 0.15, off_rad


def test_it_begins_again_until_the_direction_is_certain_and_then_no_more() -> None:
    starts: list[Start] = []

    def make(start: Start) -> Estimator:
        starts.append(start)
        return fgtrack.estimator("ekf-replay", CTRV(), start)

    start_estimator_of(make, positions(2.0, 20))
    assert starts[0].yaw_rad is None
    assert 2 < len(starts) < 15
    assert all(
        abs(wrap_angle((start.yaw_rad or 0.0) - 2.0)) < 0.5 for start in starts[1:]
    )
    assert starts[-1].yaw_std_rad == pytest.approx(
        np.pi / np.sqrt(3.0)
    )  # the measurements say it once more
    starts.clear()
    start_estimator_of(make, positions(2.0, 60, speed_mps=0.0))
    assert (
        len(starts) == MOST_MEASUREMENTS + 2
    )  # the first one, and after the last that takes part


def start_estimator_of(make: object, measurements: list[Measurement]) -> None:
    def factory(motion: MotionModel, start: Start, lag_s: float) -> Estimator:
        return make(start)  # type: ignore[operator, no-any-return]

    estimator = start_estimator("made", factory, CTRV(), START, 1.0, {})
    assert isinstance(estimator, Initiated)
    for measurement in measurements:
        estimator.update(measurement)


def test_a_window_that_moves_on_ends_it() -> None:
    estimator = fgtrack.estimator("rts", CTRV(), START, lag_s=0.2)
    for measurement in positions(2.0, 12, speed_mps=0.5):
        assert estimator.update(measurement).nis is not None
    state = estimator.state_at(12 * PERIOD_NS)
    assert np.isfinite(state.mean).all()


@pytest.mark.parametrize(
    "name", ["ekf-replay", *slow("smoother", "reorder-buffer", "al1")]
)
def test_the_contract_holds_with_an_unknown_direction(name: str) -> None:
    made = ESTIMATORS.load(name)

    def unknown(motion: MotionModel, start: Start, lag_s: float) -> Estimator:
        if not motion.linear:
            start = replace(start, yaw_rad=None, yaw_std_rad=None)
        return start_estimator(name, made, motion, start, lag_s, {})

    vars(unknown).update({**vars(Claims.of(made)), "bank": False, "initiates": True})
    checks = estimator_checks(unknown, seed=3, num_streams=3)
    del checks[
        "gives the posterior of a nonlinear model"
    ]  # of which the heading is known at the start
    for check in checks.values():
        check()


@pytest.mark.parametrize(
    "name", ["ekf-replay", "smoother", "rts", "ekf-backward-forward"]
)
def test_the_configuration_says_it_for_all_tracks(name: str) -> None:
    config = Config(
        name,
        motion=MotionConfig(kind="ctrv"),
        initiation=InitiationConfig(method="two-point"),
    )
    bank = build_bank(config)
    one = fgtrack.estimator(
        name, config.motion.model(), START, lag_s=3.5, initiation="two-point"
    )
    bank.birth(1, START)
    for measurement in positions(2.0, 4):
        bank.advance(measurement.stamp_ns)
        bank.update(measurement.stamp_ns, [1], [measurement])
        one.update(measurement)
    mean = bank.states_at(4 * PERIOD_NS).means[0]
    mean[2] = wrap_angle(float(mean[2]))  # a state may have turned more than once
    np.testing.assert_allclose(mean, one.state_at(4 * PERIOD_NS).mean, atol=1e-9)


def test_on_a_map_backward_forward_stays_one_bank_for_all_objects() -> None:
    bank = build_bank(
        Config(estimator="ekf-backward-forward", map=MapConfig(track="oval"))
    )
    assert isinstance(bank, BackwardForwardBank)
