"""Detections that a filter leaves out: each is counted by the setting that did it, and said."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
from support.tracking import START_NS, ms
from typer.testing import CliRunner

import fgtrack
from fgtrack.cli.main import app
from fgtrack.config.settings import Config
from fgtrack.core.types import Detection, DetectionList, Disposition
from fgtrack.evaluation.diagnostics import excluded_lines
from fgtrack.inputs.formats.scans import grouped
from fgtrack.inputs.stream import write_stream
from fgtrack.models.sensors import Filter, SensorModel
from fgtrack.pipeline.build import build_tracker
from fgtrack.pipeline.replay import replay_in_memory

SEEN = (
    Detection(x_m=10.0, y_m=0.0, speed_mps=5.0, score=0.9, class_name="car"),
    Detection(x_m=30.0, y_m=0.0, speed_mps=5.0, score=0.2, class_name="car"),
    Detection(x_m=50.0, y_m=0.0, speed_mps=5.0, score=0.9, class_name="bush"),
    Detection(x_m=70.0, y_m=0.0, speed_mps=80.0, score=0.9, class_name="car"),
    Detection(x_m=90.0, y_m=0.0, speed_mps=5.0, class_name="car"),
    Detection(x_m=math.nan, y_m=0.0, speed_mps=5.0, score=0.1, class_name="car"),
)
FILTERS = {
    "score": Filter(min=0.5),
    "class_name": Filter(none_of=("bush",)),
    "speed_mps": Filter(min=-70.0, max=70.0),
}
RADAR = SensorModel(std={"x_m": 0.3, "y_m": 0.3}, filters=FILTERS)


def radar_list(at_ms: float = 0.0) -> DetectionList:
    now_ns = START_NS + ms(at_ms)
    return DetectionList("radar", now_ns, now_ns, SEEN, "map")


@pytest.mark.parametrize("defects", [(), ("one_slot",)])
def test_score_class_and_speed_decide_what_is_used_and_the_rest_is_out_of_bounds(
    defects,
) -> None:
    one = build_tracker(replace(Config(), sensors={"radar": RADAR}, defects=defects))
    one.receive(radar_list())
    report = one.tick(START_NS)
    found = {
        each.index: (each.disposition.value, each.reason) for each in report.updates
    }
    out = Disposition.OUT_OF_BOUNDS.value
    assert found == {
        0: ("birth", None),
        1: (out, "filters.score"),
        2: (out, "filters.class_name"),
        3: (out, "filters.speed_mps"),
        4: (out, "filters.score"),  # says none
        5: ("invalid", None),
    }


def test_a_run_counts_what_was_left_out_by_sensor_and_setting_and_compare_shows_it(
    tmp_path: Path,
) -> None:
    config = tmp_path / "config.yaml"
    config.write_text(
        "sensors: {radar: {std: {x_m: 0.3, y_m: 0.3}, max_range_m: 1.0e+4,\n"
        "  filters: {score: {min: 0.5}, class_name: {none_of: [bush]}, speed_mps: {max: 70.0}}}}\n"
        "birth: {kind: measured, ego_speed_factor: 0.0}\n"
    )
    stream, out = tmp_path / "in.jsonl", tmp_path / "run"
    write_stream(stream, [radar_list(100.0 * k) for k in range(4)])
    said = CliRunner().invoke(
        app, ["replay", str(stream), "-c", str(config), "-o", str(out)]
    )
    line = (
        "radar: 16 of 24 detections out of bounds "
        "(8 by filters.score, 4 by filters.class_name, 4 by filters.speed_mps)"
    )
    assert line in said.output.replace("\n", " "), said.output
    meta = json.loads((out / "meta.json").read_text())
    counts = {"filters.class_name": 4, "filters.score": 8, "filters.speed_mps": 4}
    assert meta["out_of_bounds"] == {"radar": counts}
    assert meta["counts"]["radar"]["out_of_bounds"] == 16
    assert meta["left_out"] == {}
    assert line in str(fgtrack.compare(fgtrack.load_run(out)))
    tried = CliRunner().invoke(app, ["info", str(stream), "-c", str(config)])
    filtered = line.replace("16", "20").replace(
        "8 by", "12 by"
    )  # filters come first here, also of those invalid
    assert f"first 5 s of {filtered}" in tried.output.replace("\n", " ")


def test_what_a_reader_leaves_out_is_counted_and_stays_with_its_scan() -> None:
    one, other = (
        replace(radar_list(at), left_out=("filters.rcs",) * 2) for at in (0.0, 1.0)
    )
    (scan,) = grouped([one, other], {"radar": ms(5.0)})
    assert scan.left_out == ("filters.rcs",) * 4
    config = replace(Config(), sensors={"radar": replace(RADAR, filters={})})
    run = replay_in_memory([scan], config)
    assert run.meta["left_out"] == {"radar": {"filters.rcs": 4}}
    assert list(excluded_lines(run.meta)) == [
        "radar: 4 left out by the reader (4 by filters.rcs)"
    ]


def test_a_recording_that_is_converted_says_what_it_holds_no_more(
    tmp_path: Path,
) -> None:
    table, config, out = (
        tmp_path / "radar.csv",
        tmp_path / "config.yaml",
        tmp_path / "out.jsonl",
    )
    table.write_text("t,x,y,snr\n1,30,2,9\n1,40,2,3\n2,31,2,2\n")
    columns = "{stamp: t, x_m: x, y_m: y}"
    config.write_text(
        f"input: {{csv: {{detections: {{radar: {{columns: {columns}, filters: {{snr: {{min: 6}}}}}}}}}}}}"
    )
    said = CliRunner().invoke(app, ["convert", str(table), str(out), "-c", str(config)])
    assert "radar: 2 left out by the reader (2 by filters.snr)" in said.output.replace(
        "\n", " "
    ), said.output
