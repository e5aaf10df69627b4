"""What is on disk after a kill, a full disk, a folder that is not to be written to: readable and true, and it goes on.

`make faults` kills replay, sweep, convert and simulate a hundred times each, at random moments.
"""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from faults.cases import CASES, KILLED, OUT, Bench, Case, bench
from faults.server import Outcome

COMMANDS = ("replay", "sweep", "convert", "simulate")
_A_FEW = ("replay", "replay again", "simulate gzip", "convert mcap again", "convert sqlite3", "sweep")
each_case = pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in _A_FEW else [pytest.mark.slow], id=name) for name in CASES]
)


@pytest.fixture(scope="module")
def here(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    with bench(tmp_path_factory.mktemp("faults")) as made:
        yield made


def kill(here: Bench, case: Case, rng: np.random.Generator) -> tuple[str, list[str]]:
    """Kill `case` at a random moment, or right before one of its changes of files; how it ended, what is wrong."""
    undisturbed, folder = here.undisturbed(case)[1], here.scene(case)
    if rng.random() < 0.5:
        done = here.server(case.words, folder, kill_after_s=float(rng.uniform(0.0, undisturbed.took_s)))
    else:
        assert undisturbed.changes is not None
        done = here.server(case.words, folder, kill_at_change=int(rng.integers(undisturbed.changes)))
    problems = [] if done.code in (0, KILLED) else [f"ends with {done.code}: {done.said}"]
    problems += here.problems(case, folder)
    begun = any(path.name.startswith(case.out) and path.name != "product.txt" for path in folder.iterdir())
    problems += here.goes_on(case, folder)
    return "killed" if done.code == KILLED and begun else "killed at its beginning" if done.code else "done", problems


@pytest.mark.parametrize("command", COMMANDS)
def test_a_few_kills(here: Bench, command: str) -> None:
    rng = np.random.default_rng(7)
    cases = [case for case in CASES.values() if case.words[0] == command]
    for number in range(2):
        case = cases[number % len(cases)]
        assert kill(here, case, rng)[1] == [], case.name


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_a_hundred_kills(here: Bench, command: str, request: pytest.FixtureRequest) -> None:
    count, seed = request.config.getoption("--kills"), request.config.getoption("--fuzz-seed")
    rng = np.random.default_rng([seed, COMMANDS.index(command)])
    cases = [case for case in CASES.values() if case.words[0] == command]
    ends: Counter[str] = Counter()
    findings = []
    for number in range(count):
        case = cases[number % len(cases)]
        end, problems = kill(here, case, rng)
        ends[end] += 1
        findings += [f"{number}, {case.name}, {end}: {problem}" for problem in problems]
    out = Path("out/faults")
    out.mkdir(parents=True, exist_ok=True)
    said = {"kills": count, "ended": dict(ends), "findings": findings}
    (out / f"{command}.json").write_text(json.dumps(said, indent=1) + "\n")
    assert not findings


# --- a disk that is full, folders that are not to be written to


@contextmanager
def small_disk(num_bytes: int) -> Iterator[tuple[Path, Callable[[], None]]]:
    """A file system of so many bytes, and what makes it large; not in `tmp_path`, which pytest could not remove."""
    with tempfile.TemporaryDirectory(prefix="fgtrack-faults-") as place:
        options = ["-t", "tmpfs", "-o", f"size={num_bytes}", "tmpfs", place]
        if shutil.which("mount") is None or subprocess.run(["mount", *options], capture_output=True).returncode:
            pytest.skip("no file system can be mounted here")
        try:
            yield Path(place), lambda: _call("mount", "-o", "remount,size=100m", place)
        finally:
            _call("umount", "--lazy", place)


def _call(*words: str) -> None:
    subprocess.run(words, check=True)


def complains(done: Outcome, *words: str) -> list[str]:
    """What is wrong with how a command says that it cannot write."""
    lines = [line for line in done.said.splitlines() if line.startswith("fgtrack: error: ")]
    if done.code not in (1, 2) or len(lines) != 1 or "internal" in done.said or "Traceback" in done.said:
        return [f"ends with {done.code}: {done.said}"]
    return [f"does not say {word!r}: {lines[0]}" for word in words if word not in lines[0]]


@each_case
def test_a_file_that_cannot_grow(here: Bench, name: str) -> None:
    """Files end after some bytes, as on a full disk: a line says so, what is there is right, and then it goes on."""
    case = CASES[name]
    path = here.undisturbed(case)[0]
    largest = max(file.stat().st_size for file in (path.rglob("*") if path.is_dir() else [path]))
    folder = here.scene(case)
    done = here.server(case.words, folder, largest_file=largest // 3)
    assert complains(done, "cannot be written", "space") == []
    assert [*here.problems(case, folder), *here.goes_on(case, folder)] == []


@pytest.mark.parametrize("name", ["replay", "simulate gzip", "convert mcap", "convert sqlite3", "sweep"])
def test_a_full_disk(here: Bench, name: str) -> None:
    case = CASES[name]
    folder = here.scene(case)
    taken = sum(file.stat().st_size for file in folder.rglob("*"))
    with small_disk(taken + 24 * 4096) as (disk, enlarge):
        shutil.copytree(folder, disk, dirs_exist_ok=True)
        done = here.server(case.words, disk)
        assert complains(done, "cannot be written", "space") == []
        assert list(here.problems(case, disk)) == []
        enlarge()
        assert list(here.goes_on(case, disk)) == []


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
    return {str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


@pytest.mark.parametrize(
    "words", [("info", "drive.jsonl"), ("config", "-c", "smoother"), ("compare", OUT), ("compare", OUT, "--json"), ()]
)
def test_output_that_is_not_taken(here: Bench, words: tuple[str, ...]) -> None:
    """A full disk behind `>`: a line on stderr, and no success."""
    folder = here.scene(CASES["replay again"])
    done = here.server(words or ("--help",), folder, out="/dev/full")
    assert complains(done, "space") == []


# --- workers and schedulers that die


@pytest.mark.slow
def test_a_worker_that_is_killed_at_any_moment(here: Bench) -> None:
    """The sweep ends as it should, or with a line; the same command ends it."""
    case = CASES["sweep"]
    here.undisturbed(case)
    rng = np.random.default_rng(3)
    words = [*case.words[:-1], "2"]
    for _ in range(2):
        folder = here.scene(case)
        with subprocess.Popen(
            [sys.executable, "-m", "fgtrack", *words], cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        ) as process:
            while process.poll() is None and not (workers := busy_children(process.pid)):
                time.sleep(0.02)
            time.sleep(float(rng.uniform(0.0, 3.0)))
            for worker in workers[:1]:
                with suppress(ProcessLookupError):
                    os.kill(worker, signal.SIGKILL)
            said, _ = process.communicate(timeout=300.0)
        assert process.returncode == 0, said.decode()
        assert [*here.problems(case, folder), *here.goes_on(case, folder)] == []


def busy_children(pid: int) -> list[int]:
    """Processes of joblib that the process `pid` has started."""
    asked = subprocess.run(["ps", "-o", "pid=,args=", "--ppid", str(pid)], capture_output=True, text=True)
    return [int(line.split()[0]) for line in asked.stdout.splitlines() if "popen_loky" in line]


@pytest.mark.slow
@pytest.mark.skipif(find_spec("distributed") is None, reason="distributed is not installed (extra `dask`)")
@pytest.mark.parametrize("after_parts", [0, 1])
def test_a_scheduler_that_dies(here: Bench, after_parts: int) -> None:
    """The sweep says so in a line and how to go on, keeps what is done, and goes on."""
    case = CASES["sweep"]
    here.undisturbed(case)
    folder = here.scene(case)
    port = free_port()
    tools = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", str(port)]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    address = f"tcp://127.0.0.1:{port}"
    # With one thread joblib would do the work in the process of the sweep.
    worker_words = [sys.executable, "-m", "distributed.cli.dask_worker", address, "--nthreads", "2", "--no-nanny"]
    with ExitStack() as started:
        scheduler, worker = (
            started.enter_context(subprocess.Popen(words, **quiet))
            for words in ([*tools, "--no-dashboard"], [*worker_words, "--no-dashboard"])
        )
        started.callback(worker.kill)
        started.callback(scheduler.kill)
        words = [sys.executable, "-m", "fgtrack", *case.words[:-2], "--dask", address]
        wait_for_port(port)
        process = started.enter_context(
            subprocess.Popen(words, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        )
        while process.poll() is None and len(list(folder.glob(f"{OUT}/parts/*.json"))) < after_parts:
            time.sleep(0.02)
        if not after_parts:
            while process.poll() is None and not (folder / OUT).exists():
                time.sleep(0.02)
        scheduler.kill()
        said, errors = process.communicate(timeout=300.0)
    assert complains(Outcome(process.returncode, 0.0, errors, None)) == [], said
    assert "start" in errors
    assert [*here.problems(case, folder), *here.goes_on(case, folder)] == []


def free_port() -> int:
    """A port of this machine that nobody listens at."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def wait_for_port(port: int) -> None:
    """Until somebody listens there."""
    end = time.monotonic() + 120.0
    while time.monotonic() < end:
        with suppress(OSError), socket.create_connection(("127.0.0.1", port), 1.0):
            return
        time.sleep(0.1)
    pytest.fail("no scheduler came up")
