"""`fgtrack --max-memory GIB COMMAND`."""

import resource
import sys

import pytest

import fgtrack.cli.recordings
from fgtrack.cli.main import run


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux holds to the limit")
@pytest.mark.parametrize(("words", "gib"), [((), 4.0), (("--max-memory", "3"), 3.0)])
def test_a_command_runs_within_the_limit_and_the_caller_keeps_its_own(
    words: tuple[str, ...], gib: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = []
    monkeypatch.setattr(
        fgtrack.cli.recordings,
        "config",
        lambda: seen.append(resource.getrlimit(resource.RLIMIT_AS)[0]),
    )
    before = resource.getrlimit(resource.RLIMIT_AS)
    assert run([*words, "config"]) == 0
    assert seen == [int(gib * 2**30)]
    assert resource.getrlimit(resource.RLIMIT_AS) == before


def test_too_little_memory_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def exhausted() -> None:
        raise MemoryError

    monkeypatch.setattr(fgtrack.cli.recordings, "config", exhausted)
    assert run(["config"]) == 1
    assert capsys.readouterr().err == (
        "fgtrack: error: more memory is needed than --max-memory allows: raise the limit, or split the input\n"
    )
