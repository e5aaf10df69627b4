"""The README, the pages and the experiments' READMEs against the code: everything that they show is tried."""

import re
import shlex
import shutil
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from functools import cache
from html import unescape
from importlib import import_module
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple, Union, get_args, get_origin, get_type_hints
from urllib.parse import urlsplit

import matplotlib
import pytest
import typer
from matplotlib import pyplot
from ruamel.yaml import YAML
from support.examples import slow

import fgtrack
from fgtrack.cli.main import COMMANDS, app
from fgtrack.cli.main import run as run_command
from fgtrack.config.keys import sections, settings_page
from fgtrack.config.settings import Config
from fgtrack.config.shipped import Kind, shipped
from fgtrack.config.yaml_file import validate
from fgtrack.estimation.registry import ESTIMATORS
from fgtrack.pipeline.sweep_plan import SweepConfig
from fgtrack.sim.clocks import AnyClock
from fgtrack.sim.delays import AnyDelay
from fgtrack.sim.new_delays import SensorDelays
from fgtrack.sim.scenario import Scenario

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted(
    path.relative_to(ROOT)
    for path in chain(
        ROOT.glob("*.md"), ROOT.glob("docs/*.md"), ROOT.glob("experiments/**/*.md")
    )
)
TUTORIALS = sorted((ROOT / "docs/tutorials").glob("plot_*.py"))


class Block(NamedTuple):
    """A fenced block of a page."""

    page: Path
    line: int
    language: str
    text: str
    skipped: bool
    printed: str | None


@cache
def blocks(page: Path) -> tuple[Block, ...]:
    text = (ROOT / page).read_text(encoding="utf-8")
    found = []
    for fence in re.finditer(
        r"^( *)```([\w-]*)\n(.*?)^\1```$", text, re.DOTALL | re.MULTILINE
    ):
        before, behind = text[: fence.start()], text[fence.end() :]
        output = re.match(r"\s*```text\n(.*?)^```$", behind, re.DOTALL | re.MULTILINE)
        skipped = re.search(r"<!-- not run: [^>]+ -->\s*$", before) is not None
        line = before.count("\n") + 1
        found.append(
            Block(
                page,
                line,
                fence[2],
                fence[3],
                skipped,
                None if output is None else output[1],
            )
        )
    return tuple(found)


@cache
def prose(page: Path) -> str:
    """The page without its fenced blocks."""
    text = (ROOT / page).read_text(encoding="utf-8")
    return re.sub(r"^( *)```.*?^\1```$", "", text, flags=re.DOTALL | re.MULTILINE)


def all_blocks(*languages: str) -> list[Block]:
    return [
        block for page in PAGES for block in blocks(page) if block.language in languages
    ]


# Python

#: Pages with examples; docs/extending.md is followed in a folder of its own, see tests/contract.
PYTHON_PAGES = [
    page
    for page in PAGES
    if page.name != "extending.md"
    and any(block.language == "python" for block in blocks(page))
]


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what the examples name: a recording and a map."""
    folder = tmp_path_factory.mktemp("drive")
    bag = folder / "bag"
    assert (
        run_command(
            [
                "simulate",
                "single_opponent",
                "-o",
                str(bag),
                "--seed",
                "0",
                "--duration",
                "3",
            ]
        )
        == 0
    )
    [recording] = bag.glob("*.mcap")
    shutil.move(recording, folder / "drive.mcap")
    shutil.copy(ROOT / "configs/maps/oval_track.csv", folder / "track.csv")
    return folder


@pytest.mark.parametrize("page", PYTHON_PAGES, ids=str)
def test_python_blocks_run_and_print_what_they_show(
    page: Path,
    drive: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(drive)
    names: dict[str, Any] = {}
    for block in blocks(page):
        if block.language == "python" and not block.skipped:
            exec(compile("\n" * block.line + block.text, str(page), "exec"), names)
            printed = capsys.readouterr().out
            if block.printed is not None:
                assert_same_output(printed, block.printed, f"{page}:{block.line}")


def assert_same_output(found: str, shown: str, where: str) -> None:
    """Equal words; numbers may differ by one unit of the last digit that is shown."""
    words, expected = (
        re.findall(r"[-+]?\d+\.?\d*|[^\s\d]+", found),
        re.findall(r"[-+]?\d+\.?\d*|[^\s\d]+", shown),
    )
    assert len(words) == len(expected), f"{where} prints\n{found}"
    for word, wanted in zip(words, expected, strict=True):
        if re.fullmatch(r"[-+]?\d+\.?\d*", wanted):
            unit = 10.0 ** -len(wanted.partition(".")[2])
            assert abs(float(word) - float(wanted)) < 1.01 * unit, (
                f"{where} prints\n{found}"
            )
        else:
            assert word == wanted, f"{where} prints\n{found}"


@pytest.mark.parametrize("tutorial", slow(*TUTORIALS), ids=lambda path: path.stem)
def test_tutorials_run(
    tutorial: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    matplotlib.use("agg")
    exec(
        compile(tutorial.read_text(encoding="utf-8"), str(tutorial), "exec"),
        {"__name__": "__main__"},
    )
    pyplot.close("all")


# Links


def links(page: Path) -> list[str]:
    return re.findall(r"\]\(([^)\s]+)\)", re.sub(r"`[^`\n]*`", "", prose(page)))


@cache
def anchors(page: Path) -> frozenset[str]:
    titles = re.findall(r"^#+ (.*)$", prose(page), re.MULTILINE)
    return frozenset(
        re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles
    )


@pytest.mark.parametrize("page", PAGES, ids=str)
def test_links_have_targets(page: Path) -> None:
    for link in links(page):
        target = urlsplit(link)
        if target.scheme or target.netloc:
            assert (target.scheme, "." in target.netloc) == ("https", True), (
                f"{page}: {link}"
            )
            continue
        path = (ROOT / page).parent / target.path if target.path else ROOT / page
        assert path.exists(), f"{page}: {link} does not exist"
        if target.fragment:
            assert target.fragment in anchors(path.resolve().relative_to(ROOT)), (
                f"{page}: {link} has no such heading"
            )


def test_pages_named_in_the_code_exist() -> None:
    files = chain(
        *(
            ROOT.glob(f"{folder}/**/*.{end}")
            for folder in ("fgtrack", "configs")
            for end in ("py", "yaml")
        )
    )
    for file in files:
        for name in re.findall(r"docs/[\w/-]+\.md", file.read_text(encoding="utf-8")):
            assert (ROOT / name).is_file(), f"{file}: {name} does not exist"


@pytest.mark.parametrize("page", ["CONTRIBUTING.md", "docs/architecture.md"])
def test_files_named_on_the_pages_for_developers_exist(page: str) -> None:
    for name in re.findall(
        r"`((?:fgtrack|tests|docs|\.ci)/[\w/.]*|CHANGELOG\.md)`", prose(Path(page))
    ):
        assert (ROOT / name).exists(), f"{page}: {name} does not exist"
    for files, test in re.findall(
        r"^\| [^|]+ \| `(.+)` \| `(.+)` \|$", prose(Path(page)), re.MULTILINE
    ):
        for file in files.split("`, `"):
            assert (ROOT / "fgtrack" / file).exists(), f"{page}: {file} does not exist"
        assert (ROOT / "tests" / test).exists(), f"{page}: {test} does not exist"


def test_the_way_of_a_detection_names_functions_that_exist() -> None:
    text = prose(Path("docs/architecture.md"))
    rows = re.findall(r"^\| \d+ \| (.+?) \| (.+?) \| .+ \|$", text, re.MULTILINE)
    assert len(rows) == 10
    for functions, files in rows:
        for file in re.findall(r"`(.+?)`", files):
            source = (ROOT / "fgtrack" / file).read_text(encoding="utf-8")
            for function in re.findall(r"`(.+?)`", functions):
                assert f"def {function}(" in source, f"{file} has no {function}"


def test_the_picture_of_the_architecture_shows_the_imports(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pytest.importorskip("grimp", reason="import-linter is not installed")
    monkeypatch.syspath_prepend(str(ROOT / "docs/_ext"))
    graph = import_module("import_graph")
    shown = unescape((ROOT / "docs/architecture.svg").read_text(encoding="utf-8"))
    assert graph.described(graph.imports()[0]) in shown, "run `make picture`"


# Commands


def command_lines() -> Iterator[tuple[str, str]]:
    for page in PAGES:
        for block in blocks(page):
            if block.language in ("", "sh"):
                for line in block.text.splitlines():
                    if re.match(r"(\.venv/bin/)?fgtrack ", line):
                        yield f"{page}", line
        for line in re.findall(r"`(fgtrack [^`]+)`", prose(page)):
            yield f"{page}", line
    for file in sorted(ROOT.glob("configs/**/*.yaml")):
        for line in re.findall(
            r"^# +(fgtrack .*)$", file.read_text(encoding="utf-8"), re.MULTILINE
        ):
            yield str(file.relative_to(ROOT)), line


#: Parameters that name a shipped file, and the kind of file.
SHIPPED: dict[str, Kind] = {
    "config_file": "configuration",
    "scenario_file": "scenario",
    "sweep_name": "sweep",
}


@pytest.mark.parametrize(("where", "line"), list(command_lines()))
def test_command_lines_can_be_parsed(where: str, line: str) -> None:
    words = shlex.split(re.sub(r"[\[\]]", "", line), comments=True)[1:]
    group = typer.main.get_command(app)
    if words[0].startswith("-"):
        assert words[0] in {
            option for parameter in group.params for option in parameter.opts
        } | {"--help"}, where
        return
    assert words[0] in COMMANDS, where
    with group.make_context("fgtrack", list(words)) as context:
        command = group.resolve_command(context, words)[1]  # type: ignore[attr-defined]
        given, _, _ = command.make_parser(command.context_class(command)).parse_args(
            list(words[1:])
        )
    for parameter, kind in SHIPPED.items():
        name = given.get(parameter)
        if isinstance(name, str) and re.fullmatch("[a-z0-9_]+", name):
            assert name in shipped(kind), f"{where}: there is no shipped {kind} {name}"
    for setting in given.get("settings") or []:
        key, equals, _ = setting.partition("=")
        assert equals
        assert key == "key" or is_key(Config, key.split(".")), (
            f"{where}: there is no {key}"
        )
    for name in (given.get("estimators") or "NAME").split(","):
        assert name in ESTIMATORS or name.isupper() or not name.strip("."), (
            f"{where}: there is no {name}"
        )


#: Files of a reader, and what stands for them.
OWN = {
    "RECORDING": "drive.mcap",
    "INPUT": "drive.mcap",
    "OUT": "copy.jsonl",
    "TRACK.csv": "track.csv",
    "FILE.yaml": "late.yaml",
    "RUN": "runs/ekf-replay",
    "out/demo/runs": "runs",
}
#: Commands that need recordings that are not here, a cluster, or many minutes.
ELSEWHERE = re.compile(
    r"00_00_01|kitti|results\.json|dask|race\.jsonl|default-10\d|sweep (delay|karle2023_table)"
    r"|simulate race|fgtrack verify( |$)(?!-e)"
)


@pytest.mark.slow
@pytest.mark.parametrize(
    "page", [page for page in PAGES if page.name != "extending.md"], ids=str
)
def test_commands_in_blocks_of_a_page_run(
    page: Path, studied: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(studied)
    for block in blocks(page):
        for line in (
            block.text.splitlines()
            if block.language in ("", "sh") and not block.skipped
            else ()
        ):
            words = shlex.split(
                re.sub(r"^\.venv/bin/", "", re.sub(r"[\[\]]", "", line)), comments=True
            )
            if words[:1] == ["fgtrack"] and not ELSEWHERE.search(line):
                arguments = [
                    OWN.get(word.removesuffix("..."), word) for word in words[1:]
                ]
                writes = {"-o", "--write", "--figure", "convert", "simulate"} & set(
                    arguments
                )
                overwrite = (
                    ["--overwrite"] if writes and "--overwrite" not in arguments else []
                )
                assert run_command([*arguments, *overwrite]) == 0, f"{page}: {line}"


@pytest.fixture(scope="module")
def studied(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what the commands name: a recording, its map, delays, a configuration and runs."""
    folder = tmp_path_factory.mktemp("studied")
    shutil.copy(ROOT / "configs/maps/oval_track.csv", folder / "track.csv")
    (folder / "late.yaml").write_text("radar: {delay: {kind: none}}\n")
    bag = folder / "bag"
    assert run_command(["simulate", "default", "-o", str(bag), "--duration", "12"]) == 0
    [recording] = bag.glob("*.mcap")
    for name in ("drive.mcap", "a.mcap", "b.mcap", "c.mcap"):
        shutil.copy(recording, folder / name)
    names = [
        "-e",
        "smoother,ekf-replay,ekf-backward-forward",
        "-o",
        str(folder / "runs"),
    ]
    assert (
        run_command(
            [
                "replay",
                str(folder / "drive.mcap"),
                "-c",
                "tuned",
                "--map",
                "oval",
                *names,
            ]
        )
        == 0
    )
    return folder


@pytest.mark.parametrize(
    "block", all_blocks("", "sh"), ids=lambda block: f"{block.page}:{block.line}"
)
def test_scripts_that_are_called_exist(block: Block) -> None:
    for script in re.findall(r"^python ([\w/.]+\.py)", block.text, re.MULTILINE):
        assert (ROOT / script).is_file(), f"{block.page}: {script}"
    for target in re.findall(r"^make ([\w-]+)", block.text, re.MULTILINE):
        assert re.search(
            rf"^{target}:",
            (ROOT / "Makefile").read_text(encoding="utf-8"),
            re.MULTILINE,
        )


# Settings and files


def is_key(hint: Any, names: list[str]) -> bool:
    """Whether a value of type `hint` has the key `names`; in a mapping or list any name goes."""
    if not names:
        return True
    if is_dataclass(hint):
        hints = get_type_hints(hint)
        return names[0] in {f.name for f in fields(hint)} and is_key(
            hints[names[0]], names[1:]
        )
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Union or type(hint).__name__ == "UnionType":
        return any(is_key(one, names) for one in arguments)
    if origin is not None and arguments:
        return is_key(
            arguments[-1] if arguments[-1] is not Ellipsis else arguments[0], names[1:]
        )
    return False


@pytest.mark.parametrize("page", PAGES, ids=str)
def test_settings_that_are_named_exist(page: Path) -> None:
    roots = {field.name: Config for field in fields(Config)} | {"scenario": Scenario}
    if page.name == "metrics.md":
        del roots["sensors"]  # there a part of metrics.json
    for key in re.findall(r"`([a-z_]+(?:\.\w+)+)`", prose(page)):
        names = key.split(".")
        if names[0] in roots and names[-1] not in ("csv", "json", "png", "yaml"):
            names = names[1:] if names[0] == "scenario" else names
            is_known = is_key(roots[key.split(".")[0]], names)
            is_known |= page.name == "scenarios.md" and is_key(Scenario, names)
            assert is_known, f"{page}: there is no key {key}"


@pytest.mark.parametrize(
    "block", all_blocks("yaml"), ids=lambda block: f"{block.page}:{block.line}"
)
def test_yaml_blocks_are_valid_files(block: Block) -> None:
    raw = YAML(typ="safe", pure=True).load(block.text)
    kind: Any = dict[str, SensorDelays]
    if "format" in raw:
        kind = SweepConfig
    elif set(raw) <= {field.name for field in fields(Config)}:
        kind = Config
    elif set(raw) <= {field.name for field in fields(Scenario)}:
        kind = Scenario
    validate(kind, raw, f"{block.page}:{block.line}")


@pytest.mark.parametrize(
    "model", [*get_args(get_args(AnyDelay)[0]), *get_args(get_args(AnyClock)[0])]
)
def test_every_delay_and_clock_model_has_a_row_with_its_parameters(model: Any) -> None:
    names = ", ".join(
        f"`{field.name}`" for field in fields(model) if field.name != "kind"
    )
    assert f"| `{model.kind}` | {names}{' ' if names else ''}|" in (
        ROOT / "docs/delays.md"
    ).read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("page", "mark", "names"),
    [
        (
            "estimators",
            "`{}`",
            [name for name in ESTIMATORS if name not in ESTIMATORS.sources()],
        ),
        ("api", "`{}`", [name for name in dir(fgtrack) if not name.startswith("_")]),
        ("configuration", "| `{}` |", [field.name for field in fields(Config)]),
    ],
)
def test_every_name_is_on_its_page(page: str, mark: str, names: list[str]) -> None:
    text = (ROOT / f"docs/{page}.md").read_text(encoding="utf-8")
    assert [name for name in names if mark.format(name) not in text] == []


@pytest.mark.parametrize(("kind", "least"), [(Config, 20), (Scenario, 15)])
def test_every_setting_has_a_meaning_in_the_reference(kind: type, least: int) -> None:
    found = list(sections(kind))
    assert len(found) > least
    lacking = [
        f"{section.path}.{one.name}"
        for section in found
        for one in section.settings
        if not one.doc
    ]
    inherited = (".mount.", ".motion.")
    lacking = [name for name in lacking if not any(part in name for part in inherited)]
    assert lacking == []


def test_the_page_on_scenarios_holds_every_key() -> None:
    text = (ROOT / "docs/scenarios.md").read_text(encoding="utf-8")
    _, _, table = text.partition("## Every key\n\n")
    assert (
        table.strip() == settings_page("fgtrack.sim.scenario:Scenario", "###").strip()
    )


def test_the_metrics_that_are_explained_exist() -> None:
    run = fgtrack.replay(
        fgtrack.simulate("single_opponent", duration_s=2.0), "smoother", map="oval"
    )
    paths = list(leaves(fgtrack.compare(run).to_dict()["runs"]))
    cells = re.findall(r"^\| (`.+?) \|", prose(Path("docs/metrics.md")), re.MULTILINE)
    for name in re.findall(r"`([^`]+)`", " ".join(cells)):
        pattern = re.sub(r"[A-Z]+", r"[^.]+", name.strip("."))
        assert any(re.search(rf"(^|\.){pattern}(\.|$)", path) for path in paths), name


def leaves(value: Any, path: str = "") -> Iterator[str]:
    """Paths of all values of nested mappings and lists."""
    for key, inner in (
        value.items()
        if isinstance(value, dict)
        else enumerate(value)
        if isinstance(value, list)
        else ()
    ):
        yield from leaves(inner, f"{path}.{key}")
    yield path


def test_the_first_lines_of_the_readme_give_numbers_of_its_table() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    lead, _, rest = text.partition("## The problem")
    table = rest.split("## What the comparison shows")[1].split("\n## ")[0]
    interval = r"([+-]?[\d.]+)( %)? \(([+-]?[\d.]+) to ([+-]?[\d.]+)\)"

    def sizes(part: str) -> set[tuple[float, ...]]:
        return {
            (abs(float(value)), *sorted((abs(float(low)), abs(float(high)))))
            for value, _, low, high in re.findall(interval, part)
        }

    assert len(sizes(lead)) == 4
    assert sizes(lead) <= sizes(table)
