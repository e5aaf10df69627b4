"""Every figure by name, from one list: what it draws, what it says, and how it is saved."""

import io
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from evaluation_runs import ROUND, START_NS, TICK_NS, WEST, update, write_run
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fgtrack.core.errors import DataError
from fgtrack.core.types import Disposition
from fgtrack.evaluation.runs import evaluated
from fgtrack.models.track_map import COLUMNS
from fgtrack.runs import Columns, Run
from fgtrack.show.figures import plot
from fgtrack.show.figures.style import WRONG, broken_line, log_axis

TICKS = range(60)

#: By name: whether it takes several runs, the text of its axes, and the first lines of its legend.
EXPECTED: dict[str, tuple[bool, set[str], list[str]]] = {
    "map": (
        False,
        {"x, east [m]", "y, north [m]"},
        [
            "object 7, truth",
            "object 7, track",
            "object 8, truth",
            "object 8, track",
            "paired with no object",
            "close-up",
        ],
    ),
    "residuals": (
        False,
        {
            "time [s]",
            "along track [m]",
            "across track [m]",
            "speed [m/s]",
            "density [1/m]",
            "density [s/m]",
        },
        ["lidar: mean -0.200, std 0.141, n 60"],
    ),
    "consistency": (
        False,
        {"time [s]", "NEES of\nthe position", "NIS of\nlidar", "NIS of\nradar"},
        [
            "position: mean 0.073, expected 2; 77 % of the ticks in their band",
            "95 % band",
            "expected",
        ],
    ),
    "arrivals": (
        False,
        {"time [s]", "time of receipt [s]", "delay [ms]"},
        ["fused in sequence: 120 of 120"],
    ),
    "errors": (
        True,
        {*("position error [m]", "speed error [m/s]", "yaw error [deg]", "time [s]")},
        ["smoother: RMSE 0.27 m", "ekf-replay: RMSE 0.54 m"],
    ),
    "lag": (
        True,
        {"position RMSE [m]", "lag of the output [s]"},
        ["smoother", "ekf-replay (no lag)", "present, at the same stamps"],
    ),
}


def a_run(folder: Path, *, along_m: float = 0.3, config_text: str = "") -> Run:
    """WEST and a false track all the time, ROUND at times; the smoother has lagged states."""
    tracks = [
        [WEST.track(k, 1, along_m=along_m), WEST.track(k, 3, across_m=50.0)]
        + ([ROUND.track(k, 2)] if 5 <= k < 10 or k > 50 else [])
        for k in TICKS
    ]
    updates = {
        k: [
            update(
                "lidar",
                tick=k,
                delay_ns=150_000_000 + k,
                nis=2.0,
                x_m=0.1 * (k % 5),
                y_m=0.3,
            ),
            update(
                "radar", tick=k, delay_ns=60_000_000, nis=1.0, speed_mps=0.2 * (k % 3)
            ),
        ]
        for k in TICKS
    }
    truth = [*WEST.truth(TICKS), *ROUND.truth(TICKS)]
    smoothed = (
        {k: [WEST.later(k - 5, 1, 0.1)] for k in TICKS[5:]}
        if folder.name == "smoother"
        else {}
    )
    meta = {"estimator": folder.name}
    return write_run(
        folder,
        tracks,
        truth=truth,
        updates=updates,
        smoothed=smoothed,
        meta=meta,
        config_text=config_text,
    )


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[Run]:
    folder = tmp_path_factory.mktemp("runs")
    return [a_run(folder / "smoother"), a_run(folder / "ekf-replay", along_m=0.6)]


@pytest.fixture
def names(monkeypatch: pytest.MonkeyPatch) -> Callable[[Sequence[Run]], list[str]]:
    """Gives the names of the figures that runs have data for; none is drawn."""
    for name in EXPECTED:
        monkeypatch.setattr(plot, name, lambda *_: Figure())
    return lambda runs: [plan.name for plan in plot.planned(evaluated(runs))]


def legend(axes: Axes) -> list[str]:
    shown = axes.get_legend()
    assert shown is not None
    return [text.get_text() for text in shown.get_texts()]


def labels(figure: Figure) -> set[str]:
    return {
        text for axes in figure.axes for text in (axes.get_xlabel(), axes.get_ylabel())
    } - {""}


# --- every figure


@pytest.mark.parametrize("name", EXPECTED)
def test_a_figure_says_what_it_shows(name: str, runs: list[Run]) -> None:
    """Of runs in memory, read, or named by their folder."""
    several, text, lines = EXPECTED[name]
    first, second = runs
    figure = getattr(plot, name)(
        [replace(first, path=None), second.path] if several else str(first.path)
    )
    assert labels(figure) == text
    assert legend(figure.axes[0]) == lines
    assert figure.get_suptitle()
    assert name in plot.__all__


def test_there_is_a_figure_of_what_runs_have_data_for(
    names: Callable[[Sequence[Run]], list[str]], runs: list[Run], tmp_path: Path
) -> None:
    assert names(runs) == [
        *(
            "map_smoother",
            "map_ekf-replay",
            "residuals_smoother",
            "residuals_ekf-replay",
        ),
        *("consistency_smoother", "consistency_ekf-replay"),
        "arrivals",
        *("errors_object_7", "errors_object_8", "error_against_lag"),
    ]
    assert names(runs[1:]) == [
        name for name in names(runs) if "smoother" not in name and "lag" not in name
    ]
    plain = runs[0].with_tables(
        truth=runs[0]
        .tables["truth"]
        .where(np.zeros(len(runs[0].tables["truth"]["stamp_ns"]), dtype=bool))
    )
    assert names([plain]) == [
        *("map_smoother", "residuals_smoother", "consistency_smoother", "arrivals")
    ]
    other = write_run(tmp_path / "other", updates={0: [update(delay_ns=1_000_000)]})
    assert [name for name in names([*runs, other]) if "arrivals" in name] == [
        "arrivals_smoother",
        "arrivals_other (smoother)",
    ]
    assert names([write_run(tmp_path / "empty", [[]])]) == []
    lidar, radar = (
        update("lidar", tick=0, delay_ns=7),
        update("radar", tick=1, delay_ns=9),
    )
    gated = replace(radar, disposition=Disposition.GATED)
    order = {
        "as received": [lidar, radar],
        "the other way": [radar, lidar],
        "gated": [lidar, gated],
    }  # one figure
    alike = [
        write_run(tmp_path / name, updates={0: rows}) for name, rows in order.items()
    ]
    assert [name for name in names(alike) if name.startswith("arrivals")] == [
        "arrivals"
    ]


def test_arrivals_show_the_part_with_the_most_late_detections(tmp_path: Path) -> None:
    late = {
        k: [
            update(
                "lidar",
                tick=k,
                delay_ns=150_000_000,
                disposition=Disposition.OUT_OF_SEQUENCE,
            )
        ]
        for k in range(200, 220)
    }
    early = {
        k: [update("radar", tick=k, delay_ns=20_000_000)] for k in range(0, 400, 5)
    }
    updates = {k: [*early.get(k, []), *late.get(k, [])] for k in {*early, *late}}
    flow, *delays = plot.arrivals(
        write_run(tmp_path / "run", [[]] * 400, updates=updates)
    ).axes
    assert legend(flow) == [
        "fused in sequence: 80 of 100",
        "fused out of sequence: 20 of 100",
    ]
    low_s, high_s = flow.get_xlim()
    assert low_s == pytest.approx(200 * TICK_NS / 1e9, abs=0.2)
    assert high_s - low_s == pytest.approx(
        20 * 0.02
    )  # twenty lists of the fastest sensor
    lines = [segment for lines in flow.collections for segment in lines.get_segments()]
    lengths_s = {round(float(end[0] - start[0]), 3) for start, end in lines}
    assert lengths_s == {0.15, 0.02}
    assert [axes.get_title(loc="left") for axes in delays] == [
        "lidar",
        "radar",
    ]  # a row for each
    for axes, delay_ms in zip(delays, (150.0, 20.0), strict=True):
        assert {y for line in axes.lines for y in line.get_ydata()} == {delay_ms}


@pytest.mark.parametrize("name", [name for name in EXPECTED if name != "map"])
def test_without_data_there_is_one_clear_error(name: str, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="to draw"):
        getattr(plot, name)(write_run(tmp_path / "run", [[]]))


# --- one by one


def circle_map(path: Path) -> Path:
    angle = np.linspace(0.0, 2 * np.pi, 101)
    table = np.zeros((101, len(COLUMNS)))
    table[:, 0], table[:, 1] = 300 * np.cos(angle), 300 * np.sin(angle)
    table[:, 2:4] = 7.5
    table[:, COLUMNS.index("psi_ref_rad")] = angle  # a file counts it from +y
    table[-1, :2] = table[0, :2]
    np.savetxt(path, table, delimiter=";")
    return path


def test_the_map_shows_the_bounds_of_the_track(tmp_path: Path) -> None:
    run = a_run(
        tmp_path / "run",
        config_text=f"map:\n  track: {circle_map(tmp_path / 'map.csv')}\n",
    )
    axes, _ = plot.map(run).axes
    radii = [
        float(np.hypot(*np.asarray(line.get_data())).mean()) for line in axes.lines[:2]
    ]
    assert radii == pytest.approx([292.5, 307.5], abs=0.5)
    west, west_track, *_, wrong, _ = [line.get_color() for line in axes.lines[2:]]
    assert west == west_track != wrong == WRONG


def test_a_map_of_tracks_with_rare_updates_has_no_empty_close_up(
    tmp_path: Path,
) -> None:
    run = a_run(tmp_path / "run")
    updates = run.tables["updates"]
    assert len(plot.map(run).axes) == 2
    rare = updates.where(np.arange(updates.num_rows) < 2)
    assert len(plot.map(run.with_tables(updates=rare)).axes) == 1


def test_a_map_of_more_than_twenty_kilometres_has_axes_in_kilometres(
    tmp_path: Path,
) -> None:
    run = a_run(tmp_path / "run")
    ego = run.tables["tracks"].where(np.arange(2))
    far = {
        **{name: ego[name] for name in run.tables["ego"] if name in ego},
        "receipt_ns": ego["stamp_ns"],
        "x_m": np.array([0.0, 40e3]),
        "y_m": np.zeros(2),
    }
    axes = plot.map(run.with_tables(ego=Columns(far))).axes[0]
    assert axes.get_xlabel() == "x, east [km]"
    axes.figure.canvas.draw()
    shown = [text.get_text() for text in axes.get_xticklabels()]
    assert "40" in shown or "20" in shown


@pytest.mark.parametrize("ends", [(1.5, 30.0), (1e-9, 10.0), (1e-4, 1e4)])
def test_a_logarithmic_axis_of_any_length_has_ticks(ends: tuple[float, float]) -> None:
    axes = Figure().subplots()
    axes.set(yscale="log", ylim=ends)
    log_axis(axes.yaxis)
    ticks = [tick for tick in axes.get_yticks() if ends[0] <= tick <= ends[1]]
    assert len(ticks) >= 2


def test_the_axis_of_a_nis_reaches_above_its_expected_value(tmp_path: Path) -> None:
    """Repeated reports have innovations of nearly 0, which must not make the axis as long as they are small."""
    updates = {
        k: [update("lidar", tick=k, x_m=1e-9, y_m=0.0, nis=1e-12)] for k in TICKS
    }
    run = write_run(
        tmp_path / "run", [[WEST.track(k, 1)] for k in TICKS], updates=updates
    )
    low, high = plot.consistency(run).axes[0].get_ylim()
    assert high >= 4.0
    assert low >= 1e-3


def test_a_line_is_not_drawn_across_a_pause() -> None:
    stamps_ns = START_NS + TICK_NS * np.array([1, 0, 40, 41])
    x, y = broken_line(
        stamps_ns, np.array([1.0, 0.0, 2.0, 3.0]), np.arange(4.0), TICK_NS
    )
    np.testing.assert_array_equal(x, [0.0, 1.0, np.nan, 2.0, 3.0])
    np.testing.assert_array_equal(y, [1.0, 0.0, np.nan, 2.0, 3.0])


# --- files


@pytest.fixture
def short_run(tmp_path: Path) -> Run:
    return write_run(tmp_path / "a run", updates={0: [update(delay_ns=1_000_000)]})


@pytest.mark.parametrize(
    ("form", "start", "varying"),
    [
        ("png", b"\x89PNG", b"Software"),
        ("svg", b"<?xml", b"dc:date"),
        ("pdf", b"%PDF", b"CreationDate"),
    ],
)
def test_files_hold_no_date_and_no_version(
    form: str, start: bytes, varying: bytes, short_run: Run, tmp_path: Path
) -> None:
    (file,) = plot.save_named(
        plot.drawn(plot.planned(evaluated(short_run))), tmp_path, form
    )
    assert file.name == f"arrivals.{form}"
    content = file.read_bytes()
    assert content.startswith(start)
    assert varying not in content


def test_a_figure_has_its_style_whenever_it_is_drawn_and_saved(short_run: Run) -> None:
    def picture(figure: Figure) -> bytes:
        file = io.BytesIO()
        figure.savefig(file, dpi=30)
        return file.getvalue()

    expected, drawn_before = picture(plot.arrivals(short_run)), plot.arrivals(short_run)
    with mpl.rc_context(
        {"lines.linewidth": 9.0, "axes.facecolor": "red", "xtick.labelsize": 30}
    ):
        before = dict(mpl.rcParams)
        assert (
            picture(drawn_before) == expected
        )  # it keeps the settings with which it was made
        mine = plot.arrivals(short_run)
        assert mine.axes[0].get_facecolor() == (
            1.0,
            0.0,
            0.0,
            1.0,
        )  # those of the user win
        assert dict(mpl.rcParams) == before
    assert picture(mine) != expected
    assert picture(plot.arrivals(short_run)) == expected


def test_a_notebook_shows_the_figure(short_run: Run) -> None:
    figure = plot.arrivals(short_run)
    figure.set_dpi(30)
    assert str(figure._repr_html_()).startswith('<img src="data:image/png;base64,')
