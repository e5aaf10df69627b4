"""The viewer of a report in a real browser: it draws, moves by mouse, keyboard and touch, and loads nothing."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from support.chromium import CHROMIUM, Browser, chromium

import fgtrack
from fgtrack.cli.main import run as command

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed (apt-get install chromium)")

NAMES = ("ekf-replay", "smoother")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four seconds of the default scenario, replayed with a filter and a smoother, and their report."""
    folder = tmp_path_factory.mktemp("viewer")
    fgtrack.simulate("default", seed=3, duration_s=4.0, out=folder / "drive.jsonl")
    for name in NAMES:
        fgtrack.replay(
            folder / "drive.jsonl", "tuned", map="oval", pit_map="oval", estimator=name, out=folder / "runs" / name
        )
    assert command(["report", str(folder / "runs"), "-o", str(folder / "report.html")]) == 0
    return folder


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with chromium(tmp_path_factory.mktemp("profile")) as browser:
        yield browser


@pytest.fixture
def page(folder: Path, browser: Browser) -> Iterator[Browser]:
    """The report, newly opened on a wide light screen; it must not complain, and ask for nothing but itself."""
    browser.events.clear()
    browser.screen(1280, 900)
    address = (folder / "report.html").as_uri()
    browser.open("about:blank#")
    browser.open(address)
    yield browser
    assert browser.complaints() == []
    assert {each.split("#")[0] for each in browser.requests()} <= {address, "about:blank"}


def drawn(page: Browser) -> str:
    """The picture on the canvas."""
    return str(page.value("(viewer.draw(), viewer.canvas.toDataURL())"))


@pytest.mark.parametrize("phone", [False, True])
@pytest.mark.parametrize("dark", [False, True])
def test_every_screen_shows_it_without_scrolling_sideways(page: Browser, phone: bool, dark: bool) -> None:
    page.screen(*((390, 844) if phone else (1280, 900)), dark=dark, phone=phone)
    page.until("viewer.size.width < innerWidth")
    assert page.value("document.documentElement.scrollWidth <= innerWidth")
    background = page.value("getComputedStyle(document.body).backgroundColor")
    assert background == ("rgb(20, 23, 27)" if dark else "rgb(255, 255, 255)")
    page.until(f"viewer.theme.background === '{'#14171b' if dark else '#ffffff'}'")
    page.value("document.querySelectorAll('[name=run]').forEach((box) => { box.checked = false; })")
    empty = drawn(page)
    page.value("(document.querySelector('[name=run]').checked = true, viewer.seek(2))")
    assert len(drawn(page)) > 1.5 * len(empty)


@pytest.mark.parametrize("width", [1280, 390])
def test_figures_are_as_wide_as_the_page_and_five_screens_hold_what_is_open(page: Browser, width: int) -> None:
    page.screen(width, 800)
    page.until("viewer.size.width < innerWidth")
    widths = page.value("[...document.querySelectorAll('section img')].map((one) => one.getBoundingClientRect().width)")
    assert len(widths) == 3
    if width == 390:
        assert widths == [390 - 2 * 16] * 3
    else:
        assert page.value("document.documentElement.scrollHeight") < 5 * 800


def test_the_scrubber_moves_by_mouse(page: Browser) -> None:
    before = drawn(page)
    box = page.box("[name=t]")
    page.click(box["left"] + 0.75 * box["width"], box["top"] + box["height"] / 2)
    assert page.value("viewer.time / viewer.scene.end") == pytest.approx(0.75, abs=0.03)
    assert drawn(page) != before


def test_a_drag_moves_the_picture_and_the_wheel_zooms(page: Browser) -> None:
    view, before = page.value("viewer.view"), drawn(page)
    box = page.box("#viewer canvas")
    x, y = box["left"] + 100, box["top"] + 100
    page.drag((x, y), (x + 50, y + 20))
    moved = page.value("viewer.view")
    metres = view["width"] / page.value("viewer.panes()[0].width")
    assert moved == pytest.approx({"x": view["x"] - 50 * metres, "y": view["y"] + 20 * metres, "width": view["width"]})
    assert drawn(page) != before
    page("Input.dispatchMouseEvent", type="mouseWheel", x=x, y=y, deltaX=0, deltaY=200)
    page.until(f"viewer.view.width > 1.3 * {view['width']}")


def test_the_strip_shows_the_errors_and_goes_to_a_time(page: Browser, folder: Path) -> None:
    (index,) = (k for k, name in enumerate(NAMES) if name == "smoother")
    run = fgtrack.load_run(folder / "runs" / "smoother")
    found = np.array(
        page.value(f"[...viewer.scene.runs[{index}].errorsAt(0)].map((error) => error || null)"), dtype=float
    )
    assert np.isfinite(found).sum() > 100
    timing, truth, tracks = (run.tables[name] for name in ("timing", "truth", "tracks"))
    tick = int(np.flatnonzero(np.isfinite(found) & np.isin(timing["now_ns"], truth["stamp_ns"]))[-1])
    now_ns = timing["now_ns"][tick]
    truth = truth.where((truth["stamp_ns"] == now_ns) & (truth["object_id"] == 0))
    tracks = tracks.where(tracks["now_ns"] == now_ns)
    off_m = np.hypot(tracks["x_m"] - truth["x_m"], tracks["y_m"] - truth["y_m"]).min()
    assert found[tick] == pytest.approx(off_m, abs=3e-3)
    box = page.box(".strip")
    page.click(box["left"] + 0.6 * box["width"], box["top"] + 20)
    assert page.value("viewer.time / viewer.scene.end") == pytest.approx(0.6, abs=0.01)
    page.value("viewer.choose('follow', 'ego'), viewer.draw()")
    assert page.value("viewer.strip.clientHeight") == 0


def test_the_scrubber_moves_by_touch(page: Browser) -> None:
    page.screen(390, 844, phone=True)
    box = page.box("[name=t]")
    y, start = box["top"] + box["height"] / 2, page.value("viewer.time / viewer.scene.end")
    places = [(box["left"] + share * box["width"], y) for share in np.linspace(start, 0.9, 8).tolist()]
    page.touch(*places)
    page.until("viewer.time / viewer.scene.end > 0.8")


def test_two_fingers_zoom_about_what_is_followed(page: Browser) -> None:
    page.screen(390, 844, phone=True)
    box, view = page.box("#viewer canvas"), page.value("viewer.view")
    page.pinch(box["left"] + 150, box["top"] + 100, 40, 120)
    page.until(f"viewer.view.width < {view['width']} / 2")
    found = page.value("viewer.view")
    assert found["width"] == pytest.approx(view["width"] / 3, rel=0.05)
    assert found["x"] / found["width"] == pytest.approx(view["x"] / view["width"], abs=0.02)


def test_the_scrubber_and_the_picture_move_by_keys(page: Browser) -> None:
    box = page.box("#viewer canvas")
    page.click(box["left"] + box["width"] / 2, box["top"] + box["height"] / 2)
    page.value("viewer.seek(2)")
    step = page.value("viewer.scene.runs[0].step")
    page.key("ArrowRight", 39)
    assert page.value("viewer.time") == pytest.approx(2.0 + step)
    page.key("ArrowLeft", 37)
    assert page.value("viewer.time") == pytest.approx(2.0)
    page.key("End", 35)
    assert page.value("viewer.time === viewer.scene.end")
    page.key("Home", 36)
    assert page.value("viewer.time") == 0
    page.key(".", 190, ".")
    assert page.value("viewer.time") == page.value("viewer.scene.lateTimes[0]") > 0
    assert page.value("(viewer.controls.t.focus(), viewer.seek(2), document.activeElement.type)") == "range"
    page.key("ArrowRight", 39)
    assert page.value("viewer.time") == pytest.approx(2.0 + step)


def test_space_plays_and_pauses(page: Browser) -> None:
    page.value("viewer.canvas.focus(), viewer.seek(0), viewer.choose('speed', '1')")
    page.key(" ", 32, " ")
    page.until("viewer.time > 0.2")
    assert page.value("document.getElementById('play').textContent") == "Pause"
    page.key(" ", 32, " ")
    assert not page.value("viewer.isPlaying")
    page.value("viewer.choose('speed', '4'), viewer.play(true)")
    page.until("!viewer.isPlaying && viewer.time === viewer.scene.end")


def test_a_link_opens_the_same_picture(page: Browser, folder: Path) -> None:
    page.value(
        "viewer.choose('follow', 'object 1'), viewer.resetView(), viewer.pan(40, -20), viewer.zoom(2),"
        "viewer.choose('layout', 'over'), viewer.choose('detections', 'stamped'), viewer.seek(1.2345),"
        "document.querySelector('[value=truth]').click(), viewer.resize()"
    )
    view, link = page.value("viewer.view"), page.value("viewer.link()")
    assert "t=1.2345&" in link
    pictures = []
    for _ in range(2):
        page.open("about:blank#")
        page.open((folder / "report.html").as_uri() + link)
        assert page.value("viewer.link()") == link
        assert page.value("viewer.view") == pytest.approx(view, abs=0.006)
        pictures.append(drawn(page))
    assert pictures[0] == pictures[1]
    page.value("location.hash = '#t=3'")
    page.until("viewer.time === 3")
    assert drawn(page) != pictures[0]


def test_each_layer_and_each_way_to_show_detections_changes_the_picture(page: Browser) -> None:
    page.value("viewer.seek(2.5)")
    pictures = [drawn(page)]
    for layer in page.value("viewer.checked('show')"):
        for _ in range(2):
            page.value(f"document.querySelector('[value={layer}]').click()")
            pictures.append(drawn(page))
        assert pictures.pop() == pictures[0]
    for mode in ("received", "stamped", "none"):
        page.value(f"viewer.choose('detections', '{mode}')")
        pictures.append(drawn(page))
    page.value("viewer.choose('detections', 'both'), viewer.choose('layout', 'over'), viewer.resize()")
    pictures.append(drawn(page))
    assert len(set(pictures)) == len(pictures)


def test_nothing_is_followed_from_where_the_picture_is(page: Browser) -> None:
    page.value("viewer.draw()")
    centre = page.value("viewer.centre")
    change = "dispatchEvent(new Event('change', { bubbles: true }))"
    page.value(f"(viewer.choose('follow', 'nothing'), viewer.controls.follow.{change}, viewer.seek(3), viewer.draw())")
    assert page.value("viewer.centre") == pytest.approx(centre)
