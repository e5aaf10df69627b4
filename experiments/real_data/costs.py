"""What late lists of a sensor cost each estimator, in pairs, with intervals."""

import functools
from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np

from fgtrack import FloatArray, Message
from fgtrack.evaluation import (
    PREDICTION_STEP_S,
    Estimate,
    EvaluatedRun,
    comparisons,
    displacements,
    sums_by_stamp,
    within_run,
)
from fgtrack.sim import ConstantDelay, SensorDelays, redelay

QUANTITIES = ("position_rmse_m", "gospa_in_view_rms_m")
HEADER = (
    "quantity",
    "estimator",
    "prompt_m",
    "late_m",
    "cost_m",
    "less_than_last_by_m",
)

Sums = Mapping[str, FloatArray]
"""By quantity, of one recording: sums of squares of 2 e runs, prompt and late ones of e estimators, and their count, of
every stamp, shape (n, 2 e + 1)."""


def late(messages: Sequence[Message], sensor: str, delay_s: float) -> list[Message]:
    """`messages` with the lists of `sensor` received `delay_s` after they were measured."""
    delays = {sensor: SensorDelays(ConstantDelay(delay_s))}
    return list(redelay(messages, delays, np.random.default_rng(0))[0])


def sums(
    prompt: Sequence[EvaluatedRun],
    after: Sequence[EvaluatedRun],
    horizons_s: Sequence[float] = (),
) -> Sums:
    """What runs of one recording, of the same estimators in the same order, are compared by.

    Positions where all runs track the same object at the same stamp, now and `horizons_s` ahead; GOSPA at all ticks.
    """
    runs = [*prompt, *after]
    found = comparisons(runs)[0].sums
    ahead = {
        f"position_{horizon_s:g}_s_ahead_rmse_m": _ahead(runs, horizon_s)
        for horizon_s in horizons_s
    }
    return {**{name: found[name] for name in QUANTITIES if name in found}, **ahead}


def _ahead(runs: Sequence[EvaluatedRun], horizon_s: float) -> FloatArray:
    """Squared errors of what the states predict, where all runs predict the same object from the same stamp."""
    column = round(horizon_s / PREDICTION_STEP_S) - 1
    squares: list[dict[tuple[int, int], float]] = [{} for _ in runs]
    for one, mine in zip(runs, squares, strict=True):
        for block in displacements(one.run, one.matching) if one.matching else ():
            places_of = zip(
                block.stamps_ns.tolist(), block.object_index.tolist(), strict=True
            )
            values_m2 = np.square(block.values["arc"][:, column]).tolist()
            mine.update(zip(places_of, values_m2, strict=True))
    squares = [mine for mine, one in zip(squares, runs, strict=True) if one.matching]
    places = sorted(functools.reduce(set.intersection, (set(each) for each in squares)))
    values = np.array([[each[place] for each in squares] for place in places]).reshape(
        -1, len(runs)
    )
    return sums_by_stamp(
        np.array([stamp_ns for stamp_ns, _ in places], dtype=np.int64), values
    )


def rows(found: Iterable[Sums], estimators: Sequence[str]) -> Iterator[list[str]]:
    """A row of `HEADER` for every quantity and estimator, of all recordings together.

    Intervals are those of `compare` along the recordings, one after the other. The last column is by how much
    less the delay costs than with the last estimator.
    """
    found = list(found)
    last = len(estimators) - 1
    for quantity in found[0]:
        ticks = np.concatenate([one[quantity] for one in found])
        roots = np.sqrt(ticks[:, :-1].sum(axis=0) / ticks[:, -1].sum())
        for k, name in enumerate(estimators):
            pair = (f"{roots[k]:.3f}", f"{roots[k + last + 1]:.3f}")
            saved = f"{_difference(ticks, last, k):.3f}" if k < last else ""
            yield [quantity, name, *pair, f"{_difference(ticks, k):.3f}", saved]


def _difference(ticks: FloatArray, one: int, other: int | None = None) -> Estimate:
    """What the delay costs estimator `one`; less what it costs the `other`."""
    num = ticks.shape[1] // 2

    def root(S: FloatArray, k: int) -> FloatArray:
        return np.sqrt(S[k] / S[-1])

    def statistic(S: FloatArray) -> FloatArray:
        cost = root(S, one + num) - root(S, one)
        return cost if other is None else cost - root(S, other + num) + root(S, other)

    return within_run(ticks, statistic)
