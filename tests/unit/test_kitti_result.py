"""A run of a KITTI sequence as a result file: what is in it, and what the field's own evaluation says of it."""

import math
from pathlib import Path

import numpy as np
import pytest
from support.kitti import RECTIFIED_FROM_IMU, folder, oxts
from typer.testing import CliRunner

from fgtrack.cli.main import app
from fgtrack.core.errors import CallError, DataError
from fgtrack.evaluation.kitti_result import write_kitti_result
from fgtrack.inputs.formats.kitti_view import Box, read_views
from fgtrack.pipeline.public import replay
from fgtrack.runs import Columns

SIZE = "1.5 1.6 4.0"  # height, width, length
FRAMES = range(30)
METRE_DEG = math.degrees(1.0 / 6_378_137.0)


def place(frame: int, car: int) -> tuple[float, float, float]:
    """Ahead, aside and yaw of a car in the ego frame; the ego drives 1 m a frame to the north, the first car too."""
    return (20.0, 3.0, 0.0) if car == 0 else (40.0 - 0.5 * frame, -4.0, math.pi)


def line(
    frame: int,
    car: int,
    kind: str = "Car",
    image: str = "400 170 460 190",
    score: str = "",
) -> str:
    ahead_m, aside_m, yaw_rad = place(frame, car)
    x_m, y_m, z_m = RECTIFIED_FROM_IMU @ [ahead_m, aside_m, -1.5, 1.0]
    turned_rad = math.remainder(-yaw_rad - 0.5 * math.pi, 2.0 * math.pi)
    return f"{frame} {car} {kind} 0 0 0.0 {image} {SIZE} {x_m} {y_m} {z_m} {turned_rad}{score}"


def sequence(at: Path, **files: list[str]) -> Path:
    """30 frames of an ego that drives to the north, tilted a little; two cars, seen as they are."""
    ego = [
        oxts(
            frame * METRE_DEG * math.cos(math.radians(49.0)),
            0.0,
            0.01,
            -0.02,
            0.5 * math.pi,
            10.0,
        )
        for frame in FRAMES
    ]
    seen = [line(frame, car, score=" 7.75") for frame in FRAMES for car in (0, 1)]
    folder(at, oxts=ego, pointrcnn_car=seen, **files)
    views, _ = read_views(at, "0001")
    labels = []
    for frame in FRAMES:
        for car in (0, 1):
            numbers = list(map(float, line(frame, car).split()[10:17]))
            image = Box(*numbers).image_px(views[frame].projection)
            labels.append(line(frame, car, image=" ".join(map(str, image))))
    (at / "label_02").mkdir(exist_ok=True)
    (at / "label_02/0001.txt").write_text("\n".join(labels))
    return at / "oxts/0001.txt"


@pytest.fixture(scope="module")
def replayed(tmp_path_factory):
    at = tmp_path_factory.mktemp("kitti")
    oxts_file = sequence(at / "data")
    settings = {"input.kitti.min_score": {}}
    run = replay(
        oxts_file, "kitti", estimator="ekf-replay", out=at / "run", set=settings
    )
    return run, oxts_file


def rows(file: Path) -> dict[tuple[int, int], list[str]]:
    split = [text.split() for text in file.read_text().splitlines()]
    return {(int(fields[0]), int(fields[1])): fields for fields in split}


def test_a_result_holds_a_box_of_every_track_at_every_frame(tmp_path, replayed):
    run, oxts_file = replayed
    written = write_kitti_result(run, oxts_file, tmp_path / "0001.txt")
    found = rows(tmp_path / "0001.txt")
    assert written == (len(found), 2, 0)
    last = {fields[1]: fields for (frame, _), fields in found.items() if frame == 29}
    labels = [
        text.split()
        for text in (oxts_file.parents[1] / "label_02/0001.txt")
        .read_text()
        .splitlines()[-2:]
    ]
    nearest = [
        min(last.values(), key=lambda each: abs(float(each[13]) - float(label[13])))
        for label in labels
    ]
    for label, fields in zip(labels, nearest, strict=True):
        assert fields[2] == "Car"
        assert len(fields) == 18
        assert list(map(float, fields[10:13])) == [1.5, 1.6, 4.0]
        assert 0.9 < float(fields[17]) <= 1.0  # its existence probability
        assert [float(value) for value in fields[13:16]] == pytest.approx(
            list(map(float, label[13:16])), abs=0.1
        )
        assert math.cos(float(fields[16]) - float(label[16])) > 0.999
        assert [float(value) for value in fields[6:10]] == pytest.approx(
            list(map(float, label[6:10])), abs=5.0
        )
        x_m, z_m = float(fields[13]), float(fields[15])
        assert math.cos(
            float(fields[3 + 2]) - (float(fields[16]) - math.atan2(x_m, z_m))
        ) == pytest.approx(1.0)


def test_without_existence_probabilities_the_score_is_that_of_the_detections(
    tmp_path, replayed
):
    run, oxts_file = replayed
    tracks = run.tables["tracks"]
    counted = run.with_tables(
        tracks=Columns({**tracks, "score": np.full(tracks.num_rows, np.nan)})
    )
    write_kitti_result(counted, oxts_file, tmp_path / "0001.txt")
    assert {float(fields[17]) for fields in rows(tmp_path / "0001.txt").values()} == {
        7.75
    }


def test_without_a_size_nothing_is_written(tmp_path, replayed):
    _, oxts_file = replayed
    data = oxts_file.parents[1]
    stream = tmp_path / "points.jsonl"
    CliRunner().invoke(
        app, ["convert", str(oxts_file), str(stream)], catch_exceptions=False
    )
    text = stream.read_text()
    for name in ("length_m", "width_m"):
        text = text.replace(f'"{name}"', f'"no_{name}"')
    stream.write_text(text)
    other = replay(stream, "kitti", estimator="ekf-replay")
    with pytest.raises(DataError, match="no detection of its tracks has a size"):
        write_kitti_result(other, data, tmp_path / "out.txt")
    assert not (tmp_path / "out.txt").exists()


def test_the_command_names_the_sequence_and_replaces_with_overwrite_only(
    tmp_path, replayed
):
    run, oxts_file = replayed
    out = tmp_path / "0001.txt"
    call = ["export", str(run.path), "-o", str(out), "--kitti"]
    runner = CliRunner()
    done = runner.invoke(app, [*call, str(oxts_file)], catch_exceptions=False)
    assert "boxes of 2 tracks" in done.output
    with pytest.raises(CallError, match="already exists"):
        runner.invoke(app, [*call, str(oxts_file)], catch_exceptions=False)
    runner.invoke(app, [*call, str(oxts_file), "--overwrite"], catch_exceptions=False)
    with pytest.raises(CallError, match="not a sequence of the KITTI data set"):
        runner.invoke(app, [*call, str(tmp_path)], catch_exceptions=False)


def judged(root: Path, name: str, num_frames: int) -> dict[str, float]:
    """CLEAR of the car class by TrackEval, of `root/gt/label_02` and `root/trackers/fgtrack/data`."""
    trackeval = pytest.importorskip(
        "trackeval", reason="trackeval is not installed (extra `rivals`)"
    )
    (root / "gt/evaluate_tracking.seqmap.training").write_text(
        f"{name} empty 000000 {num_frames:06d}\n"
    )
    dataset = trackeval.datasets.Kitti2DBox(
        {
            "GT_FOLDER": str(root / "gt"),
            "TRACKERS_FOLDER": str(root / "trackers"),
            "CLASSES_TO_EVAL": ["car"],
            "PRINT_CONFIG": False,
        }
    )
    quiet = {
        name: False
        for name in trackeval.Evaluator.get_default_eval_config()
        if name.startswith(("PRINT", "TIME", "OUTPUT", "PLOT"))
    }
    evaluator = trackeval.Evaluator({**quiet, "LOG_ON_ERROR": None})
    metrics = [
        trackeval.metrics.CLEAR({"PRINT_CONFIG": False}),
        trackeval.metrics.Identity({"PRINT_CONFIG": False}),
    ]
    result = evaluator.evaluate([dataset], metrics)[0]["Kitti2DBox"]["fgtrack"][
        "COMBINED_SEQ"
    ]["car"]
    return {**result["CLEAR"], **result["Identity"]}


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_the_evaluation_of_the_field_takes_the_result(tmp_path, replayed):
    run, oxts_file = replayed
    (tmp_path / "gt").mkdir()
    (tmp_path / "gt/label_02").symlink_to(oxts_file.parents[1] / "label_02")
    write_kitti_result(run, oxts_file, tmp_path / "trackers/fgtrack/data/0001.txt")
    found = judged(tmp_path, "0001", len(FRAMES))
    assert found["CLR_FP"] == found["IDSW"] == 0
    assert found["CLR_FN"] <= 2 * 2  # until a track is confirmed
    assert found["MOTA"] > 0.9
