"""`fgtrack replay`: a recording through the tracker into a run folder."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from fgtrack.cli.arguments import ConfigFile, Input, Overwrite, Settings
from fgtrack.cli.show import TickProgress, console, progress
from fgtrack.core.errors import CallError
from fgtrack.estimation.registry import ESTIMATORS
from fgtrack.io.source import open_input
from fgtrack.pipeline.replay import ReplayResult, located, replay_each, run_folders
from fgtrack.pipeline.shipped import read_config


def replay(
    recording: Input,
    out: Annotated[Path, typer.Option("-o", "--out", help="Run folder; for several estimators one below it each.")],
    config_file: ConfigFile = None,
    estimators: Annotated[
        str | None, typer.Option("-e", "--estimator", help="Estimator, or several with commas between them.")
    ] = None,
    track_map: Annotated[
        str | None, typer.Option("--map", help="Map of the track (CSV), or `oval` for the built-in one.")
    ] = None,
    pit_map: Annotated[str | None, typer.Option("--pit-map", help="Map of the pit lane (CSV), or `oval`.")] = None,
    settings: Settings = None,
    overwrite: Overwrite = False,
) -> int:
    """Replay a recording through the tracker."""
    config = read_config(config_file, settings or [], track_map=track_map, pit_map=pit_map)
    given = (config.estimator if estimators is None else estimators).split(",")
    names = tuple(ESTIMATORS.resolve(name.strip()) for name in given)
    for name in names:
        if names.count(name) > 1:
            raise CallError(f"estimator {name!r} is named twice")
    source = open_input(recording, config.input)
    with progress("replay") as show:
        results = replay_each(
            source.messages,
            config,
            run_folders(names, out),
            origin=str(recording),
            kind=source.kind,
            on_tick=TickProgress(show),
            overwrite=overwrite,
        )
    for result in results:
        console().print(_summary(result), highlight=False, soft_wrap=True)
    broken = next((result.broken for result in results if result.broken is not None), None)
    if broken is None:
        return 0
    print(f"fgtrack: error: {located(broken, str(recording))}; replayed up to there", file=sys.stderr)
    return 1


def _summary(result: ReplayResult) -> str:
    meta = result.meta
    return (
        f"{result.path}: {meta['estimator']}, {meta['detections_received']} detections, "
        f"{meta['wall_s']:.1f} s, digest {str(meta['digest'])[:12]}"
    )
