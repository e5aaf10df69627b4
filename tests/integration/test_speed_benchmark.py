import json
import re
import shlex
import sys
from datetime import date
from pathlib import Path

import pytest
from support.scripts import EXPERIMENTS

sys.path.insert(0, str(EXPERIMENTS))
import bench_report
import bench_speed
import bench_streaming
from bench_report import MAIN, REPLAY

import fgtrack

#: Prints what a run of the published implementation would, with the number of lists of its stream as its median.
PUBLISHED = """
import json, sys
lists = sum(json.loads(line)["type"] == "detections" for line in open(sys.argv[1]))
print("a line of something else")
print(json.dumps({"receive_and_handling": [lists, 0.0, 0.0]}))
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out: Path = tmp_path_factory.mktemp("speed")
    (out / "page.md").write_text(
        "# Speed\n<!-- begin speed -->\nold\n<!-- end speed -->\nMore.\n"
    )
    command = shlex.join([sys.executable, "-c", PUBLISHED])
    bench_speed.main(
        out,
        published=command,
        rounds=2,
        duration_s=1.6,
        objects="1",
        page=out / "page.md",
    )
    return out


def test_every_cell_is_measured_beside_the_published_implementation_on_its_stream(
    folder: Path,
) -> None:
    measured = json.loads((folder / "speed.json").read_text())
    assert [
        (row["cell"]["label"], row["cell"]["count"]) for row in measured["rows"]
    ] == [(name, 1) for name in MAIN]
    lists = sum(isinstance(m, fgtrack.DetectionList) for m in bench_speed.scene(1, 1.6))
    assert measured["published_ms"] == {"1": [lists, lists]}
    for row in measured["rows"]:
        assert 0.0 < row["p50_ms"] <= row["p99_ms"]
        assert min(row["ratios"]) <= lists / row["median_ms"] <= max(row["ratios"])
    assert set(measured["reading"]) == {"a stream", "a bag"}
    assert all(
        spent_s > 0.1 for each in measured["replay_s"].values() for spent_s in each
    )
    verdicts = [promise["verdict"] for promise in measured["promises"]]
    assert verdicts.count("not measured") == 2 * 10 + 2 + 3


def test_the_page_has_the_ratios_of_the_table_with_commit_and_date(
    folder: Path,
) -> None:
    page, text = (folder / "page.md").read_text(), (folder / "speed.md").read_text()
    assert re.fullmatch(
        r"# Speed\n<!-- begin speed -->\n\n[^<]+\n\n<!-- end speed -->\nMore.\n", page
    )
    [shown], [full, _] = (
        re.findall(r"^\| 1 \|.*$", each, re.MULTILINE) for each in (page, text)
    )
    assert shown == re.sub(r" \([^)]*\)", "", full)
    assert re.search(rf"commit \S+, {date.today().year}-", page)
    assert (folder / "page.png").stat().st_size > 5_000
    assert re.match(rf"commit \S+, {date.today().year}-", text)
    (folder / "other.md").write_text("# Speed\n")
    with pytest.raises(ValueError, match="has no marks"):
        bench_report.put_into(folder / "other.md", "speed", text)


def test_a_thousand_cars_have_a_thousand_tracks() -> None:
    cell = bench_speed.cell(REPLAY, 1000, duration_s=0.6)
    assert bench_speed.measure(cell, bench_speed.traffic(1000, 0.6)).tracks >= 1000


def test_the_streaming_table_has_both_streams_and_every_method(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench_streaming.main(
        tmp_path,
        duration_s=2.5,
        objects=3,
        rounds=2,
        methods="ekf-replay,ekf-backward-forward",
    )
    text = (tmp_path / "streaming.md").read_text()
    assert capsys.readouterr().out == text
    for title in ("the demo", "3 objects"):
        rows = text[text.index(f"| {title} |") :].splitlines()[2:4]
        assert [row.split("|")[1].strip() for row in rows] == [
            "ekf-replay",
            "ekf-backward-forward",
        ]
        asked_m, ready_m = (
            [float(row.split("|")[k].split()[0]) for row in rows] for k in (2, 3)
        )
        assert max(asked_m) < 2.0
        assert asked_m != ready_m
