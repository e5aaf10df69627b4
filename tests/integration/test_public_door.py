"""The public names of `import fgtrack`: what the commands do, in a few lines, without importing more than is used."""

import ast
import pydoc
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import fgtrack

DESIGN = Path(__file__).parents[3] / "shared" / "DESIGN.md"
MS = 1_000_000


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a recording of 3 s, the map it was driven on, and a run of it."""
    folder = tmp_path_factory.mktemp("drive")
    bag = fgtrack.simulate(
        "single_opponent", seed=1, duration_s=3.0, out=folder / "bag"
    )
    next(bag.glob("*.mcap")).rename(folder / "drive.mcap")
    shutil.copy(
        Path(__file__).parents[2] / "configs/maps/oval_track.csv", folder / "track.csv"
    )
    fgtrack.replay(
        folder / "drive.mcap",
        "smoother",
        map=folder / "track.csv",
        out=folder / "runs/x",
    )
    return folder


def test_importing_the_package_imports_nothing_heavy_and_a_name_only_what_it_needs() -> (
    None
):
    code = (
        "import sys, fgtrack\n"
        "heavy = {'gtsam', 'matplotlib', 'scipy', 'numpy', 'rosbags', 'pydantic', 'joblib'}\n"
        "print(sorted(heavy & set(sys.modules)))\n"
        "fgtrack.CTRV, fgtrack.Detection\n"
        "print(sorted(heavy & set(sys.modules)))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines() == ["[]", "['numpy']"]


def test_every_public_name_is_there_and_documented() -> None:
    names = [name for name in dir(fgtrack) if not name.startswith("_")]
    assert {
        "replay",
        "simulate",
        "load_run",
        "compare",
        "Tracker",
        "estimator",
        "plot",
        "testing",
    } <= set(names)
    for name in names:
        assert getattr(fgtrack, name).__doc__, name
    with pytest.raises(AttributeError, match="no attribute 'reply'"):
        _ = fgtrack.reply


LAZY = (fgtrack, fgtrack.evaluation, fgtrack.show, fgtrack.sim)


@pytest.mark.parametrize("package", LAZY, ids=lambda package: package.__name__)
def test_type_checkers_see_the_names_that_are_loaded(package: Any) -> None:
    nodes = ast.walk(ast.parse(Path(package.__file__).read_text(encoding="utf-8")))
    imports = [
        node
        for node in nodes
        if isinstance(node, ast.ImportFrom)
        and node.module.startswith("fgtrack")
        and node.module != "fgtrack.core.lazy"
    ]
    seen = {alias.asname: node.module for node in imports for alias in node.names}
    assert seen == package._HOMES
    assert sorted(seen) == package.__all__


@pytest.mark.parametrize(
    "package", [*LAZY[1:], fgtrack.config, fgtrack.plot, fgtrack.testing]
)
def test_every_name_of_a_public_module_is_the_object_and_not_a_module(
    package: Any,
) -> None:
    """A name must not be that of a module of the package: importing the module would replace the object."""
    for name in package.__all__:
        assert not isinstance(getattr(package, name), ModuleType), name
    with pytest.raises(AttributeError):
        _ = package.no_such_name


def test_a_star_import_and_the_help_show_the_public_names_alone() -> None:
    names: dict[str, object] = {}
    exec("from fgtrack import *", names)
    assert sorted(names.keys() - {"__builtins__"}) == fgtrack.__all__
    page = pydoc.plain(pydoc.render_doc(fgtrack))
    assert [name for name in fgtrack.__all__ if name not in page] == []
    assert dir(fgtrack.plot) == sorted(fgtrack.plot.__all__)


def test_the_pages_of_the_python_api_have_every_public_name(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    docs = Path(__file__).parents[2] / "docs"
    monkeypatch.syspath_prepend(docs / "_ext")
    import reference

    overview = (docs / "api.md").read_text(encoding="utf-8")
    generated = reference.public_names()
    for name in fgtrack.__all__:
        assert f"`{name}`" in overview, name
        assert f":: fgtrack.{name}" in generated or f":: {name}." in generated, name


def test_a_run_in_memory_a_run_folder_and_the_command_give_the_same_run(
    drive: Path, tmp_path: Path
) -> None:
    from fgtrack.cli.main import run as command

    kept = fgtrack.replay(drive / "drive.mcap", "smoother", map=drive / "track.csv")
    arguments = (
        "replay",
        drive / "drive.mcap",
        "-c",
        "smoother",
        "--map",
        drive / "track.csv",
        "-o",
        tmp_path / "run",
    )
    assert command([str(argument) for argument in arguments]) == 0
    for other in (
        fgtrack.load_run(drive / "runs/x"),
        fgtrack.load_run(tmp_path / "run"),
    ):
        assert kept.meta["digest"] == other.meta["digest"]
        for table in (
            "tracks",
            "updates",
            "smoothed",
            "lagged",
            "truth",
            "ego",
            "detections",
        ):
            mine, theirs = getattr(kept, table), getattr(other, table)
            assert list(mine) == list(theirs)
            for column in mine:
                np.testing.assert_array_equal(
                    mine[column], theirs[column], err_msg=f"{table}.{column}"
                )


def test_settings_estimator_and_messages_can_be_given(drive: Path) -> None:
    messages = list(fgtrack.simulate("single_opponent", seed=1, duration_s=1.0))
    run = fgtrack.replay(
        messages,
        "smoother",
        estimator="ekf-replay",
        set={"filter.storage_s": 2.0},
        map="oval",
    )
    assert run.meta["estimator"] == "ekf-replay"
    assert run.config["filter"]["storage_s"] == 2.0
    again = fgtrack.replay(
        iter(messages), fgtrack.Config(), set={"association.max_distance_m": 3.0}
    )
    assert again.config["association"]["max_distance_m"] == 3.0
    assert set(again.config["sensors"]) == {
        "lidar_cluster",
        "radar",
    }  # those of the messages
    with pytest.raises(fgtrack.CallError, match=r"filter\.storage"):
        fgtrack.replay(messages, "smoother", set={"filter.storage": 2.0})


def test_an_input_that_breaks_off_is_a_warning(drive: Path, tmp_path: Path) -> None:
    path = fgtrack.simulate(
        "single_opponent", duration_s=1.0, out=tmp_path / "drive.jsonl"
    )
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.warns(UserWarning, match="broke off"):
        run = fgtrack.replay(path, "smoother")
    assert run.meta["broken_off"]
    assert run.tables["tracks"].num_rows


@pytest.mark.skipif(
    not DESIGN.exists(),
    reason="the design, which has the snippet, is not beside the repository",
)
def test_the_snippet_of_the_design_runs_as_written(
    drive: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    section = DESIGN.read_text().partition("## 12.")[2].partition("## 13.")[0]
    snippet = section.partition("```python\n")[2].partition("```")[0]
    monkeypatch.chdir(drive)
    stamp_ns = 1_600_000_000_000_000_000
    known = {
        "stamp_ns": stamp_ns,
        "receipt_ns": stamp_ns + 60 * MS,
        "now_ns": stamp_ns + 60 * MS,
        "track_id": 0,
    }
    scope = known | {"x_m": 0.0, "y_m": 0.0, "yaw_rad": 0.0, "speed_mps": 60.0}
    exec(compile(snippet, str(DESIGN), "exec"), scope)
    assert scope["report"].tracks[0].track_id == 0
    assert Path("errors.pdf").read_bytes().startswith(b"%PDF")
    assert "tracking" in str(scope["tables"]).lower()
    assert Path("drive.jsonl").exists()


@pytest.mark.parametrize("wrong", [5, np.array([1.0])], ids=repr)
def test_an_argument_of_another_type_is_named(wrong: object) -> None:
    """One line that says which, wherever a user comes in."""
    calls: dict[str, Callable[[], object]] = {
        "recording": lambda: fgtrack.replay(wrong),
        "config": lambda: fgtrack.replay("x.jsonl", wrong),
        "map": lambda: fgtrack.replay("x.jsonl", map=wrong),
        "pit_map": lambda: fgtrack.advise("x.jsonl", pit_map=wrong),
        "out": lambda: fgtrack.replay("x.jsonl", out=wrong),
        "scenario": lambda: fgtrack.simulate(wrong),
        "seed": lambda: fgtrack.simulate(seed=wrong if wrong != 5 else -5),
        "runs": lambda: fgtrack.compare(wrong),
        "recordings?": lambda: fgtrack.tune(wrong),
        "name": lambda: fgtrack.estimator(wrong, fgtrack.CTRV(), fgtrack.Start()),
        "motion": lambda: fgtrack.estimator("ekf-replay", wrong, fgtrack.Start()),
        "start": lambda: fgtrack.estimator("ekf-replay", fgtrack.CTRV(), wrong),
        "lag_s": lambda: fgtrack.estimator(
            "ekf-replay", fgtrack.CTRV(), fgtrack.Start(), lag_s=[wrong]
        ),
    }
    for name, call in calls.items():
        with pytest.raises(fgtrack.CallError, match=f"^{name}: "):
            call()


def test_a_run_and_a_comparison_show_themselves_in_a_few_lines(
    drive: Path, tmp_path: Path
) -> None:
    run = fgtrack.load_run(drive / "runs/x")
    tables = fgtrack.compare(run)
    for one in (run, tables):
        lines = repr(one).splitlines()
        assert 3 <= len(lines) <= 12
        assert max(map(len, lines)) < 300
    assert "estimator: smoother" in repr(run)
    assert run._repr_html_().startswith("<pre>Run\n")
    assert "<table>" in tables._repr_html_()


def test_the_configuration_of_a_run_is_accepted_wherever_a_configuration_is(
    drive: Path,
) -> None:
    """It is a mapping, which `Config.from_dict` reads."""
    run = fgtrack.load_run(drive / "runs/x")
    config = fgtrack.Config.from_dict(run.config)
    assert config.estimator == "smoother"
    assert fgtrack.Tracker(run.config).config == config
    again = fgtrack.replay(drive / "drive.mcap", run.config)
    assert again.meta["digest"] == run.meta["digest"]
    other = fgtrack.replay(
        drive / "drive.mcap", run.config, set={"smoother.lag_s": 0.5}
    )
    assert other.config == {
        **run.config,
        "smoother": {**run.config["smoother"], "lag_s": 0.5},
    }
    with pytest.raises(fgtrack.CallError, match="not a noise parameter of the conf"):
        fgtrack.tune(drive / "drive.mcap", run.config, keep=["smoother.lag_s"])
    with pytest.raises(fgtrack.CallError, match=r"smoother\.lag: "):
        fgtrack.Tracker({"smoother": {"lag": 1.0}})
    with pytest.raises(fgtrack.CallError, match="must be a mapping of settings"):
        fgtrack.Config.from_dict("smoother")
