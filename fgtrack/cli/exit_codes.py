"""Exit codes of the command."""

DONE, BAD_DATA, BAD_CALL = 0, 1, 2
INTERRUPTED = 130
"""Of Ctrl-C: 128 plus the number of the signal, as shells have it."""
