"""Entry point of the installed command, and Ctrl-C: one line and one exit code, at any time.

Loading everything takes a second, in which an interrupt must not end in a traceback either.
"""

import atexit
import os
import signal
import sys
import threading
from contextlib import suppress
from types import FrameType

INTERRUPTED = 130
"""Exit code."""
_came: list[int] = []
_codes: list[int] = []
_AGAIN_S = 0.05


def watch() -> None:
    """Take note of interrupts from now on, in this process; they are raised as before.

    An extension module in which one comes while it loads turns it into an `ImportError`. One that comes where nothing
    can be raised, as in a function that C calls, comes again.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _note)
        sys.unraisablehook = _again
        atexit.register(_leave)  # the first registered is the last called


def interrupted() -> bool:
    """True if an interrupt has come since `watch`."""
    return bool(_came)


def end_with(code: int) -> None:
    """The command is done: an interrupt that comes now makes the end quicker, but no other one."""
    if signal.getsignal(signal.SIGINT) is _note:
        _codes.append(code)
        signal.signal(signal.SIGINT, lambda *_: os._exit(code))


def _note(number: int, frame: FrameType | None) -> None:
    _came.append(number)
    signal.default_int_handler(number, frame)


def _again(lost: "sys.UnraisableHookArgs") -> None:
    if isinstance(lost.exc_value, KeyboardInterrupt):
        here = threading.get_ident()  # of the main thread, in which interrupts come
        threading.Timer(_AGAIN_S, lambda: signal.pthread_kill(here, signal.SIGINT)).start()
    else:
        sys.__unraisablehook__(lost)


def _leave() -> None:
    """Leave with the exit code of the command, whatever comes while Python takes itself apart.

    It would kill the program where an interrupt had come into an `exec`, or comes now.
    """
    if _codes:
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError, AttributeError):  # full, closed, none
                stream.flush()
        os._exit(_codes[0])


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
    end_with(code)
    sys.exit(code)
