"""What is fuzzed: the kinds of inputs, and the commands that read them."""

import gzip
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from fuzz import inputs
from fuzz.inputs import Files

RUN = "run"
"""Folder of the run that a command writes, which is looked at."""


@dataclass(frozen=True, eq=False)
class Target:
    """A kind of input."""

    healthy: Callable[[], Sequence[Files]]
    """Inputs that are right, as contents by name."""
    commands: Sequence[Sequence[str]]
    """Words of the commands, called in the folder of the files."""
    corrupted: str | None = None
    """End of the names of the files that are corrupted, else any."""
    needs: str | None = None
    """Package that reads the input, where that need not be installed."""


_REPLAY = ("--overwrite", "-o", RUN, "-e")
_OPEN = ("-c", "open_space", *_REPLAY, "ekf-replay")
_CV = (
    "--set",
    "motion={kind: cv, std_per_s: {velocity: 3.0}}",
    "--set",
    "clock.node_hz=10",
)
_MERGE = "merge={kind: connected, distance_m: 5.1}"


def _recording(file: str, content: Callable[[], bytes], *options: str) -> Target:
    return Target(
        lambda: [{file: content()}],
        [("info", file), ("replay", file, *_OPEN, *options)],
    )


def _beside(
    file: str, contents: Callable[[], Sequence[bytes]], *commands: Sequence[str]
) -> Target:
    """A file, beside a stream that is right."""
    return Target(
        lambda: [{file: one, "x.jsonl": inputs.stream()} for one in contents()],
        commands,
        file,
    )


TARGETS = {
    "stream": _recording("x.jsonl", inputs.stream),
    "gzip": _recording("x.jsonl.gz", lambda: gzip.compress(inputs.stream(), mtime=0)),
    "mcap": _recording("x.mcap", lambda: inputs.bag("mcap")),
    "sqlite3": _recording("x.db3", lambda: inputs.bag("sqlite3")),
    "ros1": _recording("x.bag", inputs.ros1, "--set", "input.ego.topic=/odom"),
    "smoother": Target(
        lambda: [{"x.jsonl": inputs.stream()}],
        [
            (
                "replay",
                "x.jsonl",
                "-c",
                "open_space",
                "--set",
                _MERGE,
                *_REPLAY,
                "smoother",
            )
        ],
    ),
    "autoferry": Target(
        lambda: [inputs.autoferry()],
        [
            ("info", "in"),
            ("replay", "in", "-c", "autoferry", *_REPLAY, "ekf-replay"),
            ("compare", RUN),
        ],
    ),
    "log-folder": Target(
        lambda: [inputs.log_folder()],
        [
            ("info", "in"),
            (
                "replay",
                "in",
                "-c",
                "karle2023",
                "--set",
                "map.track=null",
                *_REPLAY,
                "ekf-backward-forward",
            ),
        ],
    ),
    "kitti": Target(
        lambda: [inputs.kitti_sequence()],
        [("info", "in"), ("replay", "in", "-c", "kitti", *_REPLAY, "ekf-replay")],
    ),
    "tables": Target(
        lambda: [inputs.tables()],
        [
            ("info", "in", "-c", "x.yaml"),
            ("replay", "in", "-c", "x.yaml", "--overwrite", "-o", RUN),
        ],
    ),
    "nuscenes": Target(
        lambda: [inputs.nuscenes()],
        [
            ("info", "in/results.json"),
            ("replay", "in/results.json", "--set", inputs.NUSCENES, *_OPEN),
        ],
    ),
    "configuration": Target(
        inputs.configurations,
        [
            ("config", "-c", "x.yaml"),
            ("replay", "x.jsonl", "-c", "x.yaml", *_REPLAY, "ekf-replay"),
        ],
        "x.yaml",
    ),
    "scenario": Target(
        lambda: [{"x.yaml": content} for content in inputs.shipped("scenarios")],
        [("simulate", "x.yaml", "-o", "out.jsonl", "--overwrite", "--duration", "0.5")],
    ),
    "sweep": Target(
        lambda: [{"x.yaml": inputs.SWEEP}],
        [("sweep", "x.yaml", "-o", "swept", "--jobs", "1")],
        "x.yaml",
    ),
    "map": _beside(
        "x.csv",
        lambda: [inputs.track_map()],
        (
            "replay",
            "x.jsonl",
            "-c",
            "smoother",
            "--map",
            "x.csv",
            *_REPLAY,
            "ekf-replay",
        ),
        (
            "replay",
            "x.jsonl",
            "-c",
            "karle2023_reference",
            "--map",
            "x.csv",
            "-o",
            RUN,
            "--overwrite",
        ),
    ),
    "fields": Target(
        lambda: [inputs.all_fields()],
        [
            ("info", "x.jsonl", "-c", "x.yaml"),
            ("replay", "x.jsonl", "-c", "x.yaml", *_REPLAY, "ekf-replay"),
            ("compare", RUN),
        ],
        ".jsonl",
    ),
    "latitudes": Target(
        lambda: [{"x.jsonl": inputs.latitudes()}],
        [
            ("info", "x.jsonl"),
            ("replay", "x.jsonl", "--overwrite", "-o", RUN),
            ("export", RUN, "--geojson", "-o", "x.geojson", "--overwrite"),
        ],
    ),
    "ais": Target(
        lambda: [{"x.log": inputs.nmea(inputs.ships())}],
        [("info", "x.log"), ("replay", "x.log", "-c", "ais", *_REPLAY, "ekf-replay")],
        needs="pyais",
    ),
    "asterix": Target(
        lambda: [{"x.ast": inputs.asterix(inputs.aircraft())}],
        [("info", "x.ast"), ("replay", "x.ast", "-c", "adsb", *_REPLAY, "ekf-replay")],
        needs="asterix",
    ),
    "delays": _beside(
        "x.yaml",
        lambda: [inputs.DELAYS],
        ("convert", "x.jsonl", "out.jsonl", "--delays", "x.yaml", "--overwrite"),
    ),
    "calibration": Target(
        lambda: [{"x.jsonl": inputs.straight()}],
        [
            ("tune", "x.jsonl", *_CV, "-o", "x.yaml", "--overwrite"),
            ("advise", "x.jsonl", *_CV, "--tune"),
            ("offsets", "x.jsonl", *_CV),
        ],
    ),
    "run": Target(
        lambda: [inputs.run_folder()],
        [
            ("compare", "in"),
            ("report", "in", "-o", "x.html", "--overwrite"),
            ("export", "in", "-o", "x.mcap", "--overwrite"),
            ("export", "in", "-o", "bag", "--ros2", "--overwrite"),
        ],
        ".csv",
    ),
}

#: As `TARGETS`, with shorter recordings, where one value more or less matters as much.
SHORT = TARGETS | {
    "stream": _recording("x.jsonl", lambda: inputs.stream(inputs.short_drive())),
    "gzip": _recording(
        "x.jsonl.gz",
        lambda: gzip.compress(inputs.stream(inputs.short_drive()), mtime=0),
    ),
    "mcap": _recording("x.mcap", lambda: inputs.bag("mcap", inputs.short_drive())),
    "sqlite3": _recording("x.db3", lambda: inputs.bag("sqlite3", inputs.short_drive())),
    "smoother": Target(
        lambda: [{"x.jsonl": inputs.stream(inputs.short_drive())}],
        [
            (
                "replay",
                "x.jsonl",
                "-c",
                "open_space",
                "--set",
                _MERGE,
                *_REPLAY,
                "smoother",
            )
        ],
    ),
    "run": Target(
        lambda: [inputs.run_folder(inputs.short_drive())],
        [("compare", "in"), ("export", "in", "-o", "x.mcap", "--overwrite")],
        ".csv",
    ),
}
