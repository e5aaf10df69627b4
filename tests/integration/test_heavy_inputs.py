"""Inputs made to fill memory or time, each read by a command in a process of its own: below --max-memory and 20 s."""

import json
import sqlite3
import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from support.mcap import END, HEADER
from support.messages import drive
from support.server import Server

from fgtrack.io.ros.bag_writer import write_bag

pytestmark = pytest.mark.slow

MOST_MB, LONGEST_S = 4096.0, 40.0
MILLION = 1_000_000


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    made = Server()
    yield made
    made.close()


def sparse(path: Path, start: bytes, num_bytes: int, end: bytes = b"") -> None:
    """A file of so many bytes that takes no place: `start`, zeros, `end`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        file.write(start)
        file.seek(num_bytes)
        file.write(end or b"\0")


def filled(path: Path, start: bytes, item: bytes, count: int, end: bytes = b"") -> None:
    """`item` so many times."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        file.write(start)
        for _ in range(count // 1000):
            file.write(item * 1000)
        file.write(end)


def stream(folder: Path) -> None:
    from fgtrack.io.stream import write_stream

    write_stream(folder / "x.jsonl", drive())


def crowd(folder: Path) -> None:
    """One list of 30,000 objects, none seen again."""
    from fgtrack.core.types import Detection, DetectionList, EgoState
    from fgtrack.io.stream import write_stream

    ego = [EgoState(10**7 * k, 10**7 * k, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0) for k in range(20)]
    objects = tuple(Detection(x_m=10.0 * (k % 200), y_m=10.0 * (k // 200)) for k in range(30_000))
    write_stream(folder / "x.jsonl", [*ego, DetectionList("radar", 15 * 10**7, 19 * 10**7, objects)])


def spot(folder: Path) -> None:
    """Two lists of 4,000 objects in one place."""
    from fgtrack.core.types import Detection, DetectionList, EgoState
    from fgtrack.io.stream import write_stream

    rng = np.random.default_rng(1)
    ego = [EgoState(10**7 * k, 10**7 * k, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0) for k in range(40)]
    lists = [
        DetectionList(
            "radar",
            stamp_ns,
            stamp_ns + 5 * 10**7,
            tuple(Detection(x_m=x, y_m=y) for x, y in rng.normal(20.0, 0.3, size=(4_000, 2)).tolist()),
        )
        for stamp_ns in (10**8, 2 * 10**8)
    ]
    write_stream(folder / "x.jsonl", sorted([*ego, *lists], key=lambda message: message.receipt_ns))


def nuscenes_zeros(folder: Path) -> None:
    sparse(folder / "results.json", b'{"meta": {}, "results": {', 3_000 * MILLION)
    nuscenes_tables(folder)


def nuscenes_tables(folder: Path) -> None:
    (folder / "v1.0-mini").mkdir(exist_ok=True)
    entry = {
        "scene": {"token": "a", "name": "a"},
        "sample": {"token": "s", "timestamp": 10**15, "scene_token": "a"},
        "sample_data": {"sample_token": "s", "ego_pose_token": "p"},
        "ego_pose": {"token": "p", "timestamp": 10**15, "translation": [0, 0, 0], "rotation": [1, 0, 0, 0]},
    }
    for name, one in entry.items():
        (folder / f"v1.0-mini/{name}.json").write_text(json.dumps([one]))


def table_zeros(folder: Path) -> None:
    sparse(folder / "x.csv", b"t,x,y\n1,2,", 3_000 * MILLION)


def yaml(text: bytes, item: bytes, count: int, end: bytes = b"\n") -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        filled(folder / "x.yaml", text, item, count, end)

    return make


def yaml_zeros(folder: Path) -> None:
    sparse(folder / "x.yaml", b"map: ", 3_000 * MILLION)


def small_yaml(text: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        (folder / "x.yaml").write_text(text)

    return make


_RACE = """ego: {kind: track, arc_m: 0.0, speed: [[0, 50]]}
sensors: [{name: radar, std: {x_m: 1.0, y_m: 1.0}, rate_hz: RATE, clutter: {mean_per_scan: CLUTTER}}]
duration_s: DURATION
"""


def race(rate_hz: float, clutter: float, duration_s: float) -> Callable[[Path], None]:
    numbers = {"RATE": rate_hz, "CLUTTER": clutter, "DURATION": duration_s}
    text = _RACE
    for name, number in numbers.items():
        text = text.replace(name, repr(number))
    return small_yaml(text)


def sweep(folder: Path) -> None:
    axes = "\n".join(
        f"  {key}: {[0.1 * k for k in range(1, 1001)]}" for key in ("association.gate_m", "merge.distance_m")
    )
    text = f"format: fgtrack-sweep/1\nscenario: single_opponent\nestimators: [ekf-replay]\nseeds: 1000\nvary:\n{axes}\n"
    (folder / "x.yaml").write_text(text)


def blob(folder: Path) -> None:
    write_bag(folder / "bag", drive(), "sqlite3")
    (file,) = (folder / "bag").glob("*.db3")
    base = sqlite3.connect(file)
    base.execute("update messages set data = zeroblob(900000000) where id = 5")
    base.commit()
    base.close()


def mcap_large_record(folder: Path) -> None:
    sparse(folder / "x.mcap", HEADER + struct.pack("<BQ", 5, 2_900 * MILLION), 2_900 * MILLION + 50, END)


def large_meta(folder: Path) -> None:
    import fgtrack

    fgtrack.replay(iter(drive()), "smoother", out=folder / "run")
    with (folder / "run/meta.json").open("wb") as file:
        file.write(b'{"format":"fgtrack-run/1","x":[0')
        for _ in range(20_000):
            file.write(b",{}" * 1000)
        file.write(b"]}")


def stream_zeros(folder: Path) -> None:
    sparse(folder / "x.jsonl", b'{"type": "header", "format": "fgtrack-stream/1"}\n', 3_000 * MILLION)


CONFIG, SIMULATE = ("config", "-c", "x.yaml"), ("simulate", "x.yaml", "-o", "y.jsonl")
_TABLE = "input.csv.detections={lidar: {columns: {stamp: t, x_m: x, y_m: y}}}"
TABLE = (
    "replay",
    "x.csv",
    "-c",
    "open_space",
    "--set",
    _TABLE,
    "--set",
    "sensors={lidar: {std: {x_m: 1.0, y_m: 1.0}}}",
    "-o",
    "run",
)
BOMBS: dict[str, tuple[Callable[[Path], None], tuple[str, ...]]] = {
    "nuscenes of 3 GB": (nuscenes_zeros, ("info", "results.json")),
    "table of 3 GB": (table_zeros, TABLE),
    "yaml of 3 GB": (yaml_zeros, CONFIG),
    "scenario of 10^9 scans": (race(1e4, 0.0, 86_400.0), SIMULATE),
    "sweep of 10^9 cells": (sweep, ("sweep", "x.yaml", "-o", "out", "--jobs", "1")),
    "sqlite3 with a blob of 900 MB": (blob, ("info", "bag")),
    "mcap, message of 3 GB": (mcap_large_record, ("info", "x.mcap")),
    "all in one place": (spot, ("replay", "x.jsonl", "-e", "ekf-replay", "-o", "run")),
    "stream of 3 GB": (stream_zeros, ("info", "x.jsonl")),
    "run with large meta": (large_meta, ("compare", "run")),
    "crowd of 30,000": (crowd, ("replay", "x.jsonl", "-e", "smoother-banded", "-o", "run")),
}


@pytest.mark.parametrize("name", BOMBS)
def test_a_bomb(server: Server, tmp_path: Path, name: str) -> None:
    make, words = BOMBS[name]
    make(tmp_path)
    done = server(words, tmp_path, kill_after_s=300.0)
    assert done.peak_mb < MOST_MB
    assert done.cpu_s < LONGEST_S
    assert done.code in (0, 1, 2)
    assert "internal error" not in done.said
    assert done.said.strip()
