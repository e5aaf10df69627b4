"""`fgtrack tune`: from recordings of known noise to a configuration with that noise."""

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fgtrack.cli.main import run
from fgtrack.config.reading import read_config, read_scenario
from fgtrack.config.settings import Config
from fgtrack.config.yaml_file import load
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import Detection, DetectionList
from fgtrack.inputs.stream import write_stream
from fgtrack.noise.measurements import recorded_series
from fgtrack.noise.parameters import ConfigNoise
from fgtrack.sim.simulate import simulate

Capture = pytest.CaptureFixture[str]
SECONDS = 10.0


@pytest.fixture(scope="module")
def stream(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten seconds of one object that moves as the model says, seen by two sensors with other noise than configured."""
    scenario = read_scenario("drawn_ctrv", duration_s=SECONDS)
    lidar, radar = scenario.sensors
    sensors = (
        replace(lidar, std={"x_m": 0.6, "y_m": 0.15}, rate_hz=10.0),
        replace(radar, rate_hz=10.0),
    )
    scenario = replace(scenario, opponents=scenario.opponents[:1], sensors=sensors)
    path = tmp_path_factory.mktemp("tune") / "drive.jsonl"
    write_stream(path, simulate(scenario, np.random.default_rng(3)))
    return path


@pytest.fixture(scope="module")
def written(stream: Path) -> Path:
    """What `fgtrack tune` makes of it."""
    out = stream.with_name("tuned.yaml")
    assert (
        run(
            [
                "tune",
                str(stream),
                "-c",
                "open_space",
                "-o",
                str(out),
                "--set",
                "birth.speed_std_mps=30",
            ]
        )
        == 0
    )
    return out


def test_the_file_holds_the_configuration_with_other_noise(written: Path) -> None:
    config, before = (
        load(Config, written),
        read_config("open_space", ["birth.speed_std_mps=30"]),
    )
    assert config.sensors["lidar_cluster"].std == pytest.approx(
        {"x_m": 0.6, "y_m": 0.15}, rel=0.3
    )
    assert (
        replace(config, sensors=before.sensors, motion=before.motion, ego=before.ego)
        == before
    )
    text = written.read_text(encoding="utf-8")
    assert text.startswith("# Noise of open_space, fitted to ")
    assert "lidar_cluster x_m" in text


@pytest.mark.parametrize("association", ["euclidean", "mahalanobis"])
def test_a_gate_is_opened_to_the_uncertainty_of_a_bearing_far_away(
    association: str,
) -> None:
    scenario = read_scenario("drawn_ctrv", duration_s=5.0)
    lidar, radar = scenario.sensors
    polar_std = {"range_m": 0.5, "bearing_rad": 0.003}  # 9 m at 3 km
    scenario = replace(
        scenario,
        opponents=scenario.opponents[1:2],
        sensors=(lidar, replace(radar, std=polar_std)),
    )
    messages = list(simulate(scenario, np.random.default_rng(5)))
    limit = {"euclidean": "gate_m: 5.0", "mahalanobis": "max_distance_m: 5.0"}[
        association
    ]
    config = read_config(
        "open_space",
        [
            "estimator=ekf-replay",
            f"association={{kind: {association}, {limit}}}",
            "sensors.radar={std: {range_m: 0.5, bearing_rad: 0.003}, births: false}",
        ],
    )

    def radar_count(gate_stds: float) -> int:
        series, _ = recorded_series(messages, config, gate_stds=gate_stds)
        longest = max(series, key=lambda one: len(one.observations))
        return sum(one.sensor == "radar" for one in longest.observations)

    assert radar_count(0.0) < 60
    assert radar_count(4.0) > 70


def test_equal_detections_of_two_sensors_are_observations_of_both_and_not_joined() -> (
    None
):
    sensors = {
        "front": {"std": {"x_m": 0.3, "y_m": 0.3}},
        "rear": {"std": {"x_m": 0.5, "y_m": 0.5}},
    }
    settings = {
        "sensors": sensors,
        "association": {"kind": "mahalanobis", "joint_from": 1},
        "estimator": "ekf-replay",
    }
    config = read_config("open_space", settings)
    lists = [
        DetectionList(
            name,
            k * NS_PER_S // 10,
            k * NS_PER_S // 10,
            (Detection(x_m=0.1 * k, y_m=0.0),),
            "map",
        )
        for k in range(20)
        for name in sensors
    ]
    (series,), _ = recorded_series(lists, config)
    counts = Counter(one.sensor for one in series.observations)
    assert min(counts["front"], counts["rear"]) > 15


@pytest.mark.slow
def test_json_says_the_same_and_every_parameter_has_a_row(
    stream: Path, capsys: Capture, tmp_path: Path
) -> None:
    """Also of sensors that the configuration does not name."""
    out, kept = tmp_path / "tuned.yaml", "motion.std_per_s.speed"
    words = ["-c", "open_space", "--set", "sensors={}", "--keep", kept]
    assert run(["tune", str(stream), *words, "-o", str(out), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    config = load(Config, out)
    values = {one["key"]: one["tuned"] for one in found["parameters"]}
    assert (
        values["sensors.radar.std.speed_mps"]
        == config.sensors["radar"].std["speed_mps"]
    )
    assert values["motion.std_per_s.yaw"] == config.motion.std_per_s["yaw"]
    assert len(values) == 4 + 2 + 3
    assert [
        one["key"]
        for one in found["parameters"]
        if one["why"] == "kept as configured (keep)"
    ] == [kept]
    assert values[kept] == 1.0
    assert all(
        one["why"] for one in found["parameters"] if one["known"] in ("no", "limit")
    )
    assert found["held_out"]["after"] > found["held_out"]["before"]


def test_a_key_to_keep_must_be_noise(
    stream: Path, capsys: Capture, tmp_path: Path
) -> None:
    out = str(tmp_path / "tuned.yaml")
    assert (
        run(
            [
                "tune",
                str(stream),
                "-c",
                "open_space",
                "-o",
                out,
                "--keep",
                "motion.kind",
            ]
        )
        == 2
    )
    assert (
        "keep motion.kind: not a noise parameter of the configuration"
        in capsys.readouterr().err
    )


def test_sensors_that_are_ignored_are_not_tuned_and_stay_as_they_are() -> None:
    config = read_config("autoferry")
    space = ConfigNoise(config)
    assert not {sensor for sensor, _ in space.space.names} & {"infrared", "daylight"}
    assert space.config_with(space.values) == config
