from pathlib import Path

import numpy as np
import pytest
from support.scripts import load

script = load("association")


def scene(delay_s: float, seed: int = 3, duration_s: float = 2.0):
    return script.Scene(delay_s, 0.2, duration_s, np.random.default_rng(seed))


def test_the_script_writes_tables_and_figure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    script.main(tmp_path / "out", runs=2, duration_s=2.0, seed=1)
    judged = (tmp_path / "out/judged.csv").read_text()
    followed = (tmp_path / "out/followed.csv").read_text()
    assert capsys.readouterr().out == f"{judged}\n{followed}"
    assert len(judged.splitlines()) == 1 + (len(script.SETTINGS) + 1) * len(script.VARIANTS) * len(script.KINDS)
    assert len(followed.splitlines()) == 1 + len(script.TRACKED) * len(script.VARIANTS)
    assert (tmp_path / "out/association.png").read_bytes().startswith(b"\x89PNG")


def test_without_delay_all_states_are_the_same() -> None:
    found = script.judged(scene(0.0))
    for kind in script.KINDS:
        assert len({str(found.matches[variant, kind]) for variant in script.VARIANTS}) == 1
    np.testing.assert_allclose(list(found.offset_m2.values()), found.offset_m2["prior"], rtol=1e-2)


def test_every_late_detection_is_counted_once() -> None:
    drawn = scene(0.2)
    total = sum(len(scan.sources) for scan in drawn.scans if scan.judged)
    for counts in script.judged(drawn).matches.values():
        assert counts.right + counts.wrong + counts.refused == total
    counts = script.followed(drawn, "smoothed").matches
    assert counts.right + counts.wrong + counts.refused == total


def test_the_smoothed_state_is_nearer_than_the_prior_and_the_present_is_far_away() -> None:
    found = [script.judged(scene(0.4, seed)).offset_m2 for seed in range(4)]
    mean_m2 = {variant: np.mean([one[variant] for one in found]) for variant in script.VARIANTS}
    assert mean_m2["smoothed"] < mean_m2["prior"]
    assert mean_m2["moved back"] < mean_m2["prior"]
    assert mean_m2["present"] == pytest.approx((0.4 * script.SPEED_MPS) ** 2, rel=0.1)


def test_objects_far_apart_are_never_mixed_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(script, "SPACING_M", 50.0)
    found = script.followed(scene(0.2), "prior")
    assert found.switches == found.matches.wrong == 0
    assert found.matches.right > 0
