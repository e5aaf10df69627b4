"""`fgtrack study`: from a recording to a page, without a configuration."""

from pathlib import Path

import pytest
from support.pictures import with_blank_pictures

import fgtrack
from fgtrack.cli.main import run as command
from fgtrack.recording_study import ESTIMATORS, Study


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(
        fgtrack.simulate(
            "default",
            seed=3,
            duration_s=3.0,
            out=tmp_path_factory.mktemp("in") / "drive.jsonl",
        )
    )


@pytest.fixture(scope="module")
def found(recording: Path) -> Study:
    steps: list[tuple[str, float]] = []
    with pytest.MonkeyPatch.context() as patch:
        with_blank_pictures(patch)
        found = fgtrack.study(
            recording,
            recording.parent / "out",
            on_step=lambda *step: steps.append(step),
        )
    shares = [share for _, share in steps]
    assert shares == sorted(shares)
    assert shares[0] == 0.0
    assert shares[-1] == 1.0
    assert all(any(name in text for text, _ in steps) for name in ESTIMATORS)
    return found


def test_a_recording_becomes_a_page_without_a_configuration(found: Study) -> None:
    assert [run.meta["estimator"] for run in found.runs] == list(ESTIMATORS)
    page = found.report.read_text(encoding="utf-8")
    assert (
        page.index("lidar_cluster (")
        < page.index('id="viewer"')
        < page.index('id="part-tables"')
    )
    assert {path.name for path in (found.path / "figures").iterdir()} >= {
        "errors_object_0.png",
        "map_smoother.png",
    }
    assert (found.path / "runs/smoother/metrics.json").exists()


def test_policies_for_late_lists_are_compared(found: Study) -> None:
    rows = found.tables.tables["ledger"].records
    assert len(rows) == 6
    assert "if no list were late" in found.report.read_text(encoding="utf-8")


def test_the_summary_is_short_and_says_what_to_do(found: Study) -> None:
    assert 4 <= len(found.summary) <= 7
    assert found.summary[0].startswith("In 3 s detections came from lidar_cluster (")
    assert "tracks the objects" in found.summary[1]
    assert found.summary[-1].startswith(("Use ", "First: "))


def test_the_settings_name_what_was_assumed_and_give_the_same_runs(
    found: Study, recording: Path
) -> None:
    text = found.settings.read_text(encoding="utf-8")
    assert found.assumptions
    assert "# assumed: " in text
    for line in found.assumptions:
        assert line in str(found)
    again = fgtrack.replay(recording, found.settings, estimator="ekf-replay")
    assert again.meta["digest"] == found.runs[1].meta["digest"]


def test_a_study_is_replaced_only_when_told(
    found: Study, recording: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command(["study", str(recording), "-o", str(found.path)]) == 2
    assert "--overwrite" in capsys.readouterr().err


@pytest.mark.slow
def test_without_truth_it_says_so(recording: Path, tmp_path: Path) -> None:
    lines = [
        line
        for line in recording.read_text().splitlines(keepends=True)
        if '"truth"' not in line[:60]
    ]
    (tmp_path / "drive.jsonl").write_text("".join(lines))
    found = fgtrack.study(tmp_path / "drive.jsonl", tmp_path / "out", advice=False)
    assert "half of them for" in found.summary[1]
    assert any("Without truth" in line for line in found.summary)
