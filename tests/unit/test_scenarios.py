"""The committed scenarios and the built-in one."""

from pathlib import Path

from fgtrack.pipeline.load import load
from fgtrack.sim.paper import paper_scenario
from fgtrack.sim.scenario import Scenario

CONFIGS = Path(__file__).parents[2] / "configs"


def test_the_built_in_scenario_is_the_committed_default() -> None:
    assert load(Scenario, CONFIGS / "scenarios/default.yaml") == paper_scenario()
