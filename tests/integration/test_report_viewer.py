"""The viewer of a report in a real browser: it draws, moves by mouse, keyboard and touch, and loads nothing."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from support.chromium import CHROMIUM, Browser, chromium

import fgtrack
from fgtrack.cli.main import run as command

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed (apt-get install chromium)"),
]

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


def test_the_scrubber_moves_by_mouse(page: Browser) -> None:
    before = drawn(page)
    box = page.box("[name=t]")
    page.click(box["left"] + 0.75 * box["width"], box["top"] + box["height"] / 2)
    assert page.value("viewer.time / viewer.scene.end") == pytest.approx(0.75, abs=0.03)
    assert drawn(page) != before


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
