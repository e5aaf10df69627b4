"""The error of an input that breaks off in the middle."""

from fgtrack.core.errors import DataError


class TruncatedInput(DataError):  # noqa: N818 - it names what the input is, the readers have already given all before it
    """An input broke off; everything before the break has been yielded.

    A replay catches it, finishes the run with what there is, reports the break and exits with 1.
    """
