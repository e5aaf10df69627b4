"""What the installed command runs: loading everything takes a second, in which Ctrl-C must not end in a traceback."""

import sys

from fgtrack.cli.interrupts import INTERRUPTED, end_with, interrupted, watch


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
