"""Whatever is in a file: no internal error, no warning, no hang, no flood of memory, and every detection counted.

Each case is a healthy input with a few things corrupted, always the same for its seed and number. `make fuzz` takes
half an hour for each kind and keeps what it finds in `out/fuzz`.
"""

import time
from pathlib import Path

import numpy as np
import pytest
from support.server import Server

from fuzz.mutation import mutated
from fuzz.running import healthy, problem_of
from fuzz.targets import TARGETS

pytestmark = pytest.mark.slow
_A_FEW, _SEED = 4, 20_261


def files_of(name: str, seed: int, case: int) -> dict[str, bytes]:
    """The files of a case: always the same ones."""
    rng, right = np.random.default_rng([seed, case]), healthy(TARGETS[name])
    files = dict(right[rng.integers(len(right))])
    corrupted = TARGETS[name].corrupted
    names = sorted(one for one in files if corrupted is None or one.endswith(corrupted))
    for one in rng.choice(
        names, size=1 if rng.integers(4) else min(2, len(names)), replace=False
    ).tolist():
        files[one] = mutated(rng, one, files[one])
    return files


@pytest.mark.parametrize("name", TARGETS)
def test_a_few_corrupted_inputs_of_every_kind(
    server: Server, name: str, tmp_path: Path
) -> None:
    for k, files in enumerate(healthy(TARGETS[name])):
        assert (
            problem_of(
                server, TARGETS[name], files, tmp_path / f"right-{k}", right=True
            )
            is None
        )
    cases = [files_of(name, _SEED, case) for case in range(_A_FEW)]
    assert cases == [files_of(name, _SEED, case) for case in range(_A_FEW)]
    assert len({str(files) for files in cases}) > 1
    found = {
        case: problem_of(server, TARGETS[name], files, tmp_path / str(case))
        for case, files in enumerate(cases)
    }
    assert not {case: problem for case, problem in found.items() if problem is not None}


@pytest.mark.parametrize("name", TARGETS)
def test_a_minute_of_corrupted_inputs(
    server: Server, name: str, request: pytest.FixtureRequest
) -> None:
    ends, seed = (
        time.monotonic() + request.config.getoption("--fuzz-seconds"),
        request.config.getoption("--fuzz-seed"),
    )
    case, findings, keep = 0, dict[int, str](), Path("out/fuzz").absolute() / name
    while time.monotonic() < ends:
        problem = problem_of(
            server, TARGETS[name], files_of(name, seed, case), keep / str(case)
        )
        if problem is not None:  # its folder stays
            findings[case] = problem
        case += 1
    assert case > 0
    assert not findings, f"{len(findings)} of {case} cases"
