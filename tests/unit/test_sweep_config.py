"""Sweep files: the grid, its jobs and their keys, errors; parts and tables of the results."""

import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fgtrack.config.reading import read_scenario
from fgtrack.config.yaml_file import dump, plain
from fgtrack.core.errors import CallError
from fgtrack.inputs.stream import write_stream
from fgtrack.pipeline.sweep import Cell, Sweep, write_tables
from fgtrack.pipeline.sweep_plan import Job, Plan, load_plan
from fgtrack.sim.simulate import simulate

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


def test_the_grid_is_the_product_with_the_last_axis_fastest_and_then_the_seed(
    plan: Any,
) -> None:
    made = plan(
        "seeds: [7, 3]\nvary: {association.gate_m: [5.0, 3.0], clock.node_hz: [20.0, null]}"
    )
    assert made.columns == ("association.gate_m", "clock.node_hz")
    points = [(5.0, 20.0), (5.0, None), (3.0, 20.0), (3.0, None)]
    assert [(job.cells, job.seed) for job in made.jobs] == [
        (point, seed) for point in points for seed in (7, 3)
    ]
    for job in made.jobs:
        assert (
            job.recipe["config"]["association"]["gate_m"],
            job.recipe["config"]["clock"]["node_hz"],
        ) == job.cells
        assert job.recipe["seed"] == job.seed


def test_a_group_of_keys_changes_together_and_may_have_a_label(plan: Any) -> None:
    made = plan("""
vary:
  delay:
    label: [short, long]
    scenario.sensors.radar.delay: [{kind: none}, {kind: constant, delay_s: 0.2}]
    sensors.radar.max_delay_s: [0.1, 0.3]
""")
    assert made.columns == (
        "delay",
        "scenario.sensors.radar.delay",
        "sensors.radar.max_delay_s",
    )
    assert [job.cells[0] for job in made.jobs] == ["short", "long"]
    assert [
        job.recipe["config"]["sensors"]["radar"]["max_delay_s"] for job in made.jobs
    ] == [0.1, 0.3]
    assert [
        job.recipe["scenario"]["sensors"][1]["delay"]["kind"] for job in made.jobs
    ] == ["none", "constant"]


def test_scenario_lists_are_addressed_by_name_or_index(plan: Any) -> None:
    keys = [
        "scenario.sensors.radar.delay.mean_s",
        "scenario.sensors.1.rate_hz",
        "scenario.opponents.0.lateral_m",
    ]
    made = plan(
        f"vary:\n  all:\n    {keys[0]}: [0.07]\n    {keys[1]}: [10.0]\n    {keys[2]}: [1.5]"
    )
    scenario = made.jobs[0].recipe["scenario"]
    base = plain(read_scenario("default"))
    lidar, radar = scenario["sensors"]
    assert (
        radar["delay"]["mean_s"],
        radar["rate_hz"],
        scenario["opponents"][0]["lateral_m"],
    ) == (0.07, 10.0, 1.5)
    assert lidar == base["sensors"][0]
    assert scenario["opponents"][1:] == base["opponents"][1:]


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
    assert [(*job.cells, job.seed) for job in made.jobs] == [
        (*row[:2], seed) for row in rows for seed in (4, 2)
    ]
    for job, row in zip(made.jobs[::2], rows, strict=True):
        config = job.recipe["config"]
        found = (
            config["association"]["gate_m"],
            config["clock"]["node_hz"],
            config["ignore_sensors"],
        )
        assert found == row[2:]


# --- errors name the key


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("seed: 3", "seed: unknown key, did you mean 'seeds'"),
        (
            "seeds: 100001",
            "vary: 100001 combinations of values, seeds and recordings, at most 100000",
        ),
        ("seeds: [1, 1]", "seeds: give at least one, and each only once"),
        ("seeds: [-1]", "seeds.0: Input should be greater than or equal to 0"),
        (
            "vary: {association.gate_m: 5.0}",
            "vary.association.gate_m: must be a list of values",
        ),
        (
            "vary: {a: {clock.node_hz: [5.0, 9.0], association.gate_m: [3.0]}}",
            "mapping of keys to equally long lists",
        ),
        (
            "set: {estimator: smoother}",
            "set.estimator: cannot be changed in this sweep",
        ),
        (
            "vary: {delays.radar.delay: [null]}",
            "vary.delays.radar.delay: cannot be changed in this sweep",
        ),
        ("delays: d.yaml", "delays: applies to a recording only"),
        ("input: x", "scenario, input: give exactly one of these keys"),
        (
            "vary: {clok.node_hz: [5.0, 7.0]}",
            "clok.node_hz=5.0: config: clok: unknown key",
        ),
        (
            "vary: {scenario.sensors.lidr.rate_hz: [5.0]}",
            "lidr.rate_hz: there is no entry 'lidr' among 2",
        ),
    ],
)
def test_an_error_names_the_path_of_the_key(plan: Any, text: str, said: str) -> None:
    with pytest.raises(CallError) as caught:
        plan(text)
    assert said in str(caught.value)


@pytest.mark.parametrize(
    ("head", "said"),
    [
        (
            HEAD.replace("karle2023", "missing.yaml"),
            "missing.yaml: there is no such configuration file",
        ),
        ("scenario: default\nestimators: [ekf-replay]", "format: Field required"),
        (
            "format: fgtrack-sweep/1\nscenario: default\nestimators: []",
            "estimators: give at least one",
        ),
        (
            "format: fgtrack-sweep/1\ninput: nothing.mcap\nestimators: [ekf-replay]",
            "nothing.mcap: there is no such",
        ),
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
        "clock.node_hz=-5.0: config: clock.node_hz: Input should be greater than or equal to 0.1"
        in made.jobs[2].problem
    )
    assert all((job.recipe is None) == (job.problem is not None) for job in made.jobs)


# --- recordings


@pytest.fixture
def recording(tmp_path: Path) -> str:
    write_stream(
        tmp_path / "drive.jsonl",
        simulate(read_scenario("default"), np.random.default_rng(0))[:200],
    )
    return "format: fgtrack-sweep/1\ninput: drive.jsonl\nestimators: [ekf-replay]\n"


def test_a_recording_with_its_own_delays_has_one_seed(
    plan: Any, recording: str
) -> None:
    (job,) = plan("", recording).jobs
    assert (job.recipe["delays"], "scenario" in job.recipe) == ({}, False)
    with pytest.raises(
        CallError,
        match="seeds: a recording with its recorded delays needs a single seed",
    ):
        plan("seeds: 2", recording)


def test_the_delays_of_a_recording_may_be_varied(plan: Any, recording: str) -> None:
    made = plan(
        "seeds: 2\nvary: {delays.radar.delay: [null, {kind: constant, delay_s: 0.3}]}",
        recording,
    )
    kinds = [job.recipe["delays"]["radar"]["delay"] for job in made.jobs]
    assert [kind and kind["delay_s"] for kind in kinds] == [None, None, 0.3, 0.3]
    made = plan("seeds: 2\nset: {delays.radar.loss_probability: 0.1}", recording)
    assert [job.seed for job in made.jobs] == [0, 1]


def test_recordings_are_an_axis_of_the_grid(
    plan: Any, recording: str, tmp_path: Path
) -> None:
    messages = simulate(read_scenario("default"), np.random.default_rng(1))[:200]
    write_stream(tmp_path / "other.jsonl", messages)
    head = recording.replace("drive.jsonl", "[drive.jsonl, other.jsonl]")
    made = plan(
        "vary: {evaluation.gate_m: [3.0, 5.0]}",
        head,
    )
    assert made.columns == ("recording", "evaluation.gate_m")
    assert [job.cells for job in made.jobs] == [
        ("drive.jsonl", 3.0),
        ("drive.jsonl", 5.0),
        ("other.jsonl", 3.0),
        ("other.jsonl", 5.0),
    ]
    read = [Path(job.recipe["recording"]).name for job in made.jobs]
    assert read == ["drive.jsonl", "drive.jsonl", "other.jsonl", "other.jsonl"]
    assert len(set(keys(made))) == 4
    assert {"drive.jsonl", "other.jsonl"} <= {path.name for path in made.inputs}
    for wrong in ("[]", "[drive.jsonl, drive.jsonl]"):
        with pytest.raises(
            CallError, match="input: give at least one, and each only once"
        ):
            plan("", recording.replace("drive.jsonl", wrong))


# --- keys


def keys(made: Plan) -> list[str]:
    return [job.key for job in made.jobs]


def test_the_key_of_a_job_is_that_of_its_content_however_it_is_written(
    plan: Any, tmp_path: Path
) -> None:
    (tmp_path / "scenario.yaml").write_text(dump(read_scenario("default")))
    reference = keys(plan("seeds: 3\nset: {association.gate_m: 3.0}"))
    assert keys(plan("set: {association.gate_m: 3.0}\nseeds: [0, 1, 2]")) == reference
    assert (
        keys(plan("seeds: 3\nvary: {association.gate_m: [3.0]}\nmetrics: [num_tracks]"))
        == reference
    )
    assert (
        keys(
            plan(
                "seeds: 3\nset: {association.gate_m: 3.0}",
                HEAD.replace("default", "scenario.yaml"),
            )
        )
        == reference
    )
    assert keys(plan("seeds: [1]\nset: {association.gate_m: 3.0}")) == reference[1:2]


@pytest.mark.parametrize(
    "text",
    [
        "seeds: [1]",
        "set: {association.gate_m: 4.9}",
        "duration_s: 59.9",
        "set: {ego.yaw_weight: 0.5}",
    ],
)
def test_whatever_decides_the_result_changes_the_key(plan: Any, text: str) -> None:
    assert keys(plan(text)) != keys(plan(""))


def test_versions_and_the_code_of_plug_ins_change_the_key(
    plan: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A plug-in may change without a new version."""
    found = [keys(plan(""))]
    for target, value in (
        ("fgtrack.pipeline.sweep_plan.versions", {"fgtrack": "another"}),
        (
            "fgtrack.estimation.registry.ESTIMATORS.sources",
            {"mine": "package 1.0 of other code"},
        ),
        (
            "fgtrack.estimation.registry.MOTION_MODELS.sources",
            {"mine": "package 1.0 of other code"},
        ),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(target, lambda value=value: value)
            found.append(keys(plan("")))
    assert found.count(keys(plan(""))) == 1


def test_the_content_of_every_file_changes_the_key_whatever_its_size_and_time(
    plan: Any, recording: str, tmp_path: Path
) -> None:
    track, drive = tmp_path / "track.csv", tmp_path / "drive.jsonl"
    track.write_text("abc")
    for text, head, file in (
        (f"set: {{map.track: {track}}}", HEAD, track),
        ("", recording, drive),
    ):
        before, time_ns = keys(plan(text, head)), file.stat().st_mtime_ns
        assert keys(plan(text, head)) == before
        file.write_text(
            file.read_text().replace("c", "d", 1)
            if file != drive
            else file.read_text()[:-300] + "\n"
        )
        os.utime(file, ns=(time_ns, time_ns))
        assert keys(plan(text, head)) != before


TABLES_HEAD = """
format: fgtrack-sweep/1
input: drive
config: csv.yaml
estimators: [ekf-replay]
set: {map.track: none, sensors.radar.std: {x_m: 1.0, y_m: 1.0}}
"""


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """A folder of CSV files, with two files of detections, and its configuration."""
    folder = tmp_path / "drive"
    folder.mkdir()
    rows = [f"{0.05 * k:.2f},{20.0 + 0.5 * k},1.0" for k in range(40)]
    for name in ("radar.csv", "other.csv"):
        (folder / name).write_text("\n".join(["t,x,y", *rows, ""]))
    ego = [f"{0.05 * k:.2f},{0.5 * k},0.0,0.0,10.0" for k in range(40)]
    (folder / "ego.csv").write_text("\n".join(["t,x,y,yaw,v", *ego, ""]))
    columns = "{stamp: t, x_m: x, y_m: y}"
    (tmp_path / "csv.yaml").write_text(
        "input:\n  csv:\n"
        "    ego: {file: ego.csv, columns: {stamp: t, x_m: x, y_m: y, yaw_rad: yaw, speed_mps: v}}\n"
        f"    detections: {{radar: {{file: radar.csv, frame: map, columns: {columns}}}}}\n"
    )
    return folder


def moved(file: Path) -> None:
    """Change one digit of a CSV file; its size and time stay."""
    time_ns, text = file.stat().st_mtime_ns, file.read_text()
    file.write_text(text.replace("20.5", "26.5").replace("0.05,0.5", "0.05,0.6"))
    assert file.read_text() != text
    os.utime(file, ns=(time_ns, time_ns))


FILE = "input.csv.detections.radar.file"


@pytest.mark.parametrize(
    ("text", "changed", "stale"),
    [
        (f"vary: {{{FILE}: [radar.csv, other.csv]}}", "other.csv", [False, True]),
        (f"vary: {{{FILE}: [radar.csv, other.csv]}}", "radar.csv", [True, False]),
        (f"vary: {{{FILE}: [radar.csv, other.csv]}}", "ego.csv", [True, True]),
        (f"one_at_a_time: {{{FILE}: [other.csv]}}", "other.csv", [False, True]),
        (
            f"vary: {{{FILE}: [other.csv], clock.node_hz: [20.0, 50.0]}}",
            "other.csv",
            [True, True],
        ),
        (f"vary: {{{FILE}: [other.csv]}}", "radar.csv", [False]),
        ("vary: {clock.node_hz: [20.0, 50.0]}", "other.csv", [False, False]),
    ],
)
def test_the_files_that_a_point_reads_decide_its_key(
    plan: Any, drive: Path, text: str, changed: str, stale: list[bool]
) -> None:
    before = keys(plan(text, TABLES_HEAD))
    assert keys(plan(text, TABLES_HEAD)) == before
    moved(drive / changed)
    after = keys(plan(text, TABLES_HEAD))
    assert [a != b for a, b in zip(before, after, strict=True)] == stale


def test_a_file_that_is_set_for_all_points_decides_their_keys(
    plan: Any, drive: Path
) -> None:
    head = TABLES_HEAD.replace("set: {", f"set: {{{FILE}: other.csv, ")
    before = keys(plan("", head))
    moved(drive / "radar.csv")
    assert keys(plan("", head)) == before
    moved(drive / "other.csv")
    assert keys(plan("", head)) != before


def test_the_base_need_not_fit_where_every_point_does(plan: Any, drive: Path) -> None:
    (drive / "radar.csv").unlink()
    (job,) = plan(f"vary: {{{FILE}: [other.csv]}}", TABLES_HEAD).jobs
    assert job.problem is None


@pytest.mark.parametrize("damage", ["missing", "unreadable", "no number"])
def test_a_file_that_cannot_be_read_is_a_problem_of_the_points_that_read_it(
    plan: Any, drive: Path, damage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    text, other = f"vary: {{{FILE}: [radar.csv, other.csv]}}", drive / "other.csv"
    good = keys(plan(text, TABLES_HEAD))
    if damage == "missing":
        other.unlink()
    elif damage == "no number":
        other.write_text(other.read_text().replace("20.5", "far"))
    else:
        opened = Path.open

        def refuse(path: Path, *arguments: Any, **options: Any) -> Any:
            if path.name == "other.csv":
                raise PermissionError(13, "Permission denied")
            return opened(path, *arguments, **options)

        monkeypatch.setattr(Path, "open", refuse)
    made = plan(text, TABLES_HEAD)
    assert [job.problem is None for job in made.jobs] == [True, False]
    assert keys(made) == [good[0], ""]
    assert "other.csv" in made.jobs[1].problem
    assert made.jobs[1].problem.isprintable()


def test_a_recording_that_breaks_off_is_a_bad_cell_and_not_a_bad_call(
    plan: Any, recording: str, tmp_path: Path
) -> None:
    drive = tmp_path / "drive.jsonl"
    drive.write_text(drive.read_text()[:-30])
    (job,) = plan("", recording).jobs
    assert (job.recipe, job.is_data_bad) == (None, True)
    assert "breaks off in the middle of record" in str(job.problem)


def test_a_map_that_the_recording_carries_decides_the_key(
    plan: Any, tmp_path: Path
) -> None:
    track = tmp_path / "track.csv"
    track.write_text("abc")
    messages = simulate(read_scenario("default"), np.random.default_rng(0))[:50]
    write_stream(
        tmp_path / "drive.jsonl", messages, {"settings": {"map": {"track": str(track)}}}
    )
    head = "format: fgtrack-sweep/1\ninput: drive.jsonl\nestimators: [ekf-replay]\n"
    before = keys(plan("", head))
    track.write_text("abd")
    assert keys(plan("", head)) != before


def test_a_map_that_cannot_be_read_is_a_problem_in_a_line(
    plan: Any, tmp_path: Path, monkeypatch: Any
) -> None:
    track = tmp_path / "track.csv"
    track.write_text("abc")

    def refuse(path: Path) -> bytes:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "read_bytes", refuse)
    (job,) = plan(f"set: {{map.track: {track}}}").jobs
    assert job.problem == f"{track}: cannot be read (Permission denied)"


# --- on another recording


def test_a_recording_takes_the_place_of_the_scenario(tmp_path: Path) -> None:
    (tmp_path / "sweep.yaml").write_text(
        f"{HEAD}\nseeds: 3\nduration_s: 2.0\nset: {{map.track: oval}}\nvary: {{clock.node_hz: [20.0, 50.0]}}"
    )
    scenario = read_scenario("single_opponent", duration_s=0.2)
    recording = tmp_path / "drive.jsonl"
    write_stream(recording, simulate(scenario, np.random.default_rng(0)))
    made = load_plan(
        tmp_path / "sweep.yaml", recording, ["map.track=null", "association.gate_m=3.5"]
    )
    assert [(job.cells, job.seed) for job in made.jobs] == [((20.0,), 0), ((50.0,), 0)]
    for job in made.jobs:
        assert ("scenario" in job.recipe, job.recipe["recording"]) == (
            False,
            str(recording.resolve()),
        )
        assert (
            job.recipe["config"]["map"]["track"],
            job.recipe["config"]["association"]["gate_m"],
        ) == (None, 3.5)


# --- parts and tables


RECIPE = {"estimators": ("a", "b")}
TABLES = Plan(
    columns=("rate_hz", "delay"),
    jobs=(
        Job((5.0, {"kind": "none"}), 0, "k0", RECIPE),
        Job((5.0, None), 1, "k1", RECIPE),
        Job((-1, "x,y"), 0, "", None, "rate_hz=-1: must be positive"),
    ),
    estimators=("a", "b"),
    metrics=(),
)


def cell(name: str, error: str | None = None, **values: float | None) -> Cell:
    return Cell(
        name, {} if error else values, {} if error else {"replay_s": 0.25}, error
    )


DONE = {
    "k1": [cell("a", x=1 / 3, n=2), cell("b", error="it, broke")],
    "k0": [cell("a", x=0.1), cell("b", y=1e-300, x=None)],
}


def lines(path: Path) -> list[str]:
    return path.read_text().splitlines()


def test_tables_are_in_the_order_of_the_grid_with_all_digits(tmp_path: Path) -> None:
    result = write_tables(tmp_path, TABLES, DONE)
    assert lines(tmp_path / "sweep.csv") == [
        "rate_hz,delay,seed,estimator,x,y,n",
        '5.0,"{""kind"":""none""}",0,a,0.1,,',
        '5.0,"{""kind"":""none""}",0,b,,1e-300,',
        "5.0,,1,a,0.3333333333333333,,2",
    ]
    assert lines(tmp_path / "timing.csv")[1] == '5.0,"{""kind"":""none""}",0,a,0.25'
    assert lines(tmp_path / "errors.csv") == [
        "rate_hz,delay,seed,estimator,error",
        '5.0,,1,b,"it, broke"',
        '-1,"x,y",0,a,rate_hz=-1: must be positive',
        '-1,"x,y",0,b,rate_hz=-1: must be positive',
    ]
    assert result.num_good == 3
    assert result.errors == ("it, broke", *["rate_hz=-1: must be positive"] * 2)


def test_metrics_are_chosen_by_name_or_pattern_and_unknown_ones_reported(
    tmp_path: Path,
) -> None:
    plan = Plan(
        TABLES.columns,
        TABLES.jobs,
        TABLES.estimators,
        ("n", "[xz]", "n*", "missing", "m.*"),
    )
    result = write_tables(tmp_path, plan, DONE)
    assert lines(tmp_path / "sweep.csv")[0] == "rate_hz,delay,seed,estimator,n,x"
    assert result.unknown_metrics == ("missing", "m.*")


def part(folder: Path, key: str, text: str) -> None:
    (folder / "parts").mkdir(exist_ok=True)
    (folder / f"parts/{key}.json").write_text(text)


def test_a_part_gives_back_its_cells_to_the_last_bit(tmp_path: Path) -> None:
    values = {
        "window": "window",
        "on": True,
        "none": None,
        "nan": math.nan,
        "n": 2**62,
        "x": 0.1 + 0.2,
    }
    part(
        tmp_path,
        "k0",
        json.dumps(
            [
                {"estimator": name, "values": values, "times": {"s": 0.5}}
                for name in "ab"
            ]
        ),
    )
    part(tmp_path, "k2", "[]")  # of another sweep
    sweep = Sweep.open(TABLES, tmp_path)
    assert list(sweep.done) == ["k0"]
    assert repr(sweep.done["k0"][0].values) == repr(values)
    assert [job.key for job in sweep.todo] == ["k1"]


@pytest.mark.parametrize("text", ['[{"estimator": "a", "val', '{"format": "x"}'])
def test_the_job_of_a_damaged_part_is_repeated(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, text: str
) -> None:
    part(
        tmp_path,
        "k1",
        json.dumps(
            [{"estimator": name, "values": {"x": 1}, "times": {}} for name in "ab"]
        ),
    )
    part(tmp_path, "k0", text)
    assert [job.key for job in Sweep.open(TABLES, tmp_path).todo] == ["k0"]
    assert "k0.json: is damaged, so its job is repeated" in caplog.text


@pytest.mark.parametrize("name", ["sweep.csv", "paired.csv"])
def test_tables_without_parts_are_replaced_with_overwrite_only(
    tmp_path: Path, name: str
) -> None:
    (tmp_path / name).write_text("yield\n1\n")
    with pytest.raises(CallError, match=rf"{name}: already exists"):
        Sweep.open(TABLES, tmp_path)
    assert Sweep.open(TABLES, tmp_path, overwrite=True).done == {}
