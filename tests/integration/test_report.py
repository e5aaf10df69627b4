"""`fgtrack report`: one file that loads nothing and holds what the run folders hold."""

import json
import re
import subprocess
import sys
import zipfile
from dataclasses import dataclass
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.pictures import with_blank_pictures
from support.runs import replayed

import fgtrack
from fgtrack.cli.main import run as command
from fgtrack.evaluation.placement import detections_in_map
from fgtrack.evaluation.runs import evaluated
from fgtrack.runs import Columns
from fgtrack.show.palette import style_of
from fgtrack.show.playback import playback

ROOT = Path(__file__).resolve().parents[2]
NAMES = ("ekf-replay", "smoother")
ATOL, ATOL_S = 0.6e-3, 0.6e-4  # m and rad, s


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three seconds of the default scenario, replayed with a filter and a smoother."""
    lagged = {"smoother.lagged_s": [0.2, 0.4]}
    return replayed(tmp_path_factory.mktemp("report"), 3.0, NAMES, lagged)


@pytest.fixture(scope="module")
def page(folder: Path) -> str:
    assert (
        command(["report", str(folder / "runs"), "-o", str(folder / "report.html")])
        == 0
    )
    return (folder / "report.html").read_text(encoding="utf-8")


@dataclass
class Elements(HTMLParser):
    """The elements of a page with their attributes, and the text of those with an id."""

    def __post_init__(self) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))
        if tag not in ("meta", "link", "img", "br", "input"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def elements(page: str) -> list[tuple[str, dict[str, str | None]]]:
    parser = Elements()
    parser.feed(page)
    parser.close()
    assert parser.open == []
    return parser.found


def numbers(column: list[float | None]) -> Any:
    return np.array([np.nan if value is None else value for value in column])


def embedded(page: str) -> dict[str, Any]:
    found = re.search(
        r'<script type="application/json" id="scene">(.*?)</script>', page, re.DOTALL
    )
    assert found is not None
    return dict(json.loads(found[1]))


def test_it_has_every_part_and_every_run(page: str, folder: Path) -> None:
    ids = [attributes["id"] for _, attributes in elements(page) if "id" in attributes]
    assert len(ids) == len(set(ids))
    parts = (
        "verdict",
        "viewer",
        "figures",
        "tables",
        "more-figures",
        "configuration",
        "runs",
    )
    found = [
        one for one in ids if one and one.startswith("part-") and one != "part-warnings"
    ]
    assert found == [f"part-{part}" for part in parts]
    opened = page[: page.index('<details id="part-tables">')]
    assert opened.count("<figure ") == 3
    assert "<table" not in opened
    assert {
        "figure-close_up",
        "figure-map_smoother",
        "figure-error_against_lag",
    } <= set(ids)
    tables = fgtrack.compare(folder / "runs")
    for table in tables.tables.values():
        assert not table.records or f"<h3>{table.title}</h3>" in page
    for name in NAMES:
        assert fgtrack.load_run(folder / "runs" / name).meta["digest"] in page
        assert f"{name}: config.yaml" in page
    assert re.search(
        r'<td class="left">estimator</td><td class="left">ekf-replay</td><td class="left">smoother',
        page,
    )


def test_it_names_the_recording_and_its_figures_fit_a_dark_page(page: str) -> None:
    (subtitle,) = re.findall('<p class="soft">([^<]*)</p>\n</header>', page)
    assert re.match(r"\S+\.jsonl: ", subtitle)
    assert "prefers-color-scheme: dark) { .figure img { filter: invert" in page


def test_it_loads_nothing_and_is_small(page: str) -> None:
    for tag, attributes in elements(page):
        for name in ("src", "href", "action", "poster", "data", "srcset"):
            target = attributes.get(name)
            assert target is None or target.startswith(("#", "data:")), (tag, name)
        assert not (tag == "link" and attributes.get("rel") != "icon")
    assert "default-src 'none'" in page
    own = re.sub(r"base64,[^\"]*|<pre>.*?</pre>", "", page, flags=re.DOTALL)
    assert not re.search(
        r"https?:|@import|url\(|\bimport\(|fetch\(|XMLHttpRequest|WebSocket|EventSource",
        own,
    )
    assert len(page.encode()) < 3e6


def test_what_is_embedded_is_what_the_run_folders_hold(page: str, folder: Path) -> None:
    shown = embedded(page)
    assert [one["label"] for one in shown["runs"]] == list(NAMES)
    assert shown["colours"] == [style_of(name).colour for name in NAMES]
    assert not set(shown["colours"]) & set(shown["sensor_colours"])
    (recording,) = shown["recordings"]
    start_ns = int(recording["start_ns"])

    def check(
        table: dict[str, Any], rows: Any, time: str, *keys: str, column: str = "t"
    ) -> Any:
        order = np.lexsort([rows[name] for name in (*reversed(keys), time)])
        np.testing.assert_allclose(
            numbers(table[column]), (rows[time][order] - start_ns) / 1e9, atol=ATOL_S
        )
        for name in ("x", "y"):
            np.testing.assert_allclose(
                numbers(table[name]), rows[f"{name}_m"][order], atol=ATOL
            )
        if "yaw" in table:
            np.testing.assert_allclose(
                numbers(table["yaw"]), rows["yaw_rad"][order], atol=ATOL
            )
        return order

    for name, one in zip(NAMES, shown["runs"], strict=True):
        run = fgtrack.load_run(folder / "runs" / name)
        lagged, final = run.tables["lagged"], run.tables["smoothed"]
        order = check(one["tracks"], run.tables["tracks"], "now_ns", "track_id")
        assert (
            one["tracks"]["track"] == run.tables["tracks"]["track_id"][order].tolist()
        )
        assert (
            one["tracks"]["confirmed"]
            == (run.tables["tracks"]["status"][order] == "confirmed").tolist()
        )
        long, short, direction = (
            numbers(one["tracks"][key]) for key in ("long", "short", "direction")
        )
        variance = (long * np.cos(direction)) ** 2 + (short * np.sin(direction)) ** 2
        np.testing.assert_allclose(
            variance / -2.0 / np.log(0.05),
            run.tables["tracks"]["p_x_x"][order],
            rtol=0.02,
        )
        check(
            one["past"],
            lagged.where(lagged["lag_s"] > 0.0),
            "now_ns",
            "track_id",
            "stamp_ns",
        )
        check(one["final"], final.where(final["kind"] == "final"), "stamp_ns")
        places = zip(("x_m", "y_m"), detections_in_map(run).position_m.T, strict=True)
        check(
            one["detections"],
            {**run.tables["detections"], **dict(places)},
            "receipt_ns",
            column="receipt",
        )
        late = np.isin(
            run.tables["updates"]["disposition"], ("out_of_sequence", "beyond_window")
        ).sum()
        assert one["detections"]["fate"].count(2) == late > 0
        assert numbers(one["ticks"]) == pytest.approx(
            (run.tables["timing"]["now_ns"] - start_ns) / 1e9, abs=ATOL_S
        )
    assert len(shown["runs"][1]["past"]["t"]) > 100
    check(
        recording["truth"],
        run.tables["truth"].where(run.tables["truth"]["object_id"] >= 0),
        "stamp_ns",
        "object_id",
    )
    check(recording["ego"], run.tables["ego"], "stamp_ns")
    late_case = fgtrack.close_ups([folder / "runs" / name for name in NAMES])[0]
    assert shown["moment"]["t"] == pytest.approx((late_case.now_ns - start_ns) / 1e9)
    np.testing.assert_allclose(
        [shown["moment"]["x"], shown["moment"]["y"]],
        late_case.after.means[-1, :2],
        atol=1e-9,
    )


def test_a_sensor_whose_clock_is_years_off_has_no_stamps(folder: Path) -> None:
    run = fgtrack.load_run(folder / "runs" / NAMES[0])
    off = {"stamp_ns": run.tables["detections"]["stamp_ns"] - 10**18}
    detections, updates = (
        Columns({**run.tables["detections"], **off}),
        Columns({**run.tables["updates"], **off}),
    )
    found = playback(
        evaluated(run.with_tables(detections=detections, updates=updates))
    )[0]["runs"][0]["detections"]
    assert set(found["stamp"]) == {None}
    assert None not in found["receipt"]


@pytest.mark.slow
def test_long_runs_are_thinned_and_it_is_reported(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fgtrack.show.playback.MOST_ROWS", 20)
    shown, notes = playback(evaluated(folder / "runs" / NAMES[0]))
    run = fgtrack.load_run(folder / "runs" / NAMES[0])
    step = -(-run.tables["tracks"].num_rows // 20)
    assert step > 1
    ticks_s = (
        run.tables["timing"]["now_ns"][::step] - int(shown["recordings"][0]["start_ns"])
    ) / 1e9
    np.testing.assert_allclose(numbers(shown["runs"][0]["ticks"]), ticks_s, atol=ATOL_S)
    assert set(shown["runs"][0]["tracks"]["t"]) <= set(shown["runs"][0]["ticks"])
    assert any(
        note.startswith(f"{NAMES[0]}: the viewer shows one time in {step}")
        for note in notes
    )
    receipts_ns = run.tables["detections"]["receipt_ns"]
    step = -(-len(receipts_ns) // 20)
    assert step > 1
    kept_ns = np.unique(receipts_ns)[::step]
    found = shown["runs"][0]["detections"]
    assert len(found["receipt"]) == np.isin(receipts_ns, kept_ns).sum()
    assert len(set(found["receipt"])) == len(kept_ns)
    assert any(f"{NAMES[0]}, detections: " in note for note in notes)


def test_names_from_outside_are_text(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with_blank_pictures(monkeypatch)
    strange = tmp_path / "<script>alert(1)<!-- & {{style}}"
    strange.mkdir()
    for file in (folder / "runs" / NAMES[0]).iterdir():
        (strange / file.name).write_bytes(file.read_bytes())
    out = tmp_path / "report.html"
    assert command(["report", str(strange), "-o", str(out)]) == 0
    text = out.read_text(encoding="utf-8")
    assert "<script>alert" not in text
    assert sum(tag == "script" for tag, _ in elements(text)) == 2
    assert embedded(text)["runs"][0]["label"].startswith(strange.name)


@pytest.mark.slow
def test_the_wheel_holds_the_templates(tmp_path: Path) -> None:
    subprocess.run(
        [
            sys.executable,
            "-c",
            f"from hatchling.build import build_wheel; build_wheel({str(tmp_path)!r})",
        ],
        cwd=ROOT,
        check=True,
        capture_output=True,
    )
    (wheel,) = tmp_path.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    templates = [
        path
        for path in (ROOT / "fgtrack/show/page").iterdir()
        if path.suffix in (".js", ".css", ".html")
    ]
    assert len(templates) == 4
    assert {f"fgtrack/show/page/{path.name}" for path in templates} <= set(names)
