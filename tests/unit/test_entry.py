"""The installed command: that it runs the command line, and an interrupt at any time."""

import subprocess
import sys

import pytest

#: Ctrl-C while a module loads, as an extension module in C hands it on; and in a function that C calls.
INTERRUPTED = """
import ctypes, signal, sys
from fgtrack.cli import entry
signal.signal(signal.SIGINT, signal.default_int_handler)  # which a shell may have let be ignored

class Loading:
    def find_spec(self, name, *rest):
        if name == {module!r}:
            try:
                signal.raise_signal(signal.SIGINT)
            except KeyboardInterrupt as error:
                raise {error}

sys.meta_path.insert(0, Loading())
sys.argv = ["fgtrack", *{words!r}]
entry.main()
"""
IN_A_CALLBACK = """
import ctypes, signal, sys, time
from fgtrack.cli import entry, main
signal.signal(signal.SIGINT, signal.default_int_handler)

@ctypes.CFUNCTYPE(None)
def called():
    signal.raise_signal(signal.SIGINT)

def run():
    try:
        called()
        time.sleep(60.0)
    except KeyboardInterrupt:
        return 130

main.main = run
entry.main()
"""
WHILE_LEAVING = """
import atexit, signal, sys
from fgtrack.cli import entry
signal.signal(signal.SIGINT, signal.default_int_handler)
atexit.register(lambda: signal.raise_signal(signal.SIGINT))
sys.argv = ["fgtrack", "--version"]
entry.main()
"""


def run(program: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=50.0)


@pytest.mark.parametrize("error", ["error", "ImportError('initialization failed') from None"])
@pytest.mark.parametrize(
    ("module", "words"), [("fgtrack.cli.main", []), ("fgtrack.cli.calibrate", ["info", "x"]), ("numpy", ["info", "x"])]
)
def test_an_interrupt_while_something_loads_is_one_line(module: str, words: list[str], error: str) -> None:
    done = run(INTERRUPTED.format(module=module, words=words, error=error))
    assert done.returncode == 130
    assert done.stderr.startswith("fgtrack: error: interrupted")
    assert done.stderr.count("\n") == 1


def test_an_interrupt_that_c_swallows_comes_again() -> None:
    done = run(IN_A_CALLBACK)
    assert (done.returncode, done.stderr) == (130, "")


def test_an_interrupt_after_the_end_changes_nothing() -> None:
    done = run(WHILE_LEAVING)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("fgtrack ")
