"""`fgtrack demo`: the whole chain in a minute."""

import shutil
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
from fgtrack.pipeline.replay import replay_each
from fgtrack.pipeline.shipped import read_config, read_scenario
from fgtrack.sim.simulate import simulate

_SEED = 1
_ESTIMATORS = ("smoother", "ekf-replay", "ekf-backward-forward")
_LAGS = "smoother.lagged_s=[0.1, 0.2, 0.3, 0.4, 0.5, 0.7, 0.9]"


def demo(
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for recording, runs and figures.")] = Path(
        "fgtrack-demo"
    ),
) -> None:
    """Simulate, record, replay with three estimators, compare, draw."""
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
        write_bag(bag, simulate(read_scenario("default"), np.random.default_rng(_SEED)))
    config = read_config("smoother", [_LAGS], track_map=OVAL, pit_map=OVAL)
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
