"""docs/extending.md and its example, followed word for word in a folder outside the repository."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import fgtrack
from fgtrack.core.types import EgoState
from fgtrack.inputs.ros.messages import ODOMETRY, MessageFactory

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs/extending.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```$", PAGE, re.DOTALL | re.MULTILINE)
BLIPS = "example_msgs/msg/Blips"
SWEEP = """
format: fgtrack-sweep/1
input: drive.jsonl
estimators: [refilter]
vary: {filter.storage_s: [0.3, 0.5]}
"""
CONFIG = """
input:
  ego: {topic: /ego}
  detections: {camera: {topic: /blips}}
sensors: {camera: {std: {range_m: 0.5, bearing_rad: 0.01}}}
estimator: refilter
motion: {kind: acceleration, parameters: {jerk_density_m2ps5: 2.0}}
"""
#: Commands of the page run in one interpreter; a worker of a sweep is another one.
DRIVER = """
import shlex, sys
from fgtrack.cli.main import run
for line in sys.stdin:
    print("$", line, end="", flush=True)
    code = run(shlex.split(line)[1:])
    if code:
        sys.exit(f"{line}: exit code {code}")
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The package of the page, installed for programs that `followed` starts."""
    folder = tmp_path_factory.mktemp("extending") / "example"
    shutil.copytree(ROOT / "docs/example", folder)
    (folder / "sweep.yaml").write_text(SWEEP)
    options = {
        "TARGET": str(folder / "site"),
        "NO_DEPS": "1",
        "NO_BUILD_ISOLATION": "0",
        "NO_INDEX": "1",
    }
    env = {f"PIP_{name}": value for name, value in options.items()}
    [line] = [line for line in commands()[0] if line.startswith("pip ")]
    followed(folder, ["-m", *line.split()], env=env)
    return folder


def commands() -> list[list[str]]:
    """Lines of each block of commands: those of the package, those of a model in a clone."""
    return [text.splitlines() for language, text in BLOCKS if language == "bash"]


def clone(folder: Path, *titles: str) -> None:
    """Copy fgtrack into `folder`, with the changes that the page shows under the headings `titles`."""
    for part in ("fgtrack", "configs"):
        shutil.copytree(ROOT / part, folder / part)
    changes = [
        text
        for title in titles
        for text in re.findall(
            r"^```python\n(# fgtrack.*?)^```$",
            PAGE.partition(f"\n## {title}\n")[2].partition("\n## ")[0],
            re.DOTALL | re.MULTILINE,
        )
    ]
    assert changes
    for text in changes:
        first, added = text.split("\n", 1)
        path, _, anchor = first.removeprefix("# ").partition(", behind: ")
        file = folder / path
        before = file.read_text()
        assert before.count(f"{anchor}\n") == 1
        file.write_text(before.replace(f"{anchor}\n", f"{anchor}\n{added}"))


def followed(
    folder: Path,
    arguments: list[str],
    given: str = "",
    env: dict[str, str] | None = None,
    code: int = 0,
) -> str:
    """Output of a Python that knows the package and fgtrack, started in `folder`."""
    paths = os.pathsep.join(map(str, (folder / "site", ROOT)))
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        input=given,
        env={**os.environ, **(env or {}), "PYTHONPATH": paths},
        capture_output=True,
        text=True,
    )
    assert done.returncode == code, f"{done.stdout}\n{done.stderr}"
    return done.stdout + done.stderr


def test_the_commands_of_the_page_run_and_workers_load_the_package(
    folder: Path,
) -> None:
    lines = [line for line in commands()[0] if line.startswith("fgtrack ")]
    lines.append("fgtrack sweep sweep.yaml -o sweep --jobs 4")
    said = followed(folder, ["-c", DRIVER], "\n".join(lines) + "\n")
    for name in ("refilter", "drop-bank", "smoother-dogleg", "ekf-replay"):
        assert (folder / "runs" / name / "tracks.csv").stat().st_size > 2000
    tracks = [
        (folder / "runs" / name / "tracks.csv").read_text()
        for name in ("refilter", "ekf-replay")
    ]
    # the same filter, which is only made again where the other one finds the direction of a new object itself
    assert abs(last_x_m(tracks[0]) - last_x_m(tracks[1])) < 0.02
    assert re.search(r"all \d+ promises are kept", said)
    assert (folder / "other/tracks.csv").stat().st_size > 2000
    assert (folder / "other/config.yaml").read_text().count("acceleration") >= 1
    assert (folder / "sweep/sweep.csv").read_text().count("refilter") == 2
    assert (folder / "sweep/errors.csv").read_text().count("refilter") == 0


def last_x_m(tracks: str) -> float:
    header, *rows = tracks.splitlines()
    return float(rows[-1].split(",")[header.split(",").index("x_m")])


def test_the_page_shows_the_entry_points_of_the_example() -> None:
    [shown] = [
        text.split("\n", 1)[1] for language, text in BLOCKS if language == "toml"
    ]
    assert shown in (ROOT / "docs/example/pyproject.toml").read_text(encoding="utf-8")


def test_the_tests_of_the_page_pass(folder: Path) -> None:
    said = followed(
        folder,
        [
            "-m",
            "pytest",
            "-q",
            "-p",
            "no:cacheprovider",
            "-c",
            "/dev/null",
            "--rootdir",
            ".",
            ".",
        ],
    )
    assert re.search(r"\d\d passed", said)


def test_a_recording_with_the_message_type_is_replayed(folder: Path) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    text = "int64 stamp_ns\nfloat64[] ranges_m\nfloat64[] bearings_rad\n"
    store.register(get_types_from_msg(text, BLIPS))
    make = MessageFactory()
    with Writer(folder / "bag", version=9) as bag:
        ego = bag.add_connection("/ego", ODOMETRY, typestore=make.typestore)
        blips = bag.add_connection("/blips", BLIPS, typestore=store)
        for k in range(60):
            now_ns = 10**9 + k * 50_000_000
            message = make.odometry(EgoState(now_ns, now_ns, 0.0, 0.0, 0.0, 0.0))
            bag.write(ego, now_ns, make.serialize(message))
            blip = store.types[BLIPS](
                now_ns - 20_000_000, np.array([20.0 + 0.5 * k]), np.array([0.1])
            )
            bag.write(blips, now_ns + 1, store.serialize_cdr(blip, BLIPS))
    (folder / "bag.yaml").write_text(CONFIG)
    lines = ["fgtrack info bag -c bag.yaml", "fgtrack replay bag -c bag.yaml -o blips"]
    said = followed(folder, ["-c", DRIVER], "\n".join(lines) + "\n")
    assert "detections camera" in said
    updates = (folder / "blips/updates.csv").read_text()
    assert updates.count("in_sequence") > 50


def test_a_file_of_the_format_is_an_input_of_every_command(folder: Path) -> None:
    [shown] = [text for text in texts("A file format") if text.startswith("seconds ")]
    header, *rows = shown.splitlines()
    moving = [
        f"{k / 10} lidar {10.0 + 1.5 * k:.2f} {0.05 * (-1) ** k:.2f}" for k in range(40)
    ]
    assert rows[0].split()[:2] == moving[0].split()[:2]
    (folder / "shown.pos").write_text(shown)
    (folder / "moving.pos").write_text("\n".join([header, *moving, ""]))
    lines = [
        "fgtrack info shown.pos",
        "fgtrack replay moving.pos -o positions",
        "fgtrack convert moving.pos moving.jsonl",
    ]
    said = followed(folder, ["-c", DRIVER], "\n".join(lines) + "\n")
    assert "detections lidar" in said
    assert (folder / "positions/updates.csv").read_text().count("in_sequence") > 30
    assert (folder / "moving.jsonl").read_text().count("lidar") >= 40


def texts(title: str) -> list[str]:
    """Blocks of plain text under a heading of the page."""
    section = PAGE.partition(f"\n## {title}\n")[2].partition("\n## ")[0]
    return re.findall(r"^```text\n(.*?)^```$", section, re.DOTALL | re.MULTILINE)


@pytest.mark.parametrize("estimator", ["ekf-replay", "smoother"])
def test_range_rates_alone_halve_the_error_of_the_speed_and_start_no_track(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    estimator: str,
) -> None:
    [text] = [
        text
        for text in re.findall(
            r"^```python\n(.*?)^```$", PAGE, re.DOTALL | re.MULTILINE
        )
        if text.startswith("from dataclasses") and "range_rate_mps" in text
    ]
    replay, runs = fgtrack.replay, []

    def kept(messages: list[fgtrack.Message], config: fgtrack.Config) -> fgtrack.Run:
        runs.append(replay(messages, config, estimator=estimator))
        return runs[-1]

    monkeypatch.setattr(fgtrack, "replay", kept)
    exec(compile(text, "docs/extending.md", "exec"), {})
    with_radar, without = (
        float(line.split()[0]) for line in capsys.readouterr().out.splitlines()
    )
    assert with_radar < 0.6 * without
    updates = runs[0].updates
    outcomes = updates[updates["sensor"] == "radar"]["disposition"].value_counts()
    assert set(outcomes.index) <= {"in_sequence", "out_of_sequence", "gated"}
    assert outcomes["in_sequence"] > 90


def test_the_metric_has_a_column_a_value_and_a_name_in_a_sweep(folder: Path) -> None:
    script = """
import fgtrack
messages = list(fgtrack.simulate("single_opponent", duration_s=1.0))
run = fgtrack.replay(messages, "smoother", estimator="ekf-replay")
value = fgtrack.evaluate(run).multi_object.others["missed"]["share"]
assert 0.0 < value < 1.0, value
assert fgtrack.compare(run)["multi_object"]["missed_share"].tolist() == [value]
"""
    followed(folder, ["-c", script])


def test_a_shipped_metric_is_one_file_and_the_line_that_the_page_shows() -> None:
    home = ROOT / "fgtrack/evaluation/scores"
    section = PAGE.partition("\n## A metric\n")[2].partition("\n## ")[0]
    [line] = re.findall(r"^```python\n(.*?)^```$", section, re.DOTALL | re.MULTILINE)
    assert line in (home / "registry.py").read_text(encoding="utf-8")
    naming = [
        file.relative_to(ROOT).as_posix()
        for file in sorted((ROOT / "fgtrack").rglob("*.py"))
        if re.search(r"\bospa\b", file.read_text(encoding="utf-8"))
    ]
    assert naming == [
        "fgtrack/evaluation/scores/multi_object.py",  # a docstring
        "fgtrack/evaluation/scores/ospa.py",
        "fgtrack/evaluation/scores/registry.py",
    ]


def test_a_motion_model_in_a_clone_is_one_file_and_one_line(tmp_path: Path) -> None:
    """Commands of the page, the tuned noise, the contract and the documentation know the model."""
    clone(tmp_path, "A motion model")
    source = ROOT / "docs/example/fgtrack_example/acceleration.py"
    shutil.copy(source, tmp_path / "fgtrack/models")
    said = followed(tmp_path, ["-c", DRIVER], "\n".join(commands()[1]) + "\n")
    assert "motion.jerk" in said
    tuned = (tmp_path / "tuned.yaml").read_text()
    assert re.search(r"kind: acceleration\n", tuned)
    assert (tmp_path / "run/tracks.csv").stat().st_size > 2000
    script = """
import fgtrack.models
from fgtrack.estimation.registry import MOTION_MODELS, motion_model
assert list(MOTION_MODELS)[-1] == "acceleration"
assert not MOTION_MODELS.sources()  # no plug-in
fgtrack.testing.check_motion_model(motion_model("acceleration", {}))
import reference
assert "`jerk_density_m2ps5`" in reference.motion_models_page()
"""
    shutil.copy(ROOT / "docs/_ext/reference.py", tmp_path)
    followed(tmp_path, ["-c", script])


def test_a_new_measured_quantity_is_known_everywhere(tmp_path: Path) -> None:
    """In a copy of the package, with the changes of the page."""
    simulate = "from fgtrack.cli.main import run; run(['simulate', 'single_opponent', '-o', 'old', '--duration', '1'])"
    followed(tmp_path, ["-c", simulate])
    clone(tmp_path, "A measured quantity")
    script = """
import numpy as np
import fgtrack
from dataclasses import replace
from fgtrack.core.types import MEASURABLE
from fgtrack.inputs.ros.bag_writer import write_bag
from fgtrack.inputs.source import open_input

assert "inverse_range_pm" in MEASURABLE
model = fgtrack.measurement_model(("bearing_rad", "inverse_range_pm"), fgtrack.CTRV())
x = np.array([30.0, 40.0, 0.1, 20.0, 0.0])
assert abs(model.predict(x)[1] - 0.02) < 1e-15
numeric = [(model.predict(x + h) - model.predict(x - h)) / 2e-4 for h in 1e-4 * np.eye(5)]
assert np.allclose(model.jacobian(x), np.transpose(numeric), atol=1e-8)

messages = list(fgtrack.simulate("single_opponent", duration_s=1.0))
def seen(message):
    if not isinstance(message, fgtrack.DetectionList) or message.frame != "ego":
        return message
    def inverse(item):
        return replace(item, inverse_range_pm=float(1.0 / np.hypot(item.x_m, item.y_m)), covariance=None)
    return replace(message, objects=tuple(inverse(item) for item in message.objects))
messages = [seen(message) for message in messages]
write_bag("bag", messages)
again = list(open_input("bag").messages())
assert [repr(m) for m in again] == [repr(m) for m in messages]
old = next(m for m in open_input("old").messages() if isinstance(m, fgtrack.DetectionList) and m.objects)
assert old.objects[0].inverse_range_pm is None
assert old.objects[0].covariance is None and old.objects[0].object_id is None

sensor = fgtrack.SensorModel(std={"x_m": 0.5, "y_m": 0.5, "inverse_range_pm": 0.001})
config = fgtrack.Config(estimator="ekf-replay", sensors={"lidar": sensor, "lidar_cluster": sensor, "radar": sensor})
run = fgtrack.replay("bag", config, out="run")
assert np.isfinite(run.updates["res_inverse_range_pm"]).sum() > 20
"""
    followed(tmp_path, ["-c", script])
