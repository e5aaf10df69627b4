"""Names of built-in parts and of plug-ins, and what is said where one of them is wrong."""

import logging
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from fgtrack.config.reading import read_scenario
from fgtrack.config.yaml_file import plain
from fgtrack.core.errors import CallError
from fgtrack.core.plugins import Alias, Registry
from fgtrack.estimation.base import Measurement, Start, UpdateStatus
from fgtrack.estimation.registry import (
    ESTIMATORS,
    MOTION_MODELS,
    estimator,
    estimator_bank,
    motion_model,
)
from fgtrack.models.measurement import measurement_model
from fgtrack.models.motion import CV
from fgtrack.pipeline.sweep import run_job

GROUP = "fgtrack.tests"


def installed(folder: Path, package: str, **entries: str) -> None:
    info = folder / f"{package}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n"
    )
    lines = [f"{name} = {value}" for name, value in entries.items()]
    (info / "entry_points.txt").write_text("\n".join([f"[{GROUP}]", *lines, ""]))


@pytest.fixture
def registry(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Registry:
    (tmp_path / "sound_plugin.py").write_text("class Part:\n    pass\n")
    (tmp_path / "leaving_plugin.py").write_text("raise SystemExit(0)\n")
    (tmp_path / "broken_plugin.py").write_text("import no_such_module\n")
    installed(
        tmp_path,
        "sound",
        part="sound_plugin:Part",
        ours="sound_plugin:Part",
        old="sound_plugin:Part",
    )
    installed(
        tmp_path,
        "wrecked",
        wrong="broken_plugin:Part",
        part="broken_plugin:Part",
        zero="leaving_plugin:Part",
    )
    monkeypatch.syspath_prepend(tmp_path)
    return Registry(
        "part",
        {GROUP: {"ours": "pathlib:Path"}},
        aliases={"old": Alias("ours", "It is ours.")},
    )


def test_built_in_parts_come_first_and_plug_ins_are_loaded_by_name(
    registry: Registry,
) -> None:
    assert list(registry) == ["ours", "part", "wrong", "zero"]
    assert registry.load("ours") is Path
    assert registry.load("part").__module__ == "sound_plugin"
    assert list(registry.sources()) == ["part", "wrong", "zero"]


def test_the_source_of_a_plug_in_follows_its_code(
    registry: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its version may stay, as where it is being written."""
    monkeypatch.delitem(sys.modules, "sound_plugin", raising=False)  # of another test
    before = registry.sources()
    (tmp_path / "sound_plugin.py").write_text("class Part:\n    better = True\n")
    after = registry.sources()
    assert {name for name in before if before[name] != after[name]} == {"part"}
    assert after["wrong"].startswith("wrecked 1.0 ")


def test_a_name_that_is_taken_is_left_out_with_a_line(
    registry: Registry, caplog: pytest.LogCaptureFixture
) -> None:
    assert registry.load("ours") is Path
    assert [
        record.getMessage()
        for record in caplog.records
        if record.levelno == logging.WARNING
    ] == [
        "part 'old' of sound 1.0 is not loaded: the name belongs to fgtrack; rename the entry point",
        "part 'ours' of sound 1.0 is not loaded: the name belongs to fgtrack; rename the entry point",
        "part 'part' of wrecked 1.0 is not loaded: the name belongs to sound 1.0; rename the entry point",
    ]


def test_a_broken_plug_in_is_named_and_does_not_disturb_the_others(
    registry: Registry, caplog: pytest.LogCaptureFixture
) -> None:
    with pytest.raises(
        CallError,
        match=r"^part 'wrong': plug-in broken_plugin:Part of wrecked 1\.0 cannot",
    ) as error:
        registry.load("wrong")
    assert "No module named 'no_such_module'" in str(error.value)
    assert "\n" not in str(error.value)
    caplog.clear()
    assert set(registry.loaded(GROUP)) >= {"ours"}
    assert "part 'wrong': plug-in broken_plugin:Part" in caplog.text


def test_an_unknown_name_gives_the_nearest_and_all(registry: Registry) -> None:
    with pytest.raises(
        CallError,
        match=r"^part 'prt' is unknown, did you mean 'part': there are ours, part, wrong",
    ):
        registry.resolve("prt")


def test_a_former_name_gives_the_present_part_with_a_warning(
    registry: Registry, caplog: pytest.LogCaptureFixture
) -> None:
    assert registry.load("old") is Path
    assert caplog.messages[-1] == "part 'old' is now named 'ours'. It is ours."


@pytest.mark.parametrize("name", list(ESTIMATORS))
def test_every_estimator_is_made_by_name(name: str) -> None:
    motion = CV()
    one = estimator(name, motion, Start(position_m=(1.0, 2.0)), lag_s=1.0)
    z = one.state_at(0).mean[:2]
    assert z.tolist() == [1.0, 2.0]
    measurement = Measurement(
        10**9 // 2, measurement_model(("x_m", "y_m"), motion), z, np.eye(2)
    )
    assert one.update(measurement).status is UpdateStatus.IN_SEQUENCE
    assert one.window_ns[1] == 10**9 // 2


def test_options_that_an_estimator_does_not_take_are_refused() -> None:
    start = Start()
    with pytest.raises(
        CallError,
        match=r"^ekf-replay: .*'hold_s'; its options are initiation, lagged_s$",
    ):
        estimator("ekf-replay", CV(), start, hold_s=0.1)
    with pytest.raises(
        CallError, match="unknown option 'ring'; its options are late, ring_s"
    ):
        estimator("smoother", CV(), start, ring=0.1)
    with pytest.raises(CallError, match="smoother: max_iterations: must lie between"):
        estimator("smoother", CV(), start, max_iterations=0)
    with pytest.raises(
        CallError, match=r"cv: .*'drag'; its options are velocity_density_m2ps3"
    ):
        motion_model("cv", {"drag": 0.1})


class Raising:
    """A part that cannot be made."""

    def __init__(self, *_: object) -> None:
        raise RuntimeError("oh")


class Leaving:
    """A part that ends the program."""

    def __init__(self, *_: object) -> None:
        raise SystemExit(0)


class LackingBank:
    """A bank that is none."""

    bank = True

    def __init__(self, motion: object, lag_s: float) -> None:
        pass


@pytest.mark.parametrize(
    ("part", "message"),
    [
        (Raising, r"plug-in x:Y of odd 1\.0 cannot be made \(RuntimeError: oh\)"),
        (Leaving, r"plug-in x:Y of odd 1\.0 cannot be made \(SystemExit: 0\)"),
        (5, r"odd: 5 is not a class or function: correct the entry point"),
        (LackingBank, r"'odd' makes a LackingBank, which lacks a member of TrackBank"),
    ],
    ids=["raises", "leaves", "number", "bank"],
)
def test_a_part_that_cannot_be_made_is_one_line(
    monkeypatch: pytest.MonkeyPatch, part: object, message: str
) -> None:
    package = SimpleNamespace(name="odd", version="1.0")
    entry = SimpleNamespace(
        dist=package, load=lambda: part, group="fgtrack.estimators", value="x:Y"
    )
    for registry in (ESTIMATORS, MOTION_MODELS):
        monkeypatch.setitem(registry._entries, "odd", entry)
    with pytest.raises(CallError, match=message):
        estimator("odd", CV(), Start())
    with pytest.raises(CallError, match=message):
        estimator_bank("odd", CV(), 1.0, {}).birth(0, Start())
    if part is not LackingBank:
        with pytest.raises(CallError, match=message):
            motion_model("odd", {})


def test_what_a_job_raises_is_the_error_of_a_cell(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def leaves(*_: object) -> None:
        raise SystemExit(0)

    scenario = {**plain(read_scenario("single_opponent")), "duration_s": 0.1}
    recipe = {
        "config": {},
        "recording": None,
        "scenario": scenario,
        "seed": 0,
        "estimators": ("ekf-replay",),
    }
    monkeypatch.setattr("fgtrack.pipeline.sweep.replay_in_memory", leaves)
    assert [cell.error for cell in run_job("key", recipe, leaves)[1]] == [
        "SystemExit: 0"
    ]
