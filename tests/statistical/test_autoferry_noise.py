"""The shipped configuration for Autoferry, on the recordings that its numbers come from."""

import statistics

import pytest
from support.messages import shared

import fgtrack
from fgtrack.evaluation.metrics import evaluate

SCENARIOS = range(2, 7)


@pytest.mark.slow
def test_vessels_are_tracked_with_noise_that_fits() -> None:
    motas, false, ratios = [], [], dict[str, list[float]]()
    for number in SCENARIOS:
        metrics = evaluate(fgtrack.replay(shared(f"data/autoferry/scenario{number}"), "autoferry"))
        assert metrics.multi_object is not None
        assert metrics.truth is not None
        motas.append(metrics.multi_object.clear["mota"])
        false.append(metrics.truth.false_tracks / len(metrics.truth.objects))
        for sensor in ("lidar", "radar"):
            found = metrics.consistency.nis[sensor]
            ratios.setdefault(sensor, []).append(found.mean / found.dof)
    assert min(motas) > 0.0
    assert statistics.median(motas) > 0.4
    assert statistics.median(false) <= 1.0
    for values in ratios.values():
        assert 0.5 < statistics.fmean(values) < 2.0
