"""Figures of a sweep: means and standard errors of its table, drawn over the grid."""

import csv
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from support.pictures import faults

from fgtrack.core.errors import CallError, DataError
from fgtrack.evaluation.tables.seeds import SWEEP_FILE, read_sweep
from fgtrack.pipeline.sweep import SWEEP_TABLE
from fgtrack.show.figures import plot
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
        "smoother, output 0.3 s later",
    ]
    assert axes.get_xlabel() == "LiDAR delay, mean [ms]"
    assert len(axes.collections) == len(lines)  # a band each
    for y in lines.values():
        assert y[-1] > y[1]
    assert (lines["ekf-backward-forward"][1:] > lines["smoother"][1:]).all()
    assert faults(figure) == []
