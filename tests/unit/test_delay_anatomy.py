"""What delays are made of: the time of sending that MCAP recordings keep, by topic, and its figure."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from evaluation_runs import START_NS, TICK_NS, update, write_run
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from support.pictures import faults

from fgtrack.core.errors import DataError
from fgtrack.core.types import Detection, DetectionList, EgoState
from fgtrack.evaluation import plot
from fgtrack.evaluation.runs import judged
from fgtrack.evaluation.sendings import sendings
from fgtrack.io.recording import write_recording
from fgtrack.io.run import Run

MS = 1_000_000
STAMPS_NS = [START_NS + k * TICK_NS for k in range(50)]


def recording(folder: Path, sent_after_ns: int | None, compression: CompressionType = CompressionType.ZSTD) -> Path:
    """Lists of two sensors, received 50 ms after they were sensed; sent `sent_after_ns` after that."""
    messages = []
    for stamp_ns in STAMPS_NS:
        receipt_ns = stamp_ns + 50 * MS
        messages.append(EgoState(stamp_ns, receipt_ns, 0.0, 0.0, 0.0, 0.0))
        messages += [DetectionList(name, stamp_ns, receipt_ns, [Detection(1.0, 2.0)]) for name in ("lidar", "radar")]
    write_recording(folder / "plain", messages)
    (written,) = (folder / "plain").glob("*.mcap")
    if sent_after_ns is None:
        return written
    told = folder / f"told_{compression.name}.mcap"
    with written.open("rb") as source, told.open("wb") as target:
        writer = Writer(target, compression=compression, use_chunking=compression != CompressionType.NONE)
        writer.start("ros2", "test")
        channels: dict[int, int] = {}
        for schema, channel, message in make_reader(source).iter_messages():
            assert schema is not None
            if channel.id not in channels:
                own = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, "cdr", own, dict(channel.metadata))
            sent_ns = message.log_time - 50 * MS + sent_after_ns
            writer.add_message(channels[channel.id], message.log_time, message.data, sent_ns)
        writer.finish()
    return told


def run_of(folder: Path, origin: Path) -> Run:
    """A run whose ticks are 10 ms after the receipts."""
    updates = {k + 3: [update(tick=k, delay_ns=50 * MS)] for k in range(50)}
    meta = {"estimator": "smoother", "input": {"path": str(origin)}}
    return write_run(folder, [[]] * 53, updates=updates, meta=meta)


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4, CompressionType.NONE])
def test_every_topic_tells_when_its_messages_were_sensed_sent_received_and_used(
    tmp_path: Path, compression: CompressionType
) -> None:
    found = sendings(run_of(tmp_path / "run", recording(tmp_path, 30 * MS, compression)))
    assert len(found) == 3
    for topic in found:
        assert topic.role == "messages"
        assert topic.sensed_ns.tolist() == STAMPS_NS
        assert set((topic.sent_ns - topic.sensed_ns).tolist()) == {30 * MS}
        assert set((topic.received_ns - topic.sent_ns).tolist()) == {20 * MS}
        assert set((topic.used_ns - topic.received_ns).tolist()) == {10 * MS}


def test_a_recorder_that_was_not_told_does_not_know(tmp_path: Path) -> None:
    run = run_of(tmp_path / "run", recording(tmp_path, None))
    assert sendings(run) == []
    with pytest.raises(DataError, match="does not tell when messages were sent"):
        plot.anatomy(run)
    gone = replace(run, meta={**run.meta, "input": {"path": str(tmp_path / "gone.mcap")}})
    assert sendings(gone) == []


def test_a_recording_is_found_from_the_run_folder(tmp_path: Path) -> None:
    """Given relative to another working directory, or moved together with the run."""
    told = recording(tmp_path, 30 * MS)
    run = run_of(tmp_path / "run", told)
    beside = {"path": "gone.mcap", "path_from_run": f"../{told.name}"}
    assert len(sendings(replace(run, meta={**run.meta, "input": beside}))) == 3


def test_a_recording_that_breaks_off_tells_nothing_wrong(tmp_path: Path) -> None:
    told = recording(tmp_path, 30 * MS)
    told.write_bytes(told.read_bytes()[:-700])
    for topic in sendings(run_of(tmp_path / "run", told)):
        assert set((topic.sent_ns - topic.sensed_ns).tolist()) == {30 * MS}


def test_the_figure_shows_the_parts_and_how_they_add_up(tmp_path: Path) -> None:
    run = run_of(tmp_path / "run", recording(tmp_path, 30 * MS))
    figure = plot.anatomy(run)
    means, spread = figure.axes
    bars = means.patches
    assert [(round(bar.get_x(), 6), round(bar.get_width(), 6)) for bar in bars[:3]] == [(0, 30), (30, 20), (50, 10)]
    legend = means.get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == [
        "sensed to sent",
        "sent to received",
        "received to tick",
    ]
    assert (means.get_xlabel(), spread.get_xlabel()) == ("mean [ms]", "distribution [ms]")
    assert [label.get_text() for label in means.get_yticklabels()] == [topic.topic for topic in sendings(run)]
    assert faults(figure) == []
    assert [plan.name for plan in plot.planned(judged(run)) if "anatomy" in plan.name] == ["anatomy"]
    assert np.isfinite(spread.get_xlim()).all()
