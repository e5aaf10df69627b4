"""What the installed command runs: loading everything takes a second, in which Ctrl-C must not end in a traceback."""

import sys


def main() -> None:
    """Load the command line, run it and exit."""
    try:
        from fgtrack.cli.main import main as run
    except KeyboardInterrupt:
        print("fgtrack: error: interrupted", file=sys.stderr)
        sys.exit(130)
    run()
