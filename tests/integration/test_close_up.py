"""A late detection in close-up: which one, what the tracks were before and after, and the picture of it."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import fgtrack
from fgtrack.cli.main import run as command
from fgtrack.core.geometry import wrap_angle
from fgtrack.core.time import NS_PER_S
from fgtrack.models.motion import CTRV
from fgtrack.pipeline.close_up import close_up_of, most_moved
from fgtrack.tracking.close_up import Arrival, CloseUp

NAMES = ("ekf-replay", "ekf-backward-forward")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six seconds of the default scenario, replayed with two filters."""
    folder = tmp_path_factory.mktemp("close-up")
    fgtrack.simulate("default", seed=3, duration_s=6.0, out=folder / "drive.jsonl")
    for name in NAMES:
        fgtrack.replay(
            folder / "drive.jsonl", "tuned", map="oval", pit_map="oval", estimator=name, out=folder / "runs" / name
        )
    return folder


@pytest.fixture(scope="module")
def found(folder: Path) -> list[CloseUp]:
    return fgtrack.close_ups([folder / "runs" / name for name in NAMES])


def test_it_is_the_detection_that_moved_the_present_most(folder: Path, found: list[CloseUp]) -> None:
    run = fgtrack.load_run(folder / "runs" / NAMES[0])
    tracks, updates = run.tracks, run.updates
    moved: dict[tuple[int, int], float] = {}
    names = ("x_m", "y_m", "yaw_rad", "speed_mps", "yaw_rate_radps")
    for track in set(tracks["track_id"].tolist()):
        rows = np.flatnonzero(tracks["track_id"] == track)
        for before, after in pairwise(rows.tolist()):
            if tracks["num_measured"][after] >= 20:
                x, y = (np.array([tracks[name][row] for name in names]) for row in (before, after))
                dt_s = (tracks["now_ns"][after] - tracks["now_ns"][before]) / NS_PER_S
                moved[int(tracks["tick"][after]), track] = float(np.hypot(*(y - CTRV().predict(x, dt_s))[:2]))
    keys = list(zip(updates["tick"].tolist(), updates["track_id"].tolist(), strict=True))
    fused = [name in ("in_sequence", "out_of_sequence", "beyond_window") for name in updates["disposition"].tolist()]
    alone = [
        row
        for row, key in enumerate(keys)
        if updates["disposition"][row] == "out_of_sequence"
        and key in moved
        and sum(other == key for other, used in zip(keys, fused, strict=True) if used) == 1
    ]
    best = max(alone, key=lambda row: moved[keys[row]])
    arrival = found[0].arrival
    assert (arrival.stamp_ns, arrival.receipt_ns) == (updates["stamp_ns"][best], updates["receipt_ns"][best])
    assert arrival.sensor == updates["sensor"][best]
    assert {one.arrival for one in found} == {arrival}


def test_after_it_the_present_is_that_of_the_run(folder: Path, found: list[CloseUp]) -> None:
    for name, one in zip(NAMES, found, strict=True):
        tracks = fgtrack.load_run(folder / "runs" / name).tracks
        row = tracks.where((tracks["now_ns"] == one.now_ns) & (tracks["track_id"] == one.track_id))
        np.testing.assert_allclose(one.after.means[-1, :2], [row["x_m"][0], row["y_m"][0]], atol=1e-6)
        assert one.after.stamps_ns[-1] == one.now_ns
        assert one.arrival.stamp_ns in one.after.stamps_ns


def test_it_draws_the_past_towards_the_detection_and_is_fused_once(found: list[CloseUp]) -> None:
    for one in found:
        place = one.after.at(one.arrival.stamp_ns)
        off_m = [np.linalg.norm(b.means[place, :2] - one.position_m) for b in (one.before, one.after)]
        assert off_m[1] < off_m[0]
        spread = [np.linalg.slogdet(b.covariances[place, :2, :2]).logabsdet for b in (one.before, one.after)]
        assert spread[1] < spread[0]
        assert all(record.stamp_ns != one.arrival.stamp_ns for record in one.fused)
        assert any(record.stamp_ns > one.arrival.stamp_ns for record in one.fused)


def test_a_track_and_a_stamp_can_be_asked_for(folder: Path) -> None:
    run = fgtrack.load_run(folder / "runs" / NAMES[0])
    stamp_ns = int(run.timing["now_ns"][0]) + 4 * NS_PER_S
    tracks = sorted(set(run.updates["track_id"][run.updates["disposition"] == "out_of_sequence"].tolist()))
    for track in tracks:
        arrival = most_moved(run, track, stamp_ns)
        assert abs(arrival.stamp_ns - stamp_ns) < 0.2 * NS_PER_S
        assert close_up_of(run, arrival).track_id == track
    with pytest.raises(fgtrack.DataError, match="has no track 99"):
        most_moved(run, 99)


def test_what_is_not_there_is_said(folder: Path) -> None:
    run = fgtrack.load_run(folder / "runs" / NAMES[0])
    with pytest.raises(fgtrack.DataError, match="there is no such list"):
        close_up_of(run, Arrival("lidar_cluster", 1, 2, 0))
    gated = np.flatnonzero(run.updates["disposition"] == "birth")[0]
    values = (int(run.updates[name][gated]) for name in ("stamp_ns", "receipt_ns", "index"))
    with pytest.raises(fgtrack.DataError, match="no track has fused it"):
        close_up_of(run, Arrival(str(run.updates["sensor"][gated]), *values))
    in_memory = fgtrack.replay(fgtrack.simulate("default", seed=3, duration_s=3.0), "tuned", estimator="ekf-replay")
    with pytest.raises(fgtrack.DataError, match="recording of the run is not there"):
        fgtrack.close_ups([in_memory])


def test_the_picture_says_what_moved_and_what_was_forgotten(folder: Path, found: list[CloseUp]) -> None:
    figure = fgtrack.plot.close_up([folder / "runs" / name for name in NAMES], found)
    *panels, graph = figure.axes
    for axes, name, one in zip(panels, NAMES, found, strict=True):
        title = axes.get_title(loc="left")
        assert title.startswith(f"{name}: ")
        moved_m = np.linalg.norm(one.after.means[-1, :2] - one.before.means[-1, :2])
        assert f"moves by {moved_m:.2f} m" in title
        labels = axes.get_legend_handles_labels()[1]
        assert ("... and forgotten by this method" in labels) == (name == "ekf-backward-forward")
        assert len(axes.patches) >= 5  # ellipses of both beliefs at both stamps, and of the detection
    nodes = [line for line in graph.lines if line.get_label() == "state"]
    assert len(nodes[1].get_xdata()) == len(nodes[0].get_xdata()) + 1
    with pytest.raises(fgtrack.CallError, match="of one detection"):
        fgtrack.plot.close_up([folder / "runs" / NAMES[0]], found)


def test_panels_lie_along_the_direction_of_travel(folder: Path, found: list[CloseUp]) -> None:
    figure = fgtrack.plot.close_up([folder / "runs" / NAMES[0]], found[:1])
    line = next(line for line in figure.axes[0].lines if line.get_label() == "believed after")
    x, y = line.get_xdata(), line.get_ydata()
    assert abs(wrap_angle(np.arctan2(y[-1] - y[0], x[-1] - x[0]))) < 0.1
    assert x[-1] > x[0]


def test_all_figures_can_be_the_pages_of_one_pdf(folder: Path, tmp_path: Path) -> None:
    call = ["figure", str(folder / "runs" / NAMES[0]), "-o"]
    assert command([*call, str(tmp_path / "a.pdf")]) == 0
    assert command([*call, str(tmp_path / "b.pdf")]) == 0
    content = (tmp_path / "a.pdf").read_bytes()
    assert content == (tmp_path / "b.pdf").read_bytes()
    assert content.startswith(b"%PDF")
    assert content.count(b"/Type /Page ") >= 6
    assert command([*call, str(tmp_path / "a.pdf")]) == 2
    assert command([*call, str(tmp_path / "a.pdf"), "--overwrite"]) == 0
    assert command([*call, str(tmp_path / "a.svg")]) == 2


def test_the_command_draws_it_and_goes_on_without_a_recording(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = [str(folder / "runs" / name) for name in NAMES]
    assert command(["figure", *runs, "-o", str(tmp_path / "all"), "--stamp", "4"]) == 0
    assert (tmp_path / "all/close_up.png").stat().st_size > 10_000
    for odd in ("nan", "-inf", "1e300"):
        assert command(["figure", runs[0], "-o", str(tmp_path / "odd"), f"--stamp={odd}"]) == 2
        assert "is no time after the first tick, up to 1e+09 s" in capsys.readouterr().err
    (folder / "drive.jsonl").rename(tmp_path / "drive.jsonl")
    try:
        assert command(["figure", runs[0], "-o", str(tmp_path / "rest")]) == 0
        assert "no close-up:" in capsys.readouterr().out
        assert not (tmp_path / "rest/close_up.png").exists()
        assert (tmp_path / "rest/timing.png").exists()
        assert command(["figure", runs[0], "-o", str(tmp_path / "none"), "--track", "0"]) == 1
        assert "recording of the run is not there" in capsys.readouterr().err
    finally:
        (tmp_path / "drive.jsonl").rename(folder / "drive.jsonl")


def test_a_configuration_of_a_run_that_is_none_is_bad_data(folder: Path, found: list[CloseUp]) -> None:
    run = fgtrack.load_run(folder / "runs" / NAMES[0])
    spoilt = replace(run, config_text="estimator: [1]")
    with pytest.raises(fgtrack.DataError, match=r"config\.yaml: estimator: .*, so no close-up$"):
        close_up_of(spoilt, found[0].arrival)
