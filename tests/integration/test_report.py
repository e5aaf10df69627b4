"""`fgtrack report`: one file that loads nothing and holds what the run folders hold."""

import json
import re
import subprocess
import sys
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fgtrack
from fgtrack.cli.main import run as command
from fgtrack.evaluation.palette import look
from fgtrack.evaluation.placement import placed
from fgtrack.evaluation.runs import judged
from fgtrack.io.run import Table
from fgtrack.viewers.playback import scene
from fgtrack.viewers.settings import differing, flattened

ROOT = Path(__file__).resolve().parents[2]
NAMES = ("ekf-replay", "smoother")
ATOL_M, ATOL_S, ATOL_RAD = 0.6e-3, 0.6e-4, 0.6e-4


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four seconds of the default scenario, replayed with a filter and a smoother."""
    folder = tmp_path_factory.mktemp("report")
    fgtrack.simulate("default", seed=3, duration_s=4.0, out=folder / "drive.jsonl")
    for name in NAMES:
        fgtrack.replay(
            folder / "drive.jsonl",
            "tuned",
            map="oval",
            pit_map="oval",
            estimator=name,
            set={"smoother.lagged_s": [0.2, 0.4]},
            out=folder / "runs" / name,
        )
    return folder


@pytest.fixture(scope="module")
def page(folder: Path) -> str:
    assert command(["report", str(folder / "runs"), "-o", str(folder / "report.html")]) == 0
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


def numbers(column: dict[str, Any]) -> Any:
    """A column as the page's own script reads it."""
    return np.array([np.nan if value is None else value * column["step"] for value in column["values"]])


def embedded(page: str) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="scene">(.*?)</script>', page, re.DOTALL)
    assert found is not None
    return dict(json.loads(found[1]))


def test_it_has_every_part_and_every_run(page: str, folder: Path) -> None:
    ids = [attributes["id"] for _, attributes in elements(page) if "id" in attributes]
    assert len(ids) == len(set(ids))
    parts = ("verdict", "viewer", "figures", "tables", "more-figures", "configuration", "runs")
    assert [one for one in ids if one and one.startswith("part-") and one != "part-warnings"] == [
        f"part-{part}" for part in parts
    ]
    opened = page[: page.index('<details id="part-tables">')]
    assert opened.count("<figure ") == 3
    assert "<table" not in opened
    assert {"figure-close_up", "figure-map_smoother", "figure-error_against_lag"} <= set(ids)
    tables = fgtrack.compare(folder / "runs")
    for table in tables.values():
        assert not table.num_rows or f"<h3>{table.title}</h3>" in page
    for name in NAMES:
        assert fgtrack.load_run(folder / "runs" / name).meta["digest"] in page
        assert f"{name}: config.yaml" in page


def test_it_loads_nothing(page: str) -> None:
    for tag, attributes in elements(page):
        for name in ("src", "href", "action", "poster", "data", "srcset"):
            target = attributes.get(name)
            assert target is None or target.startswith(("#", "data:")), (tag, name)
        assert not (tag == "link" and attributes.get("rel") != "icon")
    assert "default-src 'none'" in page
    own = re.sub(r"base64,[^\"]*|<pre>.*?</pre>", "", page, flags=re.DOTALL)
    assert not re.search(r"https?:|@import|url\(|\bimport\(|fetch\(|XMLHttpRequest|WebSocket|EventSource", own)


def test_what_is_embedded_is_what_the_run_folders_hold(page: str, folder: Path) -> None:
    shown = embedded(page)
    assert [one["label"] for one in shown["runs"]] == list(NAMES)
    (recording,) = shown["recordings"]
    start_ns, origin_m = int(recording["start_ns"]), np.array(recording["origin_m"])

    def check(table: dict[str, Any], rows: Any, time: str, order: Any, column: str = "t") -> None:
        def read(name: str) -> Any:
            return numbers(table[name])

        np.testing.assert_allclose(read(column), (rows[time][order] - start_ns) / 1e9, atol=ATOL_S)
        for k, name in enumerate(("x", "y")):
            np.testing.assert_allclose(read(name) + origin_m[k], rows[f"{name}_m"][order], atol=ATOL_M)
        if "yaw" in table:
            np.testing.assert_allclose(read("yaw"), rows["yaw_rad"][order], atol=ATOL_RAD)

    for one in shown["runs"]:
        run = fgtrack.load_run(folder / "runs" / one["label"])
        tracks = run.tables["tracks"]
        order = np.lexsort((tracks["track_id"], tracks["now_ns"]))
        check(one["tracks"], tracks, "now_ns", order)
        np.testing.assert_array_equal(numbers(one["tracks"]["track"]), tracks["track_id"][order])
        codes = numbers(one["tracks"]["status"]).astype(int)
        assert [one["statuses"][code] for code in codes] == tracks["status"][order].tolist()
        long_m, short_m, direction_rad = (numbers(one["tracks"][name]) for name in ("long", "short", "direction"))
        c, s = np.cos(direction_rad), np.sin(direction_rad)
        factor = -2.0 * np.log(0.05)  # chi-square with two degrees of freedom
        variances = (long_m**2 * c**2 + short_m**2 * s**2, long_m**2 * s**2 + short_m**2 * c**2)
        np.testing.assert_allclose(variances[0] / factor, tracks["p_x_x"][order], rtol=5e-3)
        np.testing.assert_allclose(variances[1] / factor, tracks["p_y_y"][order], rtol=5e-3)
        lagged = run.tables["lagged"].where(run.tables["lagged"]["lag_s"] > 0.0)
        check(one["past"], lagged, "now_ns", np.lexsort((lagged["stamp_ns"], lagged["track_id"], lagged["now_ns"])))
        final = run.tables["smoothed"].where(run.tables["smoothed"]["kind"] == "final")
        check(one["final"], final, "stamp_ns", np.lexsort((final["stamp_ns"], final["track_id"])))
        detections = run.tables["detections"]
        order = np.argsort(detections["receipt_ns"], kind="stable")
        rows = {**detections, **dict(zip(("x_m", "y_m"), placed(run).position_m.T, strict=True))}
        for time in ("stamp", "receipt"):
            check(one["detections"], rows, f"{time}_ns", order, time)
        fates = numbers(one["detections"]["disposition"]).astype(int)
        told = sorted(one["dispositions"][fate] for fate in fates)
        assert told == sorted(run.tables["updates"]["disposition"].tolist())
        assert numbers(one["ticks"]) == pytest.approx((run.tables["timing"]["now_ns"] - start_ns) / 1e9, abs=ATOL_S)
    assert len(numbers(shown["runs"][1]["past"]["t"])) > 100
    truth = run.tables["truth"].where(run.tables["truth"]["object_id"] >= 0)
    check(recording["truth"], truth, "stamp_ns", np.lexsort((truth["object_id"], truth["stamp_ns"])))
    check(recording["ego"], run.tables["ego"], "stamp_ns", np.argsort(run.tables["ego"]["stamp_ns"], kind="stable"))


def test_the_same_runs_give_the_same_bytes(page: str, folder: Path) -> None:
    assert command(["report", str(folder / "runs"), "-o", str(folder / "again.html")]) == 0
    assert (folder / "again.html").read_text(encoding="utf-8") == page


def test_it_is_small(page: str) -> None:
    assert len(page.encode()) < 3e6
    scripts = sum(len(part) for part in re.findall(r"<script>(.*?)</script>", page, re.DOTALL))
    assert scripts < 60_000


def test_runs_of_different_recordings_have_each_their_own_map_and_time(folder: Path) -> None:
    fgtrack.simulate("default", seed=4, duration_s=1.0, out=folder / "other.jsonl", overwrite=True)
    other = fgtrack.replay(folder / "other.jsonl", "tuned", map="oval", pit_map="oval", estimator="ekf-replay")
    shown = scene(judged([folder / "runs" / NAMES[0], other])).values
    assert [one["recording"] for one in shown["runs"]] == [0, 1]


def test_old_runs_without_detections_and_ego_are_shown_and_noted(folder: Path, tmp_path: Path) -> None:
    for name in ("config.yaml", "meta.json", "tracks.csv", "updates.csv", "timing.csv"):
        (tmp_path / name).write_bytes((folder / "runs" / NAMES[0] / name).read_bytes())
    found = scene(judged(tmp_path))
    assert any("no detections.csv" in note for note in found.notes)
    assert len(numbers(found.values["runs"][0]["tracks"]["t"])) > 100


def test_a_sensor_whose_clock_is_years_off_has_no_stamps(folder: Path) -> None:
    run = fgtrack.load_run(folder / "runs" / NAMES[0])
    off = {"stamp_ns": run.tables["detections"]["stamp_ns"] - 10**18}
    detections, updates = Table({**run.tables["detections"], **off}), Table({**run.tables["updates"], **off})
    shown = scene(judged(run.with_tables(detections=detections, updates=updates))).values
    found = shown["runs"][0]["detections"]
    assert np.isnan(numbers(found["stamp"])).all()
    assert np.isfinite(numbers(found["receipt"])).all()


def test_long_runs_are_thinned_and_it_is_said(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fgtrack.viewers.playback.MOST_ROWS", 200)
    found = scene(judged(folder / "runs" / NAMES[0]))
    run, (shown,) = fgtrack.load_run(folder / "runs" / NAMES[0]), found.values["runs"]
    step = -(-run.tables["tracks"].num_rows // 200)
    assert step > 1
    ticks_s = numbers(shown["ticks"])
    start_ns = int(found.values["recordings"][0]["start_ns"])
    np.testing.assert_allclose(ticks_s, (run.tables["timing"]["now_ns"][::step] - start_ns) / 1e9, atol=ATOL_S)
    assert set(numbers(shown["tracks"]["t"])) <= set(ticks_s)
    assert (
        f"{NAMES[0]}: the viewer shows one of {step} times of the ticks, "
        f"as there are {run.tables['tracks'].num_rows} rows" in (found.notes)
    )


def test_names_from_outside_are_text(folder: Path, tmp_path: Path) -> None:
    strange = tmp_path / "<script>alert(1)<!-- & x"
    strange.mkdir()
    for file in (folder / "runs" / NAMES[0]).iterdir():
        (strange / file.name).write_bytes(file.read_bytes())
    out = tmp_path / "report.html"
    assert command(["report", str(strange), "-o", str(out)]) == 0
    text = out.read_text(encoding="utf-8")
    assert "<script>alert" not in text
    assert sum(tag == "script" for tag, _ in elements(text)) == 2
    assert embedded(text)["runs"][0]["label"].startswith("<script>alert(1)<!-- & x")


@pytest.mark.parametrize(
    ("make", "arguments", "said"),
    [
        (None, ("runs", "-o", "{tmp}/report"), "a report is one HTML file"),
        (None, ("drive.jsonl", "-o", "{tmp}/report.html"), "no run folder"),
    ],
)
def test_a_bad_call_is_one_line(
    make: Callable[[Path], object] | None,
    arguments: tuple[str, ...],
    said: str,
    folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    if make is not None:
        make(tmp_path)
    first, *rest = arguments
    assert command(["report", str(folder / first), *(word.format(tmp=tmp_path) for word in rest), "--overwrite"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line


def test_a_report_is_replaced_only_when_told(page: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert command(["report", str(folder / "runs"), "-o", str(folder / "report.html")]) == 2
    assert "--overwrite" in capsys.readouterr().err


def test_the_viewer_opens_at_the_late_detection_of_the_close_up(page: str, folder: Path) -> None:
    moment, runs = embedded(page)["moment"], [folder / "runs" / name for name in NAMES]
    late = fgtrack.close_ups(runs)[0]
    (recording,) = embedded(page)["recordings"]
    assert moment["t"] == pytest.approx((late.now_ns - int(recording["start_ns"])) / 1e9)
    place_m = np.array([moment["x"], moment["y"]]) + recording["origin_m"]
    np.testing.assert_allclose(place_m, late.position_m, atol=1e-9)


def test_an_estimator_has_its_colour_of_the_figures_light_and_dark(page: str) -> None:
    assert embedded(page)["colours"] == [look(name).colour for name in NAMES]
    assert not {look(name).colour for name in NAMES} & set(embedded(page)["sensor_colours"])
    style = re.search(r"<style>(.*?)</style>", page, re.DOTALL)[1]
    assert "filter:" not in style
    assert "min-width: 720px" not in style
    assert re.search(r"\.figure img \{[^}]*width: 100%", style)


def test_settings_that_differ_are_found_by_their_path() -> None:
    one = flattened({"a": {"b": 1, "c": [1, 2]}, "d": None, "e": {}})
    other = flattened({"a": {"b": 2, "c": [1, 2]}, "d": None})
    assert one == {"a.b": "1", "a.c": "[1, 2]", "d": "null", "e": "{}"}
    assert differing([one, other]) == ["a.b", "e"]


def test_the_wheel_holds_the_templates(tmp_path: Path) -> None:
    subprocess.run(
        [sys.executable, "-c", f"from hatchling.build import build_wheel; build_wheel({str(tmp_path)!r})"],
        cwd=ROOT,
        check=True,
        capture_output=True,
    )
    (wheel,) = tmp_path.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    templates = [path for path in (ROOT / "fgtrack/viewers/page").iterdir() if path.suffix in (".js", ".css", ".html")]
    assert len(templates) == 4
    assert {f"fgtrack/viewers/page/{path.name}" for path in templates} <= set(names)
