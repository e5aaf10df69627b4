"""What is fuzzed: the kinds of inputs, and the commands that read them."""

import gzip
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from fgtrack.cli import main
from fuzz import bags, inputs
from fuzz.inputs import LINE, Files

RUN = "run"
"""Folder of the run that a command writes, which is looked at."""


@dataclass(frozen=True, eq=False)
class Target:
    """A kind of input."""

    name: str
    healthy: Callable[[], Sequence[Files]]
    """Inputs that are right, as contents by name."""
    spoilt: Callable[[str], bool]
    """Which files are spoilt."""
    commands: Sequence[Sequence[str]]
    """Words of the commands, called in the folder of the files; `LINE` for those in that file."""


def run(words: Sequence[str]) -> int:
    """Exit code of the command of these words."""
    return main.run(inputs.words(Path(LINE).read_bytes()) if words == (LINE,) else words)


_REPLAY = ("--overwrite", "-o", RUN, "-e")
_EKF = (*_REPLAY, "ekf-replay")
_CV = ("--set", "motion={kind: cv, std_per_s: {velocity: 3.0}}", "--set", "clock.node_hz=10")
_TOPICS = "input={ego: {topic: /ego}, detections: {radar: {topic: /seen}}}"
_MERGE = "merge={kind: connected, distance_m: 5.1}"


def _all(name: str) -> bool:
    return True


def _only(name: str) -> Callable[[str], bool]:
    return lambda file: file == name


TARGETS = (
    Target(
        "stream",
        lambda: [{"x.jsonl": inputs.stream()}],
        _all,
        [("info", "x.jsonl"), ("replay", "x.jsonl", "-c", "open_space", *_EKF)],
    ),
    Target(
        "stream-smoother",
        lambda: [{"x.jsonl": inputs.stream()}],
        _all,
        [("replay", "x.jsonl", "-c", "open_space", "--set", _MERGE, *_REPLAY, "smoother")],
    ),
    Target(
        "gzip",
        lambda: [{"x.jsonl.gz": gzip.compress(inputs.stream(), mtime=0)}],
        _all,
        [("info", "x.jsonl.gz"), ("replay", "x.jsonl.gz", "-c", "open_space", *_EKF)],
    ),
    Target(
        "mcap",
        lambda: [{"x.mcap": bags.bag("mcap")}],
        _all,
        [("info", "x.mcap"), ("replay", "x.mcap", "-c", "open_space", *_EKF)],
    ),
    Target(
        "sqlite3",
        lambda: [{"x.db3": bags.bag("sqlite3")}],
        _all,
        [("info", "x.db3"), ("replay", "x.db3", "-c", "open_space", *_EKF)],
    ),
    Target(
        "ros1",
        lambda: [{"x.bag": bags.ros1()}],
        _all,
        [("info", "x.bag"), ("replay", "x.bag", "-c", "open_space", "--set", "input.ego.topic=/odom", *_EKF)],
    ),
    Target(
        "foreign",
        lambda: [bags.foreign()],
        _all,
        [("info", "x.mcap", "-c", "x.yaml"), ("replay", "x.mcap", "-c", "x.yaml", "--overwrite", "-o", RUN)],
    ),
    Target(
        "bag-folder",
        bags.folders,
        _all,
        [("info", "in"), ("replay", "in", "-c", "open_space", "--set", _TOPICS, *_EKF)],
    ),
    Target(
        "autoferry",
        lambda: [inputs.autoferry()],
        _all,
        [("info", "in"), ("replay", "in", "-c", "autoferry", *_EKF), ("compare", RUN)],
    ),
    Target(
        "log-folder",
        lambda: [inputs.log_folder()],
        _all,
        [
            ("info", "in"),
            ("replay", "in", "-c", "karle2023", "--set", "map.track=null", *_REPLAY, "ekf-backward-forward"),
        ],
    ),
    Target("kitti", lambda: [inputs.kitti()], _all, [("info", "in"), ("replay", "in", "-c", "kitti", *_EKF)]),
    Target(
        "kitti-forms",
        inputs.kitti_forms,
        lambda name: "_car" in name,
        [("info", "in"), ("replay", "in", "-c", "kitti", *_EKF)],
    ),
    Target(
        "tables",
        lambda: [inputs.tables()],
        _all,
        [("info", "in", "-c", "x.yaml"), ("replay", "in", "-c", "x.yaml", "--overwrite", "-o", RUN)],
    ),
    Target(
        "nuscenes",
        lambda: [inputs.nuscenes()],
        _all,
        [
            ("info", "in/results.json"),
            ("replay", "in/results.json", "-c", "open_space", "--set", inputs.NUSCENES, *_EKF),
        ],
    ),
    Target(
        "excluded",
        lambda: [
            {"x.json": inputs.EXCLUDED, "x.jsonl": inputs.stream()},
            {"x.json": inputs.CORNERS, "x.jsonl": inputs.stream()},
        ],
        _only("x.json"),
        [("replay", "x.jsonl", "-c", "open_space", "--set", 'map.excluded=["x.json"]', *_EKF)],
    ),
    Target(
        "configuration",
        inputs.configurations,
        _only("x.yaml"),
        [("config", "-c", "x.yaml"), ("replay", "x.jsonl", "-c", "x.yaml", *_EKF)],
    ),
    Target(
        "scenario",
        lambda: [{"x.yaml": content} for content in inputs.shipped("scenarios")],
        _only("x.yaml"),
        [("simulate", "x.yaml", "-o", "out.jsonl", "--overwrite", "--duration", "0.5")],
    ),
    Target(
        "sweep",
        lambda: [{"x.yaml": content, **inputs.named()} for content in (inputs.SWEEP, inputs.RESWEEP)],
        _only("x.yaml"),
        [("sweep", "x.yaml", "-o", "swept", "--jobs", "1")],
    ),
    Target(
        "map",
        lambda: [{"x.csv": inputs.track_map(), "x.jsonl": inputs.stream()}],
        _only("x.csv"),
        [
            ("replay", "x.jsonl", "-c", "smoother", "--map", "x.csv", *_EKF),
            ("replay", "x.jsonl", "-c", "karle2023_reference", "--map", "x.csv", "-o", RUN, "--overwrite"),
        ],
    ),
    Target(
        "delays",
        lambda: [{"x.yaml": inputs.DELAYS, "x.jsonl": inputs.stream()}],
        _only("x.yaml"),
        [("convert", "x.jsonl", "out.jsonl", "--delays", "x.yaml", "--overwrite")],
    ),
    Target(
        "tune",
        lambda: [{"x.jsonl": inputs.straight()}],
        _all,
        [("tune", "x.jsonl", *_CV, "-o", "x.yaml", "--overwrite")],
    ),
    Target(
        "advise",
        lambda: [{"x.jsonl": inputs.straight()}],
        _all,
        [("advise", "x.jsonl", *_CV, "--tune"), ("offsets", "x.jsonl", *_CV)],
    ),
    Target(
        "run", lambda: [inputs.run_folder()], _all, [("compare", "in"), ("export", "in", "-o", "x.mcap", "--overwrite")]
    ),
    Target(
        "pictures",
        lambda: [inputs.run_folder()],
        _all,
        [("report", "in", "-o", "x.html", "--overwrite"), ("export", "in", "-o", "bag", "--ros2", "--overwrite")],
    ),
    Target("line", inputs.lines, _only(LINE), [("replay", "x.jsonl", "-c", "open_space", "-o", "in"), (LINE,)]),
)
