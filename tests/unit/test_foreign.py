"""Files that cannot be read as they are: one clear line with the cause and the remedy."""

import io
import json
import lzma
import tarfile
import zipfile

import pytest
from test_nuscenes import data
from typer.testing import CliRunner

from fgtrack.cli.main import app
from fgtrack.core.errors import CallError, DataError
from fgtrack.inputs.settings import InputConfig, NuscenesInput
from fgtrack.inputs.source import open_input

POINTER = (
    "version https://git-lfs.github.com/spec/v1\n"
    "oid sha256:4d7a214614ab2935c943f9e0ff69d22eadbb8f32b1258daaa5e2ca24d17e2393\n"
    "size 12345\n"
)
METADATA = "rosbag2_bagfile_information:\n  relative_file_paths: [a.mcap]\n"


@pytest.mark.parametrize(
    "files",
    [
        {"a.mcap": POINTER},
        {"a.csv": POINTER},
        {"a.bag": POINTER},
        {"a.jsonl": POINTER},
        {"a.nmea": POINTER},
        {"a.ast": POINTER},
        {"drive/metadata.yaml": METADATA, "drive/a.mcap": POINTER},
        {"drive/ego.csv": "t,x\n1,2\n", "drive/radar.csv": POINTER},
        {"kitti/oxts/0001.txt": POINTER, "kitti/calib/0001.txt": "P0: 1"},
    ],
)
def test_a_pointer_of_git_lfs_is_named(tmp_path, files):
    for name, text in files.items():
        file = tmp_path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    path = tmp_path / next(iter(files)).split("/")[0]
    with pytest.raises(DataError, match=r"is a pointer of Git LFS .* `git lfs pull`"):
        open_input(path)


def zipped():
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        archive.writestr("a.csv", "t,x\n1,2\n")
    return out.getvalue()


def tarred():
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w") as archive:
        archive.addfile(tarfile.TarInfo("a.csv"))
    return out.getvalue()


@pytest.mark.parametrize(
    ("content", "what"),
    [
        (zipped(), "a ZIP archive: unpack it"),
        (tarred(), "a tar archive: unpack it"),
        (lzma.compress(b"t,x\n1,2\n"), "compressed with xz"),
        (b"\xd4\xc3\xb2\xa1" + bytes(40), "network packets"),
        (b"PAR1" + bytes(40), "a Parquet file: write it as CSV"),
        (b"\x89HDF\r\n\x1a\n" + bytes(40), "an HDF5 file"),
        (b"MATLAB 5.0 MAT-file" + bytes(200), "a MATLAB file"),
    ],
)
def test_an_archive_or_a_file_of_another_program_is_named(tmp_path, content, what):
    (tmp_path / "drive.dat").write_bytes(content)
    with pytest.raises(DataError, match=f"is .*{what}"):
        open_input(tmp_path / "drive.dat")


@pytest.mark.parametrize("indent", [None, 2])
def test_openlabel_is_named(tmp_path, indent):
    (tmp_path / "a.json").write_text(
        json.dumps({"openlabel": {"frames": {}}}, indent=indent)
    )
    with pytest.raises(DataError, match=r"annotation in OpenLABEL.* write its objects"):
        open_input(tmp_path / "a.json")


def test_loops_of_links_are_one_line(tmp_path):
    loop = tmp_path / "loop"
    loop.symlink_to("loop")
    with pytest.raises(CallError, match="the link leads nowhere or to itself"):
        open_input(loop)
    folder = tmp_path / "drive"
    folder.mkdir()
    (folder / "self").symlink_to(".")
    (folder / "a.csv").symlink_to("a.csv")
    for path in (loop, folder):
        result = CliRunner().invoke(app, ["info", str(path)])
        assert result.exit_code in (1, 2)
        assert "internal error" not in result.output


def test_results_of_nuscenes_are_found_by_relative_paths_and_links(
    tmp_path, monkeypatch
):
    results = data(tmp_path / "set")
    monkeypatch.chdir(results.parent)
    assert len(list(open_input(results.name).messages())) == 6
    link = tmp_path / "mine" / "results.json"
    link.parent.mkdir()
    link.symlink_to(results)
    assert len(list(open_input(link).messages())) == 6
    monkeypatch.chdir(tmp_path)
    (folder,) = results.parent.glob("v1.0-*")
    moved = tmp_path / "mine" / "other.json"
    moved.write_bytes(results.read_bytes())
    relative = InputConfig(
        nuscenes=NuscenesInput(tables=str(folder.relative_to(tmp_path)))
    )
    assert len(list(open_input("mine/other.json", relative).messages())) == 6
