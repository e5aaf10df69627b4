"""Out of sequence against the stream, and against the own object."""

from dataclasses import replace

import pytest
from typer.testing import CliRunner

from fgtrack.cli.main import app
from fgtrack.clocks.arrivals import arrivals_of, overtaken_shares, window_findings
from fgtrack.clocks.stamps import stamp_findings
from fgtrack.config.reading import read_config
from fgtrack.core.types import Detection, DetectionList
from fgtrack.evaluation.diagnostics import diagnostics
from fgtrack.evaluation.metrics import evaluate
from fgtrack.inputs.info import describe
from fgtrack.inputs.recording import write_recording
from fgtrack.pipeline.public import replay

MS = 1_000_000


def listed(receipt_ms, stamp_ms, identity):
    return DetectionList(
        "adsb",
        stamp_ms * MS,
        receipt_ms * MS,
        (Detection(1.0, 2.0, id=identity),),
        "map",
    )


GIVEN = [
    listed(10, 5, "A"),
    listed(20, 3, "B"),
    listed(30, 9, "A"),
    listed(40, 8, "B"),
    listed(50, 7, "A"),
]


def test_info_counts_both_meanings(tmp_path):
    write_recording(tmp_path / "a.jsonl", GIVEN)
    (topic,) = describe(tmp_path / "a.jsonl").topics
    assert topic.late["stream_share"] == pytest.approx(3 / 4)
    assert topic.late["object_share"] == pytest.approx(1 / 3)


def test_wrong_stamps_are_left_out_of_delays_and_advice(tmp_path):
    hours_ms = 3_600_000 * 10
    given = [
        listed(hours_ms + 100 * k, 0 if k % 50 == 7 else hours_ms + 100 * k - 40, "A")
        for k in range(500)
    ]
    write_recording(tmp_path / "a.jsonl", given)
    (topic,) = describe(tmp_path / "a.jsonl").topics
    assert topic.delay == pytest.approx(
        dict.fromkeys(("mean_s", "p50_s", "p90_s", "max_s"), 0.04)
    )
    assert topic.note.startswith(
        "10 stamps differ from their receipt by more than an hour"
    )
    (one,) = arrivals_of(given).values()
    assert one.quantile_s(0.999) == pytest.approx(0.04)
    (found,) = [each for each in stamp_findings(one) if "an hour" in each.text]
    assert found.text.startswith("2.0 %")
    config = read_config("adsb")
    assert not [
        each
        for each in window_findings([one], config)
        if "max_delay_s" in str(each.settings)
    ]


def test_copies_that_are_configured_are_no_defect():
    copies = [
        replace(listed(10 * k, 10 * k - 5 - n, "A"), receipt_ns=(10 * k + n) * MS)
        for k in range(1, 40)
        for n in range(3)
    ]
    lists = [
        replace(
            each, objects=(Detection(10.0 + each.receipt_ns // (10 * MS), 2.0, id="A"),)
        )
        for each in copies
    ]
    run = replay(lists, "adsb")
    assert run.meta["counts"]["adsb"]["duplicate"] > 60
    assert not [each for each in diagnostics(run) if "duplicate" in each.text]


def test_what_comes_at_once_is_not_late(tmp_path):
    write_recording(
        tmp_path / "a.jsonl",
        [listed(10, 5, "A"), listed(10, 3, "B"), listed(20, 4, "B")],
    )
    (topic,) = describe(tmp_path / "a.jsonl").topics
    assert topic.late["stream_share"] == pytest.approx(1 / 2)


def test_the_lists_of_advise_count_both_meanings():
    arrivals = arrivals_of(GIVEN)
    assert overtaken_shares(arrivals, ["adsb"])["adsb"] == pytest.approx(3 / 5)
    assert arrivals["adsb"].object_late == pytest.approx(1 / 3)
    assert (
        arrivals_of([listed(10, 5, None), listed(20, 6, None)])["adsb"].object_late
        is None
    )


def test_the_metrics_of_a_run_count_both_meanings():
    at_m = {"A": 10.0, "B": 900.0}
    lists = [
        replace(
            each,
            objects=(Detection(at_m[each.objects[0].id], 2.0, id=each.objects[0].id),),
        )
        for each in GIVEN
    ]
    sensor = evaluate(
        replay(
            lists, "adsb", set={"sensors.adsb.copies_s": None, "clock.node_hz": None}
        )
    ).sensors["adsb"]
    assert sensor.overtaken == 3
    assert sensor.dispositions["out_of_sequence"] == 1


def test_without_identities_only_the_stream_is_known(tmp_path):
    write_recording(tmp_path / "a.jsonl", [listed(10, 5, None), listed(20, 6, None)])
    (topic,) = describe(tmp_path / "a.jsonl").topics
    assert topic.late == {"stream_share": 0.0, "object_share": None}


@pytest.mark.parametrize(
    ("sensor", "shipped"),
    [("adsb", "adsb"), ("mlat", "airport"), ("ais", "ais"), ("radar", None)],
)
def test_info_names_the_shipped_configuration_of_reports(tmp_path, sensor, shipped):
    write_recording(
        tmp_path / "a.jsonl", [replace(each, sensor=sensor) for each in GIVEN]
    )
    shown = CliRunner().invoke(app, ["info", str(tmp_path / "a.jsonl")]).output
    assert f"`-c {shipped}`" in shown if shipped else "`-c" not in shown
    assert ("assumed, " in shown) == (shipped is None)
    replayed = (
        CliRunner()
        .invoke(app, ["replay", str(tmp_path / "a.jsonl"), "-o", str(tmp_path / "run")])
        .output
    )
    assert ("is the shipped configuration" in replayed) == (shipped is not None)


def test_reports_of_several_objects_have_no_period_by_which_some_were_lost():
    whole_seconds = [1000 * k for k in range(100) if k % 5]
    periodic = [
        replace(listed(at + 10, at, None), sensor="radar") for at in whole_seconds
    ]
    reports = [listed(at + 10, at, "AB"[at // 1000 % 2]) for at in whole_seconds]
    arrivals = arrivals_of([*periodic, *reports])
    assert arrivals["radar"].lost_share == pytest.approx(0.2, abs=0.02)
    assert arrivals["adsb"].lost_share is None
