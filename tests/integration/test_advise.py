"""`advise`: what it says of a recording is right, and the configuration that it writes follows it."""

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import fgtrack
from fgtrack.cli.main import run as run_command
from fgtrack.clocks.arrivals import Arrivals, arrivals_of, window_findings
from fgtrack.clocks.stamps import stamp_findings
from fgtrack.config.reading import read_config
from fgtrack.core.types import Detection, DetectionList, EgoState, Message, TruthState
from fgtrack.evaluation.metrics import evaluate
from fgtrack.inputs.source import open_input
from fgtrack.inputs.stream import write_stream
from fgtrack.meaning.assumed import assumed
from fgtrack.runs import load_run
from fgtrack.sim.new_delays import restamped

MS = 1_000_000
START_NS = 1_600_000_000_000_000_000

#: Neither a map nor a racing team: cars anywhere, two sensors that measure positions.
CONFIG = """\
estimator: ekf-replay
sensors:
  lidar: {std: {x_m: 0.3, y_m: 0.3}}
  radar: {std: {x_m: 1.0, y_m: 1.0}}
motion: {kind: ctrv, std_per_s: {position: 0.2, yaw: 0.3, speed: 30.0, yaw_rate: 0.5}}
birth: {kind: measured, ego_speed_factor: 0.0, speed_std_mps: 10.0}
ego: {detection_origin_x_m: 0.0}
merge: {kind: none}
"""

Call = Callable[..., tuple[int, str]]


@pytest.fixture
def call(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Call:
    """Runs a command in an empty folder; gives its exit code and what it prints, its lines joined."""
    monkeypatch.chdir(tmp_path)

    def called(*arguments: object) -> tuple[int, str]:
        capsys.readouterr()
        code = run_command([str(argument) for argument in arguments])
        out, err = capsys.readouterr()
        return code, " ".join(f"{out} {err}".split())

    return called


def drive(
    count: int = 150,
    *,
    truth: bool = True,
    late_ms: Callable[[int], float] = lambda k: 100.0,
    wave_mps: float = 6.0,
) -> list[Message]:
    """The ego at 20 m/s far from the origin of the map; a car ahead that is faster and slower than it by turns."""
    rng = np.random.default_rng(1)
    messages: list[Message] = []
    for k in range(count):
        now_s = 0.05 * k
        now_ns = START_NS + k * 50 * MS
        ego_m = 1000.0 + 20.0 * now_s
        messages.append(EgoState(now_ns, now_ns, ego_m, 500.0, 0.0, 20.0))
        ahead_m = 30.0 + wave_mps * (1.0 - np.cos(now_s))
        if truth:
            messages.append(
                TruthState(
                    now_ns,
                    now_ns,
                    1,
                    ego_m + ahead_m,
                    501.0,
                    0.0,
                    20.0 + wave_mps * np.sin(now_s),
                )
            )
        for sensor, std_m, delay_ms in (
            ("lidar", 0.3, late_ms(k)),
            ("radar", 1.0, 40.0),
        ):
            x_m, y_m = rng.normal((ahead_m, 1.0), std_m).tolist()
            receipt_ns = now_ns + round(delay_ms * MS)
            messages.append(
                DetectionList(
                    sensor,
                    now_ns,
                    receipt_ns,
                    (Detection(x_m=x_m, y_m=y_m, yaw_rad=0.0),),
                    "ego",
                )
            )
    return sorted(messages, key=lambda message: message.receipt_ns)


def changed(
    change: Callable[[DetectionList], DetectionList], messages: Iterable[Message]
) -> list[Message]:
    return [
        change(item) if isinstance(item, DetectionList) else item for item in messages
    ]


def write(messages: Sequence[Message]) -> str:
    """Write the recording and `c.yaml` that reads it; gives its name."""
    write_stream("drive.jsonl", messages, overwrite=True)
    Path("c.yaml").write_text(CONFIG)
    return "drive.jsonl"


def advised(call: Call, recording: str, *options: str) -> tuple[int, str]:
    return call("advise", recording, "-c", "c.yaml", *options)


def test_a_healthy_recording_is_fine_and_nothing_is_changed(call: Call) -> None:
    write(drive())
    code, text = advised(call, "drive.jsonl", "-o", "a.yaml")
    assert code == 0
    assert "Fine, ego: states: 20 Hz, longest gap 50 ms, 0 of 150 stamps" in text
    for passed in (
        "its positions move 1 times the way of its speed",
        "Fine, lidar: stamps: 0 of 150 after their receipt",
        "m left of lidar (± 0.2 m, 150 pairs; limit 1.",
        "use: 100 % of 150 detections used (limit 50 %), 0.0 % failed (limit 5.0 %)",
        "noise: mean NIS is ",
        "window: 0 of 150 detections later than filter.storage_s allows (3 s)",
        "births: 0 of 300 used detections began a track that was never confirmed (0.0 %, limit 10 %)",
        "truth: 99 % of the time in view tracked (limit 90 %), position RMSE ",
    ):
        assert passed in text, passed
    assert "Not tested, radar: clock: +25 ms" in text
    assert (
        "radar: its clock offset from the truth of the recording is not known: +25 ms ±"
        in text
    )  # too short a drive
    assert "# Nothing is changed." in Path("a.yaml").read_text()
    for name in ("c", "a"):
        assert (
            call("replay", "drive.jsonl", "-c", f"{name}.yaml", "-o", f"runs/{name}")[0]
            == 0
        )
    assert load_run("runs/a").meta["digest"] == load_run("runs/c").meta["digest"]


@pytest.mark.parametrize("command", ["advise", "offsets"])
def test_without_a_configuration_the_sensors_are_those_of_the_recording(
    call: Call, command: str
) -> None:
    bare = changed(
        lambda item: replace(
            item, objects=[replace(one, yaw_rad=None) for one in item.objects]
        ),
        drive(100),
    )
    write(bare)
    out = () if command == "offsets" else ("-o", "a.yaml")
    code, text = call(command, "drive.jsonl", *out)
    assert code == 0, text
    assert "x_m 1, y_m 1 (usual for a LiDAR or RADAR detector" in text
    if out:
        assert call("replay", "drive.jsonl", "-c", "a.yaml", "-o", "run")[0] == 0
        assert set(load_run("run").config["sensors"]) == {"lidar", "radar"}


def test_a_track_outlives_the_silence_of_the_slowest_sensor() -> None:
    every_ms = {"camera": 50, "lidar": 3000, "radar": 1000}
    stamps_ns = {
        name: START_NS + np.arange(0, 60_000, period, dtype=np.int64) * MS
        for name, period in every_ms.items()
    }
    arrivals = [
        Arrivals(name, each, each, np.ones_like(each))
        for name, each in stamps_ns.items()
    ]
    sensors = ", ".join(f"{name}: {{std: {{x_m: 1.0, y_m: 1.0}}}}" for name in every_ms)
    config = read_config(
        None,
        [
            f"sensors={{{sensors}}}",
            "lifecycle.out_of_view_s=0.5",
            "filter.storage_s=10.0",
        ],
    )
    (found,) = window_findings(arrivals, config)
    assert (found.about, found.settings) == ("lidar", {"lifecycle.out_of_view_s": 10.0})
    short = replace(config, filter=replace(config.filter, storage_s=1.0))
    assert next(window_findings(arrivals, short)).settings == {"filter.storage_s": 12.0}
    every_30_s = START_NS + 10 * (arrivals[1].stamps_ns - START_NS)
    seldom = replace(arrivals[1], stamps_ns=every_30_s, receipts_ns=every_30_s)
    assert next(window_findings([seldom], short)).settings == {"filter.storage_s": 60.0}
    alone = replace(config, sensors={"lidar": config.sensors["lidar"]})
    assert not list(window_findings(arrivals[1:2], alone))
    settings = ["lifecycle.kind=counting", "lifecycle.forget_s=0.5"]
    counted = replace(alone, lifecycle=read_config(None, settings).lifecycle)
    assert [one.settings for one in window_findings(arrivals[1:2], counted)] == [
        {"lifecycle.forget_s": 10.0}
    ]


def test_stamps_of_zero(call: Call) -> None:
    zero = changed(
        lambda item: replace(item, stamp_ns=0) if item.sensor == "radar" else item,
        drive(45),
    )
    recording = write(zero)
    _, shown = call("info", recording, "-c", "c.yaml")
    assert "radar: all stamps are 0: set `stamp_from: receipt`" in shown
    code, text = advised(call, recording, "-o", "a.yaml")
    assert code == 0
    assert (
        "its driver sets none, so its delay stays unknown. Set sensors.radar.stamp_from: receipt"
        in text
    )
    assert call("replay", recording, "-c", "a.yaml", "-o", "run")[0] == 0
    fates = load_run("run").meta["counts"]["radar"]
    assert (
        sum(fates.get(fate, 0) for fate in ("birth", "in_sequence", "out_of_sequence"))
        > 40
    )


@pytest.mark.slow
@pytest.mark.parametrize("sensor", ["lidar", "radar"])
def test_a_wrong_clock_is_found_by_the_truth_and_mended(
    call: Call, sensor: str
) -> None:
    off = changed(
        lambda item: (
            restamped(item, item.stamp_ns + 80 * MS) if item.sensor == sensor else item
        ),
        drive(600),
    )
    write(off)
    code, text = advised(call, "drive.jsonl", "-o", "a.yaml")
    assert code == 0
    assert (
        f"later than the truth of the recording. Set sensors.{sensor}.clock_offset_s"
        in text
    )
    changes = {
        line.split()[2]: float(line.split()[4].rstrip(":"))
        for line in Path("a.yaml").read_text().splitlines()
        if line.startswith("# - sensors.")
    }
    assert changes == {
        f"sensors.{sensor}.clock_offset_s": pytest.approx(0.08, abs=0.02)
    }
    for name in ("c", "a"):
        assert (
            call("replay", "drive.jsonl", "-c", f"{name}.yaml", "-o", f"runs/{name}")[0]
            == 0
        )
    before, after = (rmse_m(f"runs/{name}") for name in ("c", "a"))
    assert after < before


def rmse_m(path: str) -> float:
    truth = evaluate(load_run(path)).truth
    assert truth is not None
    return truth.overall.errors["position_m"].rmse


@pytest.mark.slow
def test_without_truth_only_the_difference_of_two_clocks_is_known(call: Call) -> None:
    off = changed(
        lambda item: (
            restamped(item, item.stamp_ns + 80 * MS) if item.sensor == "lidar" else item
        ),
        drive(250, truth=False, wave_mps=12.0),
    )
    write(off)
    advice = fgtrack.advise("drive.jsonl", "c.yaml", reference="radar")
    (clock,) = [one for one in advice.findings if one.kind == "clock"]
    assert (
        "later than those of radar. radar arrives at least 40 ms after its stamps"
        in clock.text
    )
    assert "radar is assumed to be right. To identify the wrong clock" in clock.text
    code, text = call(
        "offsets", "drive.jsonl", "-c", "c.yaml", "--reference", "radar", "--json"
    )
    assert code == 0
    offsets = json.loads(text)
    assert offsets["verdicts"] == {"lidar": clock.text}
    (lidar,) = [one for one in offsets["sensors"] if one["sensor"] == "lidar"]
    assert lidar["offset_s"] == pytest.approx(
        advice.config.sensors["lidar"].clock_offset_s, abs=1e-4
    )
    assert advice.config.sensors["lidar"].clock_offset_s == pytest.approx(
        0.08, abs=0.02
    )


def test_a_limit_that_refuses_bursts(call: Call) -> None:
    def late_ms(k: int) -> float:
        return (
            600.0 + 5.0 * (k % 7) if k % 100 in range(40, 60) else 100.0 + 3.0 * (k % 7)
        )

    write(drive(200, late_ms=late_ms))
    Path("c.yaml").write_text(CONFIG.replace("lidar: {", "lidar: {max_delay_s: 0.3, "))
    advice = fgtrack.advise("drive.jsonl", "c.yaml")
    assert advice.config.sensors["lidar"].max_delay_s == pytest.approx(0.8)
    assert advice.before is not None
    assert advice.after is not None
    assert advice.before.used["lidar"] == pytest.approx(0.8, abs=0.02)
    assert advice.after.used["lidar"] == pytest.approx(1.0, abs=0.01)
    assert "20 % of its detections arrive later than max_delay_s 0.3 s" in " ".join(
        advice.sentences
    )


def test_a_window_shorter_than_the_delays(call: Call) -> None:
    write(drive(100))
    Path("c.yaml").write_text(CONFIG + "filter: {storage_s: 0.05}\n")
    assert fgtrack.advise(
        "drive.jsonl", "c.yaml"
    ).config.filter.storage_s == pytest.approx(0.2)


def test_stamps_after_their_receipt_are_reported(call: Call) -> None:
    write(changed(delayed("radar", 70), drive()))
    Path("c.yaml").write_text(CONFIG)
    assert (
        "radar: 100 % of its stamps lie after their receipt, by up to 30 ms"
        in " ".join(fgtrack.advise("drive.jsonl", "c.yaml").sentences)
    )


def test_a_jump_and_a_drift_of_the_delay_are_reported() -> None:
    def jump(item: DetectionList) -> DetectionList:
        later = item.sensor == "radar" and item.stamp_ns > START_NS + 10_000 * MS
        return restamped(item, item.stamp_ns - 500 * MS) if later else item

    def drift(item: DetectionList) -> DetectionList:
        slow_ns = (item.stamp_ns - START_NS) * 2 // 1000
        return (
            restamped(item, item.stamp_ns - slow_ns) if item.sensor == "radar" else item
        )

    for change, told in (
        (jump, "its delay is 40 ms until about 10 s and 540 ms after that"),
        (drift, "its delay is 50 ms until about 10 s and 70 ms after that"),
    ):
        arrivals = arrivals_of(changed(change, drive(400)))
        assert any(told in one.text for one in stamp_findings(arrivals["radar"]))
        assert not list(stamp_findings(arrivals["lidar"]))


def test_a_sensor_without_a_model_has_assumed_noise(call: Call) -> None:
    write(drive())
    Path("c.yaml").write_text(
        "\n".join(line for line in CONFIG.splitlines() if "radar" not in line)
    )
    code, text = advised(call, "drive.jsonl", "-o", "a.yaml")
    assert code == 0
    assert "assumed, radar: standard deviations x_m 1, y_m 0.91 (scatter of 142" in text
    assert call("replay", "drive.jsonl", "-c", "a.yaml", "-o", "run")[0] == 0


@pytest.mark.slow
def test_an_estimator_that_forgets_and_noise_that_does_not_fit(call: Call) -> None:
    write(drive(250))
    text = CONFIG.replace("ekf-replay", "ekf-backward-forward").replace(
        "radar: {std: {x_m: 1.0", "radar: {std: {x_m: 9.0"
    )
    Path("c.yaml").write_text(text.replace("y_m: 1.0}", "y_m: 9.0}"))
    advice = fgtrack.advise("drive.jsonl", "c.yaml", tune=True)
    assert advice.config.estimator == "ekf-replay"
    assert [one.about for one in advice.findings if one.kind == "noise"] == ["radar"]
    assert advice.config.sensors["radar"].std["x_m"] == pytest.approx(1.0, rel=0.3)
    told = {one.key: one.value for one in advice.changes}
    assert told["sensors.radar.std.x_m"] == advice.config.sensors["radar"].std["x_m"]
    assert set(told) <= {"estimator", *(key for key in told if ".std" in key)}
    (tuned,) = [str(one) for one in advice.findings if one.about == "tune"]
    assert tuned.startswith(
        "tune: noise fitted to the recording by maximum likelihood. Unchanged: "
    )
    assert f"sensors.radar.std.x_m: {told['sensors.radar.std.x_m']}" in tuned
    assert any(
        line.startswith("- sensors.radar.std.x_m = ") for line in advice.comments()
    )
    assert "Nothing is changed." not in advice.comments()


@pytest.mark.slow
def test_white_noise_is_not_fitted_to_errors_that_last(call: Call) -> None:
    rng, error_m = np.random.default_rng(4), np.zeros(2)

    def erring(item: DetectionList) -> DetectionList:
        nonlocal error_m
        if item.sensor != "lidar":
            return item
        error_m = 0.9 * error_m + 0.44 * rng.normal(0.0, 1.5, 2)  # for half a second
        of = item.objects[0]
        assert of.x_m is not None
        assert of.y_m is not None
        return replace(
            item,
            objects=(replace(of, x_m=of.x_m + error_m[0], y_m=of.y_m + error_m[1]),),
        )

    write_stream("drive.jsonl", changed(erring, drive(350)))
    Path("c.yaml").write_text(CONFIG)
    advice = fgtrack.advise("drive.jsonl", "c.yaml", tune=True)
    assert any(one.kind == "noise" and one.about == "lidar" for one in advice.findings)
    (tuned,) = [one for one in advice.findings if one.about == "tune"]
    assert tuned.text.startswith(
        "no noise is changed: with the fitted noise, innovations of "
    )
    assert "remain autocorrelated (0." in tuned.text
    assert not advice.changes
    assert (
        advice.config
        == assumed(read_config("c.yaml"), open_input("drive.jsonl")).config
    )
    code, text = call("tune", "drive.jsonl", "-c", "c.yaml", "-o", "t.yaml")
    assert code == 0
    assert "innovations remain correlated in time (autocorrelation 0." in text
    assert "model time-correlated errors of this sensor" in text


@pytest.mark.slow
def test_an_origin_that_is_wrong_is_found_by_the_truth(call: Call) -> None:
    def moved(item: DetectionList) -> DetectionList:
        return replace(
            item,
            objects=[
                replace(of, x_m=of.x_m + 1.5)
                for of in item.objects
                if of.x_m is not None
            ],
        )

    write(changed(moved, drive(600)))
    advice = fgtrack.advise("drive.jsonl", "c.yaml")
    (bias,) = [one for one in advice.findings if one.kind == "bias"]
    assert bias.text.startswith("detections of all sensors lie 1.")
    assert "m left of the truth, in the frame of the ego: set its origin" in bias.text
    assert advice.config.ego.detection_origin_x_m == pytest.approx(-1.5, abs=0.1)
    assert advice.before is not None
    assert advice.after is not None
    rmse_m = [
        one.truth.errors["position_m"].rmse
        for one in (advice.before, advice.after)
        if one.truth is not None
    ]
    assert rmse_m[1] < 0.5 < rmse_m[0]


def delayed(sensor: str, off_ms: int) -> Callable[[DetectionList], DetectionList]:
    return lambda item: (
        restamped(item, item.stamp_ns + off_ms * MS) if item.sensor == sensor else item
    )


@pytest.mark.parametrize(
    "off_s",
    [18, -37, *(pytest.param(each, marks=pytest.mark.slow) for each in (-18, 3600))],
)
def test_a_constant_of_clocks_is_recognised_and_replayed(
    call: Call, off_s: int
) -> None:
    write(changed(delayed("radar", 1000 * off_s), drive(truth=False)))
    advice = fgtrack.advise("drive.jsonl", "c.yaml")
    (clock,) = [one for one in advice.findings if one.settings]
    assert clock.settings == {"sensors.radar.clock_offset_s": off_s}
    assert clock.effect == "used detections of radar rise from 0.0 % to 100 %"
    assert "after the correction its median delay is 40 ms" in clock.text
    assert advice.after is not None
    assert advice.after.used["radar"] > 0.99
    assert not any("stamps" in line for line in advice.fine if "radar" in line)


def test_a_clock_that_is_corrected_already_is_no_finding(call: Call) -> None:
    write(changed(delayed("radar", 18_000), drive(truth=False)))
    Path("c.yaml").write_text(
        CONFIG.replace("radar: {", "radar: {clock_offset_s: 18.0, ")
    )
    advice = fgtrack.advise("drive.jsonl", "c.yaml")
    assert not [one for one in advice.findings if one.kind == "clock"]
    assert any("Fine, radar: stamps: 0 of 150" in line for line in advice.fine)


def test_advice_that_does_not_help_is_withdrawn_with_the_numbers(call: Call) -> None:
    """The stamps lie 23 s before their receipts, which no constant explains, and the window cannot help."""
    write(changed(delayed("radar", -23_000), drive(truth=False)))
    advice = fgtrack.advise("drive.jsonl", "c.yaml")
    assert not advice.changes
    (window,) = [one for one in advice.findings if one.kind == "window"]
    assert (
        "filter.storage_s was replayed, but nothing improves (used detections without"
        in window.text
    )
    assert "radar 0.0 % and 0.0 %" in window.text
    assert not any("use:" in line for line in advice.fine if "radar" in line)
    told = [one for one in advice.findings if one.about == "radar"]
    assert any("no ego pose was known at the stamps of 150" in one.text for one in told)


def moved(sensor: str, by_m: float) -> Callable[[DetectionList], DetectionList]:
    def at(item: DetectionList) -> DetectionList:
        if item.sensor != sensor:
            return item
        (of,) = item.objects
        assert of.x_m is not None
        return replace(item, objects=(replace(of, x_m=of.x_m + by_m),))

    return at


@pytest.mark.parametrize(
    ("by_m", "is_off"),
    [
        (11.0, True),
        (0.5, False),
        pytest.param(-4.0, True, marks=pytest.mark.slow),
    ],
)
def test_sensors_that_disagree_are_never_fine(
    call: Call, by_m: float, is_off: bool
) -> None:
    write(changed(moved("radar", by_m), drive(300, truth=False)))
    advice = fgtrack.advise("drive.jsonl", "c.yaml")
    found = [one for one in advice.findings if one.kind == "agreement"]
    assert bool(found) == is_off
    assert any("frame and mount" in line for line in advice.fine) != is_off
    assert any("noise" in line or "births" in line for line in advice.fine) != is_off
    if is_off:
        assert (
            f"it lies {by_m - 0.1:.1f} m ahead" in found[0].text
            or f"it lies {by_m:.1f} m ahead" in found[0].text
        )


def test_an_ego_whose_positions_do_not_follow_its_speed_is_not_fine(call: Call) -> None:
    standing = [
        replace(item, speed_mps=9.0) if isinstance(item, EgoState) else item
        for item in drive(truth=False)
    ]
    write(standing)
    advice = fgtrack.advise("drive.jsonl", "c.yaml")
    (way,) = [one for one in advice.findings if one.kind == "test"]
    assert (
        way.text
        == "positions against speed: its positions move 2.22 times the way of its speed."
    )
    assert not any("positions against speed" in line for line in advice.fine)


def test_births_that_die_unconfirmed_are_not_fine(call: Call) -> None:
    rng = np.random.default_rng(3)

    def cluttered(item: DetectionList) -> DetectionList:
        false = tuple(
            Detection(x_m=x_m, y_m=y_m)
            for x_m, y_m in rng.uniform((0.0, -60.0), (120.0, 60.0), (1, 2)).tolist()
        )
        return (
            replace(item, objects=(*item.objects, *false))
            if item.sensor == "radar"
            else item
        )

    write(changed(cluttered, drive(truth=False)))
    advice = fgtrack.advise("drive.jsonl", "c.yaml")
    assert not any("births" in line for line in advice.fine)
    assert any(
        one.about == "tracks" and "never confirmed" in one.text
        for one in advice.findings
    )


@pytest.mark.slow
def test_the_page_on_advice_quotes_the_command(call: Call) -> None:
    page = (Path(__file__).parents[2] / "docs/advise.md").read_text()
    quoted = page.partition("```text\n")[2].partition("```")[0]
    assert call("simulate", "default", "-o", "drive.jsonl", "--duration", "60")[0] == 0
    _, text = call("advise", "drive.jsonl")
    for line in quoted.removeprefix("- ").split("\n- "):
        assert " ".join(line.split()) in text


def test_bad_calls(call: Call) -> None:
    write(drive())
    assert advised(call, "drive.jsonl", "--reference", "sonar")[0] == 2
    Path("mine.yaml").write_text("estimator: smoother\n")
    assert advised(call, "drive.jsonl", "-o", "mine.yaml")[0] == 2
    assert advised(call, "nothing.jsonl")[0] == 2
    Path("cut.jsonl").write_text(
        "\n".join(Path("drive.jsonl").read_text().splitlines()[:300]) + '\n{"type": "eg'
    )
    code, text = call("advise", "cut.jsonl", "-c", "c.yaml")
    assert code == 1
    assert "- Fine, ego: " in text
    assert "the messages before are used" in text
