"""A live tracker that is killed at any moment goes on from its newest save as if it had not been."""

import os
import signal
import time
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
from support.traffic import Ticks, bits, gone_on, traffic

from fgtrack.pipeline.live import Tracker

#: Fewest kills; `--kills` asks for more.
FEWEST_KILLS = 20
EVERY = 4
"""Ticks between two saves."""


def digest(tracker: Tracker, ticks: Ticks) -> list[str]:
    """What each of `ticks` reports, in short. This tracker is never saved."""
    digests = list[str]()
    for tick in ticks:
        [report] = gone_on(tracker, [tick])
        digests.append(sha256(repr(bits([report])).encode()).hexdigest())
    return digests


def run_and_save(name: str, ticks: Ticks, path: Path, told: int) -> None:
    """Go through `ticks`, save now and then as a node does, and write a byte for each tick; ends the process."""
    tracker = Tracker("smoother", estimator=name)
    for k, tick in enumerate(ticks):
        os.write(told, b".")
        gone_on(tracker, [tick])
        if k % EVERY == EVERY - 1:
            tracker.save(path)
    os._exit(0)


def kill_in_tick(
    name: str, ticks: Ticks, path: Path, number: int, wait_s: float
) -> None:
    """Kill a process some time after it has begun a tick, or has ended."""
    told, tell = os.pipe()
    pid = (
        os.fork()
    )  # everything is loaded, so that the process is killed while it tracks
    if pid == 0:
        run_and_save(name, ticks, path, tell)
    os.close(tell)
    for _ in range(number):
        os.read(told, 1)
    time.sleep(wait_s)
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    os.close(told)


@pytest.mark.parametrize("name", ["ekf-replay", "smoother-banded", "smoother"])
def test_a_killed_tracker_goes_on_from_its_newest_save_with_the_same_bits(
    name: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    rng = np.random.default_rng(request.config.getoption("--fuzz-seed"))
    ticks = traffic(3)
    expected = digest(Tracker("smoother", estimator=name), ticks)
    kills = max(FEWEST_KILLS, request.config.getoption("--kills"))
    resumed_at = set[int]()
    for k in range(kills):
        path, number = tmp_path / str(k), int(rng.integers(1, len(ticks) + 1))
        kill_in_tick(name, ticks, path, number, 0.01 * float(rng.random()))
        assert path.exists() or number <= EVERY + 1
        tracker = (
            Tracker.load(path) if path.exists() else Tracker("smoother", estimator=name)
        )
        first = tracker.timing.ticks
        assert first % EVERY == 0
        assert digest(tracker, ticks[first:]) == expected[first:]
        resumed_at.add(first)
    assert len(resumed_at) > 5
