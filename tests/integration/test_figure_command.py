"""`fgtrack figure` on sweeps and on many runs: which files it writes, and what it refuses."""

from pathlib import Path

import pytest

from fgtrack.cli.main import run as command

HEADER = "delay_s,seed,estimator,truth.overall.errors.position_m.rmse,truth.overall.errors.yaw_rad.rmse\n"


def a_sweep(folder: Path) -> Path:
    folder.mkdir()
    rows = [
        f"{d},{seed},{name},{d + seed},{d}\n"
        for d in (0.1, 0.2)
        for seed in (0, 1)
        for name in ("a", "b")
    ]
    (folder / "sweep.csv").write_text(HEADER + "".join(rows))
    return folder


def test_a_sweep_is_drawn_by_its_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sweep = str(a_sweep(tmp_path / "sweep"))
    assert command(["figure", sweep, "-o", str(tmp_path / "few")]) == 0
    assert "1 more figures with --all" in capsys.readouterr().out
    assert sorted(file.name for file in (tmp_path / "few").iterdir()) == [
        "error_against_delay.png",
        "sweep_truth.overall.errors.position_m.rmse.png",
    ]
    assert command(["figure", sweep, "-o", str(tmp_path / "all.pdf"), "--all"]) == 0
    assert "more with" not in capsys.readouterr().out
    assert (tmp_path / "all.pdf").read_bytes().count(b"/Type /Page ") == 3


def test_a_sweep_is_drawn_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sweep, out = str(a_sweep(tmp_path / "sweep")), ["-o", str(tmp_path / "out")]
    for more, message in (
        ([str(tmp_path)], "give it alone"),
        (["--stamp", "1"], "without --stamp"),
    ):
        assert command(["figure", sweep, *more, *out]) == 2
        assert message in capsys.readouterr().err
    (tmp_path / "sweep" / "sweep.csv").write_text(HEADER)
    assert command(["figure", sweep, *out]) == 1
    assert "no rows of a sweep" in capsys.readouterr().err
