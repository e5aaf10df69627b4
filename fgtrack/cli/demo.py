"""`fgtrack demo`: the whole chain in a minute."""

from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from fgtrack.cli.arguments import Overwrite
from fgtrack.cli.compare import written_tables
from fgtrack.cli.figure import drawn_close_up
from fgtrack.cli.report import REPORT, write_report
from fgtrack.cli.show import TickProgress, console, progress, say
from fgtrack.evaluation.comparison import compare
from fgtrack.evaluation.plot import named_figures, save_named
from fgtrack.evaluation.runs import judged
from fgtrack.io.output import Kind, check_output, claimed, new_files
from fgtrack.io.ros.bag_writer import RECORDING, write_bag
from fgtrack.io.run import RUN, load_run
from fgtrack.io.source import open_input
from fgtrack.models.oval import OVAL
from fgtrack.pipeline.replay import replay_each
from fgtrack.pipeline.shipped import read_config, read_scenario
from fgtrack.sim.simulate import simulate

_SEED = 1
_ESTIMATORS = ("smoother", "ekf-replay", "ekf-backward-forward")
#: By what is added to the name of an estimator: the paper's noise, and noise that fits the simulation. With the lags
#: of the lagged output; those of the last one are drawn.
_SETTINGS = {
    "": ("smoother", "smoother.lagged_s=[0.3, 0.5]"),
    "-tuned": ("tuned", "smoother.lagged_s=[0.1, 0.2, 0.3, 0.4, 0.5, 0.7, 0.9]"),
}


def demo(
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for recording, runs, figures and report.")] = Path(
        "fgtrack-demo"
    ),
    overwrite: Overwrite = False,
) -> None:
    """Simulate, record, replay with two noises, compare, draw, report."""
    with claimed(out):
        bag, figures, page = out / "recording", out / "figures", out / "report.html"
        folders = {
            setting: {name: out / "runs" / f"{name}{ending}" for name in _ESTIMATORS}
            for ending, setting in _SETTINGS.items()
        }
        check_output(bag, RECORDING, overwrite)
        check_output(figures, Kind("a folder", Path.is_dir), overwrite)
        check_output(page, REPORT, overwrite)
        for named in folders.values():
            for folder in named.values():
                check_output(folder, RUN, overwrite)
        with progress("simulate"):
            write_bag(bag, simulate(read_scenario("default"), np.random.default_rng(_SEED)), overwrite=overwrite)
        runs = []
        for (name, lags), named in folders.items():
            config = read_config(name, [lags], track_map=OVAL, pit_map=OVAL)
            source = open_input(bag, config.input)
            with progress(f"replay, {name}") as show:
                results = replay_each(
                    source.messages,
                    config,
                    named,
                    origin=str(bag),
                    kind=source.kind,
                    on_tick=TickProgress(show),
                    overwrite=overwrite,
                )
            runs += [load_run(result.path) for result in results]
        every = judged(runs)
        for title, part in (
            ("With the paper's noise", every[: len(_ESTIMATORS)]),
            ("With fitted noise", every[-len(_ESTIMATORS) :]),
        ):
            say(f"{title}:")
            for sentence in compare(*part).verdict:
                say(f"  {sentence}")
        console().print(replace(written_tables(every), verdict=()))
        with progress("draw"), new_files(figures, overwrite) as folder:
            fitted = every[-len(_ESTIMATORS) :]
            drawn = list(chain(drawn_close_up(fitted)[0], named_figures(fitted)))
            files = save_named(drawn, folder, "png")
        with progress("report"):
            write_report(fitted, drawn, page, overwrite)
        say(f"recording: {bag}\nruns: {out / 'runs'}")
        for file in files:
            say(f"figure: {figures / file.name}")
        say(f"report: {page}")
