"""The installed command: that it runs the command line, and an interrupt at any time."""

import subprocess
import sys

import pytest

#: Ctrl-C while a module loads.
INTERRUPTED = """
import signal, sys
from fgtrack.cli import entry
signal.signal(signal.SIGINT, signal.default_int_handler)  # which a shell may have let be ignored

class Loading:
    def find_spec(self, name, *rest):
        if name == {module!r}:
            signal.raise_signal(signal.SIGINT)

sys.meta_path.insert(0, Loading())
sys.argv = ["fgtrack", *{words!r}]
entry.main()
"""


def run(program: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=50.0
    )


@pytest.mark.parametrize(
    ("module", "words"),
    [
        ("fgtrack.cli.main", []),
        ("fgtrack.cli.calibrate", ["info", "x"]),
        ("numpy", ["info", "x"]),
    ],
)
def test_an_interrupt_while_something_loads_is_one_line(
    module: str, words: list[str]
) -> None:
    done = run(INTERRUPTED.format(module=module, words=words))
    assert done.returncode == 130
    assert done.stderr.startswith("fgtrack: error: interrupted")
    assert done.stderr.count("\n") == 1
