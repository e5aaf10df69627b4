"""Wall time in a replay: measured, waited for, and never in the results."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest

from fgtrack.core.types import Message
from fgtrack.io.run import COLUMNS, Node, RunWriter, load_run
from fgtrack.pipeline import replay as pipeline
from fgtrack.pipeline.build import build_tracker
from fgtrack.pipeline.config import ClockConfig, Config, MapConfig
from fgtrack.pipeline.replay import replay_each
from fgtrack.pipeline.shipped import read_scenario
from fgtrack.sim.simulate import simulate

MS = 1_000_000


@dataclass
class FakeClock:
    """Time that passes by a step at every look, and as far as is waited for."""

    step_ns: int = 0
    time_ns: int = 5_000 * MS
    waits_ns: list[int] = field(default_factory=list)

    def now_ns(self) -> int:
        self.time_ns += self.step_ns
        return self.time_ns

    def wait_until(self, time_ns: int) -> None:
        self.waits_ns.append(time_ns)
        self.time_ns = max(self.time_ns, time_ns)


@pytest.fixture(scope="module")
def messages() -> list[Message]:
    return simulate(replace(read_scenario("default"), duration_s=0.6), np.random.default_rng(1))


Driven = Callable[..., tuple[list[int], int | None]]


@pytest.fixture
def driven(messages: list[Message], tmp_path: Path) -> Driven:
    def drive(clock: FakeClock, realtime: bool, node_hz: float | None = 50.0) -> tuple[list[int], int | None]:
        config = Config(estimator="ekf-replay", map=MapConfig(track="oval"), clock=ClockConfig(node_hz=node_hz))
        with RunWriter(tmp_path / f"run{len(list(tmp_path.iterdir()))}") as writer:
            _, _, misses = pipeline._drive(
                build_tracker(config), messages, config, writer, clock=clock, realtime=realtime
            )
        return load_run(writer.path).tables["timing"]["process_ns"].tolist(), misses

    return drive


@pytest.mark.parametrize(("due_ms", "took_ms", "done_ms", "misses"), [
    ([0, 20, 40], [5, 5, 5], [5, 25, 45], 0),
    ([0, 20, 40], [20, 20, 20], [20, 40, 60], 0),
    ([0, 20, 40, 60], [35, 10, 5, 1], [35, 45, 50, 61], 2),
    ([0, 20, 40], [30, 30, 30], [30, 60, 90], 3),
    ([], [], [], 0),
])  # fmt: skip
def test_a_tick_begins_when_the_one_before_is_done(
    due_ms: list[int], took_ms: list[int], done_ms: list[int], misses: int
) -> None:
    node = Node(20 * MS)
    assert [node.done_ns(due * MS, took * MS) for due, took in zip(due_ms, took_ms, strict=True)] == [
        done * MS for done in done_ms
    ]
    assert node.misses == misses


def test_missed_deadlines_are_counted(driven: Driven) -> None:
    took_ns, misses = driven(FakeClock(step_ns=3 * MS), realtime=False)
    assert misses == 0
    assert driven(FakeClock(step_ns=21 * MS), realtime=False)[1] == len(took_ns)
    assert driven(FakeClock(step_ns=21 * MS), realtime=False, node_hz=None)[1] is None


def test_only_in_real_time_a_tick_waits_as_long_as_it_was_recorded(driven: Driven) -> None:
    fast, paced = FakeClock(), FakeClock()
    ticks = len(driven(fast, realtime=False)[0])
    driven(paced, realtime=True)
    assert not fast.waits_ns
    assert paced.waits_ns[0] == paced.time_ns - 20 * MS * (ticks - 1)  # the first one is due at once
    assert np.diff(paced.waits_ns).tolist() == [20 * MS] * (ticks - 1)


def test_in_real_time_all_files_but_the_times_are_the_same_to_the_bit(messages: list[Message], tmp_path: Path) -> None:
    config = Config(estimator="ekf-replay", map=MapConfig(track="oval"))
    for name, realtime in (("fast", False), ("paced", True)):
        (result,) = replay_each(lambda: messages, config, {"ekf-replay": tmp_path / name}, realtime=realtime)
        assert result.meta["wall_s"] >= (0.5 if realtime else 0.0)
        assert result.deadline_misses is not None
    fast, paced = load_run(tmp_path / "fast"), load_run(tmp_path / "paced")
    assert fast.meta["digest"] == paced.meta["digest"]
    assert {k: v for k, v in fast.meta.items() if k != "wall_s"} == {
        k: v for k, v in paced.meta.items() if k != "wall_s"
    }
    for table in COLUMNS:
        for name, values in fast.tables[table].items():
            if name != "process_ns":
                assert values.tobytes() == paced.tables[table][name].tobytes(), (table, name)
