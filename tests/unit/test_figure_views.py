"""What single figures draw: the map, NEES and NIS, differences, the few."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from evaluation_runs import START_NS, TICK_NS, WEST, Car, update, write_run
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from fgtrack.core.types import Detection, DetectionList, EgoState, FloatArray
from fgtrack.estimation.base import Measurement, Start
from fgtrack.estimation.registry import estimator
from fgtrack.estimation.repeated import FusedOnce
from fgtrack.evaluation.runs import evaluated
from fgtrack.models.motion import CV
from fgtrack.show.figures import plot
from fgtrack.show.palette import style_of

TICKS = range(60)


def labelled(axes: Axes, label: str) -> Line2D:
    return next(line for line in axes.lines if str(line.get_label()).startswith(label))


def y_of(line: Line2D) -> FloatArray:
    return np.asarray(line.get_ydata(), dtype=np.float64)


def x_of(line: Line2D) -> FloatArray:
    return np.asarray(line.get_xdata(), dtype=np.float64)


def stamp_ns(tick: int) -> int:
    return START_NS + tick * TICK_NS


# --- the map


def test_one_stray_track_does_not_stretch_the_map_but_is_counted(
    tmp_path: Path,
) -> None:
    tracks = [
        [WEST.track(k, 1), *([WEST.track(k, 2, across_m=90_000.0)] if k < 3 else [])]
        for k in TICKS
    ]
    figure = plot.map(write_run(tmp_path / "run", tracks, truth=WEST.truth(TICKS)))
    (axes,) = figure.axes
    figure.canvas.draw()  # an equal aspect is made then
    assert max(*np.abs(axes.get_xlim()), *np.abs(axes.get_ylim())) < 200.0
    assert "3 rows of tracks and detections are outside" in figure.get_suptitle()


def test_ego_and_detections_are_on_the_map(tmp_path: Path) -> None:
    """The ego stands at (10, 20), turned to +y; what it sees 5 m ahead is at (10, 25)."""
    ego = [
        EgoState(stamp_ns(k), stamp_ns(k), 10.0, 20.0, np.pi / 2, 0.0) for k in TICKS
    ]
    seen = [
        DetectionList("lidar", stamp_ns(k), stamp_ns(k), [Detection(x_m=5.0, y_m=0.0)])
        for k in TICKS[1:-1]
    ]
    (axes,) = plot.map(
        write_run(
            tmp_path / "run",
            [[WEST.track(k, 1)] for k in TICKS],
            ego=ego,
            detections=seen,
        )
    ).axes
    own, found = labelled(axes, "ego"), labelled(axes, "detections (58)")
    assert (x_of(own)[0], y_of(own)[0]) == (10.0, 20.0)
    assert (x_of(found)[0], y_of(found)[0]) == pytest.approx((10.0, 25.0))


# --- NEES and NIS


def test_consistent_values_are_inside_their_bands_and_others_outside(
    tmp_path: Path,
) -> None:
    rng = np.random.default_rng(1)
    updates = {
        k: [
            update("lidar", tick=k, nis=nis, x_m=0.0, y_m=0.0),
            update("radar", tick=k, nis=9.0 * nis, speed_mps=0.0),
        ]
        for k, nis in enumerate(rng.chisquare(2, 400))
    }
    figure = plot.consistency(write_run(tmp_path / "run", updates=updates))
    said = {}
    for axes, sensor in zip(figure.axes, ("lidar", "radar"), strict=True):
        line = labelled(axes, sensor)
        said[sensor] = str(line.get_label())
        band = axes.collections[0].get_paths()[0].vertices
        inside = (y_of(line) > np.min(band[:, 1])) & (y_of(line) < np.max(band[:, 1]))
        assert inside.mean() > 0.85 if sensor == "lidar" else not inside.any()
        assert axes.get_yscale() == "log"
    assert "expected 2; 9" in said["lidar"]
    assert "mean of 10" in said["lidar"]
    assert "expected 1; " in said["radar"]


# --- differences


def test_curves_that_coincide_are_both_seen_for_one_is_dashed(tmp_path: Path) -> None:
    runs = []
    for name in ("smoother", "ekf-replay"):
        tracks = [[WEST.track(k, 1, along_m=0.5)] for k in TICKS]
        later = (
            {k: [WEST.later(k - 5, 1, along_m=0.1)] for k in TICKS[5:]}
            if name == "smoother"
            else {}
        )
        meta = {"estimator": name}
        runs.append(
            write_run(
                tmp_path / name,
                tracks,
                truth=WEST.truth(TICKS),
                meta=meta,
                smoothed=later,
            )
        )
    position, *_ = plot.errors(runs).axes
    smoother, replay, final = position.lines
    np.testing.assert_allclose(y_of(smoother), y_of(replay))
    assert (smoother.get_linestyle(), replay.get_linestyle()) == ("-", "--")
    assert (
        final.get_color()
        == smoother.get_color()
        == style_of("smoother").colour
        != replay.get_color()
    )
    assert str(final.get_label()).startswith("smoother, final state: RMSE 0.1")


# --- few


def test_of_many_objects_the_worst_are_drawn_and_the_rest_on_request(
    tmp_path: Path,
) -> None:
    cars = [Car(k, 100.0, 30.0 * k, 0.0, 20.0) for k in range(6)]
    tracks = [
        [car.track(k, car.object_id, along_m=0.1 * car.object_id) for car in cars]
        for k in TICKS
    ]
    run = write_run(
        tmp_path / "run",
        tracks,
        truth=[row for car in cars for row in car.truth(TICKS)],
    )
    plans = [
        plan for plan in plot.planned(evaluated(run)) if plan.name.startswith("errors")
    ]
    assert [plan.name for plan in plans if not plan.is_extra] == [
        *("errors_all_objects", "errors_object_3", "errors_object_4", "errors_object_5")
    ]
    assert len(plans) == 7
    few, every = (
        [name for name, _ in plot.drawn(plans, each)] for each in (False, True)
    )
    assert len(every) == len(few) + 3
    many = evaluated(
        [replace(run, path=None)] * 1
        + [write_run(tmp_path / f"r{k}", [[cars[0].track(0, 1)]]) for k in range(7)]
    )
    maps = [plan for plan in plot.planned(many) if plan.name.startswith("map")]
    assert (len(maps), sum(not plan.is_extra for plan in maps)) == (8, 3)


# --- the factor graph of a window


def test_a_late_measurement_stands_out_in_the_window_that_it_splits() -> None:
    """One motion factor is split; a state, two motion factors and a measurement factor are new."""
    one = estimator("smoother-banded", CV(), Start(), lag_s=1.0)
    assert isinstance(one, FusedOnce)

    def fuse(*times_ms: int) -> None:
        for ms in times_ms:
            one.update(Measurement.of(ms * 1_000_000, x_m=0.0, y_m=0.0, std=0.3))

    fuse(100, 200, 400)
    before = one.window()
    fuse(300)
    after = one.window()
    figure = plot.window(after, before)
    assert [axes.get_ylabel() for axes in figure.axes] == [
        "before",
        "after",
        "position std [m]",
    ]
    changed = [
        sorted(
            (line.get_marker(), round(float(x_of(line)[0]), 3))
            for line in axes.lines
            if line.get_color() == "#B65CA8" and line.get_linestyle() == "None"
            if len(x_of(line))
        )
        for axes in figure.axes[:2]
    ]
    assert changed == [
        [("s", 0.3)],
        [("o", 0.3), ("s", 0.25), ("s", 0.3), ("s", 0.35)],
    ]
    spread = figure.axes[2]
    np.testing.assert_allclose(x_of(labelled(spread, "after")), np.arange(5) / 10)
    deviation_m = np.sqrt(after.covariances[3, :2, :2].trace() / 2.0)
    assert y_of(labelled(spread, "after"))[3] == pytest.approx(deviation_m)
    alone = plot.window(after)
    assert [axes.get_ylabel() for axes in alone.axes] == ["window", "position std [m]"]
    assert not [line for line in alone.axes[0].lines if line.get_color() == "#B65CA8"]
