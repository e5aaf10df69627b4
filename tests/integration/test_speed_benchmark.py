import json
import sys
from pathlib import Path

import pytest
from support.scripts import EXPERIMENTS

sys.path.insert(0, str(EXPERIMENTS))
import bench_report
import bench_speed
import bench_streaming

CHECKOUT = EXPERIMENTS.parent
SMALL = {"rounds": 1, "duration_s": 1.6}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out: Path = tmp_path_factory.mktemp("speed")
    (out / "page.md").write_text("# Speed\n<!-- begin speed -->\nold\n<!-- end speed -->\nMore.\n")
    options = {"figure": out / "again.png", "page": out / "page.md"}
    bench_speed.main(out, objects="1,2", against=CHECKOUT, **options, **SMALL)
    return out


def test_the_table_has_a_row_for_every_cell_and_every_promise(folder: Path) -> None:
    found = json.loads((folder / "speed.json").read_text())
    assert [(row["cell"]["label"], row["cell"]["count"]) for row in found["ticks"]] == [
        *((label, 1) for label in bench_report.MAIN),
        (bench_report.BANDED, 2),
    ]
    assert all(0.0 < row["median_ms"] <= row["p99_ms"] <= row["largest_ms"] * 1.001 for row in found["ticks"])
    text = (folder / "speed.md").read_text()
    assert all(bar["what"] in text for bar in found["bars"])
    assert [bar["verdict"] for bar in found["bars"]].count("not measured") == 8 + 1
    assert [one["count"] for one in found["against"]] == [1]
    assert found["machine"]["python"] in text


def test_the_tables_replace_those_of_the_page(folder: Path) -> None:
    page, text = (folder / "page.md").read_text(), (folder / "speed.md").read_text()
    assert page == f"# Speed\n<!-- begin speed -->\n\n{text}\n<!-- end speed -->\nMore.\n"
    (folder / "other.md").write_text("# Speed\n")
    with pytest.raises(ValueError, match="has no marks"):
        bench_report.put_into(folder / "other.md", "speed", text)


def test_the_streaming_table_has_both_streams_and_every_method(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "page.md"
    page.write_text("<!-- begin streaming -->\n<!-- end streaming -->\n")
    bench_streaming.main(
        tmp_path, duration_s=2.5, objects=3, rounds=2, methods="ekf-replay,ekf-backward-forward", page=page
    )
    text = (tmp_path / "streaming.md").read_text()
    assert capsys.readouterr().out == text
    assert text in page.read_text()
    for title in ("the demo", "3 objects"):
        rows = text[text.index(f"| {title} |") :].splitlines()[2:4]
        assert [row.split("|")[1].strip() for row in rows] == ["ekf-replay", "ekf-backward-forward"]
        asked_m, ready_m = ([float(row.split("|")[k].split()[0]) for row in rows] for k in (2, 3))
        assert max(asked_m) < 2.0
        assert asked_m != ready_m
