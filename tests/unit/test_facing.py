"""Readings of yaws that may be half a turn off, and the belief about the front of tracks."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm
from support.tracking import START_NS

from fgtrack.core.linalg import kernels
from fgtrack.core.state import to_bytes
from fgtrack.core.types import FloatArray, SmoothedReport, TrackState
from fgtrack.estimation.base import Measurement, Measurements, Start, StatesAt
from fgtrack.models.correlated_errors import ColouredNoiseMeasurement
from fgtrack.models.measurement import measurement_model
from fgtrack.models.motion import CTRV, CV, MotionModel
from fgtrack.tracking.association import (
    GatedEuclidean,
    GatedMahalanobis,
    chi_square_quantile,
)
from fgtrack.tracking.facing import (
    HALF_TURN,
    REVERSED,
    WITHOUT_YAW,
    Facing,
    Facings,
    as_read,
    read,
    turned,
)
from fgtrack.tracking.facing_kernels import BACKWARDS, SLOW_MPS
from fgtrack.tracking.preprocess import Candidates, Group

SHARES = np.array([0.9, 0.07, 0.03])
VARIANCES = {"x_m": 0.09, "y_m": 0.09, "yaw_rad": 0.01, "speed_mps": 0.04}
P = np.diag([0.1, 0.1, 0.02, 1.0, 0.1])
P[0, 2] = P[2, 0] = 0.02
SURE_FRONT = 30.0
UNLIMITED = np.full(4, math.inf)
POLAR_MOTION = CTRV()


def group_of(
    rows: Sequence[dict[str, float]], motion: MotionModel = POLAR_MOTION, **more: Any
) -> Group:
    names = tuple(rows[0])
    z = np.array([list(row.values()) for row in rows])
    R = np.tile(np.diag([VARIANCES[name] for name in names]), (len(rows), 1, 1))
    stack = Measurement(START_NS, measurement_model(names, motion), z, R, **more)
    return Group(np.arange(len(rows)), stack, R, None)


def candidates_of(group: Group) -> Candidates:
    m = len(group.rows)
    lines = np.column_stack([group.stack.z[:, :2], np.full(m, np.nan)])
    return Candidates(list(range(m)), {}, lines, [group])


def tracks_of(*means: Sequence[float], covariance: FloatArray = P) -> StatesAt:
    x = np.array(means, dtype=np.float64)
    return StatesAt(tuple(range(len(x))), x, np.tile(covariance, (len(x), 1, 1)))


def facings_of(
    *log_odds: float, shares: FloatArray = SHARES, cartesian: bool = False
) -> Facings:
    return Facings(np.array(log_odds), shares, cartesian)


def reading_of(
    row: dict[str, float],
    mean: Sequence[float],
    log_odds: float = SURE_FRONT,
    **more: Any,
) -> int:
    group, zero = group_of([row], **more), np.zeros(1, dtype=np.int64)
    limits = np.full(len(row) + 1, math.inf)
    found = read(group, zero, zero, tracks_of(mean), facings_of(log_odds), limits)
    return int(found.codes[0])


def at(yaw_rad: float, **more: float) -> dict[str, float]:
    return {"x_m": 0.1, "y_m": -0.2, "yaw_rad": yaw_rad, **more}


DRIVING = [0.0, 0.0, 0.3, 8.0, 0.0]


@pytest.mark.parametrize("offset_rad", [0.2, -0.2])
@pytest.mark.parametrize(
    ("yaw_rad", "expected"),
    [(0.0, 0), (math.pi, HALF_TURN), (math.pi / 2.0, WITHOUT_YAW), (-1.3, WITHOUT_YAW)],
)
def test_a_yaw_is_read_as_it_is_turned_or_not_at_all(
    yaw_rad: float, expected: int, offset_rad: float
) -> None:
    assert (
        reading_of(at(0.3 + yaw_rad + offset_rad * (expected != WITHOUT_YAW)), DRIVING)
        == expected
    )


def test_an_uncertain_yaw_is_taken_from_the_nearer_end_and_never_left() -> None:
    wide = P + np.diag([0.0, 0.0, 3.0, 0.0, 0.0])
    group, zero = group_of([at(0.3 + 1.2)]), np.zeros(1, dtype=np.int64)
    found = read(
        group,
        zero,
        zero,
        tracks_of(DRIVING, covariance=wide),
        facings_of(SURE_FRONT),
        UNLIMITED,
    )
    assert found.codes[0] == 0


def test_a_track_that_is_known_by_its_rear_expects_yaws_half_a_turn_off() -> None:
    backwards = [0.0, 0.0, 0.3, -8.0, 0.0]
    group, zero = group_of([at(0.3), at(0.3 + math.pi)]), np.zeros(2, dtype=np.int64)
    found = read(
        group, np.arange(2), zero, tracks_of(backwards), facings_of(-20.0), UNLIMITED
    )
    assert found.codes.tolist() == [0, HALF_TURN]
    assert found.costs[0] > found.costs[1] + 2.0 * math.log(SHARES[0] / SHARES[1]) - 1.0
    assert found.evidence[0, 1] > 0.95
    assert found.evidence[1, 1] < 1e-6


def expected_terms(
    row: dict[str, float], mean: Sequence[float], front: bool, cross: float = 0.0
) -> list[float]:
    """The terms of p(z | front or rear) as the definition has it, by SciPy: right, flipped, anything."""
    names = list(row)
    x = np.array(mean)
    H = np.eye(5)[
        [["x_m", "y_m", "yaw_rad", "speed_mps"].index(name) for name in names]
    ]
    R = np.diag([VARIANCES[name] for name in names])
    R[0, -1] = R[-1, 0] = cross
    z = np.array(list(row.values()))
    right, flip, other = SHARES
    has_speed = "speed_mps" in names

    def density(turn: bool, reverse: bool) -> float:
        y, D = z - H @ x, np.eye(len(names))
        k = names.index("yaw_rad")
        if has_speed and reverse:
            D[-1, -1] = -1.0
            y[-1] = -z[-1] - x[3]
        y[k] = math.remainder(y[k] + (math.pi if turn else 0.0), math.tau)
        return float(
            multivariate_normal(np.zeros(len(z)), H @ P @ H.T + D @ R @ D).pdf(y)
        )

    def without(reverse: bool) -> float:
        kept = [k for k, name in enumerate(names) if name != "yaw_rad"]
        y = (z - H @ x)[kept]
        if has_speed and reverse:
            y[-1] = -z[-1] - x[3]
        D = np.diag(
            [-1.0 if reverse and name == "speed_mps" else 1.0 for name in names]
        )
        return float(
            multivariate_normal(
                np.zeros(len(kept)), (H @ P @ H.T + D @ R @ D)[np.ix_(kept, kept)]
            ).pdf(y)
        )

    flips = (
        [density(front, reverse) for reverse in (False, True)]
        if has_speed
        else [density(front, False)]
    )
    return [
        right * density(not front, not front),
        flip * float(np.mean(flips)),
        other * without(not front) / math.tau,
    ]


@pytest.mark.parametrize("speed", [{}, {"speed_mps": 1.1}, {"speed_mps": -0.4}])
@pytest.mark.parametrize("yaw_rad", [0.4, 1.4, -2.6, 3.0])
def test_the_evidence_is_the_ratio_of_the_two_densities(
    yaw_rad: float, speed: dict[str, float]
) -> None:
    """With a speed, its error and that of x are correlated."""
    cross = 0.04 if speed else 0.0
    row, mean = at(yaw_rad, **speed), [0.0, 0.0, 0.3, 0.5, 0.0]
    group, zero = group_of([row]), np.zeros(1, dtype=np.int64)
    if speed:
        group.stack.R[:, 0, -1] = group.stack.R[:, -1, 0] = cross
    found = read(
        group,
        zero,
        zero,
        tracks_of(mean),
        facings_of(0.0),
        np.full(len(row) + 1, math.inf),
    )
    front, rear = (
        sum(expected_terms(row, mean, is_front, cross)) for is_front in (True, False)
    )
    assert found.evidence[0, 0] == pytest.approx(
        math.log(front / rear), rel=1e-9, abs=1e-9
    )


def test_the_cost_of_a_right_yaw_is_that_of_its_innovation() -> None:
    group, zero = group_of([at(0.35)]), np.zeros(1, dtype=np.int64)
    tracks = tracks_of(DRIVING)
    found = read(group, zero, zero, tracks, facings_of(SURE_FRONT), UNLIMITED)
    S = P[:3, :3] + group.stack.R[0]
    y = np.array([0.1, -0.2, 0.05])
    assert found.costs[0] == pytest.approx(
        y @ np.linalg.solve(S, y) + np.linalg.slogdet(S)[1], rel=1e-9
    )


def test_the_cost_is_that_of_the_likeliest_reading() -> None:
    """Costs differ from -2 log p by what all readings of one detection have in common."""
    rows = [at(0.35), at(0.3 + math.pi), at(0.3 + 1.5)]
    group, zeros = group_of(rows), np.zeros(3, dtype=np.int64)
    found = read(
        group,
        np.arange(3),
        zeros,
        tracks_of(DRIVING),
        facings_of(SURE_FRONT),
        UNLIMITED,
    )
    common = 3.0 * math.log(math.tau) - 2.0 * math.log(SHARES[0])
    for cost, row in zip(found.costs, rows, strict=True):
        assert cost + common == pytest.approx(
            -2.0 * math.log(max(expected_terms(row, DRIVING, True))), rel=1e-6
        )


def test_a_gate_passes_each_reading_with_its_own_number_of_components() -> None:
    rule, tracks = GatedMahalanobis(gate_probability=0.99), tracks_of(DRIVING)
    S = P[:2, :2] + 0.09 * np.eye(2)
    edge_m = math.sqrt(chi_square_quantile(0.99, 2) * S[0, 0])
    for x_m, inside in ((0.98 * edge_m, True), (1.02 * edge_m, False)):
        group = group_of([{"x_m": x_m, "y_m": 0.0, "yaw_rad": 0.3 + 1.5}])
        assert (
            bool(
                rule(candidates_of(group), tracks, facings=facings_of(SURE_FRONT)).pairs
            )
            == inside
        )
    assert not rule(candidates_of(group_of([at(0.3 + math.pi)])), tracks).pairs
    assert rule(
        candidates_of(group_of([at(0.3 + math.pi)])),
        tracks,
        facings=facings_of(SURE_FRONT),
    ).pairs


def test_a_euclidean_gate_with_a_nis_reads_yaws_and_one_without_does_not() -> None:
    tracks, flipped = tracks_of(DRIVING), candidates_of(group_of([at(0.3 + math.pi)]))
    limited = GatedEuclidean(gate_m=3.0, max_nis=30.0)
    assert limited(flipped, tracks).refused == (0,)
    assert limited(flipped, tracks, facings=facings_of(SURE_FRONT)).pairs == [(0, 0)]
    assert (limited.reads_yaws, GatedEuclidean().reads_yaws) == (True, False)


def test_cars_abreast_in_opposite_directions_keep_their_detections_where_the_positions_are_vague() -> (
    None
):
    vague = np.diag([4.0, 4.0, 0.02, 1.0, 0.1])
    tracks = tracks_of(
        [0.0, 0.0, 0.0, 8.0, 0.0], [0.0, 2.0, math.pi, 8.0, 0.0], covariance=vague
    )
    rows = [
        {"x_m": 0.0, "y_m": 1.6, "yaw_rad": 0.05},
        {"x_m": 0.0, "y_m": 0.4, "yaw_rad": math.pi - 0.05},
    ]
    found = GatedMahalanobis()(
        candidates_of(group_of(rows)),
        tracks,
        facings=facings_of(SURE_FRONT, SURE_FRONT),
    )
    assert found.pairs == [(0, 0), (1, 1)]


@pytest.mark.parametrize("reverse", [False, True])
def test_a_speed_is_read_along_the_front(reverse: bool) -> None:
    row = {"x_m": 0.0, "y_m": 0.0, "speed_mps": 8.0}
    mean = [0.0, 0.0, 0.3, -8.0 if reverse else 8.0, 0.0]
    assert reading_of(row, mean, -20.0 if reverse else 20.0) == (
        REVERSED if reverse else 0
    )


def test_the_sign_of_a_speed_is_not_guessed_at_rest() -> None:
    row = {"x_m": 0.0, "y_m": 0.0, "speed_mps": 0.3}
    assert reading_of(row, [0.0, 0.0, 0.3, -0.3, 0.0], 0.0) == 0


def test_a_detector_that_turns_the_box_may_turn_the_speed_as_well() -> None:
    mean = [0.0, 0.0, 0.3, 8.0, 0.0]
    assert reading_of(at(0.3 + math.pi, speed_mps=8.0), mean) == HALF_TURN
    assert reading_of(at(0.3 + math.pi, speed_mps=-8.0), mean) == HALF_TURN | REVERSED


def test_the_heading_of_the_map_is_compared_modulo_pi_and_always_used() -> None:
    assert (
        reading_of(at(0.3 + math.pi), DRIVING, 0.0, assumed=("yaw_rad",)) == HALF_TURN
    )
    assert reading_of(at(0.3 + 1.5), DRIVING, 20.0, assumed=("yaw_rad",)) == 0


def test_a_cartesian_state_faces_along_its_velocity() -> None:
    group, zero = group_of([at(0.0), at(math.pi)], CV()), np.zeros(2, dtype=np.int64)
    tracks = tracks_of([0.0, 0.0, 6.0, 0.0], covariance=0.1 * np.eye(4))
    found = read(
        group, np.arange(2), zero, tracks, facings_of(0.0, cartesian=True), UNLIMITED
    )
    assert found.codes.tolist() == [0, HALF_TURN]
    assert found.costs[1] > found.costs[0]


def test_measurements_are_as_they_are_read() -> None:
    group = group_of(
        [
            at(0.1, speed_mps=2.0),
            at(0.2, speed_mps=3.0),
            at(3.0, speed_mps=4.0),
            at(1.0, speed_mps=5.0),
        ]
    )
    R = group.stack.R.copy()
    R[:, 0, 3] = R[:, 3, 0] = 0.01
    stack = replace(group.stack, R=R)
    parts = as_read(stack, np.array([0, WITHOUT_YAW, HALF_TURN, HALF_TURN | REVERSED]))
    (rows, whole), (left, short) = parts
    assert (list(rows), list(left)) == ([0, 2, 3], [1])
    np.testing.assert_allclose(whole.z[:, 2], [0.1, 3.0 - math.pi, 1.0 - math.pi])
    np.testing.assert_allclose(whole.z[:, 3], [2.0, 4.0, -5.0])
    np.testing.assert_allclose(whole.R[:, 0, 3], [0.01, 0.01, -0.01])
    assert short.model.components == ("x_m", "y_m", "speed_mps")
    np.testing.assert_allclose(short.z, [[0.1, -0.2, 3.0]])
    np.testing.assert_allclose(short.R[0], R[0][np.ix_([0, 1, 3], [0, 1, 3])])
    assert as_read(stack, np.zeros(4, dtype=np.int64)) == [(slice(None), stack)]


def test_a_part_of_a_model_with_correlated_errors_keeps_their_gains() -> None:
    gain = np.array([[0.3, 0.0, 0.0], [0.0, 0.4, 0.0], [0.0, 0.0, 0.5]])
    names = (*CTRV().state_names, "a", "b", "c")
    model = ColouredNoiseMeasurement(("x_m", "y_m", "yaw_rad"), names, (5, 6, 7), gain)
    x = np.arange(1.0, 9.0)
    np.testing.assert_allclose(model.part([0, 1]).predict(x), model.predict(x)[:2])
    np.testing.assert_allclose(model.part([0, 1]).jacobian(x), model.jacobian(x)[:2])
    assert model.part([0, 1]).components == ("x_m", "y_m")


def test_the_evidence_of_a_speed_is_the_probability_of_reversing() -> None:
    """Two thresholds at one speed enclose log (f (1 - b) + (1 - f) b) / (f b + (1 - f) (1 - b))."""
    speed, variance = -1.7, 0.6
    f = norm.cdf(speed / math.sqrt(variance + SLOW_MPS**2))
    belief = math.log(
        (f * (1.0 - BACKWARDS) + (1.0 - f) * BACKWARDS)
        / (f * BACKWARDS + (1.0 - f) * (1.0 - BACKWARDS))
    )
    means = np.array([[0.0, 0.0, 0.3, speed, 0.0]])
    covariances = np.diag([1.0, 1.0, 1.0, variance, 1.0])[None]
    decide = kernels("fgtrack.tracking.facing_kernels").turned
    for offset, expected in ((-1e-6, True), (1e-6, False)):
        result = decide(
            means,
            covariances,
            np.array([offset - belief]),
            np.array([not expected]),
            0.0,
        )
        assert result.tolist() == [expected]


class Tracks:
    """One track with a yaw of 0.3 rad, and the yaws of a sensor."""

    def __init__(self, first_rad: float | None = 0.3, cartesian: bool = False) -> None:
        self.facing = Facing(cartesian)
        self.stamp_ns = START_NS
        names = ("x_m", "y_m") if first_rad is None else ("x_m", "y_m", "yaw_rad")
        first = Measurement(
            START_NS,
            measurement_model(names, CTRV()),
            np.zeros(len(names)),
            np.eye(len(names)),
        )
        self.facing.born(0, "lidar", Start(stamp_ns=START_NS, yaw_rad=first_rad), first)

    def see(
        self, *yaws_rad: float, speed_mps: float = 0.0, sensor: str = "lidar"
    ) -> list[str | None]:
        words = []
        for yaw_rad in yaws_rad:
            self.stamp_ns += 100_000_000
            state = tracks_of([0.0, 0.0, 0.3, speed_mps, 0.0])
            candidates = candidates_of(group_of([at(yaw_rad)]))
            found = self.facing.read(
                sensor, self.stamp_ns, candidates, [(0, 0)], (), state
            )
            words.append(None if found is None else found.words[0])
        return words

    def yaw_speed(self, speed_mps: float = 0.0) -> tuple[float, float]:
        state = TrackState(
            self.stamp_ns, np.array([0.0, 0.0, 0.3, speed_mps, 0.1]), np.eye(5)
        )
        [published] = self.facing.published((0,), [state])
        return float(published.mean[2]), float(published.mean[3])


BACK = 0.3 - math.pi


def test_a_standing_track_that_began_with_a_flipped_yaw_turns_round_after_a_few() -> (
    None
):
    tracks = Tracks()
    seen = []
    for _ in range(6):
        tracks.see(BACK)
        seen.append(tracks.yaw_speed()[0])
    assert seen[0] == 0.3
    assert seen[4] == pytest.approx(BACK)
    assert seen[5] == pytest.approx(BACK)


def test_a_moving_track_that_began_with_a_flipped_yaw_turns_at_the_next() -> None:
    tracks = Tracks()
    tracks.see(BACK, speed_mps=-8.0)
    assert tracks.yaw_speed(-8.0) == pytest.approx((BACK, 8.0))


def test_a_reversing_track_is_published_with_its_measured_yaw_and_a_negative_speed() -> (
    None
):
    tracks = Tracks()
    for _ in range(30):
        tracks.see(0.3, speed_mps=-3.0)
        assert tracks.yaw_speed(-3.0) == (0.3, -3.0)


def test_five_flips_in_a_row_do_not_turn_an_old_track() -> None:
    tracks = Tracks()
    tracks.see(*[0.3] * 50)
    assert tracks.see(*[BACK] * 5) == ["flipped"] * 5
    assert tracks.yaw_speed()[0] == 0.3


def test_a_track_without_yaws_faces_as_it_moves_and_keeps_its_front_at_rest() -> None:
    tracks = Tracks(first_rad=None)
    assert tracks.yaw_speed(-8.0) == pytest.approx((BACK, 8.0))
    assert tracks.yaw_speed(0.3) == pytest.approx((BACK, -0.3))
    assert tracks.yaw_speed(8.0) == (0.3, 8.0)


def test_a_turned_state_is_the_same_motion_with_its_covariance() -> None:
    rng = np.random.default_rng(3)
    root = rng.normal(size=(6, 6))
    state = TrackState(5, np.array([1.0, 2.0, 2.9, 4.0, 0.3, -1.0]), root @ root.T)
    [opposite] = turned([state], np.array([True]))
    np.testing.assert_allclose(opposite.mean, [1.0, 2.0, 2.9 - math.pi, -4.0, 0.3, 1.0])
    T = np.diag([1.0, 1.0, 1.0, -1.0, 1.0, -1.0])
    np.testing.assert_array_equal(opposite.covariance, T @ state.covariance @ T)
    velocity = [
        state.mean[3] * np.cos(state.mean[2]),
        state.mean[3] * np.sin(state.mean[2]),
    ]
    turned_mean = opposite.mean
    np.testing.assert_allclose(
        velocity,
        turned_mean[3] * np.array([np.cos(turned_mean[2]), np.sin(turned_mean[2])]),
    )


def test_smoothed_states_face_as_the_track_until_its_last_ones_are_published() -> None:
    tracks = Tracks()
    tracks.see(*[BACK] * 6)
    tracks.yaw_speed()
    report = SmoothedReport(
        0, TrackState(START_NS, np.array([0.0, 0.0, 0.3, 1.0, 0.0]), np.eye(5))
    )
    for end in (False, True):
        if end:
            tracks.facing.forget(0)
        [result] = tracks.facing.smoothed([report])
        assert (result.state.mean[2], result.state.mean[3]) == pytest.approx(
            (BACK, -1.0)
        )
    [again] = tracks.facing.smoothed([report])
    assert again is report


def test_shares_of_wrong_yaws_are_learned_by_sensor() -> None:
    tracks, rng = Tracks(), np.random.default_rng(1)
    for _ in range(400):
        kind = rng.random()
        tracks.see(
            BACK if kind < 0.3 else 0.3 + 1.5 if kind < 0.4 else 0.3, speed_mps=8.0
        )
        tracks.see(0.3, speed_mps=8.0, sensor="camera")
    spread = 3.0 * math.sqrt(0.3 * 0.7 / 200.0)
    shares = tracks.facing.at("lidar", (0,)).shares
    assert abs(shares[1] - 0.3) < spread
    assert abs(shares[2] - 0.1) < spread
    assert tracks.facing.at("camera", (0,)).shares[0] > 0.98
    counts = tracks.facing.counts["lidar"]
    assert counts["yaws"] == 400
    assert abs(counts["flipped"] - 120) < 3.0 * math.sqrt(400 * 0.3 * 0.7)
    assert abs(counts["unused"] - 40) < 3.0 * math.sqrt(400 * 0.1 * 0.9)


def test_a_detector_that_begins_to_flip_is_noticed_within_its_memory() -> None:
    tracks = Tracks()
    tracks.see(*[0.3] * 2000, speed_mps=8.0)
    tracks.see(*[0.3, BACK] * 150, speed_mps=8.0)
    assert tracks.facing.at("lidar", (0,)).shares[1] > 0.3


def test_late_yaws_are_the_same_evidence() -> None:
    """Without time between them, front and rear have no time to change places."""
    results = []
    for order in ([0.3, BACK, 0.3, 0.3], [0.3, 0.3, 0.3, BACK]):
        tracks = Tracks()
        for yaw_rad in order:
            tracks.stamp_ns = START_NS - 100_000_000
            tracks.see(yaw_rad)
        results.append(float(tracks.facing.at("lidar", (0,)).log_odds[0]))
    assert results[0] == pytest.approx(results[1], abs=0.2)


def test_old_evidence_of_a_cartesian_state_fades_sooner() -> None:
    """Its yaw is the direction of the velocity: that of the rear as soon as the object begins to reverse."""
    left = []
    for cartesian in (False, True):
        tracks = Tracks(cartesian=cartesian)
        tracks.see(*[0.3] * 20)
        tracks.stamp_ns += 10_000_000_000
        tracks.see(0.3)
        left.append(float(tracks.facing.at("lidar", (0,)).log_odds[0]))
    assert left[1] < 2.0 * math.log(3.0) < 4.0 * math.log(3.0) < left[0]


def test_measurements_of_one_stack_come_apart_and_keep_their_tracks() -> None:
    group = group_of([at(0.3), at(0.3 + 1.5)])
    parts = as_read(group.stack, np.array([0, WITHOUT_YAW]))
    assert [
        (list(rows), Measurements(part)[0].model.components) for rows, part in parts
    ] == [
        ([0], ("x_m", "y_m", "yaw_rad")),
        ([1], ("x_m", "y_m")),
    ]


def test_the_readings_of_the_association_are_those_of_the_pairs_alone() -> None:
    """The association has compared all pairs; the assigned ones are looked up by their candidates and tracks."""
    states = tracks_of(
        [0.0, 0.0, 0.0, 8.0, 0.0],
        [20.0, 0.0, 1.0, 8.0, 0.0],
        [40.0, 0.0, 2.0, 8.0, 0.0],
    )
    rows = [
        {"x_m": 40.1, "y_m": 0.0, "yaw_rad": 2.0 - math.pi},
        {"x_m": 0.1, "y_m": 0.0, "yaw_rad": 0.1},
    ]
    rows.append({"x_m": 20.1, "y_m": 0.0, "yaw_rad": 2.5})
    candidates = candidates_of(group_of(rows))
    results = []
    for is_given in (True, False):
        facing = Facing(cartesian=False)
        for track_id in range(3):
            first = Measurement(
                START_NS,
                measurement_model(("x_m", "y_m"), CTRV()),
                np.zeros(2),
                np.eye(2),
            )
            facing.born(track_id, "lidar", Start(stamp_ns=START_NS, yaw_rad=0.0), first)
        found = GatedMahalanobis()(
            candidates, states, facings=facing.at("lidar", states.track_ids)
        )
        assert found.pairs == [(0, 2), (1, 0), (2, 1)]
        given = found.readings if is_given else ()
        read_yaws = facing.read(
            "lidar", START_NS + 1, candidates, found.pairs, given, states
        )
        assert read_yaws is not None
        results.append(
            (
                read_yaws.readings.tolist(),
                read_yaws.words,
                facing.at("lidar", (0, 1, 2)).log_odds.tolist(),
            )
        )
    assert results[0] == results[1]
    assert results[0][0] == [HALF_TURN, 0, WITHOUT_YAW]
    assert results[0][1] == ["flipped", None, "unused"]


def test_yaws_that_arrive_late_for_ever_leave_a_finite_belief() -> None:
    tracks = Tracks()
    for _ in range(2000):
        tracks.stamp_ns = START_NS - 200_000_000
        tracks.see(0.3)
    tracks.stamp_ns = START_NS + 1_000_000_000
    tracks.see(0.3)
    assert 1.0 < tracks.facing.at("lidar", (0,)).log_odds[0] < 40.0


def test_rows_of_ended_tracks_are_used_again() -> None:
    facing = Facing(cartesian=False)
    first = Measurement(
        START_NS, measurement_model(("x_m", "y_m"), CTRV()), np.zeros(2), np.eye(2)
    )
    for track_id in range(1000):
        facing.born(track_id, "lidar", Start(stamp_ns=START_NS), first)
        if track_id >= 20:
            facing.forget(track_id - 20)
    assert len(facing._log_odds) <= 32
    assert facing.at("lidar", tuple(range(980, 1000))).log_odds.tolist() == [0.0] * 20


def test_the_heading_of_the_map_is_turned_for_a_track_known_by_its_rear_and_teaches_nothing() -> (
    None
):
    tracks = Tracks()
    candidates = candidates_of(group_of([at(0.3 + math.pi)], assumed=("yaw_rad",)))
    states = tracks_of(DRIVING)
    before = tracks.facing.at("lidar", (0,))
    found = GatedMahalanobis()(candidates, states, facings=before)
    result = tracks.facing.read(
        "lidar", START_NS + 1, candidates, found.pairs, found.readings, states
    )
    assert result is not None
    assert (result.readings.tolist(), result.words) == ([HALF_TURN], [None])
    after = tracks.facing.at("lidar", (0,))
    assert (after.log_odds == before.log_odds).all()
    assert (after.shares == before.shares).all()
    assert tracks.facing.counts == {}


def test_a_track_whose_start_was_interrupted_has_no_front_to_forget() -> None:
    tracks = Tracks()
    before = to_bytes(tracks.facing.checkpoint())
    tracks.facing.forget(7)
    assert to_bytes(tracks.facing.checkpoint()) == before
    assert tracks.see(0.3) == [None]
