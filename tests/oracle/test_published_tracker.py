"""fgtrack's published tracker against a second one, written from the description alone."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import islice
from pathlib import Path
from zlib import crc32

import numpy as np
import pytest
from published_filter import DT, predict
from published_lane import Array
from published_situations import SITUATIONS, Situation, anything
from published_streams import generate
from published_tracker import ObjectResult, TickResult, run
from support.examples import slow
from support.messages import SHARED
from support.ticks import listed_ticks

from fgtrack.config.settings import Config
from fgtrack.config.yaml_file import load
from fgtrack.pipeline.build import build_propagator, build_tracker
from fgtrack.pipeline.clock import Delivered

REFERENCE_CONFIG = (
    Path(__file__).resolve().parents[2] / "configs/karle2023_reference.yaml"
)
SHARED_MAPS = ("lvms", "ims")
TOLERANCE = 1e-9
# After seconds of prediction an update leaves a ten millionth of the covariance: rounding loses as many digits.
TOLERANCE_AFTER_GAPS = 1e-7

Maps = tuple[Path, Path]


@dataclass(frozen=True)
class Snapshot:
    """The objects after a tick."""

    track_ns: int
    objects: dict[int, ObjectResult]


@pytest.fixture(scope="module")
def maps() -> dict[str, Maps]:
    """Track and pit lane of every map there is."""
    folder = Path(__file__).parents[2] / "configs/maps"
    found = {"oval": (folder / "oval_track.csv", folder / "oval_pitlane.csv")}
    for name in SHARED_MAPS:
        track, pit = (
            SHARED / f"data/maps/{name}_{lane}.csv" for lane in ("track", "pitlane")
        )
        if track.exists() and pit.exists():
            found[name] = (track, pit)
    return found


@cache
def reference_config(track: Path, pit: Path) -> Config:
    settings = [
        f"map.track={json.dumps(str(track))}",
        f"map.pit={json.dumps(str(pit))}",
    ]
    return load(Config, REFERENCE_CONFIG, settings)


def fgtrack_run(
    messages: Sequence[Delivered], ticks_ns: list[int], track: Path, pit: Path
) -> Iterator[Snapshot]:
    """What fgtrack makes of it; counters and last sights are read off its lifecycle."""
    tracker = build_tracker(reference_config(track, pit))
    for tick in islice(listed_ticks(messages, ticks_ns), len(ticks_ns)):
        for message in tick.messages:
            tracker.receive(message)
        report = tracker.tick(tick.now_ns)
        lives = tracker._parts.lifecycle.lives
        yield Snapshot(
            tracker._parts.bank.present_ns,
            {
                row.track_id: ObjectResult(
                    row.state.mean,
                    row.state.covariance,
                    lives[row.track_id].counter,
                    row.num_measured,
                    lives[row.track_id].last_seen_ns,
                )
                for row in report.tracks
            },
        )


def difference(x: Array, expected: Array) -> Array:
    """Difference of two states, the yaw's modulo 2 pi."""
    d = x - expected
    d[2] = np.remainder(d[2] + np.pi, 2.0 * np.pi) - np.pi
    return d


def assert_same_object(
    got: ObjectResult, expected: ObjectResult, tolerance: float
) -> None:
    assert (got.counter, got.num_measured, got.last_seen_ns) == (
        expected.counter,
        expected.num_measured,
        expected.last_seen_ns,
    )
    assert np.abs(difference(got.x, expected.x)).max() <= tolerance, (
        "the state is another"
    )
    assert np.abs(got.P - expected.P).max() <= tolerance * (
        1.0 + np.abs(expected.P).max()
    ), "its covariance is another"


class Relabelling:
    """Which of our ids is which of theirs: new ones are told apart by their state at birth."""

    def __init__(self) -> None:
        self.ours: dict[int, int] = {}

    def update(self, got: Snapshot, expected: TickResult) -> None:
        for theirs in expected.deaths:
            self.ours.pop(theirs, None)
        for theirs in sorted(set(expected.objects) - set(self.ours)):
            free = set(got.objects) - set(self.ours.values())
            assert free, (
                f"a birth is missing: {sorted(expected.objects)} against {sorted(got.objects)}"
            )
            x = expected.objects[theirs].x
            self.ours[theirs] = min(
                free,
                key=lambda ours: float(
                    np.abs(difference(got.objects[ours].x, x)).max()
                ),
            )
        assert set(self.ours.values()) == set(got.objects)


def assert_same_run(situation: Situation, seed: int, track: Path, pit: Path) -> None:
    """Both trackers report the same of every object after every tick."""
    messages, ticks_ns = generate(situation, seed, track, pit)
    tolerance = TOLERANCE_AFTER_GAPS if situation.clock == "gaps" else TOLERANCE
    relabelling = Relabelling()
    expectations = run(messages, ticks_ns, track, pit)
    for expected, got in zip(
        expectations, fgtrack_run(messages, ticks_ns, track, pit), strict=True
    ):
        assert got.track_ns == expected.track_ns
        relabelling.update(got, expected)
        for theirs, state in expected.objects.items():
            assert_same_object(got.objects[relabelling.ours[theirs]], state, tolerance)


@pytest.mark.parametrize("name", SITUATIONS)
def test_fgtrack_does_what_the_oracle_does(name: str, maps: dict[str, Maps]) -> None:
    seed = crc32(name.encode())
    chosen = list(maps)[seed % len(maps)]
    assert_same_run(SITUATIONS[name], seed, *maps[chosen])


@pytest.mark.parametrize("seed", [*range(8), *slow(*range(8, 100))])
def test_fgtrack_does_what_the_oracle_does_whatever_comes(
    seed: int, maps: dict[str, Maps]
) -> None:
    situation = anything(np.random.default_rng(seed))
    assert_same_run(situation, seed, *maps[list(maps)[seed % len(maps)]])


@pytest.mark.parametrize("num_steps", [1, 15, 350])
@pytest.mark.parametrize(
    "yaw_range_rad", [(-np.pi, np.pi), (-40.0, -np.pi), (np.pi, 40.0)]
)
def test_fgtrack_predicts_as_the_oracle_does(
    yaw_range_rad: tuple[float, float], num_steps: int
) -> None:
    rng = np.random.default_rng(num_steps)
    yaws = rng.uniform(*yaw_range_rad, 20)
    states = np.stack(
        [
            *rng.normal(0.0, 300.0, (2, 20)),
            yaws,
            *(rng.normal(0.0, 1.0, (3, 20)) * [[40.0], [1.0], [2.0]]),
        ]
    )
    roots = rng.normal(0.0, 1.0, (20, 6, 6))
    covariances = roots @ roots.transpose(0, 2, 1)
    propagator = build_propagator(load(Config, REFERENCE_CONFIG), DT)
    to_rep103 = np.array([0.0, 0.0, np.pi / 2.0, 0.0, 0.0, 0.0])
    means, spreads = propagator.propagate(
        states.T + to_rep103, covariances, np.full(20, num_steps), DT
    )
    for i in range(20):
        x, P = states[:, i], covariances[i]
        for _ in range(num_steps):
            x, P = predict(x, P)
        np.testing.assert_allclose(means[i], x + to_rep103, rtol=1e-11, atol=TOLERANCE)
        np.testing.assert_allclose(
            spreads[i], P, rtol=1e-11, atol=TOLERANCE * (1.0 + np.abs(P).max())
        )
