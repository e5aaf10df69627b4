"""The key of a job of a sweep follows what it reads."""

import os
from pathlib import Path

import pytest
from support import kitti

from fgtrack.pipeline.config import Config
from fgtrack.pipeline.inputs import fingerprints
from fgtrack.pipeline.load import validate


def config(**given: object) -> Config:
    return validate(Config, given, "test")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with files in it and below."""
    (tmp_path / "many").mkdir()
    for name in ("a.csv", "b.csv"):
        (tmp_path / "many" / name).write_text(name)
    return tmp_path / "many"


def test_a_fingerprint_follows_the_content_of_a_file_whatever_its_size_and_time(folder: Path) -> None:
    given, file = config(map={"track": str(folder / "a.csv")}), folder / "a.csv"
    before, time_ns = fingerprints(None, None, given), file.stat().st_mtime_ns
    file.write_text("b.csv")
    os.utime(file, ns=(time_ns, time_ns))
    assert fingerprints(None, None, given) != before


def test_a_fingerprint_follows_the_files_beside_the_one_that_is_named(tmp_path: Path) -> None:
    """A sequence of KITTI is named by its file of `oxts/`, and its detections lie elsewhere."""
    sequence = kitti.folder(tmp_path, rrc=[kitti.pose(0, 20.0, 1.0, 0.0)]) / "oxts/0001.txt"
    before = fingerprints(sequence, None, config())
    assert fingerprints(sequence, None, config()) == before
    (tmp_path / "rrc/0001.txt").write_text(kitti.pose(0, 21.0, 1.0, 0.0))
    assert fingerprints(sequence, None, config()) != before
