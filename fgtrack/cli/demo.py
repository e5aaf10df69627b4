"""`fgtrack demo`: the whole chain in a minute."""

from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from fgtrack.cli.arguments import Overwrite
from fgtrack.cli.compare import written_tables
from fgtrack.cli.figure import drawn_close_up
from fgtrack.cli.report import REPORT, write_report
from fgtrack.cli.show import TickProgress, command_line, progress, say, sentences, show, told
from fgtrack.evaluation.comparison import compare
from fgtrack.evaluation.figures.style import DRAWN
from fgtrack.evaluation.plot import named_figures, save_named
from fgtrack.evaluation.runs import judged
from fgtrack.io.output import Kind, check_output, claimed, new_files
from fgtrack.io.ros.bag_writer import RECORDING, write_bag
from fgtrack.io.run import RUN, load_run
from fgtrack.io.source import open_input
from fgtrack.io.span import end_ns
from fgtrack.models.oval import OVAL
from fgtrack.pipeline.replay import replay_each
from fgtrack.pipeline.shipped import read_config, read_scenario
from fgtrack.sim.delays import AnyDelay, ConstantDelay, GammaDelay
from fgtrack.sim.scenario import Scenario
from fgtrack.sim.simulate import simulate
from fgtrack.sim.vehicles import TrackVehicle

_ESTIMATORS = ("smoother", "ekf-replay", "ekf-backward-forward")
#: By what is added to the name of an estimator: the paper's noise, and noise that fits the simulation. With the lags
#: of the lagged output; those of the last one are drawn.
_SETTINGS = {
    "": ("smoother", "smoother.lagged_s=[0.3, 0.5]"),
    "-tuned": ("tuned", "smoother.lagged_s=[0.1, 0.2, 0.3, 0.4, 0.5, 0.7, 0.9]"),
}
#: Where further cars drive: ahead of the ego as far as its speed is theirs, and to the left of the middle of the road.
_GRID = tuple((along_m, lateral_m) for along_m in (25.0, -25.0, 50.0, -50.0) for lateral_m in (6.0, -6.0))
_LIDAR = "lidar_cluster"


def demo(
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for recording, runs, figures and report.")] = Path(
        "fgtrack-demo"
    ),
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the random generator.")] = 1,
    delay_s: Annotated[
        float | None,
        typer.Option("--delay", min=0.0, max=1.0, help="Mean delay of the LiDAR in s; the RADAR's in proportion."),
    ] = None,
    num_objects: Annotated[int, typer.Option("--objects", min=1, max=len(_GRID) + 2, help="Cars besides the ego.")] = 2,
    overwrite: Overwrite = False,
) -> None:
    """Simulate, record, replay with two noises, compare, draw, report."""
    scenario, settings = _changed(read_scenario("default"), delay_s, num_objects)
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
        with progress("simulate") as tell:
            write_bag(bag, told(simulate(scenario, np.random.default_rng(seed)), tell), overwrite=overwrite)
        runs = []
        for (name, lags), named in folders.items():
            config = read_config(name, [lags, *settings], track_map=OVAL, pit_map=OVAL)
            source = open_input(bag, config.input)
            with progress(f"replay, {name}") as tell:
                results = replay_each(
                    source.messages,
                    config,
                    named,
                    origin=str(bag),
                    kind=source.kind,
                    on_tick=TickProgress(tell, partial(end_ns, source), len(named)),
                    overwrite=overwrite,
                )
            runs += [load_run(result.path) for result in results]
        every = judged(runs)
        fitted = every[-len(_ESTIMATORS) :]
        for title, part in (("With the paper's noise", every[: len(_ESTIMATORS)]), ("With fitted noise", fitted)):
            say(f"{title}:")
            sentences(compare(*part).verdict)
        show(replace(written_tables(every), verdict=()), None)
        with progress("draw"), new_files(figures, DRAWN, overwrite) as folder:
            drawn = list(chain(drawn_close_up(fitted)[0], named_figures(fitted)))
            files = save_named(drawn, folder, "png")
        with progress("report"):
            write_report(fitted, drawn, page, overwrite)
        say(f"\nevery table and column: {command_line('fgtrack', 'compare', out / 'runs', '--all')}")
        say(f"recording: {bag}\nruns: {out / 'runs'}\nfigures: {figures}, {len(files)} pictures")
        say(f"report: {page}, open it in a browser")


def _changed(scenario: Scenario, delay_s: float | None, num_objects: int) -> tuple[Scenario, list[str]]:
    """The race with other delays and as many cars, and settings with which what comes so late is still fused."""
    ego, opponents = scenario.ego, scenario.opponents[:num_objects]
    if isinstance(ego, TrackVehicle):
        more = [
            TrackVehicle(arc_m=ego.arc_m + along_m, lateral_m=lateral_m, speed=ego.speed)
            for along_m, lateral_m in _GRID[: max(0, num_objects - len(opponents))]
        ]
        opponents = (*opponents, *more)
    changed, settings = replace(scenario, opponents=opponents), []
    mean_s = next((s.delay.mean_s for s in scenario.sensors if s.name == _LIDAR and isinstance(s.delay, GammaDelay)), 0)
    if delay_s is not None and mean_s:
        factor = delay_s / mean_s
        sensors = tuple(replace(sensor, delay=_scaled(sensor.delay, factor)) for sensor in scenario.sensors)
        changed = replace(changed, sensors=sensors)
        config = read_config("smoother")
        for sensor in sensors:
            limit_s = config.sensors[sensor.name].max_delay_s
            if limit_s is not None and factor > 1.0:
                settings.append(f"sensors.{sensor.name}.max_delay_s={limit_s * factor:.3f}")
        if factor > 1.0:
            settings.append(f"smoother.lag_s={config.smoother.lag_s * factor:.3f}")
            settings.append(f"smoother.ring_s={config.smoother.ring_s * factor:.3f}")
            settings.append(f"filter.storage_s={config.filter.storage_s * factor:.3f}")
    return changed, settings


def _scaled(delay: AnyDelay, factor: float) -> AnyDelay:
    if not isinstance(delay, GammaDelay):
        return delay
    if factor == 0.0:
        return ConstantDelay(0.0)
    return GammaDelay(delay.min_s * factor, delay.mean_s * factor, delay.q90_s * factor)
