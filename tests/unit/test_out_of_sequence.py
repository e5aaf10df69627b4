"""Out of sequence against the stream, and against the own object."""

from dataclasses import replace

import pytest

from fgtrack.calibration.arrivals import arrivals_of, overtaken
from fgtrack.core.types import Detection, DetectionList
from fgtrack.evaluation.metrics import evaluate
from fgtrack.io.info import describe
from fgtrack.io.recording import write_recording
from fgtrack.pipeline.public import replay

MS = 1_000_000


def listed(receipt_ms, stamp_ms, identity):
    return DetectionList("adsb", stamp_ms * MS, receipt_ms * MS, (Detection(1.0, 2.0, id=identity),), "map")


GIVEN = [listed(10, 5, "A"), listed(20, 3, "B"), listed(30, 9, "A"), listed(40, 8, "B"), listed(50, 7, "A")]


def test_info_counts_both_meanings(tmp_path):
    write_recording(tmp_path / "a.jsonl", GIVEN)
    (topic,) = describe(tmp_path / "a.jsonl").topics
    assert topic.late["stream_share"] == pytest.approx(3 / 4)
    assert topic.late["object_share"] == pytest.approx(1 / 3)


def test_what_comes_at_once_is_not_late(tmp_path):
    write_recording(tmp_path / "a.jsonl", [listed(10, 5, "A"), listed(10, 3, "B"), listed(20, 4, "B")])
    (topic,) = describe(tmp_path / "a.jsonl").topics
    assert topic.late["stream_share"] == pytest.approx(1 / 2)


def test_the_lists_of_advise_count_both_meanings():
    arrivals = arrivals_of(GIVEN)
    assert overtaken(arrivals, ["adsb"])["adsb"] == pytest.approx(3 / 5)
    assert arrivals["adsb"].object_late == pytest.approx(1 / 3)
    assert arrivals_of([listed(10, 5, None), listed(20, 6, None)])["adsb"].object_late is None


def test_the_metrics_of_a_run_count_both_meanings():
    at_m = {"A": 10.0, "B": 900.0}
    lists = [
        replace(each, objects=(Detection(at_m[each.objects[0].id], 2.0, id=each.objects[0].id),)) for each in GIVEN
    ]
    sensor = evaluate(replay(lists, "adsb", set={"sensors.adsb.copies_s": None, "clock.node_hz": None})).sensors["adsb"]
    assert sensor.overtaken == 3
    assert sensor.dispositions["out_of_sequence"] == 1


def test_without_identities_only_the_stream_is_known(tmp_path):
    write_recording(tmp_path / "a.jsonl", [listed(10, 5, None), listed(20, 6, None)])
    (topic,) = describe(tmp_path / "a.jsonl").topics
    assert topic.late == {"stream_share": 0.0, "object_share": None}
