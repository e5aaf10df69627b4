"""Whatever is in a file: no internal error, no warning, no hang, no flood of memory, and every detection counted.

Each case is a healthy input with a few things spoilt, always the same for its seed and number. `make fuzz` takes half
an hour for each kind and keeps what it finds in `out/fuzz`.
"""

import sys
from pathlib import Path

import pytest

from fuzz.cases import files_of, fuzz, healthy, problem_of, write
from fuzz.targets import TARGETS, Target

each_target = pytest.mark.parametrize("target", TARGETS, ids=[target.name for target in TARGETS])
_A_FEW = 4
_SEED = 20_261


@each_target
def test_a_few_spoilt_inputs_of_every_kind(target: Target, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for files in healthy(target):
        assert problem_of(target, files, right=True) is None
    problems = {case: problem_of(target, files_of(target, _SEED, case)) for case in range(_A_FEW)}
    assert not {case: problem for case, problem in problems.items() if problem is not None}


@pytest.mark.slow
@each_target
def test_a_minute_of_spoilt_inputs(target: Target, request: pytest.FixtureRequest) -> None:
    seconds, seed = request.config.getoption("--fuzz-seconds"), request.config.getoption("--fuzz-seed")
    count, findings = fuzz(target.name, seed, seconds, most=10**9, keep=Path("out/fuzz").absolute())
    assert count > 0
    assert not findings, f"{len(findings)} of {count} cases"


@each_target
def test_a_case_is_always_the_same_and_another_one_another(target: Target) -> None:
    assert files_of(target, 1, 2) == files_of(target, 1, 2)
    assert len({str(files_of(target, 1, case)) for case in range(8)}) > 4


def test_a_process_of_its_own_says_how_far_it_came() -> None:
    count, findings = fuzz("delays", _SEED, seconds=300.0, most=3)
    assert (count, findings) == (3, [])


def test_what_is_looked_for_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The judge itself: an internal error, a silent failure, an endless line, an escape, a strange exit code."""
    target = next(target for target in TARGETS if target.name == "delays")
    said = iter([(1, "fgtrack: error: internal error: Boom"), (1, ""), (2, "x" * 10_000), (0, "\x1b[31m"), (7, "what")])

    def fake(words: object) -> int:
        code, text = next(said)
        (sys.stderr if code else sys.stdout).write(f"{text}\n")
        return code

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("fuzz.cases.run", fake)
    for expected in ("internal error", "without a word", "prints", "prints", "exit code 7"):
        problem = problem_of(target, healthy(target)[0])
        assert problem is not None
        assert expected in problem


def test_an_input_that_is_right_must_be_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else nothing but its refusal is fuzzed."""
    target = next(target for target in TARGETS if target.name == "delays")
    wrong = {**healthy(target)[0], "x.yaml": b"radar: {delay: {kind: gamma}}\n"}
    monkeypatch.chdir(tmp_path)
    assert problem_of(target, wrong) is None
    assert "for an input that is right" in str(problem_of(target, wrong, right=True))


def test_a_kept_case_is_written_whole(tmp_path: Path) -> None:
    write(tmp_path / "case", {"in/a.txt": b"1", "b": b""})
    assert (tmp_path / "case/in/a.txt").read_bytes() == b"1"
