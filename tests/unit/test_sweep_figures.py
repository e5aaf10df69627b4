"""Figures of a sweep: means and standard errors of its table, drawn over the grid."""

import csv
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.pictures import faults

from fgtrack.core.errors import CallError, DataError
from fgtrack.evaluation.tables.seeds import (
    SWEEP_FILE,
    difference_table,
    read_sweep,
    seed_comparisons,
    summary_table,
)
from fgtrack.pipeline.sweep import SWEEP_TABLE
from fgtrack.show.figures import plot
from fgtrack.show.figures.style import save
from fgtrack.show.figures.sweep import metric_words

POSITION, NEES = (
    "truth.overall.errors.position_m.rmse",
    "consistency.position_nees.mean",
)
DELAYS = ("0.05", "0.1", "0.2")


def a_sweep(
    folder: Path,
    *,
    seeds: int = 3,
    gates: tuple[str, ...] = ("5.0",),
    estimators: int = 2,
) -> Path:
    """Position RMSE: the delay, plus 1 for each further estimator, plus 0.1 times the seed; one cell is empty."""
    folder.mkdir(parents=True)
    with (folder / SWEEP_FILE).open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(
            [
                "delay_s",
                "sensors.radar.delay",
                "gate_m",
                "seed",
                "estimator",
                POSITION,
                NEES,
                "num_tracks",
            ]
        )
        for delay, gate, seed, index in product(
            DELAYS, gates, range(seeds), range(estimators)
        ):
            rmse = (
                repr(float(delay) + index + 0.1 * seed)
                if (delay, seed, index) != ("0.2", 2, 1)
                else ""
            )
            mapping = f'{{"kind": "constant", "delay_s": {delay}}}'
            writer.writerow(
                [delay, mapping, gate, seed, f"estimator-{index}", rmse, 2.0, 1]
            )
    return folder


def test_means_and_standard_errors_are_those_of_the_seeds(tmp_path: Path) -> None:
    table = read_sweep(a_sweep(tmp_path / "sweep"))
    assert table.axes == ("delay_s", "sensors.radar.delay", "gate_m")
    assert table.shown_axes == ["delay_s"]
    means = table.means(POSITION)
    assert means.loc[0, ["delay_s", "estimator", "seeds"]].tolist() == [
        "0.05",
        "estimator-0",
        3,
    ]
    assert means["mean"][:2].tolist() == pytest.approx([0.15, 1.15])
    assert means["standard_error"][0] == pytest.approx(0.1 / np.sqrt(3.0))
    assert means["seeds"].tolist()[-1] == 2  # the empty cell is left out


def test_a_sweep_over_delays_has_a_figure_of_error_against_delay(
    tmp_path: Path,
) -> None:
    table = read_sweep(a_sweep(tmp_path / "one"))
    plans = plot.planned_sweep(table)
    assert plans[0].name == "error_against_delay"
    axes = plans[0].draw().axes[0]
    lines = {line.get_label(): line.get_xdata().tolist() for line in axes.lines}
    assert lines == {f"estimator-{k}": [50.0, 100.0, 200.0] for k in range(2)}
    gates = read_sweep(a_sweep(tmp_path / "two", gates=("5.0", "9.0")))
    names = [plan.name for plan in plot.planned_sweep(gates)]
    assert "error_against_delay" not in names, "two axes"


def test_the_figure_has_a_line_with_bars_for_each_estimator(tmp_path: Path) -> None:
    figure = plot.sweep(a_sweep(tmp_path / "sweep"))
    (axes,) = figure.axes
    first, second = axes.containers
    np.testing.assert_allclose(first.lines[0].get_ydata(), [0.15, 0.2, 0.3])
    np.testing.assert_allclose(second.lines[0].get_ydata(), [1.15, 1.2, 1.25])
    np.testing.assert_allclose(first.lines[0].get_xdata(), [0.05, 0.1, 0.2], atol=2e-3)
    assert not np.allclose(
        first.lines[0].get_xdata(), second.lines[0].get_xdata(), atol=1e-6
    )  # bars side by side
    (bars,) = first.lines[2]
    low, high = bars.get_segments()[0][:, 1]
    assert (high - low) / 2.0 == pytest.approx(
        4.302653 * 0.1 / np.sqrt(3.0)
    )  # t(2) at 97.5 %
    assert axes.get_xlabel() == "delay [s]"
    assert "mean over 2 to 3 seeds" in figure.get_suptitle()
    assert faults(figure) == []


def test_the_axis_with_the_most_numbers_is_horizontal_and_the_others_have_panels(
    tmp_path: Path,
) -> None:
    figure = plot.sweep(
        a_sweep(tmp_path / "sweep", gates=("5.0", "3.0", "2.0", "1.0")), NEES
    )
    seen = [axes for axes in figure.axes if axes.get_visible()]
    assert {axes.get_xlabel() for axes in seen} == {"gate [m]"}
    assert [axes.get_title(loc="left") for axes in seen] == [
        f"delay [s]: {delay}" for delay in DELAYS
    ]
    assert faults(figure) == []


def test_what_is_no_sweep_is_one_clear_error(tmp_path: Path) -> None:
    with pytest.raises(CallError, match="cannot be read"):
        plot.sweep(tmp_path)
    with pytest.raises(CallError, match="not a metric of the sweep"):
        plot.sweep(a_sweep(tmp_path / "sweep"), "rmse")
    (tmp_path / SWEEP_FILE).write_text("a,b\n1,2\n")
    with pytest.raises(DataError, match="no rows of a sweep"):
        read_sweep(tmp_path)
    assert SWEEP_FILE == SWEEP_TABLE


@pytest.mark.parametrize(
    ("key", "expected"),
    [
        ("lidar_delay_s", "LiDAR delay [s]"),
        ("scenario.sensors.radar.rate_hz", "RADAR rate [Hz]"),
        ("truth.overall.errors.yaw_rate_radps.rmse", "yaw rate RMSE [rad/s]"),
        ("lagged.0.3.errors.position_m.rmse", "position RMSE [m], output 0.3 s later"),
        ("consistency.nis.lidar_cluster.mean", "mean NIS of lidar cluster"),
    ],
)
def test_labels_are_words_with_units_not_keys(key: str, expected: str) -> None:
    assert metric_words(key) == expected


def test_error_against_delay_needs_no_sweep_and_rises_for_every_method() -> None:
    figure = plot.error_against_delay()
    (axes,) = figure.axes
    lines = {str(line.get_label()): np.asarray(line.get_ydata()) for line in axes.lines}
    assert list(lines) == [
        "smoother",
        "ekf-replay",
        "ekf-backward-forward",
        "drop",
        "smoother, 0.3 s later",
    ]
    assert axes.get_xlabel() == "LiDAR delay, mean [ms]"
    assert len(axes.collections) == len(lines)  # a band each
    for y in lines.values():
        assert y[-1] > y[1]
    assert (lines["ekf-backward-forward"][1:] > lines["smoother"][1:]).all()
    assert faults(figure) == []


SHARE = "truth.overall.tracked_share_in_view"


def a_tracked_sweep(folder: Path) -> Path:
    """Two estimators, three delays, two seeds; the first one tracks less and less of the time."""
    folder.mkdir()
    rows = [["delay_s", "seed", "estimator", POSITION, SHARE]]
    for delay, seed in product(DELAYS, range(2)):
        tracked = 1.0 - 1.2 * float(delay)
        rows.append(
            [delay, str(seed), "drop", str(float(delay) + 0.01 * seed), str(tracked)]
        )
        rows.append([delay, str(seed), "ekf-replay", str(0.2 + 0.01 * seed), "1.0"])
    with (folder / SWEEP_FILE).open("w", newline="") as file:
        csv.writer(file).writerows(rows)
    return folder


@pytest.mark.parametrize("draw", [plot.sweep, plot.error_against_delay])
def test_the_share_of_the_time_that_is_tracked_stands_beside_a_low_error(
    draw: Any, tmp_path: Path
) -> None:
    figure = draw(a_tracked_sweep(tmp_path / "sweep"), width="3.4in")
    [axes] = figure.axes
    texts = [text.get_text() for text in axes.texts]
    assert texts == [
        "94 %",
        "88 %",
        "76 %",
    ]  # not the estimator that tracks all the time
    assert "mean over 2 seeds" in figure.caption
    assert "95 % interval" in figure.caption
    assert "numbers: share of the time tracked [%]" in figure.caption
    assert faults(figure) == []


def test_axes_are_logarithmic_where_the_user_says_so(tmp_path: Path) -> None:
    folder = a_tracked_sweep(tmp_path / "sweep")
    scales = {
        log: plot.sweep(folder, **({"log": log} if log else {})).axes[0]
        for log in (None, "x", "y", "xy")
    }
    found = {
        log: (axes.get_xscale(), axes.get_yscale()) for log, axes in scales.items()
    }
    assert found == {
        None: ("linear", "linear"),
        "x": ("log", "linear"),
        "y": ("linear", "log"),
        "xy": ("log", "log"),
    }
    with pytest.raises(CallError, match="log 'z': must be one of x, y, xy"):
        plot.sweep(folder, log="z")


def test_labels_at_the_ends_of_lines_do_not_overlap(tmp_path: Path) -> None:
    folder = a_sweep(tmp_path / "sweep", estimators=6)
    figure = plot.sweep(folder, width="3.4in", legend="ends")
    figure.draw_without_rendering()
    [axes] = figure.axes
    boxes = [text.get_window_extent() for text in axes.texts]
    assert [text.get_text() for text in axes.texts].count("estimator-3") == 1
    assert len(boxes) == 6
    assert axes.get_legend() is None
    boxes.sort(key=lambda box: box.y0)
    assert all(low.y1 <= high.y0 + 1.0 for low, high in pairwise(boxes))
    assert all(box.x1 <= figure.bbox.width + 1.0 for box in boxes)


def test_labels_at_the_ends_of_a_narrow_figure_leave_the_curves_half_of_the_width() -> (
    None
):
    figure = plot.error_against_delay(width="3.4in", legend="ends")
    figure.draw_without_rendering()
    [axes] = figure.axes
    assert "smoother,\n0.3 s later" in [text.get_text() for text in axes.texts]
    assert axes.get_window_extent().width > 0.5 * figure.bbox.width


def test_a_legend_above_a_narrow_figure_has_columns(tmp_path: Path) -> None:
    figure = plot.sweep(a_sweep(tmp_path / "sweep", estimators=4), width="3.4in")
    legend = figure.axes[0].get_legend()
    assert legend._ncols == 3
    figure.draw_without_rendering()
    assert legend.get_window_extent().x1 <= figure.bbox.width


@pytest.mark.parametrize("form", ["pdf", "eps"])
def test_fonts_are_truetype_and_equal_figures_give_equal_bytes(
    form: str, tmp_path: Path
) -> None:
    folder = a_tracked_sweep(tmp_path / "sweep")
    contents = [
        save(
            plot.error_against_delay(folder, width="3.4in"), tmp_path / f"{k}.{form}"
        ).read_bytes()
        for k in range(2)
    ]
    assert contents[0] == contents[1]
    assert b"/Type3" not in contents[0]
    assert b"/FontType 3" not in contents[0]
    assert b"/FontType 42" in contents[0] or b"/CIDFontType2" in contents[0]


def test_a_table_for_latex_has_words_intervals_and_seeds(tmp_path: Path) -> None:
    sweep = read_sweep(a_tracked_sweep(tmp_path / "sweep"))
    summary = summary_table(sweep).to_latex()
    assert (
        "Mean over 2 seeds, $\\pm$: half of the 95 \\% interval of the mean (t)"
        in summary
    )
    assert "delay [s] & estimator & position RMSE [m] & tracked [\\%]" in summary
    differences = difference_table(seed_comparisons(sweep), sweep.axes).to_latex()
    assert (
        "\\caption{position RMSE [m]. Intervals: t intervals of paired" in differences
    )
    assert "truth" not in summary + differences


def test_a_consistency_alone_names_no_best_estimator(tmp_path: Path) -> None:
    rows = [
        [
            "delay_s",
            "seed",
            "estimator",
            "consistency.nis.radar.mean",
            "consistency.nis.radar.dof",
        ]
    ]
    rows += [
        ["0.1", str(seed), name, "2.5", "2.0"]
        for seed in range(3)
        for name in ("a", "b")
    ]
    (tmp_path / "sweep.csv").write_text("\n".join(",".join(row) for row in rows) + "\n")
    sweep = read_sweep(tmp_path)
    table = difference_table(seed_comparisons(sweep), sweep.axes)
    assert table.records
    assert not any(map(table.is_main, table.records))


def test_states_without_a_lag_are_no_waited_output(tmp_path: Path) -> None:
    lags = ("0.0", "0.3", "window")
    names = [f"lagged.{lag}.errors.position_m.rmse" for lag in lags]
    rows = [["delay_s", "seed", "estimator", POSITION, *names]]
    rows += [[delay, "0", "smoother", "0.3", "0.3", "0.2", "0.1"] for delay in DELAYS]
    (tmp_path / SWEEP_FILE).write_text("\n".join(map(",".join, rows)) + "\n")
    [axes] = plot.error_against_delay(tmp_path).axes
    labels = [str(line.get_label()) for line in axes.lines]
    assert labels == ["smoother", "smoother, 0.3 s later"]
