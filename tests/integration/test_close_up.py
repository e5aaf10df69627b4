"""A late detection in close-up: which one, what the tracks were before and after, and the picture of it."""

import re
from pathlib import Path

import numpy as np
import pytest
from support.pictures import faults
from support.runs import replayed

import fgtrack
from fgtrack.cli.main import run as command
from fgtrack.evaluation.placement import detections_in_map
from fgtrack.show.figures.close_up import Arrival, CloseUp
from fgtrack.show.figures.late_detection import chosen, close_up_of
from fgtrack.show.palette import style_of

NAMES = ("ekf-replay", "ekf-backward-forward")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six seconds of the default scenario, replayed with two filters."""
    return replayed(tmp_path_factory.mktemp("close-up"), 6.0, NAMES)


@pytest.fixture(scope="module")
def found(folder: Path) -> list[CloseUp]:
    return fgtrack.close_ups([folder / "runs" / name for name in NAMES])


def test_it_is_one_detection_that_came_late_and_the_rule_says_how_typical_it_is(
    folder: Path, found: list[CloseUp]
) -> None:
    (arrival,) = {one.arrival for one in found}
    for name in NAMES:
        updates = fgtrack.load_run(folder / "runs" / name).tables["updates"]
        row = (updates["stamp_ns"] == arrival.stamp_ns) & (
            updates["index"] == arrival.index
        )
        assert updates["disposition"][
            row & (updates["sensor"] == arrival.sensor)
        ].tolist() == ["out_of_sequence"]
    rule = r"\d+ % of \d+ late detections lower the present error.* (\d+\.\d+) to (\d+\.\d+) m"
    errors_m = re.match(rule, found[0].rule)
    assert errors_m is not None
    assert float(errors_m[1]) > float(errors_m[2])


def test_a_close_up_of_a_long_run_is_chosen_among_its_first_late_detections(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = fgtrack.load_run(folder / "runs" / NAMES[0])
    every, _ = chosen([run])
    monkeypatch.setattr("fgtrack.show.figures.late_detection._MOST_LATE", 40)
    arrival, rule = chosen([run])
    late_ticks = np.sort(run.updates.query("disposition == 'out_of_sequence'")["tick"])
    tick = run.updates.query(
        f"stamp_ns == {arrival.stamp_ns} and receipt_ns == {arrival.receipt_ns}"
    )["tick"]
    assert "of the first" in rule
    assert tick.max() <= late_ticks[50]
    last, _ = chosen([run], every.stamp_ns)
    assert last.stamp_ns == every.stamp_ns


def test_it_draws_the_past_towards_the_detection_and_is_fused_once(
    folder: Path, found: list[CloseUp]
) -> None:
    for name, one in zip(NAMES, found, strict=True):
        run = fgtrack.load_run(folder / "runs" / name)
        table, stamp_ns = run.tables["detections"], one.arrival.stamp_ns
        row = np.logical_and.reduce(
            [
                table[key] == getattr(one.arrival, key)
                for key in ("sensor", "stamp_ns", "receipt_ns", "index")
            ]
        )
        (position_m,) = detections_in_map(run).position_m[row]
        k = one.after.stamps_ns.tolist().index(stamp_ns)
        off_m = [
            np.linalg.norm(each.means[k, :2] - position_m)
            for each in (one.before, one.after)
        ]
        assert off_m[1] < off_m[0]
        assert stamp_ns not in one.fused_ns
        assert one.fused_ns.max() > stamp_ns


def test_what_is_not_there_is_said(folder: Path) -> None:
    run = fgtrack.load_run(folder / "runs" / NAMES[0])
    with pytest.raises(fgtrack.DataError, match="the recording has no such list"):
        close_up_of(run, Arrival("lidar_cluster", 1, 2, 0))
    gated = np.flatnonzero(run.tables["updates"]["disposition"] == "birth")[0]
    values = (
        int(run.tables["updates"][name][gated])
        for name in ("stamp_ns", "receipt_ns", "index")
    )
    with pytest.raises(fgtrack.DataError, match="no track fused it"):
        close_up_of(run, Arrival(str(run.tables["updates"]["sensor"][gated]), *values))
    in_memory = fgtrack.replay(
        fgtrack.simulate("default", seed=3, duration_s=3.0),
        "tuned",
        estimator="ekf-replay",
    )
    with pytest.raises(fgtrack.DataError, match="recording of the run is missing"):
        fgtrack.close_ups([in_memory])


def test_the_picture_shows_errors_before_and_after_and_what_was_forgotten(
    folder: Path, found: list[CloseUp]
) -> None:
    runs = [folder / "runs" / name for name in NAMES]
    figure = fgtrack.plot.close_up(runs, found)
    assert faults(figure) == []
    assert figure.get_supxlabel().replace("\n", " ") == found[0].rule
    for column, (name, one) in enumerate(zip(NAMES, found, strict=True)):
        present, errors = figure.axes[column], figure.axes[len(NAMES) + column]
        before, after = (
            line
            for line in errors.lines
            if line.get_label() in ("before it arrives", "after")
        )
        assert after.get_color() == style_of(name).colour
        text = f"{before.get_ydata()[-1]:.2f} m before, {after.get_ydata()[-1]:.2f} m after"
        assert present.get_title(loc="left") == f"{name}\n{text}"
        labels = errors.get_legend_handles_labels()[1]
        assert ("fused meanwhile, now forgotten" in labels) == (
            name == "ekf-backward-forward"
        )
        assert after.get_xdata()[-1] == 0.0
        assert one.after.stamps_ns[-1] == one.now_ns
    with pytest.raises(fgtrack.CallError, match="of one detection"):
        fgtrack.plot.close_up(runs[:1], found)


def test_without_truth_no_run_is_judged(folder: Path, found: list[CloseUp]) -> None:
    runs = [fgtrack.load_run(folder / "runs" / name) for name in NAMES]
    blind = [
        run.with_tables(truth=run.tables["truth"].where(np.zeros(0, dtype=np.int64)))
        for run in runs
    ]
    figure = fgtrack.plot.close_up(blind, found)
    assert faults(figure) == []
    title = figure.get_suptitle().replace("\n", " ")
    assert "nearer to the centre is better" not in title
    assert (
        f"without truth the centre is {NAMES[0]} afterwards, so no run is judged"
        in title
    )
    assert (
        "nearer to the centre is better"
        in fgtrack.plot.close_up(runs, found).get_suptitle()
    )


def test_the_command_refuses_times_that_are_not_and_goes_on_without_a_recording(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = [str(folder / "runs" / NAMES[0])]
    for odd in ("-inf", "1e300"):
        assert (
            command(["figure", runs[0], "-o", str(tmp_path / "odd"), f"--stamp={odd}"])
            == 2
        )
        assert "--stamp" in capsys.readouterr().err
    (folder / "drive.jsonl").rename(tmp_path / "drive.jsonl")
    try:
        assert command(["figure", runs[0], "-o", str(tmp_path / "rest")]) == 0
        assert "no close-up:" in capsys.readouterr().out
        assert not (tmp_path / "rest/close_up.png").exists()
        assert (tmp_path / "rest/arrivals.png").exists()
        assert (
            command(["figure", runs[0], "-o", str(tmp_path / "none"), "--stamp", "4"])
            == 1
        )
        assert "recording of the run is missing" in capsys.readouterr().err
    finally:
        (tmp_path / "drive.jsonl").rename(folder / "drive.jsonl")
