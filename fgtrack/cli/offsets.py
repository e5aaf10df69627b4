"""`fgtrack offsets`: how wrong the clocks of a recording are."""

from dataclasses import asdict, replace

from fgtrack.calibration.clock_offsets import OffsetReport, SensorOffset, estimate_offsets
from fgtrack.calibration.clocks import clock_verdicts
from fgtrack.cli.arguments import ConfigFile, FormOption, Input, Json, PitMap, Reference, Settings, TrackMap
from fgtrack.cli.show import chosen_form, progress, say, sentences, show
from fgtrack.core.errors import DataError
from fgtrack.evaluation.tables import Column, Table, Value
from fgtrack.io.errors import UntilBreak
from fgtrack.io.source import open_input
from fgtrack.pipeline.assumptions.assumed import assumed
from fgtrack.pipeline.replay import located
from fgtrack.pipeline.shipped import read_config


def offsets(
    recording: Input,
    config_file: ConfigFile = None,
    reference: Reference = None,
    track_map: TrackMap = None,
    pit_map: PitMap = None,
    settings: Settings = None,
    as_json: Json = False,
    form: FormOption = None,
) -> None:
    """Estimate constant clock offsets of sensors.

    Says which ones are not identifiable.
    """
    form = chosen_form(as_json, form)
    config = read_config(config_file, settings or [], track_map=track_map, pit_map=pit_map)
    source = open_input(recording, config.input)
    with progress("offsets"):
        found = assumed(config, source)
        readable = UntilBreak(source.messages())
        report = estimate_offsets(list(readable), found.config, reference)
        report = report if readable.error is None else replace(report, broken=str(readable.error))
    for line in found.lines() if form is None else ():
        say(line)
    verdicts = clock_verdicts(report)
    show(_table(report), form, report.as_dict() | {"verdicts": [asdict(one) for one in verdicts]})
    if form is None:
        sentences(f"{one.sensor}: {one}" for one in verdicts)
    if report.broken is not None:
        raise DataError(f"{located(report.broken, str(recording))}; used up to there")


def _table(report: OffsetReport) -> Table:
    records = [
        {"sensor": one.sensor, "offset_s": one.offset_s, "std_s": one.std_s, "num_detections": one.num_detections}
        | {"known": _verdict(one, report.reference)}
        for one in report.sensors
    ]
    columns = [
        Column("sensor", left=True),
        Column("offset\n[ms]", "offset_s", scale=1e3, text=_one_decimal),
        Column("std\n[ms]", "std_s", scale=1e3, text=_one_decimal),
        Column("detections", "num_detections"),
        Column("known", left=True),
    ]
    notes = [f"{one.sensor}: {one.why}" for one in report.sensors]
    title = f"Offsets of {report.num_detections} detections of {report.num_tracks} tracks (reported stamp - true time)"
    return Table(title, records, columns, ("sensor",), notes)


def _verdict(one: SensorOffset, reference: str) -> str:
    return "reference" if one.sensor == reference else "yes" if one.is_known else "no"


def _one_decimal(value: Value) -> str:
    return f"{value:.1f}"
