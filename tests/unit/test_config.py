from dataclasses import fields, is_dataclass, replace
from pathlib import Path

import pytest
from support.paper import paper

from fgtrack.config.settings import Config, Effective
from fgtrack.config.yaml_file import dump, load, read_yaml, validate, with_value
from fgtrack.core.errors import CallError
from fgtrack.karle2023.tracker_parts import PublishedTracker
from fgtrack.pipeline.build import build_bank, build_tracker
from fgtrack.pipeline.sweep_plan import SweepConfig
from fgtrack.sim.scenario import Scenario
from fgtrack.tracking.association import GatedEuclidean, GatedMahalanobis
from fgtrack.tracking.decided_tracker import DecidedTracker
from fgtrack.tracking.tracker import MultiObjectTracker

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
FILES = sorted(CONFIGS.rglob("*.yaml"))


KINDS = {"scenarios": Scenario, "sweeps": SweepConfig}


def kind_of(path: Path) -> type[Config] | type[Scenario] | type[SweepConfig]:
    return KINDS.get(path.parent.name, Config)


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "config.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def keys(value: object) -> set[str]:
    """Names of all fields, at any depth."""
    if not is_dataclass(value):
        return set()
    return {field.name for field in fields(value)}.union(
        *(keys(getattr(value, field.name)) for field in fields(value))
    )


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_every_file_of_the_project_loads_and_comes_back_from_its_dump(
    path: Path, tmp_path: Path
) -> None:
    loaded = load(kind_of(path), path)
    again = load(kind_of(path), written(tmp_path, dump(loaded)))
    assert again == loaded
    assert dump(again) == dump(loaded)


def test_the_defaults_are_those_of_open_space_and_shift_join_and_expect_nothing() -> (
    None
):
    config = load(Config, None)
    assert config == Config()
    assert config.effective == Effective((0.0, 0.0), None, "filter.storage_s", 3.0, 3.0)
    assert (config.map.track, config.birth.ego_speed_factor, config.lifecycle.kind) == (
        None,
        0.0,
        "existence",
    )
    assert (config.ego.yaw_weight, config.ego.yaw_rate_weight) == (1.0, 1.0)


def test_what_is_easily_overlooked_is_a_line() -> None:
    assert str(paper().effective) == (
        "detection origin -1.74 m ahead, 0 m left of the ego; merge up to 5.1 m; lag 3.5 s"
    )
    assert (
        str(Config().effective) == "merge none; lag 3 s"
    )  # no ego frame that detections are shifted to
    smoother = paper(
        "estimator=smoother", "motion.kind=ctrv", "smoother.late=fuse"
    ).effective
    assert (smoother.lag_s, smoother.reach_s) == (1.0, 3.0)
    assert str(smoother).endswith("lag 1 s, late detections up to 3 s")
    drops = paper(
        "estimator=smoother-banded", "motion.kind=ctrv", "smoother.late=drop"
    ).effective
    assert (drops.lag_s, drops.reach_s) == (1.0, 1.0)


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"association": {"kind": "mahalanobis"}}, ""),
        ({}, "late lists change decisions for 2 s"),
        (
            {"estimator": "larsen"},
            "late lists change decisions for 2 s; larsen is not exact: "
            "its states depend on the order of arrival",
        ),
        (
            {"association.revise": False},
            "late lists change no decision: a list older than the newest list is too old",
        ),
        (
            {"estimator": "drop"},
            "late lists change no decision: a list older than the newest list is too old",
        ),
    ],
)
def test_a_line_says_whether_late_lists_change_decisions(
    changes: dict[str, object], line: str
) -> None:
    config = Config.from_dict(
        {
            "association": {"kind": "hypotheses"},
            "lifecycle": {"kind": "existence"},
            "filter": {"storage_s": 2.0},
        }
    )
    assert config.replace(changes).revision_line == line


def test_a_dump_writes_every_key_out() -> None:
    text = dump(Config())
    assert [key for key in keys(Config()) if f"{key}:" not in text] == []


@pytest.mark.parametrize(
    "path",
    [path for path in FILES if kind_of(path) is Config],
    ids=lambda path: path.stem,
)
def test_every_configuration_can_be_built(path: Path) -> None:
    config = load(Config, path)
    tracker = build_tracker(config)
    assert type(tracker) is (
        PublishedTracker
        if config.lifecycle.kind == "published"
        else DecidedTracker
        if config.association.kind == "hypotheses"
        else MultiObjectTracker
    )


def test_an_estimator_gets_its_options_and_refuses_others() -> None:
    name = "estimator=reorder-buffer"
    build_bank(load(Config, None, [name, "options.reorder-buffer={hold_s: 0.2}"]))
    with pytest.raises(
        CallError, match=r"reorder-buffer: .*'hold'; its options are hold_s"
    ):
        build_bank(load(Config, None, [name, "options.reorder-buffer={hold: 0.2}"]))
    with pytest.raises(
        CallError, match=r"options\.smoother: .*set the keys of smoother"
    ):
        build_bank(
            load(Config, None, ["estimator=smoother", "options.smoother={late: drop}"])
        )


def test_a_former_name_is_replaced_and_the_warning_names_both_methods(
    caplog: pytest.LogCaptureFixture,
) -> None:
    assert Config(estimator="backward-forward").estimator == "rewind-forget"
    [line] = caplog.messages
    assert "now named 'rewind-forget'" in line
    assert "Karle et al. 2023, on a grid of 10 ms, is 'ekf-backward-forward'" in line
    with pytest.raises(
        CallError, match="'backward-forward' is now named 'rewind-forget'"
    ):
        load(Config, None, ["options={backward-forward: {}}"])


def test_settings_stand_above_the_file_and_the_last_one_wins(tmp_path: Path) -> None:
    path = written(tmp_path, "filter: {frequency_hz: 50.0, storage_s: 2.0}\n")
    settings = [
        "filter.frequency_hz=20",
        "filter.frequency_hz=25.0",
        "association={kind: mahalanobis}",
        "map.track=oval",
    ]
    config = load(Config, path, settings)
    assert (config.filter.frequency_hz, config.filter.storage_s) == (25.0, 2.0)
    assert config.association == GatedMahalanobis()
    assert config.map.track == "oval"


def test_a_setting_of_one_sensor_leaves_the_other_ones() -> None:
    sensors = paper(
        "sensors.radar.max_delay_s=1.5", "sensors.radar.counter_add=1"
    ).sensors
    radar = replace(paper().sensors["radar"], max_delay_s=1.5, counter_add=1)
    assert sensors == {**paper().sensors, "radar": radar}


def test_a_setting_of_a_choice_is_of_the_default_kind_unless_it_names_another() -> None:
    assert load(
        Config, None, ["association.gate_probability=0.9"]
    ).association == GatedMahalanobis(gate_probability=0.9)
    assert (
        load(Config, None, ["association.kind=euclidean"]).association
        == GatedEuclidean()
    )


def test_a_setting_below_a_key_of_the_file_adds_nothing_to_it(tmp_path: Path) -> None:
    path = written(tmp_path, "sensors: {radar: {std: {x_m: 1.0, y_m: 1.0}}}\n")
    assert list(load(Config, path, ["sensors.radar.max_delay_s=1.5"]).sensors) == [
        "radar"
    ]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "filtre: {}\n",
            "config.yaml: filtre: unknown key, did you mean 'filter'; the keys are estimator, sensors",
        ),
        (
            "filter: {frequence: 3.0}\n",
            "filter.frequence: unknown key, did you mean 'frequency_hz'",
        ),
        (
            "sensors: {lidar: {std: {x_m: 1.0, y_m: 1.0, mass_kg: 1.0}}}\n",
            "std: unknown 'mass_kg'",
        ),
        ("sensors: {lidar: {std: {x_m: 1.0}}}\n", "std: give x_m and y_m together"),
        (
            "filter: {frequency_hz: fast}\n",
            'filter.frequency_hz: Input should be a valid number, not "fast"',
        ),
        (
            "filter: {frequency_hz: 0.0}\n",
            "filter.frequency_hz: Input should be greater than or equal to 1, not 0.0",
        ),
        ("filter: {storage_s: 1e9}\n", "storage_s: must lie"),
        ("clock: {node_hz: .nan}\n", "node_hz"),
        ("map: {inner_buffer_m: .inf}\n", "map.inner_buffer_m"),
        ("ego: {yaw_weight: 0.0}\n", "ego.yaw_weight: Input should be greater than 0"),
        ("inbox: {max_future_s: 2.0}\n", "inbox: unknown key"),
        ("association: {gate_m: 3.0}\n", "association: the key `kind` is missing"),
        (
            "association: {kind: mahalanobis, gate_m: 3.0}\n",
            "association.gate_m: unknown key",
        ),
        (
            "association: {kind: mahalanobis, gate_probability: 1.5}\n",
            "gate_probability: Input should be less than 1",
        ),
        ("motion: {kind: cv}\n", "std of CV: give velocity"),
        (
            "defects: [saturated_yaw]\n",
            "defects: noise_per_step and saturated_yaw need motion.kind ctrv_euler",
        ),
        ("lifecycle: {counter_cap: 0}\n", "counter_cap"),
        ("evaluation: {gate_m: 0.0}\n", "gate_m: must be positive"),
        (
            "filter: {storage_s: 1.0}\nfilter: {storage_s: 2.0}\n",
            "config.yaml:2: invalid YAML, found duplicate key",
        ),
        ("filter: {storage_s: &a [*a]}\n", "Circular reference"),
        ("clock: {node_hz: 2020-01-01}\n", "only plain YAML values"),
        ("- 1\n", "must contain a mapping of keys to values, not [1]"),
        (
            "? [1, 2]\n: 3\n",
            "config.yaml: only plain YAML values and text keys are allowed",
        ),
        ("!!python/object:os.system {}\n", "config.yaml"),
    ],
)
def test_every_error_is_one_line_with_the_file_and_the_key(
    tmp_path: Path, text: str, message: str
) -> None:
    path = written(tmp_path, text)
    with pytest.raises(CallError) as error:
        load(Config, path)
    assert message in str(error.value)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


def test_a_name_with_a_dot_stands_in_quotes() -> None:
    sensors = load(
        Config,
        None,
        ['sensors."cam.top".std.bearing_rad=0.1', "sensors.lidar.std.bearing_rad=0.2"],
    ).sensors
    assert [(name, dict(one.std)) for name, one in sensors.items()] == [
        ("cam.top", {"bearing_rad": 0.1}),
        ("lidar", {"bearing_rad": 0.2}),
    ]


@pytest.mark.parametrize(
    "setting", ["", "=", "=1", "a", "a.=1", ".a=1", "a..b=1", 'a."b=1', 'a""b=1']
)
def test_a_setting_that_is_no_setting_says_how_to_write_it(setting: str) -> None:
    with pytest.raises(CallError, match="must be key=value"):
        load(Config, None, [setting])


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("estimator.x=1", "estimator"),
        ("filter.frequency_hz=[1", "--set filter.frequency_hz=[1"),
        ("nothing=1", "defaults with --set: nothing: unknown key"),
    ],
)
def test_a_wrong_setting_names_its_key(setting: str, message: str) -> None:
    with pytest.raises(CallError) as error:
        load(Config, None, [setting])
    assert message in str(error.value)


def test_a_path_through_a_single_value_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path, "filter: {storage_s: 2.0}\n")
    with pytest.raises(CallError, match=r"there is no key .* in the value"):
        load(Config, path, ["filter.storage_s.x=1"])


@pytest.mark.parametrize(
    ("key", "value", "named"),
    [
        ("ego.speed", [[4.0, 52.0], [64.0]], r"ego\.speed\.1\.1"),
        ("ego.speed", [[], [64.0, 1.0]], r"ego\.speed\.0\.0"),
        ("sensors.0.clutter.speed_mps", [1.0], r"sensors\.0\.clutter\.speed_mps\.1"),
        ("sensors.1.drop_outs", [[1.0]], r"sensors\.1\.drop_outs\.0\.1"),
        ("sensors.1.split_distance_m", [], r"sensors\.1\.split_distance_m\.0"),
    ],
)
def test_a_pair_that_lacks_a_value_is_named(
    key: str, value: object, named: str
) -> None:
    raw = read_yaml(Path(__file__).parents[2] / "configs/scenarios/default.yaml")
    with pytest.raises(CallError, match=rf"^it: {named}: Field required"):
        validate(Scenario, with_value(raw, key.split("."), value), "it")


def test_an_empty_file_is_the_default_and_a_missing_one_an_error(
    tmp_path: Path,
) -> None:
    assert (
        load(Config, written(tmp_path, ""))
        == load(Config, written(tmp_path, "# nothing\n"))
        == Config()
    )
    for path in (tmp_path / "missing.yaml", tmp_path):
        with pytest.raises(CallError, match="configuration cannot be read"):
            read_yaml(path)
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(CallError, match="is no text file"):
        read_yaml(tmp_path / "binary.yaml")


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        (
            "smoother.lag_s=1e308",
            "smoother.lag_s: must be 0, or have a magnitude of 1e-12 to 1e+09, not 1e+308",
        ),
        (
            "sensors.radar.std.speed_mps=1e-300",
            "sensors.radar.std.speed_mps: must be 0, or have a magnitude of",
        ),
        (
            "motion.std_per_s.yaw=-0.3",
            "motion.std_per_s.yaw: Input should be greater than or equal to 0, not -0.3",
        ),
        ("sensors=" + "[" * 1_000, "nested too deeply"),
    ],
)
def test_no_setting_is_beyond_reason(setting: str, message: str) -> None:
    with pytest.raises(CallError) as caught:
        load(Config, None, [setting])
    assert message in str(caught.value)
    assert len(str(caught.value)) < 720


def test_a_config_goes_through_a_file_and_takes_other_values(tmp_path: Path) -> None:
    config = paper().replace(
        {"smoother.lag_s": 2.0, 'sensors."radar".max_delay_s': 0.5},
        estimator="smoother",
    )
    assert (
        config.smoother.lag_s,
        config.sensors["radar"].max_delay_s,
        config.estimator,
    ) == (2.0, 0.5, "smoother")
    assert config.replace(smoother=paper().smoother).smoother == paper().smoother
    config.to_yaml(tmp_path / "my.yaml")
    assert Config.from_yaml(tmp_path / "my.yaml") == config
    assert Config.from_yaml("smoother").estimator == "smoother"
    with pytest.raises(
        CallError,
        match=r"the configuration.*: smoother\.lags: unknown key, did you mean 'lag_s'",
    ):
        config.replace({"smoother.lags": 2.0})
