"""How a smoother finds the direction of an object that starts with an unknown one."""

import numpy as np
import pytest

from fgtrack.core.geometry import rotation
from fgtrack.estimation.base import Measurement, Start
from fgtrack.estimation.filters.initiation import Fix, Line, Search, fixes_of, over
from fgtrack.estimation.object_bank import SingleObject
from fgtrack.estimation.smoothing.bank import SmootherBank
from fgtrack.estimation.smoothing.solver import Solver
from fgtrack.models.motion import CTRV
from fgtrack.models.sensors import RobustLoss

STD_M = 0.5
STD = {"x_m": STD_M, "y_m": STD_M}
PERIOD_NS = (
    20_000_000  # in which the object moves hardly further than a standard deviation
)
EXACT = dict.fromkeys(CTRV.state_names, 1e-6)


def start() -> Start:
    return Start(position_std_m=STD_M, yaw_std_rad=np.pi, speed_std_mps=40.0)


def fused(
    yaw_rad: float, num: int, seed: int = 0, loss: RobustLoss | None = None
) -> SingleObject:
    """A smoother after `num` positions of an object at 30 m/s; the same but for the direction."""
    rng = np.random.default_rng(seed)
    smoother = SingleObject(
        CTRV(), SmootherBank(CTRV(), 1.0, relinearise=EXACT), start()
    )
    for k in range(1, num + 1):
        along_across = np.array(
            [30.0 * k * PERIOD_NS / 1e9, 0.0]
        ) + STD_M * rng.standard_normal(2)
        x_m, y_m = (rotation(yaw_rad) @ along_across).tolist()
        smoother.update(
            Measurement.of(k * PERIOD_NS, x_m=x_m, y_m=y_m, std=STD, loss=loss)
        )
    return smoother


@pytest.mark.parametrize("yaw_rad", [-2.5, -1.0, 1.5, 3.0])
def test_no_direction_of_travel_is_preferred(yaw_rad: float) -> None:
    """That at which the state began is none that was known."""
    for num in (2, 4, 20):
        ahead, turned = (
            fused(yaw, num).state_at(num * PERIOD_NS).mean for yaw in (0.0, yaw_rad)
        )
        ahead[:2] = rotation(yaw_rad) @ ahead[:2]
        turn = np.array([0.0, 0.0, yaw_rad, 0.0, 0.0])
        off = turned - ahead - turn
        off[2] = np.angle(np.exp(1j * off[2]))
        np.testing.assert_allclose(off, 0.0, atol=1e-3)
    assert abs(turned[3] - 30.0) < 5.0
    assert abs(np.angle(np.exp(1j * (turned[2] - yaw_rad)))) < 0.3


@pytest.mark.parametrize("seed", range(3, 7))
@pytest.mark.parametrize(
    "loss", [None, RobustLoss("cauchy", 2.0)], ids=["gaussian", "cauchy"]
)
def test_while_the_direction_is_uncertain_every_measurement_is_solved_to_convergence(
    seed: int, loss: RobustLoss | None
) -> None:
    for num in (1, 2):
        smoother = fused(-2.5, num, seed, loss)
        found = smoother.state_at(num * PERIOD_NS)
        smoother.bank.converge()  # type: ignore[attr-defined]  # a smoother's
        off = found.mean - smoother.state_at(num * PERIOD_NS).mean
        assert np.abs(off / np.sqrt(np.diag(found.covariance))).max() < 1e-3


def test_a_certain_direction_is_not_sought_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A line is a poor guess of a bend, so it serves as long as it must and no longer."""
    restarts: list[Line] = []
    restart = Solver.restart
    monkeypatch.setattr(
        Solver,
        "restart",
        lambda self, track, line: (restarts.append(line), restart(self, track, line)),
    )
    fused(1.0, 20)
    assert over(restarts[-1], "regression", 3.0)
    assert not any(over(line, "regression", 3.0) for line in restarts[:-1])
    assert 1 < len(restarts) < 20
    restarts.clear()
    standing = SingleObject(CTRV(), SmootherBank(CTRV(), 0.1), start())
    for k in range(1, 20):
        standing.update(Measurement.of(k * PERIOD_NS, x_m=0.0, y_m=0.0, std=STD))
    assert len(restarts) == 5  # until the first node left the window
    restarts.clear()
    smoother = SingleObject(
        CTRV(), SmootherBank(CTRV(), 1.0, relinearise=EXACT), Start(yaw_rad=0.0)
    )
    smoother.update(Measurement.of(PERIOD_NS, x_m=1.0, y_m=0.0, std=STD))
    assert not restarts


def test_certainty_counts_standard_deviations_of_the_velocity() -> None:
    assert not over(
        Line(np.zeros(2), np.array([0.0, 5.8]), np.diag([1.0, 4.0])), "regression", 2.9
    )
    line = Line(np.zeros(2), np.array([0.0, 6.2]), np.diag([1.0, 4.0]))
    assert over(line, "regression", 3.0)
    assert not over(line, "regression", 3.2)
    assert over(line, "two-point", 3.2)


def test_a_line_that_is_certain_stays_unless_something_older_than_its_last_position_comes() -> (
    None
):
    first_ns, R = 7_000_000_000, 0.01 * np.eye(2)
    search = Search(first_ns, "regression")
    fixes = [
        Fix(time_s, np.array([20.0 * time_s, 0.0]), R)
        for time_s in (0.0, 0.001, 0.1, 0.2)
    ]
    assert search.next_line(lambda: fixes[:1], first_ns) is None  # all of one time
    found = search.next_line(lambda: fixes[:2], first_ns + 1_000_000)
    assert found is not None
    assert found[1].until_ns is None
    found = search.next_line(lambda: fixes[::-1], first_ns + 100_000_000)
    assert found is not None
    line, search = found
    assert search.until_ns == first_ns + 100_000_000
    np.testing.assert_allclose(
        line.position_m + 0.1 * line.velocity_mps, [2.0, 0.0], atol=1e-9
    )
    assert search.next_line(lambda: fixes, first_ns + 100_000_001) is None
    assert search.next_line(lambda: fixes, first_ns + 100_000_000) is not None


def test_the_first_state_is_the_first_position() -> None:
    bearing = Measurement.of(0, bearing_rad=0.1, std={"bearing_rad": 0.1})
    seen = Measurement.of(0, x_m=1.0, y_m=2.0, std=STD)
    first, later = fixes_of(
        np.arange(5.0), 3.0 * np.eye(5), [(0.3, bearing), (0.4, seen)]
    )
    assert (first.time_s, later.time_s) == (0.0, 0.4)
    np.testing.assert_array_equal(first.position_m, [0.0, 1.0])
    np.testing.assert_array_equal(first.covariance, 3.0 * np.eye(2))
    np.testing.assert_array_equal(later.position_m, [1.0, 2.0])
