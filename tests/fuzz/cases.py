"""Runs spoilt inputs in a process of their own, and says what is wrong with what comes out."""

import contextlib
import io
import multiprocessing
import resource
import shutil
import tempfile
import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from fgtrack.estimation.failures import Failure
from fgtrack.io.run import load_run
from fuzz.inputs import Files
from fuzz.mutation import mutated
from fuzz.targets import RUN, TARGETS, Target, run

LONGEST_S = 20.0
MOST_BYTES = 10**9
_CASES_PER_PROCESS = 400
_LONGEST_LINE = 2000
_STARTING_S = 120.0


@dataclass(frozen=True)
class Finding:
    """A case that does what no input may make a command do."""

    target: str
    case: int
    problem: str


@cache
def healthy(target: Target) -> Sequence[Files]:
    """The inputs of `target` that are right."""
    return target.healthy()


def files_of(target: Target, seed: int, case: int) -> dict[str, bytes]:
    """The files of a case: always the same ones."""
    rng = np.random.default_rng([seed, case])
    right = healthy(target)
    files = dict(right[rng.integers(len(right))])
    names = sorted(filter(target.spoilt, files))
    for name in rng.choice(names, size=1 if rng.integers(4) else min(2, len(names)), replace=False).tolist():
        files[name] = mutated(rng, name, files[name])
    return files


def fuzz(name: str, seed: int, seconds: float, most: int, keep: Path | None = None) -> tuple[int, list[Finding]]:
    """Number of cases that were run, and what was found; inputs of findings are kept in `keep`."""
    target = next(target for target in TARGETS if target.name == name)
    ends, case, findings = time.monotonic() + seconds, 0, list[Finding]()
    while case < most and time.monotonic() < ends:
        last = min(most, case + _CASES_PER_PROCESS)
        for number, problem in _guarded(name, seed, case, last, ends):
            case = number + 1
            if problem is not None:
                findings.append(Finding(name, number, problem))
                if keep is not None:
                    write(keep / name / str(number), files_of(target, seed, number))
    return case, findings


def write(folder: Path, files: Files) -> None:
    """Write `files` below `folder`."""
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)


def _guarded(name: str, seed: int, first: int, last: int, ends: float) -> Iterator[tuple[int, str | None]]:
    """Cases with what is wrong with each, up to `last`, the time, or one after which the process is gone."""
    ours, theirs = multiprocessing.get_context("spawn").Pipe()
    worker = multiprocessing.get_context("spawn").Process(target=_work, args=(theirs, name, seed, first, last, ends))
    worker.start()
    theirs.close()
    case, limit_s = first, _STARTING_S
    try:
        while ours.poll(limit_s):
            said = ours.recv()
            if said is None:
                return
            if isinstance(said, str):
                assert not said, f"{name}: a healthy input: {said}"
            elif isinstance(said, int):
                case, limit_s = said, 3 * LONGEST_S
            else:
                yield case, said[0]
        yield case, f"hangs: {limit_s:.0f} s and more"
    except EOFError:
        yield case, "kills its process"
    finally:
        worker.kill()
        worker.join()


def _work(pipe: Connection, name: str, seed: int, first: int, last: int, ends: float) -> None:
    target = next(target for target in TARGETS if target.name == name)
    warnings.simplefilter("error")
    warnings.simplefilter("ignore", ResourceWarning)
    with (
        tempfile.TemporaryDirectory() as parent,
        tempfile.TemporaryDirectory(dir=parent) as folder,
        contextlib.chdir(folder),
    ):
        pipe.send(_limit_memory(target))
        for case in range(first, last):
            if time.monotonic() > ends:
                break
            pipe.send(case)
            pipe.send((problem_of(target, files_of(target, seed, case)),))
    pipe.send(None)


def _limit_memory(target: Target) -> str:
    """So much on top of what healthy inputs take; gives what is wrong with one of those."""
    for files in healthy(target):
        problem = problem_of(target, files, right=True)
        if problem is not None:
            return problem
    taken = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (taken + MOST_BYTES, resource.RLIM_INFINITY))
    return ""


def problem_of(target: Target, files: Files, right: bool = False) -> str | None:
    """What is wrong with what the commands make of `files`, in the empty working directory; `right` ones end with 0."""
    write(Path(), files)
    try:
        for words in target.commands:
            started = time.monotonic()
            out, err = io.StringIO(), io.StringIO()
            try:
                with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
                    code = run(words)
            except BaseException as error:  # whatever it is, it is a finding
                return f"{words[0]}: {type(error).__name__} {error}"
            problem = _problem(code, out.getvalue(), err.getvalue()) or _problem_of_run(Path(RUN))
            if problem is None and right and code:
                problem = f"exit code {code} for an input that is right: {err.getvalue().strip()}"
            if problem is None and time.monotonic() - started > LONGEST_S:
                problem = f"takes {time.monotonic() - started:.0f} s"
            if problem is not None:
                return f"{words[0]}: {problem}"
    finally:
        for path in Path().iterdir():
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    return None


def _problem(code: int, out: str, err: str) -> str | None:
    if "internal error" in err or "Traceback" in err:
        return err.strip()[-600:]
    if code not in (0, 1, 2):
        return f"exit code {code}"
    if code and not err.strip():
        return f"exit code {code} without a word"
    for line in (out + err).splitlines():
        if not line.isprintable() or (line in err and len(line) > _LONGEST_LINE):
            return f"prints {line[:200]!r}"
    return None


def _problem_of_run(path: Path) -> str | None:
    """Dispositions that do not add up, states that are none."""
    if not (path / "meta.json").is_file():
        return None
    found = load_run(path)
    if not found.meta.get("complete"):
        return "leaves an incomplete run"
    counted = sum(sum(counts.values()) for counts in found.meta["counts"].values())
    if not len(found.updates) == counted == found.meta["detections_received"]:
        return f"{found.meta['detections_received']} detections, {counted} counted, {len(found.updates)} rows"
    raised = [
        kind for kind in (Failure.LIST_FAILED, Failure.ESTIMATOR_RAISED) if found.meta.get("failures", {}).get(kind)
    ]
    if raised:  # what the guards hide is a defect all the same
        return f"{', '.join(raised)}: {found.meta['first_failure']}"
    for table in (found.tables["tracks"], found.tables["smoothed"]):
        if not table.num_rows:
            continue
        for name in ("x_m", "y_m", "yaw_rad", "speed_mps", *(name for name in table if name.startswith("p_"))):
            if not np.isfinite(table[name]).all():
                return f"{name} is not finite"
            if name in ("p_x_x", "p_y_y", "p_yaw_yaw", "p_speed_speed") and not (table[name] > 0.0).all():
                return f"{name} is not positive"
    return None
