from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from fgtrack.core.geometry import wrap_angles
from fgtrack.core.types import FloatArray
from fgtrack.models.oval import make_oval, make_pit_lane
from fgtrack.models.path import Path as DrivenPath
from fgtrack.models.track_map import COLUMNS, TrackMap

MAPS = Path(__file__).resolve().parents[2] / "configs/maps"
COLUMN = {name: index for index, name in enumerate(COLUMNS)}


@pytest.fixture(scope="module")
def oval() -> TrackMap:
    return make_oval()


@pytest.fixture(scope="module")
def pit_lane() -> TrackMap:
    return make_pit_lane()


@pytest.mark.parametrize(
    ("name", "lane"), [("oval_track", "oval"), ("oval_pitlane", "pit_lane")]
)
def test_the_committed_maps_are_what_the_functions_make(
    request: pytest.FixtureRequest, name: str, lane: str
) -> None:
    track: TrackMap = request.getfixturevalue(lane)
    np.testing.assert_allclose(
        TrackMap.read(MAPS / f"{name}.csv").table, track.table, atol=1e-7
    )


def test_the_oval_has_the_proportions_of_a_speedway(oval: TrackMap) -> None:
    curvature = oval.table[:, COLUMN["kappa_ref_radpm"]]
    banking = np.degrees(-oval.table[:, COLUMN["banking_rad"]])
    assert oval.length_m == pytest.approx(2400.0, abs=0.01)
    assert oval.counter_clockwise
    assert 1.0 / curvature.max() == pytest.approx(220.0, abs=0.1)
    assert curvature.min() > -1e-6
    assert np.count_nonzero(curvature < 1e-6) * 2.0 > 500.0  # metres of straight
    assert (banking.min(), banking.max()) == pytest.approx((9.0, 20.0), abs=0.1)
    left, right = oval.bounds(np.linspace(0.0, 2400.0, 100))
    np.testing.assert_allclose(left + right, 15.0)


ANGLES = np.array([0.0, 0.4, 1.0, 1.3, 2.2, 3.0, 3.3, 4.4, 5.0, 5.8])
COARSE = np.stack([300.0 * np.cos(ANGLES), 200.0 * np.sin(ANGLES)], axis=1)


@pytest.mark.parametrize("fine", [True, False])
def test_a_path_frame_holds_the_exact_derivatives(oval: TrackMap, fine: bool) -> None:
    path = (
        DrivenPath.through(oval.table[:, :2])
        if fine
        else DrivenPath.through(np.vstack([COARSE, COARSE[:1]]))
    )
    u, h = np.linspace(-50.0, 2500.0, 997), 1e-4
    frame, ahead, behind = path.frame(u), path.frame(u + h), path.frame(u - h)

    def assert_derivative(
        value: FloatArray, difference: FloatArray, atol: float
    ) -> None:
        np.testing.assert_allclose(value, difference / (2.0 * h), atol=atol)

    assert_derivative(
        frame.scale * np.cos(frame.heading_rad), ahead.x_m - behind.x_m, 1e-7
    )
    assert_derivative(
        frame.scale * np.sin(frame.heading_rad), ahead.y_m - behind.y_m, 1e-7
    )
    assert_derivative(
        frame.turn, wrap_angles(ahead.heading_rad - behind.heading_rad), 1e-8
    )
    assert_derivative(frame.turn_rate, ahead.turn - behind.turn, 2e-6)
    assert_derivative(frame.scale_rate, ahead.scale - behind.scale, 1e-8)


def test_a_path_is_the_periodic_cubic_spline() -> None:
    points = np.vstack([COARSE, COARSE[:1]])
    path = DrivenPath.through(points)
    spline = CubicSpline(path.u_m, points, bc_type="periodic")
    frame, u = (
        path.frame(path.length_m + path.u_m),
        np.linspace(0.0, path.length_m, 500),
    )
    np.testing.assert_allclose(
        np.stack([frame.x_m, frame.y_m], axis=1), points, atol=1e-9
    )
    np.testing.assert_allclose(
        np.stack([path.frame(u).x_m, path.frame(u).y_m], axis=1), spline(u), atol=1e-9
    )
