"""Figures for a page: width, font, style, axes of one's own; nothing collapses or is cut off."""

from pathlib import Path

import pytest
from support.pictures import faults
from test_figure_texts import a_run

from fgtrack.core.errors import CallError
from fgtrack.evaluation.runs import EvaluatedRun, evaluated
from fgtrack.show.figures import plot


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[EvaluatedRun]:
    folder = tmp_path_factory.mktemp("paper")
    return evaluated(
        [
            a_run(folder / name)
            for name in ("smoother", "ekf-replay", "ekf-backward-forward")
        ]
    )


@pytest.mark.parametrize("name", ["errors", "lag"])
def test_a_figure_in_a_column_is_readable(name: str, runs: list[EvaluatedRun]) -> None:
    figure = getattr(plot, name)(runs, width="3.4in")
    assert figure.get_figwidth() == pytest.approx(3.4)
    assert figure.get_suptitle() == ""  # a paper has captions
    assert faults(figure) == []
    for axes in figure.axes:
        assert axes.get_window_extent().width > 0.7 * figure.bbox.width


def test_fonts_of_vector_files_are_truetype(
    runs: list[EvaluatedRun], tmp_path: Path
) -> None:
    plot.errors(runs).savefig(tmp_path / "figure.pdf")
    content = (tmp_path / "figure.pdf").read_bytes()
    assert b"/Type3" not in content
    assert b"/Subtype /TrueType" in content or b"/CIDFontType2" in content


def test_a_style_is_a_file_or_a_name(runs: list[EvaluatedRun], tmp_path: Path) -> None:
    (tmp_path / "mine.mplstyle").write_text("axes.facecolor: black\n")
    assert plot.arrivals(runs[0], style=tmp_path / "mine.mplstyle").axes[
        0
    ].get_facecolor() == (0.0, 0.0, 0.0, 1.0)
    assert plot.arrivals(runs[0], style="dark_background").axes[0].get_facecolor() == (
        0.0,
        0.0,
        0.0,
        1.0,
    )


@pytest.mark.parametrize(
    ("paper", "message"),
    [
        ({"width": "3.4 feet"}, "write 3.4in"),
        ({"width": "nan"}, "write 3.4in"),
        ({"width": 0.1}, "must be between 1.5 and 40 inches"),
        ({"font": "No Such Font"}, "not installed"),
        ({"style": "nowhere.mplstyle"}, "cannot be used"),
    ],
)
def test_what_is_not_usable_is_one_clear_error(
    paper: dict[str, str], message: str, runs: list[EvaluatedRun]
) -> None:
    with pytest.raises(CallError, match=message):
        plot.arrivals(runs[0], **paper)
