"""What is on disk after a kill, a full disk, a folder that is not to be written to: readable and true, and it goes on.

`make faults` kills replay, sweep, convert and simulate a hundred times each, at random moments.
"""

import os
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from support.server import Outcome

from faults.cases import CASES, KILLED, OUT, Bench, Case, bench

COMMANDS = ("replay", "sweep", "convert", "simulate")
each_case = pytest.mark.parametrize("name", CASES)


@pytest.fixture(scope="module")
def here(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    with bench(tmp_path_factory.mktemp("faults")) as made:
        yield made


def kill(here: Bench, case: Case, rng: np.random.Generator) -> tuple[str, list[str]]:
    """Kill `case` at a random moment, or right before one of its changes of files; how it ended, what is wrong."""
    undisturbed, folder = here.undisturbed(case)[1], here.scene(case)
    if rng.random() < 0.5:
        done = here.server(
            case.words, folder, kill_after_s=float(rng.uniform(0.0, undisturbed.took_s))
        )
    else:
        assert undisturbed.changes is not None
        done = here.server(
            case.words, folder, kill_at_change=int(rng.integers(undisturbed.changes))
        )
    problems = (
        [] if done.code in (0, KILLED) else [f"ends with {done.code}: {done.said}"]
    )
    problems += here.problems(case, folder)
    begun = any(
        path.name.startswith(case.out) and path.name != "product.txt"
        for path in folder.iterdir()
    )
    problems += here.goes_on(case, folder)
    return (
        "killed"
        if done.code == KILLED and begun
        else "killed at its beginning"
        if done.code
        else "done",
        problems,
    )


@pytest.mark.parametrize("command", COMMANDS)
def test_a_kill_at_any_moment(
    here: Bench, command: str, request: pytest.FixtureRequest
) -> None:
    count, seed = (
        request.config.getoption("--kills"),
        request.config.getoption("--fuzz-seed"),
    )
    rng = np.random.default_rng([seed, COMMANDS.index(command)])
    cases = [case for case in CASES.values() if case.words[0] == command]
    ends: Counter[str] = Counter()
    findings = []
    for number in range(count):
        case = cases[number % len(cases)]
        end, problems = kill(here, case, rng)
        ends[end] += 1
        findings += [f"{number}, {case.name}, {end}: {problem}" for problem in problems]
    assert not findings, dict(ends)


# --- a disk that is full, folders that are not to be written to


def complains(done: Outcome, *words: str) -> list[str]:
    """What is wrong with how a command says that it cannot write."""
    lines = [
        line for line in done.said.splitlines() if line.startswith("fgtrack: error: ")
    ]
    if (
        done.code not in (1, 2)
        or len(lines) != 1
        or "internal" in done.said
        or "Traceback" in done.said
    ):
        return [f"ends with {done.code}: {done.said}"]
    return [
        f"does not say {word!r}: {lines[0]}" for word in words if word not in lines[0]
    ]


@each_case
def test_a_file_that_cannot_grow(here: Bench, name: str) -> None:
    """Files end after some bytes, as on a full disk: a line says so, what is there is right, and then it goes on."""
    case = CASES[name]
    path = here.undisturbed(case)[0]
    largest = max(
        file.stat().st_size for file in (path.rglob("*") if path.is_dir() else [path])
    )
    folder = here.scene(case)
    done = here.server(case.words, folder, largest_file=largest // 3)
    assert complains(done, "cannot be written", "space") == []
    assert [*here.problems(case, folder), *here.goes_on(case, folder)] == []


@each_case
@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become another user")
def test_a_folder_that_is_not_to_be_written_to(here: Bench, name: str) -> None:
    """Of another user: the command says so, in one line, and changes nothing."""
    case = CASES[name]
    here.undisturbed(case)
    folder = here.scene(case)
    for path in (folder, *folder.parents[: len(folder.parents) - 2]):
        path.chmod(path.stat().st_mode | 0o055)
    before = contents(folder)
    done = here.server(case.words, folder, user=65534)
    assert complains(done, "choose another") == []
    assert contents(folder) == before


def contents(folder: Path) -> dict[str, bytes | None]:
    """Of all files below `folder`, by name; None for a folder."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in folder.rglob("*")
    }


@pytest.mark.parametrize(
    "words",
    [
        ("info", "drive.jsonl"),
        ("config", "-c", "smoother"),
        ("compare", OUT),
        ("compare", OUT, "--json"),
        (),
    ],
)
def test_output_that_is_not_taken(here: Bench, words: tuple[str, ...]) -> None:
    """A full disk behind `>`: a line on stderr, and no success."""
    folder = here.scene(CASES["replay again"])
    done = here.server(words or ("--help",), folder, out="/dev/full")
    assert complains(done, "space") == []
