"""The experiment on real recordings runs, and says what it measured."""

import csv
from pathlib import Path

import pytest
from support.scripts import load

script = load("real_data")
DATA = Path(__file__).resolve().parents[2] / "../shared/data"


@pytest.mark.skipif(not (DATA / "autoferry" / "scenario4").is_dir(), reason="needs ../shared/data/autoferry")
def test_tracks_are_better_than_their_raw_detections(tmp_path: Path) -> None:
    script.main(autoferry=DATA / "autoferry", out=tmp_path, estimators="ekf-replay", scenarios="scenario4")
    with (tmp_path / "autoferry_scores.csv").open(newline="") as file:
        first, *averages = csv.DictReader(file)
    assert tuple(first) == script.HEADER
    assert float(first["mota"]) > float(first["mota_raw"]) + 20.0
    assert [row["recording"] for row in averages] == ["median", "mean"]
    assert averages[0]["mota"] == first["mota"]
