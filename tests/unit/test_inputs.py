"""What a command reads: its output must be none of it, and the key of a job follows it."""

from pathlib import Path

import pytest

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
    given = config(
        map={"track": str(folder), "pit": str(folder), "excluded": [str(folder)]}, clock={"ticks_file": str(folder)}
    )
    assert fingerprints(None, None, given) == []
    assert inputs(given) == []


def test_of_a_recording_every_file_counts_of_definitions_these_of_the_others_the_file(folder: Path) -> None:
    given = config(map={"track": str(folder / "a.csv")}, input={"message_definitions": [str(folder)]})
    found = fingerprints(folder, None, given)
    names = [[name for place, name, _, _ in found if place == one] for one in dict.fromkeys(row[0] for row in found)]
    assert names == [["a.csv", "b.msg", "below/c.csv", "below/d.msg"], ["a.csv"], ["b.msg", "below/d.msg"]]
    assert set(inputs(given, [folder])) == {folder, folder / "a.csv"}


def test_a_fingerprint_follows_its_file(folder: Path) -> None:
    given = config(map={"track": str(folder / "a.csv")})
    before = fingerprints(None, None, given)
    (folder / "a.csv").write_text("another")
    assert fingerprints(None, None, given) != before


def test_folders_of_definitions_have_an_end(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert definition_files(folder) == [folder / "b.msg", folder / "below/d.msg"]
    monkeypatch.setattr("fgtrack.io.ros.typestore._MOST_FOLDERS", 1)
    with pytest.raises(CallError, match="more than 1 folders, name that of the message definitions"):
        definition_files(folder)
