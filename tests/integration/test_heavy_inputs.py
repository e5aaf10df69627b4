"""Inputs made to fill memory or time, each read by a command in a process of its own: below --max-memory and 40 s."""

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.messages import drive
from support.server import Server

import fgtrack
from fgtrack.core.types import Detection, DetectionList, EgoState
from fgtrack.inputs.ros.mcap_file import MCAP_MAGIC
from fgtrack.inputs.stream import write_stream

pytestmark = pytest.mark.slow

MOST_MB, LONGEST_S = 4096.0, 40.0
Make = Callable[[Path], object]


def sparse(name: str, start: bytes, end: bytes = b"\0") -> Make:
    """A file of 3 GB that takes no room: `start`, zeros, `end`."""

    def make(folder: Path) -> None:
        with (folder / name).open("wb") as file:
            file.write(start)
            file.seek(3_000_000_000)
            file.write(end)

    return make


def small(name: str, content: str | bytes) -> Make:
    data = content.encode() if isinstance(content, str) else content
    return lambda folder: (folder / name).write_bytes(data)


def crowd(*lists: tuple[int, np.ndarray]) -> Make:
    """Lists of a RADAR by stamp in ms, and an ego at rest."""

    def make(folder: Path) -> None:
        sent: list[fgtrack.Message] = [
            EgoState(10**7 * k, 10**7 * k, 0.0, 0.0, 0.0, 0.0) for k in range(40)
        ]
        for stamp_ms, positions_m in lists:
            objects = tuple(Detection(x_m=x, y_m=y) for x, y in positions_m.tolist())
            sent.append(
                DetectionList(
                    "radar", stamp_ms * 10**6, (stamp_ms + 50) * 10**6, objects
                )
            )
        write_stream(folder / "x.jsonl", sorted(sent, key=lambda one: one.receipt_ns))

    return make


def large_meta(folder: Path) -> None:
    fgtrack.replay(iter(drive()), "smoother", out=folder / "run")
    (folder / "run/meta.json").write_bytes(
        b'{"format":"fgtrack-run/1","x":[0' + b",{}" * 20_000_000 + b"]}"
    )


RACE = """ego: {kind: track, arc_m: 0.0, speed: [[0, 50]]}
sensors: [{name: radar, std: {x_m: 1.0, y_m: 1.0}, rate_hz: 1.0e+4}]
duration_s: 86400.0
"""
AXES = "\n".join(
    f"  {key}: {[0.1 * k for k in range(1, 1001)]}"
    for key in ("association.gate_m", "merge.distance_m")
)
SWEEP = f"format: fgtrack-sweep/1\nscenario: single_opponent\nestimators: [ekf-replay]\nseeds: 1000\nvary:\n{AXES}\n"
CONFIG = ("config", "-c", "x.yaml")
COLUMNS = "input.csv.detections={lidar: {columns: {stamp: t, x_m: x, y_m: y}}}"
TABLE = (
    "replay",
    "x.csv",
    "--set",
    COLUMNS,
    "--set",
    "sensors={lidar: {std: {x_m: 1.0, y_m: 1.0}}}",
    "-o",
    "run",
)
GRID_M = 10.0 * np.stack(np.divmod(np.arange(30_000), 200), axis=-1)
SPOT_M = np.random.default_rng(1).normal(20.0, 0.3, size=(4_000, 2))

#: By name: how the input is made, the command, and what it says.
HEAVY: dict[str, tuple[Make, tuple[str, ...], str]] = {
    "nuscenes of 3 GB": (
        sparse("x.json", b'{"meta": {}, "results": {'),
        ("info", "x.json"),
        "x.json",
    ),
    "table of 3 GB": (sparse("x.csv", b"t,x,y\n1,2,"), TABLE, "memory"),
    "stream of 3 GB": (
        sparse("x.jsonl", b'{"type": "header", "format": "fgtrack-stream/1"}\n'),
        ("info", "x.jsonl"),
        "",
    ),
    "yaml of 3 GB": (sparse("x.yaml", b"map: "), CONFIG, "memory"),
    "mcap, message of 3 GB": (
        sparse("x.mcap", MCAP_MAGIC + struct.pack("<BQ", 5, 2_999_999_950), MCAP_MAGIC),
        ("info", "x.mcap"),
        "",
    ),
    "scenario of 10^9 scans": (
        small("x.yaml", RACE),
        ("simulate", "x.yaml", "-o", "y.jsonl"),
        "memory",
    ),
    "sweep of 10^9 cells": (
        small("x.yaml", SWEEP),
        ("sweep", "x.yaml", "-o", "out", "--jobs", "1"),
        "x.yaml",
    ),
    "run with large meta": (large_meta, ("compare", "run"), "run"),
    "crowd of 30,000": (
        crowd((150, GRID_M)),
        ("replay", "x.jsonl", "-e", "smoother-banded", "-o", "run"),
        "",
    ),
    "all in one place": (
        crowd((100, SPOT_M), (200, SPOT_M)),
        ("replay", "x.jsonl", "-e", "ekf-replay", "-o", "run"),
        "",
    ),
}


@pytest.mark.parametrize("name", HEAVY)
def test_it_is_refused_or_read_in_bounded_memory_and_time(
    server: Server, tmp_path: Path, name: str
) -> None:
    make, words, said = HEAVY[name]
    make(tmp_path)
    done = server(words, tmp_path, kill_after_s=300.0)
    assert done.peak_mb < MOST_MB
    assert done.cpu_s < LONGEST_S
    assert done.code in (0, 1, 2)
    assert "internal error" not in done.said
    assert said in " ".join(done.said.split())
    assert done.said.strip()
