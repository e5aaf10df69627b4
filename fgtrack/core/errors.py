"""Errors that a user sees as one line: what is wrong, where, and what to do."""


class FgtrackError(Exception):
    """Base of every error that the package raises on purpose."""


class DataError(FgtrackError):
    """An input or a run is bad (exit code 1)."""


class CallError(FgtrackError, ValueError):
    """The call or the configuration is bad (exit code 2); of a configuration file, pydantic adds the key."""
