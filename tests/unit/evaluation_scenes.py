"""Random scenes of several objects and tracks, as positions and as what evaluation sees of them."""

from dataclasses import dataclass

import numpy as np

from fgtrack.evaluation.near_pairs import Scenes


@dataclass(frozen=True)
class Positions:
    """Objects or tracks at every tick."""

    ids: list[np.ndarray]
    """Shape (n,) at each tick."""
    xy: list[np.ndarray]
    """Shape (n, 2) at each tick."""


def random_scenes(seed: int, side_m: float) -> tuple[Positions, Positions, Scenes]:
    """Objects, tracks and both as `Scenes`: up to 5 objects that come and go in a square of `side_m`.

    Tracks follow the objects with errors, are missed at times, change their id, exchange their objects; clutter has
    tracks of its own. The smaller the square, the more pairs there are to choose from.
    """
    rng = np.random.default_rng(seed)
    ticks, count = int(rng.integers(1, 40)), int(rng.integers(1, 6))
    xy = rng.uniform(0.0, side_m, (count, 2)) + np.cumsum(
        rng.normal(0.0, 0.5, (ticks, count, 2)), axis=0
    )
    present = rng.random((ticks, count)) > 0.15
    followers = np.arange(count)
    objects, tracks = Positions([], []), Positions([], [])
    for tick in range(ticks):
        if rng.random() < 0.1:
            followers = followers.copy()
            followers[rng.integers(count)] = 10 + tick
        if rng.random() < 0.1:
            followers = rng.permutation(followers)
        seen = rng.random(count) > 0.2
        clutter = np.flatnonzero(rng.random(3) < 0.2)
        objects.ids.append(np.flatnonzero(present[tick]))
        objects.xy.append(xy[tick, present[tick]])
        tracks.ids.append(np.concatenate([followers[seen], 1000 + clutter]))
        around = xy[tick, seen] + rng.normal(0.0, 2.0, (seen.sum(), 2))
        tracks.xy.append(
            np.concatenate([around, rng.uniform(0.0, side_m, (len(clutter), 2))])
        )
    return objects, tracks, as_scenes(objects, tracks, count)


def as_scenes(objects: Positions, tracks: Positions, count: int) -> Scenes:
    """Scenes of `count` objects, whose ids are their columns."""
    present = np.zeros((len(objects.ids), count), dtype=bool)
    blocks = []
    for tick, (ids, xy) in enumerate(zip(objects.ids, objects.xy, strict=True)):
        present[tick, ids] = True
        block = np.full((len(tracks.xy[tick]), count), np.inf)
        block[:, ids] = np.linalg.norm(tracks.xy[tick][:, None] - xy, axis=-1)
        blocks.append(block)
    tick_index = np.repeat(np.arange(len(blocks)), [len(block) for block in blocks])
    return Scenes.of(
        tick_index, np.concatenate(tracks.ids), np.concatenate(blocks), present, present
    )
