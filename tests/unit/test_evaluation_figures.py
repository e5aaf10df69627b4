from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from evaluation_runs import ROUND, START_NS, TICK_NS, WEST, update, write_run

from fgtrack.core.errors import CallError, DataError
from fgtrack.evaluation.figure_style import broken_line
from fgtrack.evaluation.figures import (
    figure_delays,
    figure_errors,
    figure_residuals,
    figure_timing,
    save_figures,
)
from fgtrack.evaluation.map_figure import figure_map
from fgtrack.evaluation.matching import match
from fgtrack.io.run import Run
from fgtrack.models.track_map import COLUMNS, TrackMap

TICKS = range(60)


def a_run(folder: Path, *, truth: bool = True, along_m: float = 0.3, config_text: str = "") -> Run:
    tracks = [
        [WEST.track(k, 1, along_m=along_m), WEST.track(k, 3, across_m=50.0)]
        + ([ROUND.track(k, 2)] if k < 10 or k > 50 else [])
        for k in TICKS
    ]
    updates = {
        k: [
            update("lidar", tick=k, delay_ns=150_000_000 + k, nis=2.0, x_m=0.1 * (k % 5), y_m=0.3),
            update("radar", tick=k, delay_ns=60_000_000, nis=1.0, speed_mps=0.2 * (k % 3)),
        ]
        for k in TICKS
    }
    rows = [*WEST.truth(TICKS), *ROUND.truth(TICKS)] if truth else []
    return write_run(
        folder, tracks, truth=rows, updates=updates, meta={"estimator": folder.name}, config_text=config_text
    )


def circle_map(path: Path) -> Path:
    angle = np.linspace(0.0, 2 * np.pi, 101)
    table = np.zeros((101, len(COLUMNS)))
    table[:, 0], table[:, 1] = 300 * np.cos(angle), 300 * np.sin(angle)
    table[:, 2:4] = 7.5
    table[:, COLUMNS.index("psi_ref_rad")] = angle + np.pi / 2
    table[-1, :2] = table[0, :2]
    TrackMap(table).write(path)
    return path


def test_every_figure_is_saved_and_the_common_ones_once(tmp_path: Path) -> None:
    runs = [a_run(tmp_path / "smoother"), a_run(tmp_path / "ekf-replay", along_m=0.6)]
    files = save_figures(runs, tmp_path / "out" / "figures")
    assert [file.name for file in files] == [
        "map_smoother.png",
        "residuals_smoother.png",
        "map_ekf-replay.png",
        "residuals_ekf-replay.png",
        "delays.png",
        "errors_object_7.png",
        "errors_object_8.png",
        "timing.png",
    ]
    assert all(file.read_bytes().startswith(b"\x89PNG") for file in files)


def test_figures_are_the_same_bytes_every_time_whatever_the_users_style(tmp_path: Path) -> None:
    run = a_run(tmp_path / "smoother")
    first = save_figures([run], tmp_path / "first")
    with mpl.rc_context({"lines.linewidth": 9.0, "axes.facecolor": "red", "savefig.dpi": 30}):
        before = dict(mpl.rcParams)
        second = save_figures([run], tmp_path / "second")
        assert dict(mpl.rcParams) == before
    assert [file.read_bytes() for file in first] == [file.read_bytes() for file in second]
    assert b"Software" not in first[0].read_bytes()


def test_a_run_without_truth_has_the_figures_that_need_none(tmp_path: Path) -> None:
    files = save_figures([a_run(tmp_path / "run", truth=False)], tmp_path / "out")
    assert [file.name.split("_")[0] for file in files] == ["map", "residuals", "delays.png", "timing.png"]


def test_an_empty_run_has_no_figures(tmp_path: Path) -> None:
    assert save_figures([write_run(tmp_path / "run", [[]])], tmp_path / "out") == []


def test_the_map_shows_bounds_truth_and_false_tracks(tmp_path: Path) -> None:
    run = a_run(tmp_path / "run", config_text=f"map:\n  track: {circle_map(tmp_path / 'map.csv')}\n")
    (axes,) = figure_map(run, match(run)).axes
    legend = axes.get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == [
        "object 7, truth",
        "object 7, track",
        "object 8, truth",
        "object 8, track",
        "paired to no object",
    ]
    radii = [float(np.hypot(*np.asarray(line.get_data())).mean()) for line in axes.lines[:2]]
    assert radii == pytest.approx([292.5, 307.5], abs=0.5)


def test_a_map_that_is_gone_is_said_and_one_that_is_none_is_refused(tmp_path: Path) -> None:
    gone = a_run(tmp_path / "gone", config_text="map: {track: nowhere.csv}")
    figure = figure_map(gone, match(gone))
    assert "not there any more" in figure.get_suptitle()
    (tmp_path / "bad.csv").write_text("no map\n")
    bad = a_run(tmp_path / "bad", config_text=f"map:\n  track: {tmp_path / 'bad.csv'}\n")
    with pytest.raises(DataError, match="no map"):
        figure_map(bad, match(bad))
    broken = a_run(tmp_path / "broken", config_text="map: {")
    with pytest.raises(DataError, match="not YAML"):
        figure_map(broken, match(broken))


def test_the_built_in_oval_is_drawn_and_open_space_has_no_bounds(tmp_path: Path) -> None:
    oval = a_run(tmp_path / "oval", config_text="map: {track: oval}")
    space = a_run(tmp_path / "space", config_text="map: {track: null}")
    count = [len(figure_map(run, match(run)).axes[0].lines) for run in (oval, space)]
    assert count[0] == count[1] + 2


def test_the_residual_figure_has_a_row_per_component_and_says_mean_and_deviation(tmp_path: Path) -> None:
    axes = figure_residuals(a_run(tmp_path / "run")).axes
    assert [one.get_ylabel() for one in axes[::2]] == ["along track [m]", "across track [m]", "speed [m/s]"]
    legend = axes[4].get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == ["radar: mean 0.200, std 0.163, n 60"]


def test_outliers_do_not_widen_the_residual_figure_but_are_counted(tmp_path: Path) -> None:
    values = [0.1 * (k % 11) - 0.5 for k in TICKS]
    values[7] = 99.0
    updates = {k: [update(tick=k, speed_mps=value)] for k, value in enumerate(values)}
    axes = figure_residuals(write_run(tmp_path / "run", updates=updates)).axes[0]
    assert axes.get_ylim()[1] < 5.0
    legend = axes.get_legend()
    assert legend is not None
    assert legend.get_texts()[0].get_text().endswith("n 60 (1 outside)")


def test_the_delay_figure_says_mean_and_quantile(tmp_path: Path) -> None:
    legend = figure_delays(a_run(tmp_path / "run")).axes[0].get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == [
        "lidar: mean 150 ms, q90 150 ms, max 150 ms",
        "radar: mean 60 ms, q90 60 ms, max 60 ms",
    ]


def test_the_error_figure_is_broken_where_the_object_was_not_tracked(tmp_path: Path) -> None:
    matching = match(a_run(tmp_path / "run"))
    assert matching is not None
    axes = figure_errors({"run": matching}, 8).axes
    assert [one.get_ylabel() for one in axes] == [
        "position error [m]",
        "speed error [m/s]",
        "yaw error [rad]",
    ]
    assert np.isnan(np.asarray(axes[0].lines[0].get_ydata(), dtype=float)).sum() == 1


def test_the_time_figure_leaves_out_ticks_without_detections(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", process_ns=[1_000_000, 2_000_000, 4_000_000], num_detections=[0, 1, 1])
    (over_time, _) = figure_timing({"run": run}).axes
    assert np.asarray(over_time.lines[0].get_ydata()).tolist() == [2.0, 4.0]


def test_a_line_is_not_drawn_across_a_pause() -> None:
    stamps_ns = START_NS + TICK_NS * np.array([1, 0, 40, 41])
    x, y = broken_line(stamps_ns, np.array([1.0, 0.0, 2.0, 3.0]), np.arange(4.0), TICK_NS)
    np.testing.assert_array_equal(x, [0.0, 1.0, np.nan, 2.0, 3.0])
    np.testing.assert_array_equal(y, [1.0, 0.0, np.nan, 2.0, 3.0])


def test_two_rows_that_are_far_apart_are_no_line(tmp_path: Path) -> None:
    tracks = [[WEST.track(k, 1), *([WEST.track(k, 2, across_m=9.0)] if k in (0, 59) else [])] for k in TICKS]
    run = write_run(tmp_path / "run", tracks, truth=WEST.truth(TICKS))
    wrong = figure_map(run, match(run)).axes[0].lines[-1]
    assert np.isnan(np.asarray(wrong.get_xdata(), dtype=float)).tolist() == [False, True, False]


def test_a_folder_that_cannot_be_made_is_one_clear_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(CallError, match="cannot be made"):
        save_figures([a_run(tmp_path / "run")], tmp_path / "file" / "out")
