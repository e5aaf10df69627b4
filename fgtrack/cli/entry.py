"""Entry point of the installed command; Ctrl-C gives one line and one exit code, even during the imports."""

import sys

from fgtrack.cli.exit_codes import INTERRUPTED


def main() -> None:
    """Load the command line, run it and exit."""
    try:
        from fgtrack.cli.main import main as run

        code = run()
    except KeyboardInterrupt:
        print("fgtrack: error: interrupted", file=sys.stderr)
        code = INTERRUPTED
    sys.exit(code)
