"""Is a car tracked as well where the scores were fitted to other drives?

    python experiments/real_data/leave_one_out.py --kitti KITTI -o out/leave_one_out --jobs 2

KITTI is the folder of the tracking data set. Every sequence is tracked with `sensors.pointrcnn_car.score` from the
labels of the others: a logistic fit of "is a labelled car" to all their detections, less the prior odds. With several
values of `--published`, the existence probability from which a track is published, a row for each: recall and switches.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import typer
from joblib import Parallel, delayed
from scipy.optimize import minimize
from scores import SEQUENCES, kitti_sources, raw, raw_mota, scans, write

import fgtrack
from fgtrack.core.types import BoolArray, FloatArray
from fgtrack.evaluation.matching import match
from fgtrack.evaluation.metrics import evaluate
from fgtrack.io.run import Run
from fgtrack.io.source import open_input
from fgtrack.models.sensors import Score
from fgtrack.pipeline.config import Config
from fgtrack.pipeline.shipped import read_config
from fgtrack.tracking.existence import ExistenceRules

SENSOR = "pointrcnn_car"
SCORES = (2.0, 3.0)
"""Lowest scores with which the detections themselves are judged."""
HEADER = (
    *("sequence", "published", "even", "scale", *(f"mota_raw_{score:g}" for score in SCORES)),
    *("mota", "recall", "id_switches"),
)


class Labelled(NamedTuple):
    """Detections outside ignored regions."""

    scores: FloatArray
    """Shape (n,)."""
    is_car: BoolArray
    """Whether each is a labelled car, shape (n,)."""


def labelled(source: Path, config: Config, run: Run) -> Labelled:
    """What the labels say of the detections of a sequence."""
    seen = list(scans(open_input(source, config.input).messages(), config))
    matching = match(raw(run, seen), config.evaluation)
    assert matching is not None
    scores = np.concatenate([scan.scores for scan in seen])
    return Labelled(scores[matching.tracks["track_id"]], matching.paired)


def fitted(found: Sequence[Labelled]) -> Score:
    """The score model of all of `found`: logit P(car | score) = prior log-odds + (score - even) / scale."""
    scores, is_car = (np.concatenate(each) for each in zip(*found, strict=True))
    signs = np.where(is_car, 1.0, -1.0)

    def loss(line: FloatArray) -> float:
        return float(np.logaddexp(0.0, -signs * (line[0] + line[1] * scores)).sum())

    offset, slope = minimize(loss, np.array([0.0, 1.0])).x.tolist()
    prior = float(np.log(is_car.sum() / (~is_car).sum()))
    return Score(even=(prior - offset) / slope, scale=1.0 / slope)


def tracked(name: str, source: Path, config: Config, others: Sequence[Labelled]) -> list[str]:
    """The row of one sequence."""
    assert isinstance(config.lifecycle, ExistenceRules)
    score = fitted(others)
    sensor = replace(config.sensors[SENSOR], score=score)
    run = fgtrack.replay(source, replace(config, sensors={**config.sensors, SENSOR: sensor}))
    scores = evaluate(run).multi_object
    assert scores is not None
    clear = scores.clear
    motas = [100.0 * raw_mota(source, _from(config, lowest), run) for lowest in SCORES]
    recall = 100.0 * clear["pairs"] / (clear["pairs"] + clear["misses"])
    numbers = (config.lifecycle.confirm_probability, score.even, score.scale, *motas, 100.0 * clear["mota"], recall)
    return [name, *(f"{number:.2f}" for number in numbers), f"{clear['id_switches']:.0f}"]


def published_from(config: Config, probability: float) -> Config:
    """`config` with tracks published from this existence probability on."""
    assert isinstance(config.lifecycle, ExistenceRules)
    rules = replace(config.lifecycle, confirm_probability=probability, doubt_probability=probability)
    return replace(config, lifecycle=rules)


def _from(config: Config, lowest: float) -> Config:
    kitti = replace(config.input.kitti, min_score={**config.input.kitti.min_score, SENSOR: lowest})
    return replace(config, input=replace(config.input, kitti=kitti))


def main(
    kitti: Annotated[Path, typer.Option(help="Folder of the KITTI tracking data set.")],
    out: Annotated[Path, typer.Option("-o", help="Folder for the table.")] = Path("out/leave_one_out"),
    sequences: Annotated[str, typer.Option(help="Sequences, separated by commas.")] = SEQUENCES,
    estimator: Annotated[str, typer.Option(help="Estimator.")] = "smoother",
    published: Annotated[str, typer.Option(help="From which probabilities, separated by commas.")] = "0.5",
    jobs: Annotated[int, typer.Option(help="Replays at a time.")] = 1,
) -> None:
    """Fit to all but one, track that one; print leave_one_out.csv."""
    config = replace(read_config("kitti"), estimator=estimator)
    sources = kitti_sources(kitti, sequences)
    labels = {
        name: labelled(source, config, fgtrack.replay(source, replace(config, estimator="drop")))
        for name, source in sources.items()
    }
    rows = Parallel(n_jobs=jobs)(
        delayed(tracked)(name, source, one, [found for other, found in labels.items() if other != name])
        for one in [published_from(config, float(each)) for each in published.split(",")]
        for name, source in sources.items()
    )
    score = fitted(list(labels.values()))
    write(out / "leave_one_out.csv", HEADER, rows)
    print(f"fitted to all: even {score.even:.2f}, scale {score.scale:.2f}")


if __name__ == "__main__":
    typer.run(main)
