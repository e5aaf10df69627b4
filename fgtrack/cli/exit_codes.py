"""Exit codes of the command."""

DONE = 0
BAD_DATA = 1
BAD_CALL = 2
INTERRUPTED = 130
"""Exit code after Ctrl-C: 128 plus the number of the signal, as in shells."""
