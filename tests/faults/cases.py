"""Commands that are disturbed: what they leave behind, and what becomes of it."""

import csv
import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from support.server import Outcome, Server

from fgtrack.core.errors import DataError, FgtrackError
from fgtrack.core.types import Message
from fgtrack.inputs.errors import UntilBreak
from fgtrack.inputs.settings import InputConfig
from fgtrack.inputs.source import open_input
from fgtrack.pipeline.sweep import SWEEP_TABLE
from fgtrack.runs import load_run

OUT = "product"
KILLED = -9
_SWEEP = """format: fgtrack-sweep/1
scenario: single_opponent
config: smoother
duration_s: 0.3
seeds: [1, 2]
estimators: [ekf-replay, ekf-backward-forward]
vary: {association.gate_m: [3.0, 5.0]}
metrics: ["truth.*"]
"""
#: What the user has lying about, inside the products too.
NOTES = {"notes.txt": "mine", "product.txt": "mine, too", "product.part": "and this"}


@dataclass(frozen=True)
class Case:
    """A command, and the older product that it replaces, where there is one."""

    name: str
    words: Sequence[str]
    kind: str
    """Of the product: run, recording or sweep."""
    older: Sequence[str] = ()
    """Words of the command that made what is replaced."""
    out: str = OUT
    """Name of the product."""


_REPLAY = ("replay", "drive.jsonl", "-c", "smoother", "--map", "oval", "-o", OUT)


def _recordings() -> Iterator[Case]:
    forms = {
        "stream": f"{OUT}.jsonl",
        "gzip": f"{OUT}.jsonl.gz",
        "mcap": OUT,
        "sqlite3": OUT,
    }
    for name, out in forms.items():
        storage = ("--storage", name) if name in ("mcap", "sqlite3") else ()
        simulate = (
            "simulate",
            "single_opponent",
            "--duration",
            "4",
            *storage,
            "-o",
            out,
        )
        convert = ("convert", "drive.jsonl", out, *storage)
        yield Case(f"convert {name}", convert, "recording", out=out)
        yield Case(
            f"convert {name} again",
            (*convert, "--overwrite"),
            "recording",
            (*simulate, "--seed", "5"),
            out,
        )
        if name == "gzip":
            yield Case(f"simulate {name}", simulate, "recording", out=out)


CASES = {
    case.name: case
    for case in (
        Case("replay", (*_REPLAY, "-e", "smoother"), "run"),
        Case(
            "replay again",
            (*_REPLAY, "-e", "ekf-replay", "--overwrite"),
            "run",
            (*_REPLAY, "-e", "smoother"),
        ),
        *_recordings(),
        Case("sweep", ("sweep", "sweep.yaml", "-o", OUT, "--jobs", "1"), "sweep"),
    )
}


class Bench:
    """Where the commands run: folders with the user's files, and what undisturbed commands make of them."""

    def __init__(self, folder: Path) -> None:
        self.server = Server()
        self._folder = folder
        self._count = 0
        self._template = folder / "template"
        self._template.mkdir()
        for name, content in NOTES.items():
            (self._template / name).write_text(content)
        (self._template / "sweep.yaml").write_text(_SWEEP)
        done = self.server(
            (
                "simulate",
                "single_opponent",
                "--seed",
                "3",
                "--duration",
                "2",
                "-o",
                "drive.jsonl",
            ),
            self._template,
        )
        assert done.code == 0, done.said
        self._undisturbed: dict[str, tuple[Path, Outcome]] = {}
        self._older: dict[str, Path] = {}

    def scene(self, case: Case) -> Path:
        """A new folder for `case`: the user's files, and the older product."""
        self._count += 1
        folder = self._folder / f"scene-{self._count}"
        if case.older and case.name not in self._older:
            older = self._older[case.name] = self._folder / f"older-{len(self._older)}"
            shutil.copytree(self._template, older)
            done = self.server(case.older, older)
            assert done.code == 0, done.said
        shutil.copytree(self._older.get(case.name, self._template), folder)
        return folder

    def undisturbed(self, case: Case) -> tuple[Path, Outcome]:
        """What `case` makes when nothing disturbs it, and how long it takes."""
        if case.name not in self._undisturbed:
            folder = self.scene(case)
            done = self.server(case.words, folder, kill_at_change=-1)
            assert done.code == 0, done.said
            self._undisturbed[case.name] = folder / case.out, done
        return self._undisturbed[case.name]

    def older(self, case: Case) -> Path | None:
        """The older product of `case`."""
        return self._older[case.name] / case.out if case.older else None

    def problems(self, case: Case, folder: Path) -> Iterator[str]:
        """What is wrong with what a disturbed `case` has left in `folder`."""
        known = {
            path.relative_to(self._template): path for path in self._template.rglob("*")
        }
        for name, path in known.items():
            left = folder / name
            if path.is_file() and (
                not left.is_file() or left.read_bytes() != path.read_bytes()
            ):
                yield f"{name}, a file of the user, was changed"
        for path in folder.iterdir():
            mine = path.name == case.out or (
                path.name.startswith(f"{case.out}.") and path.name.endswith(".part")
            )
            if path.relative_to(folder) not in known and not mine:
                yield f"{path.name} is left"
        try:
            yield from _JUDGES[case.kind](
                folder, case.out, self.undisturbed(case)[0], self.older(case)
            )
        except FgtrackError as error:
            yield f"cannot be read: {error}"

    def goes_on(self, case: Case, folder: Path) -> Iterator[str]:
        """What is wrong with the same command, called again: it finishes, or says that it needs --overwrite."""
        done = self.server(case.words, folder)
        if (
            done.code == 2
            and "--overwrite" in done.said
            and "--overwrite" not in case.words
        ):
            done = self.server((*case.words, "--overwrite"), folder)
        if done.code != 0:
            yield f"does not go on ({done.code}): {done.said}"
        elif not _same(case.kind, folder / case.out, self.undisturbed(case)[0]):
            yield "called again, it gives something else"

    def close(self) -> None:
        """End the server."""
        self.server.close()


@contextmanager
def bench(folder: Path) -> Iterator[Bench]:
    """A bench in the empty `folder`."""
    made = Bench(folder)
    try:
        yield made
    finally:
        made.close()


def _same(kind: str, path: Path, other: Path) -> bool:
    if kind == "run":
        return (
            load_run(path).meta["digest"] == load_run(other).meta["digest"]
            and load_run(path).meta["complete"]
        )
    if kind == "sweep":
        return (path / SWEEP_TABLE).read_bytes() == (other / SWEEP_TABLE).read_bytes()
    return _messages(path) == _messages(other)


def _messages(path: Path) -> tuple[list[Message], str | None]:
    readable = UntilBreak(open_input(path, InputConfig()).messages())
    return list(readable), None if readable.error is None else str(readable.error)


# --- what may be on disk


def _run_problems(
    folder: Path, out: str, undisturbed: Path, older: Path | None
) -> Iterator[str]:
    """A run that says whether it is complete: the older one, the new one, or the beginning of the new one."""
    path = folder / out
    if not (
        path / "meta.json"
    ).exists():  # killed at its beginning: nothing there says that it is a run
        return
    found = load_run(path)
    if (
        older is not None
        and found.meta["estimator"] == load_run(older).meta["estimator"]
    ):
        if any(
            (path / file.name).read_bytes() != file.read_bytes()
            for file in older.iterdir()
        ):
            yield "the older run is neither whole nor gone"
        return
    for file in sorted(undisturbed.glob("*.csv")):
        if file.name == "timing.csv":
            continue
        if not (path / file.name).exists():
            if found.meta["complete"]:
                yield f"{file.name} is missing"
        elif not _is_beginning(path, undisturbed, file.name):
            yield f"{file.name} is no beginning of what it should be"
        elif (
            found.meta["complete"]
            and (path / file.name).stat().st_size != file.stat().st_size
        ):
            yield f"{file.name} is short, and the run says that it is complete"


def _is_beginning(path: Path, undisturbed: Path, name: str) -> bool:
    file = path / name
    return not file.exists() or (undisturbed / name).read_bytes().startswith(
        file.read_bytes()
    )


def _recording_problems(
    folder: Path, out: str, undisturbed: Path, older: Path | None
) -> Iterator[str]:
    """The older recording or the whole new one; in a .part the beginning of the new one, or the older one."""
    right, old = _messages(undisturbed), None if older is None else _messages(older)
    path = folder / out
    old_is_there = old is None
    if path.exists():
        found = _messages(path)
        old_is_there |= found == old
        if found not in (right, old):
            yield f"{out} holds {len(found[0])} of {len(right[0])} messages"
        old_is_there |= found == right
    for part in folder.glob(f"{out}.*.part"):
        if (
            not path.exists() and (part / ".replaced").exists()
        ):  # else it is being removed
            old_is_there |= _messages(part / ".replaced") == old
        inner = part / out if part.is_dir() else part
        if not inner.exists() or (inner.is_dir() and not any(inner.iterdir())):
            continue
        with suppress(
            DataError
        ):  # what was killed at its very beginning says that it is nothing
            messages, _ = _messages(inner)
            if messages != right[0][: len(messages)]:
                yield f"{part.name} is no beginning of what it should be"
    if not old_is_there:
        yield "the older recording is gone before the new one is there"


def _sweep_problems(
    folder: Path, out: str, undisturbed: Path, older: Path | None
) -> Iterator[str]:
    """Parts that are whole, and tables whose rows are right."""
    path = folder / out
    if not path.exists():
        return
    for part in sorted((path / "parts").glob("*.json")):
        if _values(part) != _values(undisturbed / "parts" / part.name):
            yield f"part {part.stem} is not what it should be"
    if (path / SWEEP_TABLE).exists():
        with (
            (path / SWEEP_TABLE).open(newline="") as mine,
            (undisturbed / SWEEP_TABLE).open(newline="") as its,
        ):
            rows = list(csv.reader(its))
            if not all(row in rows for row in [*csv.reader(mine)][1:]):
                yield "sweep.csv has rows that are not right"


def _values(part: Path) -> list[tuple[str, Mapping[str, object]]] | None:
    if not part.exists():
        return None
    return [
        (cell["estimator"], cell["values"]) for cell in json.loads(part.read_text())
    ]


_JUDGES = {
    "run": _run_problems,
    "recording": _recording_problems,
    "sweep": _sweep_problems,
}
