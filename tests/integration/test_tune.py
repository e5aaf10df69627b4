"""`fgtrack tune`: from recordings of known noise to a configuration with that noise."""

import json
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fgtrack.cli.main import run
from fgtrack.cli.tune import _command
from fgtrack.core.types import EgoState
from fgtrack.io.run import load_run
from fgtrack.io.stream import write_stream
from fgtrack.pipeline.config import Config
from fgtrack.pipeline.load import load
from fgtrack.pipeline.shipped import read_config, read_scenario
from fgtrack.pipeline.tune_file import tuned_text, write_advised, write_tuned
from fgtrack.pipeline.tune_measurements import recorded
from fgtrack.pipeline.tune_space import ConfigNoise
from fgtrack.sim.simulate import simulate

Capture = pytest.CaptureFixture[str]
SECONDS = 10.0


@pytest.fixture(scope="module")
def stream(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten seconds of one object that moves as the model says, seen by two sensors with other noise than configured."""
    scenario = read_scenario("drawn_ctrv", duration_s=SECONDS)
    lidar, radar = scenario.sensors
    sensors = replace(lidar, std={"x_m": 0.6, "y_m": 0.15}, rate_hz=10.0), replace(radar, rate_hz=10.0)
    scenario = replace(scenario, opponents=scenario.opponents[:1], sensors=sensors)
    path = tmp_path_factory.mktemp("tune") / "drive.jsonl"
    write_stream(path, simulate(scenario, np.random.default_rng(3)))
    return path


@pytest.fixture(scope="module")
def written(stream: Path) -> Path:
    """What `fgtrack tune` makes of it."""
    out = stream.with_name("tuned.yaml")
    assert run(["tune", str(stream), "-c", "open_space", "-o", str(out), "--set", "birth.speed_std_mps=30"]) == 0
    return out


def test_the_file_repeats_the_configuration_with_other_noise(written: Path) -> None:
    config, before = load(Config, written), read_config("open_space", ["birth.speed_std_mps=30"])
    assert config.sensors["lidar_cluster"].std == pytest.approx({"x_m": 0.6, "y_m": 0.15}, rel=0.3)
    assert replace(config, sensors=before.sensors, motion=before.motion, ego=before.ego) == before
    text = written.read_text(encoding="utf-8")
    assert "# where the first detection has no speed" in text
    assert "lidar_cluster: {std: {x_m: 0." in text
    assert "NIS lidar_cluster x_m" in text
    assert "NEES of the position" in text
    lines = [line for line in text.splitlines() if not line.startswith("#   fgtrack")]
    assert max(map(len, lines)) <= 120


@pytest.mark.parametrize("association", ["euclidean", "mahalanobis"])
def test_a_gate_is_opened_to_the_uncertainty_of_a_bearing_far_away(association: str) -> None:
    scenario = read_scenario("drawn_ctrv", duration_s=5.0)
    lidar, radar = scenario.sensors
    polar_std = {"range_m": 0.5, "bearing_rad": 0.003}  # 9 m at 3 km
    scenario = replace(scenario, opponents=scenario.opponents[1:2], sensors=(lidar, replace(radar, std=polar_std)))
    messages = list(simulate(scenario, np.random.default_rng(5)))
    limit = {"euclidean": "gate_m: 5.0", "mahalanobis": "max_distance_m: 5.0"}[association]
    config = read_config(
        "open_space",
        [
            "estimator=ekf-replay",
            f"association={{kind: {association}, {limit}}}",
            "sensors.radar={std: {range_m: 0.5, bearing_rad: 0.003}, births: false}",
        ],
    )

    def radar_count(gate_stds: float) -> int:
        series, _ = recorded(messages, config, gate_stds=gate_stds)
        longest = max(series, key=lambda one: len(one.observations))
        return sum(one.sensor == "radar" for one in longest.observations)

    assert radar_count(0.0) < 60
    assert radar_count(4.0) > 70


def test_a_tuned_file_is_replayed_and_not_replaced_without_being_asked(
    written: Path, stream: Path, capsys: Capture
) -> None:
    text = written.read_text(encoding="utf-8")
    assert run(["replay", str(stream), "-c", str(written), "-o", str(written.with_name("run"))]) == 0
    assert load_run(written.with_name("run")).meta["estimator"] == "smoother"
    assert run(["tune", str(stream), "-c", "open_space", "-o", str(written)]) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert run(["tune", str(stream), "-c", "open_space", "-o", str(stream), "--overwrite"]) == 2
    assert "not a tuned configuration" in capsys.readouterr().err
    assert written.read_text(encoding="utf-8") == text


@pytest.mark.slow
def test_json_says_the_same_and_every_parameter_has_a_row(stream: Path, capsys: Capture, tmp_path: Path) -> None:
    """Also of sensors that the configuration does not name."""
    out, kept = tmp_path / "tuned.yaml", "motion.std_per_s.speed"
    words = ["-c", "open_space", "--set", "sensors={}", "--keep", kept]
    assert run(["tune", str(stream), *words, "-o", str(out), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    config = load(Config, out)
    values = {one["key"]: one["tuned"] for one in found["parameters"]}
    assert values["sensors.radar.std.speed_mps"] == config.sensors["radar"].std["speed_mps"]
    assert values["motion.std_per_s.yaw"] == config.motion.std_per_s["yaw"]
    assert len(values) == 4 + 2 + 3
    assert [one["key"] for one in found["parameters"] if one["why"] == "kept as asked"] == [kept]
    assert values[kept] == 1.0
    assert all(one["why"] for one in found["parameters"] if one["known"] in ("no", "limit"))
    assert all(one["tuned"] == one["configured"] for one in found["parameters"] if one["known"] == "no")
    errors = {one["key"]: one["std_error"] or 0.0 for one in found["parameters"]}
    known = {one["key"]: one["known"] for one in found["parameters"]}
    assert {key for key, is_known in known.items() if is_known == "yes"} == {
        key for key, error in errors.items() if 0.0 < error <= 0.05
    }
    assert {key for key, is_known in known.items() if is_known == "roughly"} == {
        key for key, error in errors.items() if 0.05 < error <= 0.5
    }
    assert found["held_out"]["after"] > found["held_out"]["before"]
    assert found["nees"]["after"] > 0.0


def test_a_key_to_keep_must_be_noise(stream: Path, capsys: Capture, tmp_path: Path) -> None:
    out = str(tmp_path / "tuned.yaml")
    assert run(["tune", str(stream), "-c", "open_space", "-o", out, "--keep", "motion.kind"]) == 2
    assert "keep motion.kind: is no noise of the configuration" in capsys.readouterr().err


def test_a_recording_of_nothing_is_one_line(tmp_path: Path, capsys: Capture) -> None:
    path = tmp_path / "drive.jsonl"
    write_stream(path, [EgoState(k * 10_000_000, k * 10_000_000, 0.0, 0.0, 0.0, 0.0) for k in range(50)])
    assert run(["tune", str(path), "-c", "smoother", "-o", str(tmp_path / "tuned.yaml")]) == 1
    [line] = capsys.readouterr().err.splitlines()
    assert "nothing to fit noise to" in line
    assert not (tmp_path / "tuned.yaml").exists()


def test_without_a_file_the_text_holds_what_is_no_default() -> None:
    config = read_config(
        None, ["sensors={radar: {std: {x_m: 1.5, y_m: 3.0, speed_mps: 0.2}}}", "motion.std_per_s.yaw=0.1"]
    )
    text = tuned_text(None, config, ["why"])
    assert text.startswith("# The noise of the defaults, fitted to recordings (fgtrack tune).\n#\n# why\n")
    assert "estimator" not in text
    assert "    std: {x_m: 1.5, y_m: 3.0, speed_mps: 0.2}\n" in text


@pytest.mark.parametrize("end", ["\n", "\r", "\x85", "\u2028", "\x0b"])
def test_no_name_in_a_comment_becomes_a_setting(end: str, tmp_path: Path) -> None:
    base = tmp_path / f"odd{end}ignore_sensors: [radar] #.yaml"
    base.write_text("estimator: ekf-replay\n", encoding="utf-8")
    config, comment = read_config(base), f"x{end}ignore_sensors: [radar] #.jsonl"
    for write in (write_tuned, write_advised):
        write(tmp_path / "out.yaml", base, config, [comment], overwrite=True)
        assert load(Config, tmp_path / "out.yaml") == config
        (tmp_path / "out.yaml").unlink()


def test_the_command_in_a_tuned_file_is_one_that_a_shell_takes() -> None:
    told = _command([Path("my drive.jsonl")], Path("a;b.yaml"), None, "it's", None, [("--set", "a.b=c d")])
    assert shlex.split(told) == "fgtrack tune|my drive.jsonl|-o|a;b.yaml|--map|it's|--set|a.b=c d".replace(
        " ", "|", 1
    ).split("|")


COMMENTED = """\
sensors:
  # of the LiDAR
  lidar:
    # its errors
    std: {x_m: 1.0, y_m: 1.0}  # metres
    births: true

  # of the RADAR
  radar:
    std:
      x_m: 1.0  # along
      # across
      y_m: 1.0
# what is near
association:
  kind: euclidean
  gate_m: 4.0
# left out
ignore_sensors:
  - camera  # infrared

# how objects move
motion: {kind: cv, std_per_s: {velocity: 3.0}}
# the end
"""
CHANGED = """\
sensors:
  # of the LiDAR
  lidar:
    # its errors
    std: {x_m: 1.0, y_m: 1.0}  # metres
    births: true
    correlation: {share: 0.6, time_s: 40.0}

  # of the RADAR
  radar:
    std:
      x_m: 1.0  # along
      # across
      y_m: 2.5
    correlation: {share: 0.5, time_s: 60.0}
# what is near
association: {kind: mahalanobis}
# left out
ignore_sensors: [lamp]

# how objects move
motion: {kind: cv, std_per_s: {velocity: 4.0}}
birth: {speed_std_mps: 3.0, kind: measured}
# the end
"""


def test_comments_stay_with_what_they_are_about(tmp_path: Path) -> None:
    path = tmp_path / "commented.yaml"
    path.write_text(COMMENTED, encoding="utf-8")
    settings = [
        "sensors.lidar.correlation={share: 0.6, time_s: 40.0}",
        "sensors.radar.correlation={share: 0.5, time_s: 60.0}",
        "sensors.radar.std.y_m=2.5",
        "association={kind: mahalanobis}",
        "ignore_sensors=[lamp]",
        "motion.std_per_s.velocity=4",
        "birth.speed_std_mps=3.0",
    ]
    text = tuned_text(path, read_config(path, settings), [])
    assert text.partition("#\n#\n")[2] == CHANGED


def test_sensors_that_are_ignored_are_not_tuned_and_stay_as_they_are() -> None:
    config = read_config("autoferry")
    space = ConfigNoise(config)
    assert not {sensor for sensor, _ in space.space.names} & {"infrared", "daylight"}
    assert space.config_with(space.values) == config
