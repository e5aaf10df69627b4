"""The sweep files of the project: each loads, its labels say what is set, and its first job runs."""

from dataclasses import replace
from pathlib import Path

import pytest

from fgtrack.pipeline.scored_sweep import score
from fgtrack.pipeline.sweep import Sweep
from fgtrack.pipeline.sweep_plan import Job, load_plan

pytestmark = pytest.mark.slow

FOLDER = Path(__file__).parents[2] / "configs/sweeps"
FILES = sorted(FOLDER.glob("*.yaml"))
DURATION_S = 1.5


def shortened(job: Job) -> Job:
    """A job with a shorter scenario, under a key of its own."""
    assert job.recipe is not None
    scenario = {
        **job.recipe["scenario"],
        "duration_s": min(job.recipe["scenario"]["duration_s"], DURATION_S),
    }
    return replace(
        job, key=f"{job.key}-short", recipe={**job.recipe, "scenario": scenario}
    )


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_the_first_job_runs_and_has_every_metric_that_is_asked_for(
    path: Path, tmp_path: Path
) -> None:
    plan = load_plan(path)
    result = Sweep.open(
        replace(plan, jobs=(shortened(plan.jobs[0]),)), tmp_path / "out"
    ).run(score, jobs=1)
    assert result.errors == ()
    assert result.num_good == len(plan.estimators)
    assert result.unknown_metrics == ()
