"""Is a car tracked as well where scores and visibility were fitted to other drives?

    python experiments/real_data/leave_one_out.py --kitti KITTI -o out/leave_one_out --jobs 2

KITTI is the folder of the tracking data set. Every sequence is tracked with `sensors.pointrcnn_car.score` from the
labels of the others: a logistic fit of "is a labelled car" to all their detections, less the prior odds. Visibility
and detection probability are the most likely ones for the scans of their cars from the first detection on. With several
values of `--published`, the existence probability from which a track is published, a row for each: recall and switches.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import typer
from joblib import Parallel, delayed
from options import Jobs, Kitti, Out, Sequences
from scipy.optimize import minimize
from scipy.special import expit
from scores import SEQUENCES, kitti_sources, raw, raw_mota, scans, write

import fgtrack
from fgtrack import NS_PER_S, BoolArray, Config, FloatArray, Run, evaluate, open_input
from fgtrack.config import ExistenceRules, Score
from fgtrack.evaluation import NO_TRACK, match

SENSOR = "pointrcnn_car"
SCORES = (2.0, 3.0)
"""Lowest scores with which the detections themselves are judged."""
HEADER = (
    *(
        "sequence",
        "published",
        "even",
        "scale",
        "visible_share",
        "visible_s",
        "detection_probability",
    ),
    *(f"mota_raw_{score:g}" for score in SCORES),
    *("mota", "recall", "id_switches"),
)


class Labelled(NamedTuple):
    """Detections outside ignored regions."""

    scores: FloatArray
    """Shape (n,)."""
    is_car: BoolArray
    """Whether each is a labelled car, shape (n,)."""
    cars: tuple[FloatArray, ...]
    """Of each car, from its first detection on: time in s of the scans, and 1 where it was detected, shape (m, 2)."""


def labelled(source: Path, config: Config, run: Run) -> Labelled:
    """What the labels say of the detections of a sequence."""
    seen = list(scans(open_input(source, config.input).messages(), config))
    matching = match(raw(run, seen), config.evaluation)
    assert matching is not None
    scores = np.concatenate([scan.scores for scan in seen])
    detected, cars = matching.track_ids != NO_TRACK, []
    for has, present in zip(detected.T, matching.present.T, strict=True):
        scans_of = np.flatnonzero(present & np.logical_or.accumulate(has))
        cars.append(
            np.column_stack([matching.now_ns[scans_of] / NS_PER_S, has[scans_of]])
        )
    return Labelled(scores[matching.tracks["track_id"]], matching.paired, tuple(cars))


def fitted(found: Sequence[Labelled]) -> Score:
    """The score model of all of `found`: logit P(car | score) = prior log-odds + (score - even) / scale."""
    scores, is_car = (
        np.concatenate(each) for each in list(zip(*found, strict=True))[:2]
    )
    signs = np.where(is_car, 1.0, -1.0)

    def loss(line: FloatArray) -> float:
        return float(np.logaddexp(0.0, -signs * (line[0] + line[1] * scores)).sum())

    offset, slope = minimize(loss, np.array([0.0, 1.0])).x.tolist()
    prior = float(np.log(is_car.sum() / (~is_car).sum()))
    return Score(even=(prior - offset) / slope, scale=1.0 / slope)


def visibility(found: Sequence[Labelled]) -> tuple[float, float, float]:
    """Most likely share of time in which a car is visible, time constant in s and P_D if visible; see `existence`."""

    def loss(unbounded: FloatArray) -> float:
        share, time_s, P_D = (
            expit(unbounded[0]),
            math.exp(unbounded[1]),
            expit(unbounded[2]),
        )
        total = 0.0
        for car in (car for each in found for car in each.cars):
            v = 1.0
            for (before_s, _), (time, has) in pairwise(car.tolist()):
                v = share + (v - share) * math.exp((before_s - time) / time_s)
                likelihood = v * P_D if has else 1.0 - v * P_D
                v, total = (
                    v * (P_D if has else 1.0 - P_D) / likelihood,
                    total - math.log(likelihood),
                )
        return total

    best = minimize(loss, np.array([2.0, 0.0, 3.0]), method="Nelder-Mead").x
    return float(expit(best[0])), math.exp(best[1]), float(expit(best[2]))


def tracked(
    name: str, source: Path, config: Config, others: Sequence[Labelled]
) -> list[str]:
    """The row of one sequence."""
    assert isinstance(config.lifecycle, ExistenceRules)
    score, (share, time_s, P_D) = fitted(others), visibility(others)
    sensor = replace(config.sensors[SENSOR], score=score, detection_probability=P_D)
    rules = replace(config.lifecycle, visible_share=share, visible_s=time_s)
    run = fgtrack.replay(
        source,
        replace(config, sensors={**config.sensors, SENSOR: sensor}, lifecycle=rules),
    )
    scores = evaluate(run).multi_object
    assert scores is not None
    clear = scores.clear
    motas = [100.0 * raw_mota(source, _from(config, lowest), run) for lowest in SCORES]
    recall = 100.0 * clear["pairs"] / (clear["pairs"] + clear["misses"])
    chosen = (
        config.lifecycle.confirm_probability,
        score.even,
        score.scale,
        share,
        time_s,
        P_D,
    )
    numbers = (*chosen, *motas, 100.0 * clear["mota"], recall)
    return [
        name,
        *(f"{number:.3g}" for number in numbers),
        f"{clear['id_switches']:.0f}",
    ]


def published_from(config: Config, probability: float) -> Config:
    """`config` with tracks published from this existence probability on."""
    assert isinstance(config.lifecycle, ExistenceRules)
    rules = replace(
        config.lifecycle, confirm_probability=probability, doubt_probability=probability
    )
    return replace(config, lifecycle=rules)


def _from(config: Config, lowest: float) -> Config:
    kitti = replace(
        config.input.kitti, min_score={**config.input.kitti.min_score, SENSOR: lowest}
    )
    return replace(config, input=replace(config.input, kitti=kitti))


def main(
    kitti: Kitti,
    out: Out = Path("out/leave_one_out"),
    sequences: Sequences = SEQUENCES,
    estimator: Annotated[str, typer.Option(help="Estimator.")] = "smoother",
    published: Annotated[
        str, typer.Option(help="From which probabilities, separated by commas.")
    ] = "0.5",
    jobs: Jobs = 1,
) -> None:
    """Fit to all but one, track that one; print leave_one_out.csv."""
    config = replace(Config.from_yaml("kitti"), estimator=estimator)
    sources = kitti_sources(kitti, sequences)
    labels = {
        name: labelled(
            source, config, fgtrack.replay(source, replace(config, estimator="drop"))
        )
        for name, source in sources.items()
    }
    rows = Parallel(n_jobs=jobs)(
        delayed(tracked)(
            name,
            source,
            one,
            [found for other, found in labels.items() if other != name],
        )
        for one in [
            published_from(config, float(each)) for each in published.split(",")
        ]
        for name, source in sources.items()
    )
    score = fitted(list(labels.values()))
    write(out / "leave_one_out.csv", HEADER, rows)
    share, time_s, P_D = visibility(list(labels.values()))
    print(f"fitted to all: even {score.even:.2f}, scale {score.scale:.2f}")
    print(
        f"visible {share:.2f} of the time, for {time_s:.2f} s, detected with {P_D:.3f}"
    )


if __name__ == "__main__":
    typer.run(main)
