"""Real recordings: how well are vessels and cars tracked, beside what the raw detections say?

    python experiments/real_data/real_data.py --autoferry AUTOFERRY --kitti KITTI -o out/real_data --jobs 2

AUTOFERRY holds a folder for each scenario, KITTI is the folder of the tracking data set (docs/recordings.md). All
scenarios are replayed with one configuration, all sequences with another. Two tables of each: scores and NIS.
"""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer
from joblib import Parallel, delayed
from options import (
    Estimators,
    Jobs,
    OptionalAutoferry,
    OptionalKitti,
    Out,
    Scenarios,
    Sequences,
)
from scores import (
    SEQUENCES,
    Found,
    autoferry_sources,
    kitti_sources,
    scored,
    write_scores,
)

import fgtrack
from fgtrack import Config
from fgtrack.evaluation import EvaluatedRun


def judged(name: str, source: Path, config: Config) -> Found:
    """Scores of one recording, `name`."""
    return scored(
        name, source, config, EvaluatedRun(name, fgtrack.replay(source, config))
    )


def main(
    autoferry: OptionalAutoferry = None,
    kitti: OptionalKitti = None,
    out: Out = Path("out/real_data"),
    estimators: Estimators = "ekf-replay,smoother",
    sequences: Sequences = SEQUENCES,
    scenarios: Scenarios = "",
    autoferry_config: Annotated[
        str, typer.Option(help="Configuration for Autoferry.")
    ] = "autoferry",
    kitti_config: Annotated[
        str, typer.Option(help="Configuration for KITTI.")
    ] = "kitti",
    jobs: Jobs = 1,
) -> None:
    """Replay all recordings, print their scores and NIS."""
    groups: list[tuple[str, str, dict[str, Path]]] = []
    if autoferry is not None:
        groups.append(
            ("autoferry", autoferry_config, autoferry_sources(autoferry, scenarios))
        )
    if kitti is not None:
        groups.append(("kitti", kitti_config, kitti_sources(kitti, sequences)))
    for group, config, sources in groups:
        configs = [
            replace(Config.from_yaml(config), estimator=each)
            for each in estimators.split(",")
        ]
        tasks = [(*source, one) for one in configs for source in sources.items()]
        write_scores(
            out,
            Parallel(n_jobs=jobs)(delayed(judged)(*task) for task in tasks),
            f"{group}_",
        )


if __name__ == "__main__":
    typer.run(main)
