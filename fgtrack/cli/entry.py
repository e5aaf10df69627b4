"""Entry point of the installed command, and Ctrl-C: one line and one exit code, at any time.

Loading everything takes a second, in which an interrupt must not end in a traceback either.
"""

import signal
import sys
from types import FrameType

INTERRUPTED = 130
"""Exit code."""
_came: list[int] = []


def watch() -> None:
    """Take note of interrupts from now on, in this process; they are raised as before.

    An extension module in which one comes while it loads turns it into an `ImportError`.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _note)


def interrupted() -> bool:
    """True if an interrupt has come since `watch`."""
    return bool(_came)


def _note(number: int, frame: FrameType | None) -> None:
    _came.append(number)
    signal.default_int_handler(number, frame)


def main() -> None:
    """Load the command line, run it and exit."""
    watch()
    try:
        from fgtrack.cli.main import main as run

        code = run()
    except (KeyboardInterrupt, Exception) as error:
        if not isinstance(error, KeyboardInterrupt) and not interrupted():
            raise
        print("fgtrack: error: interrupted", file=sys.stderr)
        code = INTERRUPTED
    sys.exit(code)
