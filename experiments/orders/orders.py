"""How far are estimates of different orders of arrival from one another, on streams made to tell them apart?

    python experiments/orders/orders.py -o out/orders

Every exact estimator takes every stream of `fgtrack/pipeline/nasty_streams.py` in the order of the stamps and in random
ones, all of it inside its window, with its default settings and, where it iterates, converged.
"""

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import typer
from joblib import Parallel, delayed

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import TrackState
from fgtrack.estimation.base import Estimator
from fgtrack.estimation.dense_joint import Difference, dense_joint, difference
from fgtrack.pipeline.certificate import Subject
from fgtrack.pipeline.nasty_streams import NASTY
from fgtrack.pipeline.oracle.estimates import smoothed
from fgtrack.pipeline.oracle.filters import filtered
from fgtrack.pipeline.verify import exact_estimators
from fgtrack.pipeline.verify_streams import Stream

#: Estimates further apart, in standard deviations, are not one solution.
SAME = 1e-5
_ITERATIONS = 100
_AHEAD_NS = NS_PER_S // 10

States = Mapping[int, TrackState]


class Row(NamedTuple):
    """One estimator on one stream, over all orders: largest differences in standard deviations."""

    stream: str
    estimator: str
    seed: int
    orders: int
    default_median: float
    """Default settings, the present, from the converged state of the order of the stamps: median over the orders."""
    default_max: float
    """The same, largest of the orders."""
    converged: float
    """Converged (filters: as they are), present and past, mean and covariance, from the order of the stamps."""
    oracle: float
    """The same from the oracle; NaN where there is none for this estimator and stream."""
    minima: int
    """How many solutions the orders have converged to; each but the first is confirmed."""


def measured(name: str, estimator: str, seed: int, orders: int) -> Row:
    """A row of the table."""
    rng = np.random.default_rng(seed)
    stream, subject = NASTY[name](rng), exact_estimators()[estimator]
    places = [list(range(len(stream.measurements)))]
    places += [rng.permutation(len(stream.measurements)).tolist() for _ in range(orders - 1)]
    iterates = subject.claims.nonlinear == "at convergence"
    runs = [fed(stream, subject, one) for one in places]
    if iterates:
        for one in runs:
            one.converge(_ITERATIONS)  # type: ignore[attr-defined]  # the claim says that it has it
    stamps_ns = [*stream.probes_ns(), stream.newest_ns, stream.newest_ns + _AHEAD_NS]
    found = [states(one, stamps_ns) for one in runs]
    default = replace(subject, options={})
    now_ns = [stream.newest_ns]
    plain = [states(fed(stream, default, one), now_ns) for one in places] if iterates else found
    apart = [apart_from(one, {at: found[0][at] for at in now_ns}, stream).mean_sigma for one in plain]
    expected = oracle(stream, subject, stamps_ns)
    return Row(
        name,
        estimator,
        seed,
        orders,
        float(np.median(apart)),
        max(apart),
        max(max(apart_from(one, found[0], stream)) for one in found),
        max(max(apart_from(one, expected, stream)) for one in found) if expected else math.nan,
        len(solutions(stream, subject, runs)),
    )


def fed(stream: Stream, subject: Subject, places: Sequence[int]) -> Estimator:
    """An estimator that has taken the whole stream; every measurement must have been fused."""
    estimator = subject.start(stream)
    for place in places:
        result = estimator.update(stream.measurements[place])
        assert result.innovation is not None, f"{stream.name}: {result.status}"
    return estimator


def states(estimator: Estimator, stamps_ns: Sequence[int]) -> States:
    """What it says at stamps."""
    return {at: estimator.state_at(at) for at in stamps_ns}


def apart_from(found: States, expected: States, stream: Stream) -> Difference:
    """Largest differences at the stamps of `expected`."""
    each = [difference(found[at], state, stream.motion) for at, state in expected.items()]
    return Difference(max(one.mean_sigma for one in each), max(one.covariance for one in each))


def oracle(stream: Stream, subject: Subject, stamps_ns: Sequence[int]) -> States:
    """What the estimator says that it solves, by other means; nothing where these do not reach.

    The filter of the oracle takes the measurements of one stamp as they are drawn, so it is none for two bearings; the
    heading must be known, and a loss that descends again may have another minimum next to the oracle's start.
    """
    if stream.motion.linear:
        known_ns = stamps_ns if subject.claims.smooths else [at for at in stamps_ns if at >= stream.newest_ns]
        return dense_joint(stream.motion, stream.prior, stream.measurements, known_ns)
    robust = {one.loss[0] for one in stream.sightings if one.loss is not None}
    if stream.prior.yaw_rad is None or not robust <= {"huber"}:
        return {}
    if subject.claims.solves == "least squares":
        return {at: TrackState(at, *stream.solution.state_at(at)) for at in stamps_ns}
    bearings = any("x_m" not in one.names and len(one.names) == 1 for one in stream.sightings)
    if subject.claims.solves != "ekf" or robust or bearings:
        return {}
    found = filtered(stream.problem)
    return {at: TrackState(at, *found.state_at(at)) for at in stamps_ns}


def solutions(stream: Stream, subject: Subject, runs: Sequence[Estimator]) -> list[States]:
    """The different solutions that the orders have led to, each confirmed: what is solved from there stays there.

    One that is left has not converged, which is an error.
    """
    stamps_ns = stream.problem.stamps_ns
    distinct: list[States] = []
    for one in runs:
        here = states(one, stamps_ns)
        if any(max(apart_from(here, other, stream)) < SAME for other in distinct):
            continue
        if distinct:
            there = settled(stream, subject, one, here)
            assert apart_from(here, there, stream).mean_sigma < 1e2 * SAME, f"{stream.name}: not converged"
        distinct.append(here)
    return distinct


def settled(stream: Stream, subject: Subject, estimator: Estimator, here: States) -> States:
    """Where the oracle ends that starts `here`, or what solves other equations than it."""
    assert subject.claims.nonlinear == "at convergence", f"{stream.name}: the order of arrival matters"
    if subject.claims.solves == "least squares":
        found = smoothed(stream.problem, np.array([state.mean for state in here.values()]))
        return {at: TrackState(at, *found.state_at(at)) for at in here}
    estimator.converge(_ITERATIONS)  # type: ignore[attr-defined]  # the claim says that it has it
    return states(estimator, list(here))


def able(name: str) -> list[str]:
    """The estimators that claim to be exact on a stream of this name."""
    linear = name.startswith("CV,")
    return [one for one, subject in exact_estimators().items() if linear or subject.claims.nonlinear != "never"]


def table(rows: Sequence[Row]) -> str:
    """The largest of all seeds, and the median of the medians, by stream and estimator."""
    lines = [
        "| stream | estimator | default settings: median (largest) [sd] | converged: between orders [sd] "
        "| to the oracle | several minima |",
        "|---|---|---|---|---|---|",
    ]
    for key in dict.fromkeys((row.stream, row.estimator) for row in rows):
        own = [row for row in rows if (row.stream, row.estimator) == key]
        judged = [row.oracle for row in own if not math.isnan(row.oracle)]
        one = [row.converged for row in own if row.minima == 1]
        lines.append(
            f"| {key[0]} | {key[1]} | {np.median([row.default_median for row in own]):.1g} "
            f"({max(row.default_max for row in own):.1g}) | {f'{max(one):.1g}' if one else ''} | "
            f"{f'{max(judged):.1g}' if judged else ''} | {sum(row.minima > 1 for row in own)} of {len(own)} |"
        )
    return "\n".join(lines) + "\n"


def main(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the table.")],
    orders: Annotated[int, typer.Option(min=2, help="Orders of arrival of each stream.")] = 25,
    seeds: Annotated[int, typer.Option(min=1, help="Streams of each kind.")] = 2,
    jobs: Annotated[int, typer.Option(help="Processes.")] = -1,
    only: Annotated[list[str] | None, typer.Option(help="Only these estimators.")] = None,
) -> None:
    """Measure, print the table, and keep it with every row."""
    cases = [
        (name, estimator, seed)
        for name in NASTY
        for estimator in able(name)
        if not only or estimator in only
        for seed in range(1, seeds + 1)
    ]
    rows: list[Row] = list(Parallel(n_jobs=jobs)(delayed(measured)(*case, orders) for case in cases))
    output.mkdir(parents=True, exist_ok=True)
    with (output / "orders.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(Row._fields)
        writer.writerows(rows)
    (output / "orders.md").write_text(table(rows))
    print(table(rows), end="")


if __name__ == "__main__":
    typer.run(main)
