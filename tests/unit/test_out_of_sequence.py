"""Out of sequence against the stream, and against the own object."""

import pytest

from fgtrack.core.types import Detection, DetectionList
from fgtrack.io.info import describe
from fgtrack.io.recording import write_recording

MS = 1_000_000


def listed(receipt_ms, stamp_ms, identity):
    return DetectionList("adsb", stamp_ms * MS, receipt_ms * MS, (Detection(1.0, 2.0, id=identity),), "map")


def test_info_counts_both_meanings(tmp_path):
    given = [listed(10, 5, "A"), listed(20, 3, "B"), listed(30, 9, "A"), listed(40, 8, "B"), listed(50, 7, "A")]
    write_recording(tmp_path / "a.jsonl", given)
    (topic,) = describe(tmp_path / "a.jsonl").topics
    assert topic.late["stream_share"] == pytest.approx(3 / 4)
    assert topic.late["object_share"] == pytest.approx(1 / 3)


def test_without_identities_only_the_stream_is_known(tmp_path):
    write_recording(tmp_path / "a.jsonl", [listed(10, 5, None), listed(20, 6, None)])
    (topic,) = describe(tmp_path / "a.jsonl").topics
    assert topic.late == {"stream_share": 0.0, "object_share": None}
