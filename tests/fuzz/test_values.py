"""Whatever values are in well-formed data: no abort, no internal error, no warning, and every detection counted.

A case is a healthy file, or a healthy sequence of live messages, in which one or a few values are wrong. It is always
the same for its seed and number. `make fuzz-values` takes 10,000 of such changes and keeps what it finds in `out/fuzz`.
"""

import zlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from support.server import Server

from fuzz import documents, live
from fuzz.running import healthy, problem_of
from fuzz.targets import SHORT, Target

pytestmark = pytest.mark.long
_SEED, _COUNTS = 42, (1, 1, 1, 2, 3)
#: A live case takes a tenth of the time of a file.
_LIVE_SHARE = 12
_SHARES = _LIVE_SHARE * len(live.ESTIMATORS) + len(SHORT)


@lru_cache(maxsize=1)
def case_of(name: str, seed: int, number: int) -> tuple[dict[str, bytes], list[str]]:
    """Return the files of a case, always the same ones, and what was changed."""
    rng = np.random.default_rng([seed, zlib.crc32(name.encode()), number])
    target = SHORT[name]
    right = healthy(target)
    files = dict(right[rng.integers(len(right))])
    names = sorted(
        one
        for one in files
        if one.endswith(tuple(documents.FORMS)) and one.endswith(target.corrupted or "")
    )
    one = str(rng.choice(names))
    files[one], changes = documents.changed(
        rng, one, files[one], int(rng.choice(_COUNTS))
    )
    return files, changes


def findings_in_files(
    server: Server, name: str, seed: int, changes: int, keep: Path
) -> Iterator[str]:
    """Yield what is wrong with the cases of a target, until so many values were changed; their files stay in `keep`."""
    number = 0
    while changes > 0:
        files, said = case_of(name, seed, number)
        target = (
            SHORT[name]
            if number % 4 == 0
            else replace(SHORT[name], commands=_without_info(SHORT[name]))
        )
        problem = problem_of(server, target, files, keep / f"{name}-{number}")
        if problem is not None:
            yield f"{name} {number}: {problem}  [{'; '.join(said)}]"
        number, changes = number + 1, changes - max(len(said), 1)


def _without_info(target: Target) -> list[Sequence[str]]:
    """Return the commands that read all that `info` reads, and do more with it."""
    return [command for command in target.commands if command[0] != "info"]


def findings_in_messages(
    server: Server, name: str, seed: int, changes: int, folder: Path
) -> Iterator[str]:
    """Yield what is wrong with live cases of an estimator, until so many values were changed."""
    number = 0
    while changes > 0:
        done = server(
            [name, str(seed), str(number), str(changes)], folder, call="fuzz.live:main"
        )
        lines = done.said.splitlines()
        for line in lines:
            if line.startswith("case "):
                _, said, count = line.split(" ")
                number, changes = int(said) + 1, changes - int(count)
            else:
                yield f"{name} {number - 1}: {line}"
        if done.code != 0:
            yield f"{name} {number - 1}: ends with {done.code}"
        if not any(line.startswith("case ") for line in lines):
            return  # it ends before its first case, and would do so again


@pytest.mark.parametrize(
    "name",
    [
        name
        if name in ("ekf-replay", "smoother-banded")
        else pytest.param(name, marks=pytest.mark.slow)
        for name in live.ESTIMATORS
    ],
)
def test_a_few_wrong_values_in_live_messages(
    server: Server, name: str, tmp_path: Path
) -> None:
    assert live.case_of(name, _SEED, 1).changes == live.case_of(name, _SEED, 1).changes
    assert list(findings_in_messages(server, name, _SEED, 40, tmp_path)) == []


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow) if name == "sqlite3" else name
        for name in SHORT  # mcap has the same messages
    ],
)
def test_a_few_wrong_values_in_files_of_every_kind(
    server: Server, name: str, tmp_path: Path
) -> None:
    assert case_of(name, _SEED, 0) == case_of.__wrapped__(name, _SEED, 0)
    assert list(findings_in_files(server, name, _SEED, 2, tmp_path)) == []


@pytest.mark.slow
@pytest.mark.parametrize("name", live.ESTIMATORS)
def test_a_drive_without_wrong_values_is_tracked(name: str) -> None:
    assert list(live.problems_of(name, live.healthy())) == []


@pytest.mark.slow
@pytest.mark.parametrize("name", SHORT)
def test_files_without_wrong_values_are_read(
    server: Server, name: str, tmp_path: Path
) -> None:
    for k, files in enumerate(healthy(SHORT[name])):
        assert (
            problem_of(server, SHORT[name], files, tmp_path / f"right-{k}", right=True)
            is None
        )


@pytest.mark.slow
@pytest.mark.parametrize("name", live.ESTIMATORS)
def test_many_wrong_values_in_live_messages(
    server: Server, name: str, request: pytest.FixtureRequest
) -> None:
    changes, seed = (
        request.config.getoption("--changes"),
        request.config.getoption("--fuzz-seed"),
    )
    keep = _folder()
    found = findings_in_messages(
        server, name, seed, -(-_LIVE_SHARE * changes // _SHARES), keep
    )
    assert _kept(keep / f"live-{name}.txt", found) == 0


@pytest.mark.slow
@pytest.mark.parametrize("name", SHORT)
def test_many_wrong_values_in_files(
    server: Server, name: str, request: pytest.FixtureRequest
) -> None:
    changes, seed = (
        request.config.getoption("--changes"),
        request.config.getoption("--fuzz-seed"),
    )
    keep = _folder()
    found = findings_in_files(server, name, seed, -(-changes // _SHARES), keep)
    assert _kept(keep / f"{name}.txt", found) == 0


def _folder() -> Path:
    folder = Path("out/fuzz/values").absolute()
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def _kept(path: Path, found: Iterable[str]) -> int:
    """Write findings as they are found; return their number."""
    count = 0
    with path.open("w", encoding="utf-8", errors="backslashreplace") as file:
        for line in found:
            count += 1
            file.write(f"{line}\n")
            file.flush()
    return count
