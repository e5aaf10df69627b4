"""`fgtrack demo`: the whole chain in a minute."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from fgtrack.cli.compare import evaluated
from fgtrack.cli.show import TickProgress, console, progress
from fgtrack.core.errors import CallError
from fgtrack.evaluation.figures import save_figures
from fgtrack.evaluation.tables import comparison_tables
from fgtrack.io.ros.bag_writer import write_bag
from fgtrack.io.run import read_run
from fgtrack.io.source import open_input
from fgtrack.models.oval import OVAL
from fgtrack.pipeline.config import Config
from fgtrack.pipeline.replay import replay_each
from fgtrack.sim.paper import paper_scenario
from fgtrack.sim.simulate import simulate
from fgtrack.tracking.association import GatedEuclidean
from fgtrack.tracking.birth import MeasuredBirth

_SEED = 1
_ESTIMATORS = ("smoother", "ekf-replay", "ekf-backward-forward")
_LAGGED_S = (0.1, 0.2, 0.3, 0.4, 0.5, 0.7, 0.9)


def demo_config() -> Config:
    """What configs/smoother.yaml says, on the built-in oval and with more lags."""
    config = Config()
    return replace(
        config,
        map=replace(config.map, track=OVAL, pit=OVAL),
        motion=replace(config.motion, kind="ctrv"),
        association=GatedEuclidean(max_nis=400.0),
        lifecycle=replace(config.lifecycle, claim_overtaken=True),
        birth=MeasuredBirth(speed_std_mps=10.0),
        smoother=replace(config.smoother, lagged_s=_LAGGED_S),
        filter=replace(config.filter, storage_s=3.0),
    )


def demo(
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for recording, runs and figures.")] = Path(
        "fgtrack-demo"
    ),
) -> None:
    """Simulate the paper's scenario, record it as a rosbag2, replay the recording, compare and draw."""
    bag = out / "recording"
    if bag.exists():
        if not (bag / "metadata.yaml").exists():
            raise CallError(f"{bag}: is in the way and no recording, choose another folder with -o")
        shutil.rmtree(bag)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CallError(f"{out}: cannot be made a folder ({error.strerror}), choose another one with -o") from error
    with progress("simulate"):
        write_bag(bag, simulate(paper_scenario(), np.random.default_rng(_SEED)))
    config = demo_config()
    source = open_input(bag, config.input)
    with progress("replay") as show:
        results = replay_each(
            source.messages,
            config,
            _ESTIMATORS,
            out / "runs",
            origin=str(bag),
            kind=source.kind,
            on_tick=TickProgress(show),
        )
    runs = [read_run(result.path) for result in results]
    for table in comparison_tables(evaluated(runs)):
        console().print(table)
    with progress("draw"):
        files = save_figures(runs, out / "figures")
    console().print(f"recording: {bag}\nruns: {out / 'runs'}", highlight=False, soft_wrap=True)
    for file in files:
        console().print(f"figure: {file}", highlight=False, soft_wrap=True)
