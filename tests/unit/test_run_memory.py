"""A run kept in memory is the run that is written and read back."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fgtrack.config.motion import MotionConfig
from fgtrack.config.reading import read_scenario
from fgtrack.config.settings import Config, MapConfig
from fgtrack.core.types import EgoState, Message
from fgtrack.evaluation.metrics import evaluate
from fgtrack.pipeline.replay import replay, replay_in_memory
from fgtrack.runs import COLUMNS, Run, load_run
from fgtrack.sim.simulate import simulate

#: Columns and entries that no two runs share: wall times.
TIMES = ("process_ns",)
UNSHARED = ("wall_s",)
NAMES_AND_TIMES = ("name", "time_")


def assert_same(memory: Run, written: Run) -> None:
    assert memory.config_text == written.config_text
    assert without(memory.meta) == without(written.meta)
    for table in COLUMNS:
        kept, read = memory.tables[table], written.tables[table]
        assert list(kept) == list(read) == list(COLUMNS[table])
        for name in read:
            assert kept[name].dtype == read[name].dtype, (table, name)
            if name not in TIMES:
                assert kept[name].tobytes() == read[name].tobytes(), (table, name)


def without(meta: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in meta.items() if name not in UNSHARED}


@pytest.fixture(scope="module")
def messages() -> list[Message]:
    return simulate(
        replace(read_scenario("default"), duration_s=3.0), np.random.default_rng(4)
    )


@pytest.mark.parametrize("estimator", ["smoother", "ekf-replay"])
def test_replays_are_the_same_in_memory_and_written(
    estimator: str, messages: list[Message], tmp_path: Path
) -> None:
    config = Config(estimator=estimator, map=MapConfig(track="oval"))
    config = replace(config, smoother=replace(config.smoother, lagged_s=(0.3, 0.1)))
    if estimator == "smoother":
        config = replace(config, motion=MotionConfig(kind="ctrv"))
    replay(lambda: messages, config, {estimator: tmp_path / "run"})
    written = load_run(tmp_path / "run")
    memory = replay_in_memory(messages, config)
    assert memory.meta["broken_off"] is None
    assert memory.tables["tracks"].num_rows > 100
    assert memory.tables["ego"].num_rows == sum(
        isinstance(message, EgoState) for message in messages
    )
    received, ended = (
        list(
            zip(
                *(
                    table[name].tolist()
                    for name in ("sensor", "stamp_ns", "receipt_ns", "index")
                ),
                strict=True,
            )
        )
        for table in (memory.tables["detections"], memory.tables["updates"])
    )
    assert received == ended, "row k of both tables is the same detection"
    assert (
        (memory.tables["lagged"].num_rows > 100)
        == (memory.tables["smoothed"].num_rows > 100)
        == (estimator == "smoother")
    )
    assert_same(memory, written)
    kept, read = (evaluate(run).as_dict() for run in (memory, written))
    assert {
        name: kept[name] for name in kept if not name.startswith(NAMES_AND_TIMES)
    } == {name: read[name] for name in read if not name.startswith(NAMES_AND_TIMES)}
