from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fgtrack.core.errors import DataError
from fgtrack.core.geometry import wrap_angles
from fgtrack.core.types import FloatArray
from fgtrack.models.feet import nearest
from fgtrack.models.track_map import COLUMNS, TrackMap

ROOT = Path(__file__).resolve().parents[2]
HEADING, CURVATURE = COLUMNS.index("psi_ref_rad"), COLUMNS.index("kappa_ref_radpm")

OVAL = TrackMap.read(ROOT / "configs/maps/oval_track.csv")


def circle_table(
    num: int = 200, radius_m: float = 100.0, direction: float = 1.0
) -> FloatArray:
    """Rows of a circle around the origin, not closed; `direction` is 1 counter-clockwise, -1 clockwise."""
    angle = direction * np.arange(num) * 2.0 * np.pi / num
    table = np.zeros((num, len(COLUMNS)))
    table[:, 0], table[:, 1] = radius_m * np.cos(angle), radius_m * np.sin(angle)
    table[:, COLUMNS.index("width_right_m")] = 4.0
    table[:, COLUMNS.index("width_left_m")] = 6.0
    table[:, HEADING] = angle + direction * np.pi / 2.0
    table[:, CURVATURE] = direction / radius_m
    return table


def circular_difference(a: FloatArray, b: FloatArray, length: float) -> FloatArray:
    return np.abs((a - b + length / 2.0) % length - length / 2.0)


def assert_round_trip(track: TrackMap, s: FloatArray, lateral: FloatArray) -> None:
    s_again, lateral_again = track.frenet(track.position(s, lateral))
    assert ((s_again >= 0.0) & (s_again < track.length_m)).all()
    np.testing.assert_array_less(circular_difference(s, s_again, track.length_m), 1e-8)
    np.testing.assert_allclose(lateral_again, lateral, atol=1e-8)


@given(
    st.lists(
        st.tuples(st.floats(-5000.0, 5000.0), st.floats(-20.0, 20.0)),
        min_size=1,
        max_size=20,
    ),
    st.sampled_from(
        [OVAL, TrackMap(circle_table()), TrackMap(circle_table(direction=-1.0))]
    ),
)
def test_a_place_goes_to_the_map_and_back(
    places: list[tuple[float, float]], track: TrackMap
) -> None:
    s, lateral = np.array(places).T
    assert_round_trip(track, s, lateral)


@pytest.mark.parametrize("lateral", [-5.0, 0.0, 5.0])
def test_road_coordinates_run_on_over_rows_closing_point_and_heading_jump(
    lateral: float,
) -> None:
    heading = OVAL.table[:, HEADING]
    jump = int(np.abs(np.diff(heading)).argmax())
    assert abs(heading[jump + 1] - heading[jump]) > 6.0
    for s_0 in (0.0, OVAL.length_m * jump / (len(heading) - 1)):
        s = s_0 + np.linspace(-3.0, 3.0, 601)
        assert_round_trip(OVAL, s, np.full(len(s), lateral))
        steps = np.hypot(*np.diff(OVAL.position(s, np.full(len(s), lateral)), axis=0).T)
        np.testing.assert_allclose(steps, 0.01, rtol=0.03)


def test_lateral_is_the_distance_from_the_line_and_positive_to_the_left() -> None:
    points = np.array(
        [[97.0, 0.0], [103.0, 0.0]]
    )  # beside a row of a circle driven counter-clockwise
    np.testing.assert_allclose(
        TrackMap(circle_table()).frenet(points)[1], [3.0, -3.0], atol=1e-12
    )
    np.testing.assert_allclose(
        TrackMap(circle_table(direction=-1.0)).frenet(points)[1],
        [-3.0, 3.0],
        atol=1e-12,
    )


def test_the_line_is_closed_whether_or_not_the_last_row_repeats_the_first() -> None:
    table = circle_table(num=100)
    open_map, closed_map = TrackMap(table), TrackMap(np.vstack([table, table[0]]))
    assert len(open_map.table) == len(closed_map.table) == 101
    arc = COLUMNS.index("s_ref_m")
    assert open_map.table[-1, arc] - open_map.table[-2, arc] == pytest.approx(
        open_map.length_m / 100.0
    )
    assert (
        open_map.length_m
        == closed_map.length_m
        == pytest.approx(200.0 * 100.0 * np.sin(np.pi / 100.0))
    )
    points = np.random.default_rng(0).uniform(-130.0, 130.0, (500, 2))
    np.testing.assert_array_equal(open_map.frenet(points), closed_map.frenet(points))


def test_points_beyond_the_centre_of_curvature_and_far_away_give_finite_answers() -> (
    None
):
    points = np.array([[0.0, 0.0], [-1.0, 2.0], [1e6, -1e6]])
    track = TrackMap(circle_table())
    assert np.isfinite(track.frenet(points)).all()
    assert np.isfinite(heading(track, points)).all()


def heading(track: TrackMap, points_m: FloatArray) -> FloatArray:
    return track.view(points_m, 0.0, 0.0).yaw_rad


def heading_error(track: TrackMap, lateral: float) -> FloatArray:
    """Difference between the heading and the numeric tangent all around the lap."""
    s = np.arange(0.0, track.length_m, 0.25)
    lateral_m = np.full(len(s), lateral)
    ahead, behind = (
        track.position(s + 1.5, lateral_m),
        track.position(s - 1.5, lateral_m),
    )
    tangent = np.arctan2(*(ahead - behind).T[::-1])
    return np.abs(wrap_angles(heading(track, track.position(s, lateral_m)) - tangent))


@pytest.mark.parametrize("lateral", [-7.0, 0.0, 7.0])
def test_the_heading_is_the_numeric_tangent_everywhere(lateral: float) -> None:
    assert heading_error(OVAL, lateral).max() < 1e-3
    assert heading_error(TrackMap(circle_table(num=400)), lateral).max() < 1e-3


def test_heading_and_curvature_at_a_row_are_the_row() -> None:
    rows = OVAL.table[:-1]
    np.testing.assert_allclose(heading(OVAL, rows[:, :2]), rows[:, HEADING], atol=1e-9)
    np.testing.assert_allclose(
        OVAL.view(rows[:, :2], 0.0, 0.0).curvature_radpm, rows[:, CURVATURE], atol=1e-12
    )


def test_the_widths_are_those_of_the_rows_and_linear_between_them() -> None:
    table = circle_table(num=4)
    table[:, COLUMNS.index("width_left_m")] = [1.0, 3.0, 5.0, 7.0]
    track = TrackMap(table)
    left, right = track.bounds(
        track.length_m * np.array([0.0, 0.125, 0.25, 0.875, 1.0])
    )
    np.testing.assert_allclose(left, [1.0, 2.0, 3.0, 4.0, 1.0])
    np.testing.assert_allclose(right, 4.0)


@given(s=st.floats(0.0, 2400.0), inner=st.floats(-3.0, 3.0), outer=st.floats(-3.0, 3.0))
def test_a_positive_buffer_lets_points_in_and_a_negative_one_shrinks(
    s: float, inner: float, outer: float
) -> None:
    left, right = (float(width[0]) for width in OVAL.bounds(np.array([s])))
    lateral = np.array(
        [
            left + inner - 1e-6,
            left + inner + 1e-6,
            -right - outer + 1e-6,
            -right - outer - 1e-6,
        ]
    )
    points = OVAL.position(np.full(4, s), lateral)
    assert OVAL.view(points, inner, outer).outside.tolist() == [
        False,
        True,
        False,
        True,
    ]


def test_the_inner_bound_is_the_one_that_the_lap_encloses() -> None:
    inside_m, outside_m = 100.0 - 4.0, 100.0 + 4.0
    points = np.array([[inside_m, 0.0], [outside_m, 0.0]])
    for direction in (1.0, -1.0):
        table = circle_table(direction=direction)
        table[:, [COLUMNS.index("width_left_m"), COLUMNS.index("width_right_m")]] = 4.5
        track = TrackMap(table)
        assert track.counter_clockwise == (direction > 0.0)
        assert track.view(
            points, inner_buffer_m=-1.0, outer_buffer_m=0.0
        ).outside.tolist() == [True, False]
        assert track.view(
            points, inner_buffer_m=0.0, outer_buffer_m=-1.0
        ).outside.tolist() == [False, True]


def lines_of(table: FloatArray) -> list[str]:
    """Lines of a file with the rows `table`, whose headings are in REP-103."""
    table = table.copy()
    table[:, HEADING] -= np.pi / 2.0
    return [
        "# a comment",
        "",
        *(";".join(f"{value:.9g}" for value in row) for row in table),
    ]


def test_a_heading_in_the_file_counts_from_the_y_axis(tmp_path: Path) -> None:
    (tmp_path / "map.csv").write_text("\n".join(lines_of(circle_table())))
    track = TrackMap.read(tmp_path / "map.csv")
    np.testing.assert_allclose(
        heading(track, np.array([[100.0, 0.0]])), np.pi / 2.0, atol=1e-6
    )


def edited(row: int, column: str, value: str) -> list[str]:
    lines = lines_of(circle_table())
    cells = lines[row + 1].split(";")  # after a comment and an empty line
    cells[COLUMNS.index(column)] = value
    lines[row + 1] = ";".join(cells)
    return lines


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["1;2;3", *lines_of(circle_table())], "17 columns .*inhomogeneous"),
        (edited(10, "x_ref_m", "east"), "could not convert .*'east'"),
        (edited(10, "banking_rad", "nan"), "row 10: banking_rad is not a number up to"),
        (edited(10, "s_ref_m", "1e300"), "row 10: s_ref_m is not a number up to"),
        (
            [*lines_of(circle_table())[:12], *lines_of(circle_table())[11:]],
            "row 10: the next row repeats this point",
        ),
        (lines_of(circle_table())[:40], "row 38: the line does not close"),
        (["# only a comment"], "at least 4 rows"),
        (edited(10, "width_right_m", "-6"), "row 10: the sum of width_left_m"),
        (edited(10, "psi_ref_rad", "2"), "row 10: psi_ref_rad does not point"),
        (["\xff"], "17 columns"),
    ],
)
def test_a_file_that_is_not_a_map_is_refused_with_its_row(
    tmp_path: Path, lines: list[str], message: str
) -> None:
    (tmp_path / "map.csv").write_text("\n".join(lines), encoding="latin-1")
    with pytest.raises(DataError, match=rf"map\.csv: not a map .*{message}"):
        TrackMap.read(tmp_path / "map.csv")


@pytest.mark.parametrize("spread_m", [1.0, 40.0, 3000.0])
def test_the_search_finds_the_first_of_the_nearest_rows(spread_m: float) -> None:
    rng = np.random.default_rng(1)
    rows = np.ascontiguousarray(OVAL.table[:-1, :2])
    rows.flags.writeable = False
    longest_m = float(np.hypot(*np.diff(rows, axis=0).T).max())
    points = rows[rng.integers(len(rows), size=300)] + rng.normal(
        scale=spread_m, size=(300, 2)
    )
    squared = (rows[:, 0] - points[:, :1]) ** 2 + (rows[:, 1] - points[:, 1:]) ** 2
    np.testing.assert_array_equal(
        nearest(points, rows, longest_m), squared.argmin(axis=1)
    )
