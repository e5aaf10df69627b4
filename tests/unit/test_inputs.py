"""What a command reads: its output must be none of it, and the key of a job follows it."""

import os
from pathlib import Path

import pytest
from support import kitti

from fgtrack.core.errors import CallError
from fgtrack.io.ros.typestore import definition_files
from fgtrack.pipeline.config import Config
from fgtrack.pipeline.inputs import fingerprints, inputs
from fgtrack.pipeline.load import validate


def config(**given: object) -> Config:
    return validate(Config, given, "test")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with files in it and below."""
    (tmp_path / "many/below").mkdir(parents=True)
    for name in ("a.csv", "b.msg", "below/c.csv", "below/d.msg"):
        (tmp_path / "many" / name).write_text(name)
    return tmp_path / "many"


def test_a_folder_in_place_of_a_file_is_not_walked(folder: Path) -> None:
    """It may be the root of the file system."""
    given = config(map={"track": str(folder), "pit": str(folder), "excluded": [str(folder)]})
    assert set(fingerprints(None, None, given)) == {None}
    assert inputs(given) == []


def test_inputs_are_the_files_that_are_named(folder: Path) -> None:
    given = config(map={"track": str(folder / "a.csv")}, input={"message_definitions": [str(folder)]})
    assert set(inputs(given, [folder])) == {folder, folder / "a.csv"}


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


def test_folders_of_definitions_have_an_end(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert definition_files(folder) == [folder / "b.msg", folder / "below/d.msg"]
    monkeypatch.setattr("fgtrack.io.ros.typestore._MOST_FOLDERS", 1)
    with pytest.raises(CallError, match="more than 1 folders, name that of the message definitions"):
        definition_files(folder)
