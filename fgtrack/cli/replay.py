"""`fgtrack replay`: runs a recording through the tracker into run folders."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated

from typer import Option

from fgtrack.cli.arguments import (
    ConfigFile,
    Dask,
    Inputs,
    Jobs,
    Overwrite,
    PitMap,
    Settings,
    TableFormatOption,
    TrackMap,
    TruthOption,
)
from fgtrack.cli.show import progress, say, warn
from fgtrack.config.reading import read_config
from fgtrack.config.shipped import suited_reports
from fgtrack.core.errors import DataError
from fgtrack.core.output import check_no_overlap
from fgtrack.estimation.registry import ESTIMATORS
from fgtrack.evaluation.diagnostics import (
    diagnostics,
    excluded_lines,
    noise_diagnostics,
    received_nothing,
    repeated,
    unused,
)
from fgtrack.inputs.folders import recordings_by_name
from fgtrack.meaning.draft import drafted
from fgtrack.pipeline import replay as pipeline
from fgtrack.runs import load_run


def replay(
    recordings: Inputs,
    out: Annotated[
        Path,
        Option(
            "-o",
            "--out",
            help="Run folder; several recordings or estimators: one subfolder for each.",
        ),
    ],
    config_file: ConfigFile = None,
    estimators: Annotated[
        str | None,
        Option("-e", "--estimator", help="Names of estimators, separated by commas."),
    ] = None,
    track_map: TrackMap = None,
    pit_map: PitMap = None,
    settings: Settings = None,
    table_format: TableFormatOption = "csv",
    truth: TruthOption = None,
    jobs: Jobs = None,
    dask: Dask = None,
    overwrite: Overwrite = False,
) -> None:
    """Replay a recording through the tracker.

    Each estimator processes the recording from its start, and its results are written
    to a run folder. Several recordings, or a folder, are replayed with the same
    settings, and a table shows the worst recordings first.
    """
    read = partial(read_config, settings=settings, track_map=track_map, pit_map=pit_map)
    config = read(config_file)
    given = (config.estimator if estimators is None else estimators).split(",")
    names = tuple(dict.fromkeys(ESTIMATORS.resolve(name.strip()) for name in given))
    several = recordings_by_name(recordings, config.input)
    if len(several) > 1:
        from fgtrack.cli.recording_folders import Folder
        from fgtrack.pipeline.recording_jobs import replay_job

        every = Folder(several, out, jobs, dask, overwrite)
        config_file = every.config_file(config_file)
        config = read(config_file)
        config = every.confirmed(config, config_file is not None)
        formats = {"table_format": table_format, "truth": truth}
        every.run(config, names, replay_job, formats, "")
        return
    [recording] = several.values()
    folders = (
        {name: out / name for name in names} if len(names) > 1 else {names[0]: out}
    )
    for folder in folders.values():
        check_no_overlap(folder, [recording, config_file])
    with progress("replay") as tell:
        draft = drafted(recording, config)
        pipeline.replay(
            draft.source.messages,
            draft.config,
            folders,
            origin=str(recording),
            kind=draft.source.kind,
            on_tick=lambda report: tell(
                f"tick {report.tick}, {len(report.tracks)} tracks"
            ),
            overwrite=overwrite,
            table_format=table_format,
            truth=truth,
        )
    for line in dict.fromkeys(
        str(replace(draft.config, estimator=name).effective) for name in names
    ):
        say(line)
    for name in names:
        if line := replace(draft.config, estimator=name).revision_line:
            say(line)
    if (
        config_file is None
        and (suited := suited_reports(draft.config.sensors)) is not None
    ):
        warn(suited)
    runs = [load_run(folder) for folder in folders.values()]
    for line in draft.lines():
        say(line)
    for run in runs:
        summary = "{estimator}, {detections_received} detections, {wall_s:.1f} s, digest {digest:.12}"
        say(f"{run.path}: {summary.format_map(run.meta)}")
    for line in excluded_lines(runs[0].meta):  # all runs exclude the same detections
        say(line)
    loop = repeated(runs[0])
    for line in dict.fromkeys(
        map(
            str,
            [
                *(item for run in runs for item in diagnostics(run) if item != loop),
                *noise_diagnostics(runs[0]),
            ],
        )
    ):
        warn(line)
    # All runs break off at the same message.
    if (broken := runs[0].meta["broken_off"]) is not None:
        problem = pipeline.with_origin(broken, str(recording))
        raise DataError(f"{problem}; the messages before are replayed")
    reason = received_nothing(runs[0])
    if reason is not None and draft.open_sensors:
        reason = draft.problem  # the sensors are left out
    reason = reason or unused(runs[0])
    if reason is None and loop is not None:
        reason = loop.text
    if (reason := reason or draft.problem) is not None:
        raise DataError(f"{recording}: {reason}")
