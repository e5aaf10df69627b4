"""The viewer of a report in a real browser: it draws, follows mouse, keyboard and links, and loads nothing."""

import json
import re
import shutil
import subprocess
from html import unescape
from pathlib import Path

import pytest
from support.runs import replayed

from fgtrack.cli.main import run as command

CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))),
    None,
)
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        CHROMIUM is None, reason="no Chromium is installed (apt-get install chromium)"
    ),
]

NAMES = ("ekf-replay", "smoother")
#: Goes before the scripts of the page: errors and warnings are kept.
LISTENER = """<script>
const complaints = [];
for (const name of ["error", "warn", "assert"]) console[name] = (...words) => complaints.push(String(words));
addEventListener("error", (event) => complaints.push(event.message));
addEventListener("securitypolicyviolation", (event) => complaints.push(event.blockedURI));
const drawn = () => (viewer.draw(), viewer.canvas.toDataURL());
const press = (key, target = viewer.canvas) =>
  target.dispatchEvent(new KeyboardEvent("keydown", {key, bubbles: true, cancelable: true}));
</script>"""
PROBE = """<script>addEventListener("load", async () => {
  let found;
  try { found = await (async () => { CODE })(); } catch (error) { found = `${error}`; }
  const requests = performance.getEntriesByType("resource").map((each) => each.name);
  document.body.outerHTML = "<body><pre id=probe></pre></body>";
  document.getElementById("probe").textContent = JSON.stringify({found, complaints, requests});
});</script>"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four seconds of the default scenario, replayed with a filter and a smoother, and their report."""
    folder = replayed(tmp_path_factory.mktemp("viewer"), 4.0, NAMES)
    assert (
        command(["report", str(folder / "runs"), "-o", str(folder / "report.html")])
        == 0
    )
    return folder


def probed(
    folder: Path, code: str, link: str = "", width: int = 1280, *switches: str
) -> object:
    """Value that `code` returns in the loaded page, which must complain of nothing and load nothing."""
    page = (folder / "report.html").read_text(encoding="utf-8")
    page = page.replace("<head>", f"<head>{LISTENER}", 1).replace(
        "</body>", PROBE.replace("CODE", code) + "</body>", 1
    )
    (folder / "probe.html").write_text(page, encoding="utf-8")
    words = [
        str(CHROMIUM),
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        f"--window-size={width},900",
        *switches,
    ]
    words += [
        f"--user-data-dir={folder}/profile",
        "--virtual-time-budget=20000",
        "--dump-dom",
    ]
    words.append((folder / "probe.html").as_uri() + link)
    done = subprocess.run(
        words, capture_output=True, text=True, timeout=300, check=True
    )
    shown = re.search(r'<pre id="probe">(.*?)</pre>', done.stdout, re.DOTALL)
    assert shown is not None, done.stderr
    answer = json.loads(unescape(shown[1]))
    assert (answer["complaints"], answer["requests"]) == ([], [])
    return answer["found"]


@pytest.mark.parametrize(
    ("width", "switches", "background"),
    [
        (1280, (), "rgb(255, 255, 255)"),
        (500, ("--blink-settings=preferredColorScheme=0",), "rgb(20, 23, 27)"),
    ],
    ids=["wide and light", "narrow and dark"],
)
def test_every_screen_shows_it_without_scrolling_sideways(
    folder: Path, width: int, switches: tuple[str, ...], background: str
) -> None:
    code = """
    const narrow = document.documentElement.scrollWidth <= innerWidth;
    const boxes = document.querySelectorAll("[name=run]");
    boxes.forEach((box) => { box.checked = false; });
    const empty = drawn().length;
    boxes[0].checked = true;
    viewer.seek(2);
    return [narrow, getComputedStyle(document.body).backgroundColor, drawn().length > 1.5 * empty];"""
    assert probed(folder, code, "", width, *switches) == [True, background, True]


def test_the_picture_moves_by_scrubber_and_keys(folder: Path) -> None:
    code = """
    const before = drawn(), t = viewer.controls.t, times = [];
    t.value = 0.75 * t.max;
    t.dispatchEvent(new Event("input", {bubbles: true}));
    const scrubbed = [viewer.time / viewer.scene.end, drawn() !== before];
    viewer.seek(2);
    for (const key of ["ArrowRight", "ArrowLeft", "End", "Home", "."]) { press(key); times.push(viewer.time); }
    return [scrubbed, times, viewer.scene.runs[0].step, viewer.scene.end, viewer.scene.lateTimes[0]];"""
    scrubbed, times, step, end, late = probed(folder, code)  # type: ignore[misc]
    assert scrubbed == [pytest.approx(0.75, abs=0.03), True]
    assert times == pytest.approx([2.0 + step, 2.0, end, 0.0, late])
    assert late > 0.0


def test_a_link_opens_the_same_picture(folder: Path) -> None:
    code = """
    viewer.choose("follow", "object 1"); viewer.resetView(); viewer.pan(40, -20); viewer.zoom(2);
    viewer.choose("layout", "over"); viewer.choose("detections", "stamped"); viewer.seek(1.2345);
    document.querySelector("[value=truth]").click(); viewer.resize();
    return [viewer.view, viewer.link()];"""
    view, link = probed(folder, code)  # type: ignore[misc]
    assert "t=1.2345&" in link
    opened = [
        probed(folder, "return [viewer.view, viewer.link(), drawn()];", link)
        for _ in range(2)
    ]
    assert opened[0] == opened[1]
    assert opened[0][:2] == [pytest.approx(view, abs=0.006), link]  # type: ignore[index]
    code = "location.hash = '#t=3'; await new Promise((ready) => setTimeout(ready, 500)); return viewer.time;"
    assert probed(folder, code, link) == 3
