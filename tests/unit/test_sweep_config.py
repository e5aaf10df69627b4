"""Sweep files: what the grid is, which jobs follow, and what is said about a wrong one."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fgtrack.core.errors import CallError
from fgtrack.estimation.registry import ESTIMATORS
from fgtrack.io.stream import write_stream
from fgtrack.pipeline.load import dump, plain
from fgtrack.pipeline.shipped import read_scenario
from fgtrack.pipeline.sweep_plan import Plan, load_plan, with_value
from fgtrack.sim.simulate import simulate

CONFIGS = Path(__file__).parents[2] / "configs"

HEAD = """
format: fgtrack-sweep/1
scenario: default
estimators: [ekf-replay]
config: karle2023
"""


@pytest.fixture
def plan(tmp_path: Path) -> Any:
    def make(text: str, head: str = HEAD) -> Plan:
        path = tmp_path / "sweep.yaml"
        path.write_text(head + text)
        return load_plan(path)

    return make


# --- the grid


def test_a_sweep_that_varies_nothing_is_one_job(plan: Any) -> None:
    (job,) = plan("").jobs
    assert (job.cells, job.seed, job.recipe.estimators) == ((), 0, ("ekf-replay",))
    assert job.recipe.scenario["duration_s"] == read_scenario("default").duration_s


def test_the_grid_is_the_product_with_the_last_axis_fastest_and_then_the_seed(plan: Any) -> None:
    made = plan("seeds: [7, 3]\nvary: {association.gate_m: [5.0, 3.0], clock.node_hz: [20.0, null]}")
    assert made.columns == ("association.gate_m", "clock.node_hz")
    points = [(5.0, 20.0), (5.0, None), (3.0, 20.0), (3.0, None)]
    assert [(job.cells, job.seed) for job in made.jobs] == [(point, seed) for point in points for seed in (7, 3)]
    for job in made.jobs:
        assert (job.recipe.config["association"]["gate_m"], job.recipe.config["clock"]["node_hz"]) == job.cells
        assert job.recipe.seed == job.seed


def test_a_group_of_keys_changes_together_and_may_have_a_label(plan: Any) -> None:
    made = plan("""
vary:
  delay:
    label: [short, long]
    scenario.sensors.radar.delay: [{kind: none}, {kind: constant, delay_s: 0.2}]
    sensors.radar.max_delay_s: [0.1, 0.3]
""")
    assert made.columns == ("delay", "scenario.sensors.radar.delay", "sensors.radar.max_delay_s")
    assert [job.cells[0] for job in made.jobs] == ["short", "long"]
    assert [job.recipe.config["sensors"]["radar"]["max_delay_s"] for job in made.jobs] == [0.1, 0.3]
    assert [job.recipe.scenario["sensors"][1]["delay"]["kind"] for job in made.jobs] == ["none", "constant"]


def test_scenario_lists_are_addressed_by_name_or_index(plan: Any) -> None:
    keys = ["scenario.sensors.radar.delay.mean_s", "scenario.sensors.1.rate_hz", "scenario.opponents.0.lateral_m"]
    made = plan(f"vary:\n  all:\n    {keys[0]}: [0.07]\n    {keys[1]}: [10.0]\n    {keys[2]}: [1.5]")
    scenario = made.jobs[0].recipe.scenario
    base = plain(read_scenario("default"))
    lidar, radar = scenario["sensors"]
    assert (radar["delay"]["mean_s"], radar["rate_hz"], scenario["opponents"][0]["lateral_m"]) == (0.07, 10.0, 1.5)
    assert lidar == base["sensors"][0]
    assert scenario["opponents"][1:] == base["opponents"][1:]


def test_what_is_set_holds_for_every_point_and_has_no_column(plan: Any) -> None:
    made = plan("set: {map.track: oval}\nvary: {scenario.sensors.radar.rate_hz: [10.0, 20.0]}\nduration_s: 3.0")
    assert made.columns == ("scenario.sensors.radar.rate_hz",)
    assert all(job.recipe.config["map"]["track"] == "oval" for job in made.jobs)
    assert all(job.recipe.scenario["duration_s"] == 3.0 for job in made.jobs)


def test_a_changed_value_leaves_the_original_alone() -> None:
    items = {"sensors": [{"name": "a", "rate": 1}, {"name": "b", "rate": 2}]}
    changed = with_value(items, ["sensors", "b", "rate"], 3)
    assert changed == {"sensors": [{"name": "a", "rate": 1}, {"name": "b", "rate": 3}]}
    assert items["sensors"][1]["rate"] == 2


# --- one setting at a time


def test_one_at_a_time_is_the_base_and_every_value_alone(plan: Any) -> None:
    made = plan("""
seeds: [4, 2]
one_at_a_time:
  association.gate_m: [1.0, 2.0]
  modality: {label: [LiDAR], ignore_sensors: [[radar]]}
  both: {association.gate_m: [3.0], clock.node_hz: [null]}
""")
    assert made.columns == ("changed", "to")
    rows = [
        ("base", None, 5.0, 50.0, []),
        ("association.gate_m", 1.0, 1.0, 50.0, []),
        ("association.gate_m", 2.0, 2.0, 50.0, []),
        ("modality", "LiDAR", 5.0, 50.0, ["radar"]),
        ("both", [3.0, None], 3.0, None, []),
    ]
    assert [(*job.cells, job.seed) for job in made.jobs] == [(*row[:2], seed) for row in rows for seed in (4, 2)]
    for job, row in zip(made.jobs[::2], rows, strict=True):
        config = job.recipe.config
        found = (config["association"]["gate_m"], config["clock"]["node_hz"], config["ignore_sensors"])
        assert found == row[2:]


def test_every_point_of_a_grid_has_one_setting_at_a_time(plan: Any) -> None:
    made = plan("vary: {clock.node_hz: [20.0, 50.0]}\none_at_a_time: {association.gate_m: [1.0]}")
    assert made.columns == ("changed", "to", "clock.node_hz")
    assert [job.cells for job in made.jobs] == [
        ("base", None, 20.0),
        ("base", None, 50.0),
        ("association.gate_m", 1.0, 20.0),
        ("association.gate_m", 1.0, 50.0),
    ]


# --- errors name the key


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("seed: 3", "seed: unknown key, did you mean 'seeds', known here: format, estimators"),
        ("seeds: 0", "seeds: a positive number"),
        ("seeds: [1, 1]", "seeds: one is named twice"),
        ("seeds: [1, x]", 'seeds.1: Input should be a valid integer, not "x"'),
        ("seeds: [-1]", "seeds: a positive number"),
        ("seeds: 99999999999999999999", "seeds: no sweep has more than 100000"),
        ("seeds: [99999999999999999999]", "seeds.0: 99999999999999999999 has more than 64 bits"),
        ("seeds: 90000\nvary: {clock.node_hz: [5.0, 9.0]}", "vary, seeds: 2 points by 90000 seeds, more than 100000"),
        ("duration_s: long", "duration_s: Input should be a valid number"),
        ("vary: {association.gate_m: 5.0}", "vary.association.gate_m: a list of values is needed"),
        ("vary: {association.gate_m: []}", "vary.association.gate_m: a list of at least one value"),
        ("vary: {a: {clock.node_hz: 5.0}}", "vary.a.clock.node_hz: a list of at least one value"),
        ("vary: {a: {label: [1]}}", "vary.a: a list of values is needed, or a mapping"),
        (
            "vary: {a: {clock.node_hz: [5.0, 9.0], association.gate_m: [3.0]}}",
            "vary.a: its keys change together and need equally many values, clock.node_hz has 2, association.gate_m",
        ),
        ("vary: {a: {label: [1], map.track: [oval]}, map.track: [oval]}", "vary: 'map.track' is named twice"),
        ("vary: {seed: [1]}", "vary: 'seed' is named twice, or is a column"),
        ("vary: {estimator: [smoother]}", "vary: 'estimator' is named twice, or is"),
        ("set: {estimator: smoother}", "set: name estimators under `estimators`"),
        ("vary: {clock..node_hz: [5.0]}", "vary.clock..node_hz: 'clock..node_hz' is not a key"),
        ("vary: {delays.radar.delay: [null]}", "delays.radar.delay changes the delays, of which this sweep has none"),
        ("one_at_a_time: {association.gate_m: 5.0}", "one_at_a_time.association.gate_m: a list of values is needed"),
        ("one_at_a_time: {clock.node_hz: [5.0], seed: [1], estimator: [x]}", "one_at_a_time: name estimators under"),
        ("vary: {to: {label: [1], clock.node_hz: [5.0]}}\none_at_a_time: {clock.node_hz: [5.0]}", "'to' is named"),
        ("one_at_a_time: {clok.node_hz: [5.0], a.b: [1]}\nset: {clok.x: 1}", "configuration: clok: unknown key"),
        ("delays: d.yaml", "delays: a scenario has delays of its own"),
        ("input: x", "scenario, input: name one of them"),
        ("vary: {clok.node_hz: [5.0, 7.0]}", "clok.node_hz=5.0: configuration: clok: unknown key"),
        (
            "vary: {clock.node_hz: [-5.0]}",
            "clock.node_hz=-5.0: configuration: clock.node_hz: Input should be greater than or equal to 0.1",
        ),
        (
            "vary: {scenario.sensors.lidr.rate_hz: [5.0]}",
            "vary.scenario.sensors.lidr.rate_hz: there is no 'lidr' among 2 entries (lidar_cluster, radar)",
        ),
        ("vary: {scenario.sensors.7.rate_hz: [5.0]}", "there is no '7' among 2 entries"),
        ("duration_s: 7.0\nvary: {scenario.duration_s.x: [5.0]}", "there is no 'x' in 7.0"),
        ("set: {scenario.sensors.lidr.rate_hz: 5.0}", "set.scenario.sensors.lidr.rate_hz: there is no 'lidr'"),
    ],
)
def test_a_wrong_file_is_told_by_the_path_of_the_key(plan: Any, text: str, said: str) -> None:
    with pytest.raises(CallError) as caught:
        plan(text)
    assert said in str(caught.value)


@pytest.mark.parametrize(
    ("head", "said"),
    [
        (HEAD.replace("karle2023", "missing.yaml"), "missing.yaml: there is no such configuration file"),
        ("scenario: default\nestimators: [ekf-replay]", "format: Field required"),
        ("format: fgtrack-sweep/2\nscenario: default\nestimators: [ekf-replay]", "format: Input should be"),
        ("format: fgtrack-sweep/1\nscenario: default\nestimators: []", "estimators: name at least one"),
        (
            "format: fgtrack-sweep/1\nscenario: default\nestimators: [ukf]",
            "estimators: estimator 'ukf' is unknown: there are",
        ),
        ("format: fgtrack-sweep/1\nestimators: [ekf-replay]", "scenario, input: name one"),
        ("format: fgtrack-sweep/1\ninput: nothing.mcap\nestimators: [ekf-replay]", "nothing.mcap: there is no such"),
    ],
)
def test_what_every_sweep_needs_is_missed(plan: Any, head: str, said: str) -> None:
    with pytest.raises(CallError) as caught:
        plan("", head)
    assert said in str(caught.value)


def test_a_point_that_cannot_be_run_is_a_problem_of_its_own_cells(plan: Any) -> None:
    made = plan("seeds: 2\nvary: {clock.node_hz: [20.0, -5.0]}")
    assert [job.problem is None for job in made.jobs] == [True, True, False, False]
    assert (
        "clock.node_hz=-5.0: configuration: clock.node_hz: Input should be greater than or equal to 0.1"
        in made.jobs[2].problem
    )
    assert all((job.recipe is None) == (job.problem is not None) for job in made.jobs)


# --- recordings


@pytest.fixture
def recording(tmp_path: Path) -> str:
    write_stream(tmp_path / "drive.jsonl", simulate(read_scenario("default"), np.random.default_rng(0))[:200])
    return "format: fgtrack-sweep/1\ninput: drive.jsonl\nestimators: [ekf-replay]\n"


def test_a_recording_with_its_own_delays_has_one_seed(plan: Any, recording: str) -> None:
    (job,) = plan("", recording).jobs
    assert (job.recipe.scenario, job.recipe.delays) == (None, {})
    with pytest.raises(CallError, match="seeds: nothing is drawn where a recording keeps its delays"):
        plan("seeds: 2", recording)


def test_the_delays_of_a_recording_may_be_varied(plan: Any, recording: str) -> None:
    made = plan("seeds: 2\nvary: {delays.radar.delay: [null, {kind: constant, delay_s: 0.3}]}", recording)
    kinds = [job.recipe.delays["radar"]["delay"] for job in made.jobs]
    assert [kind and kind["delay_s"] for kind in kinds] == [None, None, 0.3, 0.3]
    made = plan("seeds: 2\nset: {delays.radar.loss_probability: 0.1}", recording)
    assert [job.seed for job in made.jobs] == [0, 1]


def test_a_recording_is_as_long_as_it_is(plan: Any, recording: str) -> None:
    with pytest.raises(CallError, match="duration_s: a recording is as long as it is"):
        plan("duration_s: 3.0", recording)


# --- keys


def keys(made: Plan) -> list[str]:
    return [job.key for job in made.jobs]


def test_the_key_of_a_job_is_that_of_its_content_however_it_is_written(plan: Any, tmp_path: Path) -> None:
    (tmp_path / "scenario.yaml").write_text(dump(read_scenario("default")))
    reference = keys(plan("seeds: 3\nset: {association.gate_m: 3.0}"))
    assert keys(plan("set: {association.gate_m: 3.0}\nseeds: [0, 1, 2]")) == reference
    assert keys(plan("seeds: 3\nvary: {association.gate_m: [3.0]}\nmetrics: [num_tracks]")) == reference
    assert keys(plan("seeds: 3\nset: {association.gate_m: 3.0}", HEAD.replace("default", "scenario.yaml"))) == reference
    assert keys(plan("seeds: [1]\nset: {association.gate_m: 3.0}")) == reference[1:2]


@pytest.mark.parametrize(
    "text",
    [
        "seeds: [1]",
        "estimators: [ekf-replay, smoother]",
        "set: {association.gate_m: 4.9}",
        "duration_s: 59.9",
        "set: {scenario.sensors.radar.delay.mean_s: 0.0621}",
    ],
)
def test_whatever_decides_the_result_changes_the_key(plan: Any, text: str) -> None:
    head = HEAD.replace("estimators: [ekf-replay]\n", "") if text.startswith("estimators") else HEAD
    assert keys(plan(text, head)) != keys(plan(""))


def test_a_changed_map_or_recording_changes_the_key(plan: Any, recording: str, tmp_path: Path) -> None:
    track = tmp_path / "track.csv"
    track.write_text("a")
    for head, file in ((HEAD, track), (recording, tmp_path / "drive.jsonl")):
        text = f"set: {{map.track: {track}}}" if file == track else ""
        before = keys(plan(text, head))
        assert keys(plan(text, head)) == before
        file.write_text(file.read_text() + "\n")
        assert keys(plan(text, head)) != before


def test_changed_areas_change_the_key(plan: Any, recording: str, tmp_path: Path) -> None:
    shore = tmp_path / "shore.csv"
    before = keys(plan(text := f"set: {{map.excluded: [{shore}]}}", recording))
    shore.write_text("a")
    assert keys(plan(text, recording)) != before


def test_the_key_knows_the_versions(plan: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    before = keys(plan(""))
    monkeypatch.setattr("fgtrack.pipeline.sweep_plan.versions", lambda: {"fgtrack": "another"})
    assert keys(plan("")) != before


# --- the committed ones


@pytest.mark.parametrize("path", sorted((CONFIGS / "sweeps").glob("*.yaml")), ids=lambda path: path.stem)
def test_every_committed_sweep_can_be_run(path: Path) -> None:
    assert all(job.problem is None for job in load_plan(path).jobs)


def test_the_delay_sweep_is_seven_delays_by_five_rates_by_twenty_seeds_by_six_estimators() -> None:
    made = load_plan(CONFIGS / "sweeps/delay.yaml")
    assert len(made.jobs) == len({job.key for job in made.jobs}) == 7 * 5 * 20
    assert len(made.estimators) == 6


# --- on another recording


def test_a_recording_takes_the_place_of_the_scenario(tmp_path: Path) -> None:
    (tmp_path / "sweep.yaml").write_text(
        f"{HEAD}\nseeds: 3\nduration_s: 2.0\nset: {{map.track: oval}}\nvary: {{clock.node_hz: [20.0, 50.0]}}"
    )
    scenario = read_scenario("single_opponent", duration_s=0.2)
    recording = tmp_path / "drive.jsonl"
    write_stream(recording, simulate(scenario, np.random.default_rng(0)))
    made = load_plan(tmp_path / "sweep.yaml", recording, ["map.track=null", "association.gate_m=3.5"])
    assert [(job.cells, job.seed) for job in made.jobs] == [((20.0,), 0), ((50.0,), 0)]
    for job in made.jobs:
        assert (job.recipe.scenario, job.recipe.recording) == (None, str(recording.resolve()))
        assert (job.recipe.config["map"]["track"], job.recipe.config["association"]["gate_m"]) == (None, 3.5)


def test_a_sweep_of_the_scenario_cannot_take_a_recording(tmp_path: Path) -> None:
    (tmp_path / "sweep.yaml").write_text(f"{HEAD}\nvary: {{scenario.sensors.radar.rate_hz: [20.0]}}")
    with pytest.raises(CallError, match="changes the scenario, of which this sweep has none"):
        load_plan(tmp_path / "sweep.yaml", tmp_path / "drive.jsonl")


def test_the_key_of_a_job_follows_the_code_of_plug_ins(plan: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    (before,) = plan("").jobs
    assert plan("").jobs == (before,)
    monkeypatch.setattr(ESTIMATORS, "sources", lambda: {"mine": "package 1.0 of other code"})
    assert plan("").jobs[0].key != before.key
