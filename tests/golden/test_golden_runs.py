"""The published tracker's own runs, replayed through the whole pipeline into a run folder."""

import gzip
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.messages import shared
from support.ticks import listed_ticks

from fgtrack.config.settings import Config
from fgtrack.config.yaml_file import load
from fgtrack.core.geometry import wrap_angles
from fgtrack.core.types import STATE_NAMES
from fgtrack.inputs.stream import read_stream
from fgtrack.pipeline import replay as pipeline
from fgtrack.runs import Run, load_run
from fgtrack.runs.schema import COVARIANCE_STATES
from fgtrack.tracking.lives.counters import Life

REFERENCE_CONFIG = (
    Path(__file__).resolve().parents[2] / "configs/karle2023_reference.yaml"
)
STATE_TOLERANCE = 1e-9
RUNS = ("short10", "lidar3_10", "jitter10", "full60")
COVARIANCE = [
    (i, j)
    for i in range(len(COVARIANCE_STATES))
    for j in range(i, len(COVARIANCE_STATES))
]


@dataclass(frozen=True)
class Golden:
    """What the published tracker gave, and what a replay gives."""

    expected: list[dict[str, Any]]
    run: Run
    lives: list[dict[int, tuple[int, int, int]]]
    """Counter, number of measurements and last sight of every track after every tick."""


def counted(lives: Mapping[int, Life]) -> dict[int, tuple[int, int, int]]:
    return {
        track_id: (life.counter, life.num_placed, life.last_seen_ns)
        for track_id, life in lives.items()
    }


@pytest.fixture(
    scope="module", params=[*RUNS[:3], pytest.param(RUNS[3], marks=pytest.mark.slow)]
)
def golden(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Golden:
    expected_file = shared(f"reference/{request.param}/expected.jsonl.gz")
    maps = [
        f"map.{lane}={json.dumps(str(shared(f'data/maps/lvms_{name}.csv')))}"
        for lane, name in (("track", "track"), ("pit", "pitlane"))
    ]
    with gzip.open(expected_file) as file:
        expected = [json.loads(line) for line in file]
    config = load(Config, REFERENCE_CONFIG, maps)
    trackers = []
    lives: list[dict[int, tuple[int, int, int]]] = []
    with pytest.MonkeyPatch.context() as patch:
        build = pipeline.build_tracker
        if request.param == "jitter10":
            ticks_ns = [tick["now_ns"] for tick in expected]
            patch.setattr(
                pipeline,
                "clock_ticks",
                lambda messages, node_hz: listed_ticks(messages, ticks_ns),
            )
        patch.setattr(
            pipeline,
            "build_tracker",
            lambda *made: trackers.append(build(*made)) or trackers[0],
        )
        run = tmp_path_factory.mktemp(request.param) / "run"
        [meta] = pipeline.replay(
            lambda: read_stream(shared(f"reference/{request.param}/stream.jsonl.gz")),
            config,
            {config.estimator: run},
            on_tick=lambda *_: lives.append(
                counted(trackers[0]._parts.lifecycle.lives)
            ),
        )
    assert meta["broken_off"] is None
    return Golden(expected, load_run(run), lives)


def test_the_ticks_are_those_of_the_published_node(golden: Golden) -> None:
    ticks = golden.run.tables["timing"]["now_ns"].tolist()
    assert ticks[: len(golden.expected)] == [tick["now_ns"] for tick in golden.expected]
    assert len(ticks) == len(golden.expected) + 1  # one more for what is left


def test_every_state_is_the_published_one_at_every_tick(golden: Golden) -> None:
    tracks = golden.run.tables["tracks"]
    last_ns = golden.expected[-1]["now_ns"]
    tracks = tracks.where(tracks["now_ns"] <= last_ns)
    rows = [
        (
            tick["now_ns"],
            tick["track_ns"],
            int(track_id),
            state["num_measured"],
            state["x"],
            state["P"],
        )
        for tick in golden.expected
        for track_id, state in tick["objects"].items()
    ]
    now_ns, track_ns, ids, measured, x, P = zip(*rows, strict=True)
    order = np.lexsort((ids, now_ns))
    given = np.lexsort((tracks["track_id"], tracks["now_ns"]))
    for name, wanted in (
        ("now_ns", now_ns),
        ("stamp_ns", track_ns),
        ("track_id", ids),
        ("num_measured", measured),
    ):
        assert tracks[name][given].tolist() == np.array(wanted)[order].tolist(), name
    states = np.column_stack([tracks[name][given] for name in STATE_NAMES])
    errors = states - np.array(x)[order]
    errors[:, 2] = wrap_angles(errors[:, 2])
    assert np.abs(errors).max() < STATE_TOLERANCE
    for i, j in COVARIANCE:
        column = tracks[f"p_{COVARIANCE_STATES[i]}_{COVARIANCE_STATES[j]}"][given]
        np.testing.assert_allclose(
            column, np.array(P)[order, i, j], rtol=1e-9, atol=STATE_TOLERANCE
        )


def test_counters_and_last_sights_are_the_published_ones(golden: Golden) -> None:
    for tick, lives in zip(golden.expected, golden.lives, strict=False):
        wanted = {
            int(track_id): (
                state["counter"],
                state["num_measured"],
                state["last_seen_ns"],
            )
            for track_id, state in tick["objects"].items()
        }
        assert lives == wanted, tick["now_ns"]


def test_births_and_deaths_are_the_published_ones(golden: Golden) -> None:
    updates = golden.run.tables["updates"]
    born: dict[int, list[tuple[int, str]]] = {}
    for row in np.flatnonzero(updates["disposition"] == "birth"):
        birth = (int(updates["track_id"][row]), str(updates["sensor"][row]))
        born.setdefault(int(updates["tick"][row]), []).append(birth)
    alive: set[int] = set()
    for tick, lives in zip(golden.expected, golden.lives, strict=False):
        births = born.get(tick["tick"], [])
        assert births == [(birth["id"], birth["sensor"]) for birth in tick["births"]], (
            tick["now_ns"]
        )
        alive |= {track_id for track_id, _ in births}
        assert sorted(alive - set(lives)) == sorted(map(int, tick["deaths"])), tick[
            "now_ns"
        ]
        alive = set(lives)


def test_every_innovation_is_the_published_one(golden: Golden) -> None:
    updates = golden.run.tables["updates"]
    found = {
        (
            int(updates["tick"][row]),
            str(updates["sensor"][row]),
            int(updates["track_id"][row]),
        ): row
        for row in np.flatnonzero(
            np.isin(updates["disposition"], ["in_sequence", "out_of_sequence"])
        )
        if updates["tick"][row] < len(golden.expected)
    }
    wanted = {
        (tick["tick"], item["sensor"], item["id"]): item
        for tick in golden.expected
        for item in tick["updates"]
    }
    assert set(found) == set(wanted)
    names = STATE_NAMES[:4]
    for key, row in found.items():
        innovation = wanted[key]["innovation"]
        given = [updates[f"res_{name}"][row] for name in names[: len(innovation)]]
        assert np.abs(np.array(given) - innovation).max() < STATE_TOLERANCE, key


def test_every_detection_has_one_row_and_the_sums_add_up(golden: Golden) -> None:
    meta = golden.run.meta
    counts = sum(sum(of_sensor.values()) for of_sensor in meta["counts"].values())
    assert (
        counts
        == golden.run.tables["updates"].num_rows
        == meta["detections_received"]
        > 0
    )
