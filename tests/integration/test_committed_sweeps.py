"""The sweep files of the project: each loads, its labels say what is set, and its first job runs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fgtrack.cli.sweep import score
from fgtrack.pipeline.sweep import Sweep
from fgtrack.pipeline.sweep_plan import Job, Plan, load_plan

FOLDER = Path(__file__).parents[2] / "configs/sweeps"
FILES = sorted(FOLDER.glob("*.yaml"))
DURATION_S = 1.5


def shortened(job: Job) -> Job:
    """A job with a shorter scenario, under a key of its own."""
    assert job.recipe is not None
    scenario = dict(job.recipe.scenario or {})
    scenario["duration_s"] = min(scenario["duration_s"], DURATION_S)
    return replace(job, key=f"{job.key}-short", recipe=replace(job.recipe, scenario=scenario))


def by_label(plan: Plan, column: str, of: str) -> dict[str, object]:
    """What is set under `of`, by the label in `column`."""
    label, value = plan.columns.index(column), plan.columns.index(of)
    return {job.cells[label]: job.cells[value] for job in plan.jobs}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_the_first_job_runs_and_has_every_metric_that_is_asked_for(path: Path, tmp_path: Path) -> None:
    plan = load_plan(path)
    result = Sweep.open(replace(plan, jobs=(shortened(plan.jobs[0]),)), tmp_path / "out").run(score, jobs=1)
    assert result.first_error is None
    assert result.num_good == len(plan.estimators)
    assert result.unknown_metrics == ()


def test_labels_of_the_clocks_say_what_is_wrong_with_them() -> None:
    clocks = by_label(load_plan(FOLDER / "wrong_stamps.yaml"), "clock", "scenario.sensors.lidar_cluster.clock")
    entries = {
        "jitter": lambda ms: {"kind": "jitter", "std_s": ms / 1e3},
        "quantised": lambda ms: {"kind": "quantised", "step_s": ms / 1e3},
        "offset": lambda ms: {"kind": "offset", "offset_s": ms / 1e3},
        "drift": lambda ms: {"kind": "drift", "drift_ppm": 1e3 * ms / 20.0},
    }
    assert clocks.pop("right") == []
    assert clocks.pop("arrival") == [{"kind": "arrival"}]
    assert clocks.pop("arrival less 151") == [{"kind": "arrival"}, entries["offset"](-151.0)]
    for label, clock in clocks.items():
        kind, size = label.split()
        assert clock == [entries[kind](float(size))]


def test_labels_of_the_bursts_are_their_share_of_the_time_and_their_length() -> None:
    plan = load_plan(FOLDER / "bursts.yaml")
    rates = [
        by_label(plan, "burst", f"scenario.sensors.lidar_cluster.delay.{name}")
        for name in ("to_bad_per_s", "to_good_per_s")
    ]
    for label, to_bad, to_good in ((label, rates[0][label], rates[1][label]) for label in rates[0]):
        share, length_s = (float(part) for part in label.split(" x "))
        np.testing.assert_allclose([to_bad / (to_bad + to_good), 1.0 / to_good], [share, length_s], rtol=1e-3)


def test_delays_of_the_delay_sweep_are_those_of_the_labels_in_the_form_of_the_paper() -> None:
    delays = by_label(load_plan(FOLDER / "delay.yaml"), "lidar_delay_s", "scenario.sensors.lidar_cluster.delay")
    assert delays.pop(0.0) == {"kind": "none"}
    for mean_s, delay in delays.items():
        assert delay["mean_s"] == mean_s
        np.testing.assert_allclose([delay["min_s"] / mean_s, delay["q90_s"] / mean_s], [0.6, 1.266], rtol=0.01)
